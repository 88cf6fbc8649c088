"""The IADRC experiments as one page: figures 2, 3, 5 and table 2 of the paper, every table, what reproduces and what does not."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tools import page
from tools.papers.common import Row
from tools.papers.joint_observer import cases, runs
from tools.papers.joint_observer.flight import Run

SHOWN = (("ADRC", 1), ("IADRC-P", 3), ("IADRC-R", 0))
DEG = 180.0 / math.pi
Medians = dict[tuple[str, str, str], float]


def write(path: Path, middle: list[Row], seeds: list[int]) -> None:
    """Write the page. `middle` are median rows; a figure whose scenario was not run is left out."""
    found: Medians = {(r["scenario"], r["config"], r["metric"]): r["value"] for r in middle}
    have = {scenario for scenario, _, _ in found}
    sections: list[tuple[str, list[str]]] = []
    if {("S1", name, "zdev") for name, _ in SHOWN} <= found.keys():
        sections.append(("Table 2: ADRC and IADRC", table_2(found)))
    figures: tuple[tuple[str, str, Callable[[int], list[str]]], ...] = (
        ("S1", "Figure 2: noise and square waves in a hover", figure_2),
        ("S3", "Figure 3: a rectangle with a wrong model in wind", figure_3),
        ("S4", "Figure 5: a bench, blown and struck", figure_5),
    )
    sections += [(head, draw(seeds[0])) for scenario, head, draw in figures if scenario in have]
    for scenario in dict.fromkeys(r["scenario"] for r in middle):
        sections.append((f"{scenario}: medians of seeds {_said(seeds)}", [medians_table(scenario, middle)]))
    lead = page.text(
        "Active disturbance rejection with a joint observer and feed-forward (Xiao & Tong 2023), rebuilt and measured."
    )
    lines = verdicts(found)
    if lines:
        sections.insert(
            0, ("What reproduces and what does not", [page.table(("claim of the paper", "here", "verdict"), lines)])
        )
    path.write_text(page.page("mavquad paper iadrc", sections, lead), encoding="utf-8")


def _said(seeds: list[int]) -> str:
    run = seeds == list(range(seeds[0], seeds[0] + len(seeds)))
    return f"{seeds[0]}-{seeds[-1]}" if run and len(seeds) > 1 else ", ".join(map(str, seeds))


def verdicts(found: Medians) -> list[tuple[str, str, str]]:
    """Each claim of the paper beside the figure measured, and whether it holds."""

    def pair(scenario: str, metric: str, config: str = "IADRC-R", base: str = "ADRC") -> tuple[float, float] | None:
        a, b = found.get((scenario, base, metric)), found.get((scenario, config, metric))
        return None if a is None or b is None else (a, b)

    claims: tuple[tuple[str, str, str, str, str, Callable[[float, float], bool]], ...] = (
        ("phase lag of z falls from 0.24 to 0.10 s", "S1", "lag_z", "s", "IADRC-R", lambda a, b: b < 0.6 * a),
        ("phase lag of roll falls from 0.27 to 0.12 s", "S1", "lag_phi", "s", "IADRC-R", lambda a, b: b < 0.6 * a),
        ("smaller deviation of z under square waves", "S1", "zdev", "m", "IADRC-R", lambda a, b: b < 0.5 * a),
        ("roll amplitude falls 2.7 times (paper's gains)", "S1-papergain", "phi2", "deg", "IADRC-R", lambda a, b: b < a / 2.5),
        ("the same with the paper's sensors only", "S1-papergain", "phi2", "deg", "IADRC-P", lambda a, b: b < a / 2.5),
        (
            "roll amplitude in noise falls from 0.65 to 0.24 deg, rates measured",
            "S1",
            "phi1",
            "deg",
            "IADRC-R",
            lambda a, b: b < a,
        ),
        ("the same with the paper's sensors only", "S1", "phi1", "deg", "IADRC-P", lambda a, b: b < a),
        ("observer error of the roll rate falls", "S1", "o_rate", "deg/s", "IADRC-R", lambda a, b: b < 0.5 * a),
        ("the same with the paper's sensors only", "S1", "o_rate", "deg/s", "IADRC-P", lambda a, b: b < 0.5 * a),
        ("back on the rectangle's path within 2 s of a corner", "S3", "settle", "s", "IADRC-R", lambda a, b: b < 2.0),
        ("attitude within about 2 deg of its reference", "S3", "att_max", "deg", "IADRC-R", lambda a, b: b < 2.0),
        ("smaller deflection in the wind on the bench", "S4", "wind_rms", "deg", "IADRC-R", lambda a, b: b < 0.6 * a),
        ("quick recovery from a blow", "S4", "recovery", "s", "IADRC-R", lambda a, b: b < a),
    )
    rows = []
    for claim, scenario, metric, unit, config, holds in claims:
        values = pair(scenario, metric, config)
        if values is not None:
            said = f"{metric} {scenario}: ADRC {values[0]:.3g}, {config} {values[1]:.3g} {unit}"
            rows.append((claim, said, "reproduces" if holds(*values) else "does not reproduce"))
    return rows


def table_2(found: Medians) -> list[str]:
    """The paper's table beside ours. Its metres belong to a disturbance added to the output, not to a force."""

    def value(config: str, metric: str) -> float:
        return found.get(("S1", config, metric), math.nan)

    rows = [("ADRC, paper", 5.02, 0.24, 0.65, 0.27), ("IADRC, paper", 4.42, 0.10, 0.24, 0.12)]
    for name, _ in SHOWN:
        rows.append((name, 3.0 + value(name, "zdev"), value(name, "lag_z"), value(name, "phi1"), value(name, "lag_phi")))
    heads = ("", "z, largest, m", "z lag, s", "roll in noise, largest, deg", "roll lag, s")
    note = "The paper's 5 m in a 3 m hover is what a step added to the output would give; here forces and torques disturb."
    return [page.table(heads, rows), page.text(note, "quiet")]


