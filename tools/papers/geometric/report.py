"""The page: figures 6 to 9 of the paper, chattering, noise, gaps and spin, and all tables."""

from collections.abc import Sequence

import numpy as np

from mavquad.estimate import rate_filters
from tools import page as html
from tools.papers.common import Row
from tools.papers.geometric import orders, setup, words
from tools.papers.geometric.runs import run
from tools.papers.geometric.setup import IDENTITY, ZERO

SHOWN = ("G1", "G5", "G7", "G9", "B2b", "B3", "online")


def page(rows: Sequence[Row]) -> str:
    """The whole page as HTML."""
    found = [(words.TITLES[s], [html.table(*words.pivot(rows, s))]) for s in words.TITLES if words.pivot(rows, s)[1]]
    sections = [
        ("What holds", [html.text(line) for line in words.claims(rows)]),
        ("The paper's figures", paper_figures()),
        ("Chattering", [chattering()]),
        ("Noise", [noise(rows)]),
        ("Gaps", [gap()]),
        ("Spin", [spin()]),
        *found,
    ]
    return html.page("Body rates without a gyro", sections)


def paper_figures() -> list[str]:
    """Figures 6 (attitude), 7 (rates), 8 (observed rates) and 9 (filtered against true, one panel per axis)."""
    source = setup.truth()
    w, _ = run(setup.configurations()["G1"], setup.stimulus(source), IDENTITY, ZERO)
    filtered = rate_filters.low_pass(w, 5.0, source.h)
    axes = list(enumerate("xyz"))
    attitude = [html.line(f"q{i}", source.t, source.q[:, i], i) for i in range(4)]
    rates = [html.line(a, source.t, source.w[:, i], i) for i, a in axes]
    observed = [html.line(a, source.t, w[:, i], i) for i, a in axes]
    panels = [
        html.figure(
            f"Fig. 9 {a.upper()}: observed and filtered at 5 Hz, and true",
            [html.line("observed", source.t, filtered[:, i], 0), html.line("true", source.t, source.w[:, i], 1, dash="dash")],
            x="t, s",
            y="rad/s",
            height=240,
            linked="paper",
        )
        for i, a in axes
    ]
    return [
        html.figure("Fig. 6: attitude", attitude, x="t, s", linked="paper"),
        html.figure("Fig. 7: body rates", rates, x="t, s", y="rad/s", linked="paper"),
        html.figure("Fig. 8: observed body rates (G1, the paper's settings)", observed, x="t, s", y="rad/s", linked="paper"),
        *panels,
    ]


def chattering() -> str:
    """One second of the error about x."""
    source = setup.truth()
    keep = (source.t >= 10.0) & (source.t <= 11.0)
    lines = []
    for colour, name in enumerate(("G1", "G3", "G4", "G6", "G7")):
        w, _ = run(setup.configurations()[name], setup.stimulus(source), IDENTITY, ZERO)
        lines.append(html.line(name, source.t[keep], (w - source.w)[keep, 0], colour))
    return html.figure("Error of the observed rate about x", lines, x="t, s", y="rad/s")


def noise(rows: Sequence[Row]) -> str:
    """Error against noise, torque unknown."""
    lines = []
    levels = (0.0, 0.1, 0.5, 1.0)
    for colour, name in enumerate(SHOWN):
        values = [words.value(rows, "8.3", name, "raw_rms", noise_deg=n, torque="unknown") for n in levels]
        lines.append(html.line(name, levels, values, colour))
    return html.figure("Rate error, torque unknown", lines, x="noise, deg per axis", y="rad/s rms")


def gap() -> str:
    """One second without samples, torque unknown."""
    source = setup.truth()
    stimulus = setup.stimulus(source, torque_scale=0.0, gap_s=(8.0, 1.0))
    keep = (source.t >= 7.0) & (source.t <= 12.0)
    lines = []
    for colour, name in enumerate(SHOWN):
        w, _ = run(setup.configurations()[name], stimulus, IDENTITY, ZERO)
        lines.append(html.line(name, source.t[keep], np.linalg.norm(w - source.w, axis=1)[keep], colour))
    return html.figure("Rate error around a gap from 8 to 9 s, torque unknown", lines, x="t, s", y="rad/s")


def spin() -> str:
    """Bias of each map, measured and by theory, at a tick of 10 ms."""
    spins = np.linspace(5.0, 40.0, 8)
    traces = []
    for colour, name in enumerate(orders.MAPS):
        traces.append(html.line(f"{name}, theory", spins, [orders.spin_theory(name, 0.01, s) for s in spins], colour))
        traces.append(html.dots(f"{name}, measured", spins, [orders.spin_bias(name, 0.01, float(s)) for s in spins], colour))
    return html.figure("Bias of the observed rate in a constant spin", traces, x="spin, rad/s", y="rad/s")
