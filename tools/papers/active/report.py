"""The report of `mavquad paper asmf`: what it comes to, then the figures of paper 004, section 4.3, as our simulation gives them."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from mavquad import statespace
from mavquad.identify import models
from tools import page as pages
from tools.papers import asmf, common
from tools.papers.active import helicopter, quadrotor, surroundings

DT_S = 0.02
WORDS = "Guaranteed while the stated noise and rate bounds hold; the flag says when the data contradict them."
METRICS = ("rms_m", "max_m", "lat_rms", "vert_rms", "along_rms", "vel_rms", "inside_pct", "half_width", "empty", "inflations")
SHARES = ("PI", "target without f", "target without integral", "target without acceleration", "active")


def page(rows: list[common.Row], seed: int) -> str:
    """A whole page from the rows of a run (medians among them); the figures fly `seed` again."""
    lead = pages.text("Model error with bounds, live, correcting a nominal controller. " + WORDS)
    sections: list[tuple[str, Sequence[str]]] = [
        ("Medians over the seeds", [_medians(rows)]),
        ("The bounds: a quadrotor on the ellipse", _quadrotor(seed)),
        ("Hover and line with a helicopter (figures 9 to 16)", _line(seed)),
        ("Ellipse with a helicopter (figures 17 and 18)", _ellipse(seed)),
    ]
    return pages.page("Active modelling with a set-membership filter", sections, lead)


def _medians(rows: list[common.Row]) -> str:
    cells: dict[tuple[str, str], dict[str, float]] = {}
    for one in rows:
        if one["seed"] is None:
            cells.setdefault((one["scenario"], one["config"]), {})[one["metric"]] = one["value"]
    return pages.table(
        ("scenario", "config", *METRICS),
        [(s, c, *(found.get(name, math.nan) for name in METRICS)) for (s, c), found in cells.items()],
    )


def _quadrotor(seed: int) -> list[str]:
    case = asmf.quad_case("quad-ellipse")
    flown = {name: quadrotor.fly(name, case, seed) for name in ("PD", "PI", "INDI", "KF", "ASMF")}
    best = flown["ASMF"]
    t_s = DT_S * np.arange(best.p_m.shape[0])
    distance = [
        pages.line(name, t_s, np.linalg.norm(run.error_m, axis=1), colour) for colour, (name, run) in enumerate(flown.items())
    ]
    pieces = [pages.figure("Distance from the path", distance, x="time, s", y="m", linked="quad")]
    for axis, name in enumerate(("north", "east", "down")):
        traces = [
            *pages.band("published bounds", t_s, best.low[:, axis], best.high[:, axis]),
            pages.line("truth", t_s, best.f_true[:, axis], 1),
            pages.line("estimate", t_s, best.f[:, axis], 0),
        ]
        pieces.append(pages.figure(f"Model error, {name}", traces, x="time, s", y="m/s^2", linked="quad"))
    inside = {name: value for name, (value, _) in quadrotor.metrics(best).items()}
    pieces.append(
        pages.text(
            f"Truth inside the published bounds in {inside['published_inside_pct']:.1f} % of the steps; half-width"
            f" {inside['published_half_width']:.2f} m/s^2, of the ellipsoid alone {inside['half_width']:.2f} m/s^2."
        )
    )
    return pieces


def _line(seed: int) -> list[str]:
    path = surroundings.there_and_back(asmf.COURSE_RAD, DT_S)
    case = helicopter.Case(path=path)
    flown = {name: helicopter.fly(name, case, seed) for name in ("PI", "active-7.1", "active")}
    t_s = DT_S * np.arange(path.p_m.shape[0])
    course = np.array([math.cos(asmf.COURSE_RAD), math.sin(asmf.COURSE_RAD), 0.0])
    across = np.array([-course[1], course[0], 0.0])

    def of(pick: Any) -> list[Any]:
        return [pages.line(name, t_s, pick(run), i) for i, (name, run) in enumerate(flown.items())]

    def drawn(title: str, traces: list[Any], unit: str) -> str:
        return pages.figure(title, traces, x="time, s", y=unit, linked="line")

    hover = slice(0, round(50.0 / DT_S))
    nominal, best, paper = flown["PI"], flown["active"], flown["active-7.1"]
    pieces = [
        pages.figure(
            "Figure 9: hover with PI, distance from its point",
            [pages.line("PI", t_s[hover], np.linalg.norm((nominal.p_m - path.p_m)[hover], axis=1), 0)],
            x="time, s",
            y="m",
        ),
        *_mismatch(nominal, t_s),
        drawn("Figure 11: across the line", of(lambda run: (run.p_m - path.p_m) @ across), "m"),
        drawn("Figure 12: height error, down", of(lambda run: run.p_m[:, 2]), "m"),
        drawn(
            "Figure 13: speed along the line",
            [*of(lambda run: run.v_m_s @ course), pages.line("wanted", t_s, path.v_m_s @ course, 4, dash="dot")],
            "m/s",
        ),
    ]
    names = (("u", "surge", "m/s^2"), ("q", "pitch", "rad/s^2"), ("v", "sway", "m/s^2"), ("p", "roll", "rad/s^2"))
    for title, chosen in (
        ("Figure 14", ((4, "heave", "m/s^2"), (5, "yaw", "rad/s^2"))),
        ("Figure 15", tuple(enumerate(names))),
    ):
        for entry in chosen:
            index, name, unit = entry if len(entry) == 3 else (entry[0], entry[1][1], entry[1][2])
            centre, half = best.f[:, index], best.half_width[:, index]
            traces = [
                *pages.band("bounds of the ellipsoid", t_s, centre - half, centre + half),
                pages.line("truth", t_s, best.f_true[:, index], 1),
                pages.line("estimate", t_s, centre, 0),
            ]
            pieces.append(drawn(f"{title}: model error in {name}", traces, unit))
    labels = ("pitch set-point, rad", "roll set-point, rad", "lon", "lat", "ped", "col")
    traces = [pages.line(label, t_s, paper.correction[:, i], i) for i, label in enumerate(labels)]
    pieces.append(drawn("Figure 16: corrections of the paper's structure", traces, "rad, share of full stick"))
    return pieces


def _mismatch(nominal: helicopter.Flown, t_s: np.ndarray) -> list[str]:
    """Figure 10: how far 2 s predictions of the hover model stray, slow and fast, as model error accumulated over them."""
    model, n = models.ref_13(), round(2.0 / DT_S)
    a_d, b_d = statespace.zoh(model.a, np.eye(13), DT_S)
    rows = [model.states.index(name) for name in ("u", "q", "v", "p", "w", "r")]
    strayed = []
    for first in range(0, t_s.size - n, n):
        error = np.zeros(13)
        for k in range(first, first + n):
            push = np.zeros(13)
            push[rows] = nominal.f_true[k]
            error = a_d @ error + b_d @ push
        strayed.append(float(np.hypot(error[0], error[5])))
    at = t_s[: len(strayed) * n : n]
    speed = np.linalg.norm(nominal.v_m_s, axis=1)[: len(strayed) * n : n]
    traces = [pages.dots("2 s predictions", speed, strayed, 0, [f"from {t:.0f} s" for t in at])]
    title = "Figure 10: how far the hover model's prediction of the speed strays in 2 s, against speed"
    return [pages.figure(title, traces, x="speed, m/s", y="m/s", hovermode="closest")]


def _ellipse(seed: int) -> list[str]:
    case = asmf.heli_case("heli-ellipse")
    flown = {name: helicopter.fly(name, case, seed) for name in dict.fromkeys((*SHARES, "active-7.1"))}
    track = case.path.p_m

    def plan_view(title: str, names: Sequence[str]) -> str:
        traces = [pages.line("path", track[:, 1], track[:, 0], 4, dash="dot", points=10**6)]
        traces += [
            pages.line(name, flown[name].p_m[:, 1], flown[name].p_m[:, 0], i, points=10**6) for i, name in enumerate(names)
        ]
        axis = {"scaleanchor": "x", "title": {"text": "north, m"}}
        return pages.figure(title, traces, x="east, m", height=520, hovermode="closest", yaxis=axis)

    found = {name: helicopter.metrics_ellipse(run, case.path) for name, run in flown.items()}
    return [
        plan_view("Figure 17: PI", ["PI"]),
        plan_view("Figure 18: corrected", ["active-7.1", "active"]),
        pages.text("What each part contributes: cross-track error on the ellipse, greatest and rms."),
        pages.table(
            ("config", "max, m", "rms, m", "height rms, m"),
            [(name, m["max_m"][0], m["lat_rms"][0], m["vert_rms"][0]) for name, m in found.items()],
        ),
    ]