def _flown(scenario: str, seed: int) -> tuple[np.ndarray, np.ndarray, list[tuple[str, int, Run]]]:
    """(time, disturbance, what was flown by each configuration shown)."""
    where = cases.SCENARIOS[scenario]
    flights = [(name, colour, *runs.flown(where, cases.find(scenario, name), seed)) for name, colour in SHOWN]
    return cases.times(where), flights[0][3], [(name, colour, run) for name, colour, run, _ in flights]


def figure_2(seed: int) -> list[str]:
    """Height and roll; observer errors; the disturbance and its estimates."""
    t, d, flights = _flown("S1", seed)

    def of(value: Callable[[Run], np.ndarray]) -> list[object]:
        return [page.line(name, t, value(run), colour, width=1.0) for name, colour, run in flights]

    truth = [page.line("true", t, d[:, 2], 5, dash="dot")]
    return [
        page.figure("2a: height", of(lambda r: -r.truth[:, 2]), x="s", y="m", linked="2"),
        page.figure("2a: roll", of(lambda r: DEG * r.truth[:, 6]), x="s", y="deg", linked="2"),
        page.figure("2b: error of the roll used", of(lambda r: DEG * (r.used - r.truth)[:, 6]), x="s", y="deg", linked="2"),
        page.figure(
            "2b: error of the roll rate used", of(lambda r: DEG * (r.used - r.truth)[:, 9]), x="s", y="deg/s", linked="2"
        ),
        page.figure("disturbance of z, estimated", truth + of(lambda r: r.f[:, 2]), x="s", y="m/s²", linked="2"),
    ]


def figure_3(seed: int) -> list[str]:
    """Position over time, attitude against its reference, the path in space."""
    t, _, flights = _flown("S3", seed)
    wanted = cases.reference(cases.SCENARIOS["S3"])
    name, colour, best = flights[-1]
    place = [page.line(f"{axis} wanted", t, wanted[:, i], 5, dash="dot") for i, axis in enumerate("xy")]
    place += [page.line(f"{axis} {name}", t, best.truth[:, i], colour + i) for i, axis in enumerate("xy")]
    error = [page.line(n, t, np.hypot(*(r.truth[:, :2] - wanted[:, :2]).T), c, width=1.0) for n, c, r in flights]
    roll = [page.line("reference", t, DEG * best.reference[:, 0], 5), page.line("roll", t, DEG * best.truth[:, 6], colour)]
    paths = [("wanted", wanted[:, :3], 5), *((n, r.truth[:, :3], c) for n, c, r in flights)]
    return [
        page.figure("3a: position", place, x="s", y="m", linked="3"),
        page.figure("3a: horizontal error", error, x="s", y="m", linked="3"),
        page.figure(f"3b: roll of {name}", roll, x="s", y="deg", linked="3"),
        page.path3d("3c: path", paths),
    ]


def figure_5(seed: int) -> list[str]:
    """Roll and pitch on the bench."""
    t, _, flights = _flown("S4", seed)
    return [
        page.figure(
            f"5: {axis}",
            [page.line(n, t, DEG * r.truth[:, i], c, width=1.0) for n, c, r in flights],
            x="s",
            y="deg",
            linked="5",
        )
        for axis, i in (("roll", 6), ("pitch", 7))
    ]


def medians_table(scenario: str, middle: list[Row]) -> str:
    """One line per configuration; "never" where a time was not reached."""
    here = [r for r in middle if r["scenario"] == scenario]
    metrics = list(dict.fromkeys(r["metric"] for r in here))
    units = {r["metric"]: r["unit"] for r in here}
    values = {(r["config"], r["metric"]): r["value"] for r in here}
    rows = []
    for name in dict.fromkeys(r["config"] for r in here):
        cells = [values.get((name, m), math.nan) for m in metrics]
        rows.append((name, *("never" if x == math.inf else "-" if math.isnan(x) else f"{x:.3g}" for x in cells)))
    return page.table(("", *(f"{m}, {units[m]}" for m in metrics)), rows)
