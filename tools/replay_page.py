"""The page of a replayed log: what anyone's flight says to this companion's observers, and what it would have commanded."""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mavquad.errors import LogError
from mavquad.link.columns import Log
from mavquad.plan_file import made_by
from tools import link_page
from tools import page as html
from tools.observers import Reference, Run
from tools.recorded import Flown, wind
from tools.what_if import WhatIf

Array = NDArray[Any]
_TIME = "seconds after the first attitude"
_AXES = ("north", "east", "down")
_COLOURS = (0, 1, 2, 3, 6, 4)


class Material(NamedTuple):
    """Everything there is to show of one log."""

    flight: Flown
    log: Log | None  # of a tlog
    survey: dict[str, Any]  # tools/survey: what the log holds and the ways to the body rates
    rates: dict[str, tuple[Array, Array]]  # by name: vehicle time (n,), rates (n, 3)
    runs: Sequence[Run]
    reference: Reference | None
    compared: Sequence[dict[str, Any]]
    what_ifs: Sequence[WhatIf]
    differences: Sequence[dict[str, Any]]
    command: Sequence[str]  # as it was typed


def write(m: Material, path: Path) -> Path:
    """The page, written. Raises LogError where it cannot be."""
    sections = [
        ("What it would have commanded", _commands(m)),
        ("Disturbance", _disturbance(m)),
        ("Wind", _wind(m)),
        ("Body rates", _rates(m)),
        ("Link", link_page.section(m.log, _log_seconds(m)) if m.log is not None else _tables(m)),
        ("What was said, and when", _events(m)),
        ("To repeat this", _repeat(m)),
    ]
    try:
        path.write_text(html.page(f"Replay of {m.flight.recording.path.name}", sections, _lead(m)), encoding="utf-8")
    except OSError as error:
        raise LogError(f"{path}: cannot be written: {error.strerror}; choose another with --out") from None
    return path


def _log_seconds(m: Material) -> Any:
    """Log stamps as the page's time: by when the attitudes arrived."""
    arrival, t_us = m.flight.attitude.arrival_us, m.flight.attitude.columns[0]
    offset = float(np.median(arrival - t_us)) if m.flight.recording.format == "tlog" else 0.0
    return lambda stamps: m.flight.seconds(np.asarray(stamps, float) - offset)


# ---- the first screen -----------------------------------------------------------------------------------------------------
def _lead(m: Material) -> str:
    flight, r = m.flight, m.survey["rates"]
    span_s = 1e-6 * (flight.span_us[1] - flight.span_us[0])
    boxes = [
        ("replayed", f"{span_s:.1f} s", f"{flight.span}; the log: {m.survey['messages']} messages in {m.survey['span_s']:.1f} s"),
        ("attitude", f"{flight.attitude.rate_hz():.0f} Hz", flight.attitude.source),
        ("position", f"{flight.position.rate_hz():.0f} Hz" if flight.position else "none", flight.position.source if flight.position else ""),
        ("carried by", f"{100.0 * flight.hover_thrust:.0f} % thrust", f"by {flight.command.source}" if flight.command else "nothing says the thrust"),
    ]  # fmt: skip
    if m.log is not None:
        lost = link_page.losses(m.log)
        received, missing = (sum(v[i] for v in lost.values()) for i in (0, 1))
        silences = sum(h.silences for h in link_page.health(m.log))
        boxes.insert(
            1,
            (
                "link",
                f"{100.0 * missing / max(1, received + missing):.2f} % lost",
                f"{missing} messages; {silences} silences > 1 s",
            ),
        )
    for one in m.runs:
        use = flight.inside(one.observed.t_us) & np.isfinite(one.observed.f_ned_m_s2).all(axis=1)
        if use.any() and one.label.partition(":")[0] in ("asmf", "joint", "eskf", "leso"):
            size = np.linalg.norm(one.observed.f_ned_m_s2[use], axis=1)
            boxes.append(
                (f"disturbance, {one.label}", f"{np.median(size):.2f} m/s^2", f"median; largest {size.max():.2f} m/s^2")
            )
    pieces = [html.text(_verdict(m), "verdict"), html.cards(boxes)]
    how = (
        "How we know: the vehicle's own telemetry, fed to this companion's observers as it would have arrived live."
        f" Body rates are judged against {r['reference']}."
        if "reference" in r
        else "How we know: the vehicle's own telemetry."
    )
    if not flight.vehicle_source:
        how += (
            " Nobody said which vehicle this is: mass and drag are those of the x500, which matters for wind and bounds only;"
            " `mavquad identify` fits an airframe file to a log, `--airframe` takes it."
        )
    pieces.append(html.text(how, "quiet"))
    pieces += [html.text(f"Note: {note}.", "quiet") for note in flight.notes]
    return "".join(pieces) + _compared(m)


def _verdict(m: Material) -> str:
    r = m.survey["rates"]
    if "ways" not in r:
        return f"This log holds no body rates: {r['problem']}."
    best = min((w for w in r["ways"] if w["method"] not in ("rates the autopilot reports",)), key=lambda w: sum(w["rms_rad_s"]))
    told = [w for w in r["ways"] if w["method"] == "rates the autopilot reports"]
    words = f"Body rates from attitude alone: {best['method']} is {_rad(best)} rad/s off"
    return f"{words}; the autopilot's own report {_rad(told[0])}." if told else f"{words}."


def _rad(way: dict[str, Any]) -> str:
    return f"{float(np.sqrt(np.mean(np.square(way['rms_rad_s'])))):.4f}"


def _compared(m: Material) -> str:
    if not m.compared:
        return ""
    assert m.reference is not None
    rows = []
    for row in m.compared:
        cells: list[Any] = [row["observer"], *row["disturbance_rms_m_s2"], *row["velocity_rms_m_s"]]
        rows.append([*cells, row.get("inside_bounds_pct", float("nan")), row.get("half_width_m_s2", float("nan"))])
    heads = [
        "rms against the reference",
        *(f"f {a}, m/s^2" for a in "ned"),
        *(f"v {a}, m/s" for a in "ned"),
        "inside bounds, %",
        "half-width, m/s^2",
    ]
    return html.text(f"Compared with: {m.reference.name}.", "quiet") + html.table(heads, rows)


# ---- figures ------------------------------------------------------------------------------------------------------------------
def _commands(m: Material) -> list[str]:
    flight, command = m.flight, m.flight.command
    if not m.what_ifs:
        return [html.text("No position is known, or no path: nothing can be commanded.", "quiet")]
    pieces = [
        html.text(
            f"Open loop: the vehicle did what it did. What was wanted: {m.what_ifs[0].wanted}. An integral learns nothing open"
            " loop: of pid the part that holds against a steady wind is missing here, not of controllers with an observer.",
            "quiet",
        )
    ]
    for i, name in enumerate(("roll", "pitch")):
        traces = []
        if command is not None and np.isfinite(command.attitude_rad[:, i]).any():
            traces.append(
                html.line(
                    f"was commanded ({command.source})",
                    flight.seconds(command.t_us),
                    np.degrees(command.attitude_rad[:, i]),
                    5,
                    width=2.5,
                )
            )
        else:
            from tools.recorded import euler

            t_us, q, _ = flight.attitude.columns
            traces.append(html.line("attitude as flown", flight.seconds(t_us), np.degrees(euler(q)[:, i]), 5, width=2.5))
        for k, what in enumerate(m.what_ifs):
            traces.append(
                html.line(what.label, flight.seconds(what.t_us), np.degrees(what.attitude_rad[:, i]), _COLOURS[k % 6])
            )
        pieces.append(html.figure(name.capitalize(), traces, x=_TIME, y="deg", height=240, linked="time"))
    traces = [
        html.line(what.label, flight.seconds(what.t_us), what.thrust_m_s2, _COLOURS[k % 6]) for k, what in enumerate(m.what_ifs)
    ]
    if command is not None:
        traces.insert(
            0, html.line(f"was commanded ({command.source})", flight.seconds(command.t_us), command.thrust_m_s2, 5, width=2.5)
        )
    pieces.append(html.figure("Specific thrust", traces, x=_TIME, y="m/s^2", height=240, linked="time"))
    heads = ["difference from what was, rms", "roll, deg", "pitch, deg", "specific thrust, m/s^2", "steps"]
    rows = [
        [d["what_if"], d.get("roll_rms_deg"), d.get("pitch_rms_deg"), d.get("thrust_rms_m_s2"), d["steps"]]
        for d in m.differences
    ]
    return [*pieces, html.table(heads, rows)]


def _disturbance(m: Material) -> list[str]:
    flight, figures = m.flight, []
    if not m.runs:
        return [html.text("No position in this log: no disturbance can be told from it.", "quiet")]
    for i, name in enumerate(_AXES):
        traces: list[Any] = []
        for one in m.runs:
            o, known = one.observed, one.observed.low_m_s2[:, i]
            if np.isfinite(known).any():
                what = "bounds" if np.isfinite(o.guaranteed).any() else "3 sigma"
                traces += html.band(f"{what}, {one.label}", flight.seconds(o.t_us), known, o.high_m_s2[:, i])
        if m.reference is not None:
            traces.append(html.line("reference", flight.seconds(m.reference.t_us), m.reference.f_ned_m_s2[:, i], 5, width=2.5))
        for k, one in enumerate(m.runs):
            traces.append(
                html.line(one.label, flight.seconds(one.observed.t_us), one.observed.f_ned_m_s2[:, i], _COLOURS[k % 6])
            )
        figures.append(html.figure(f"Disturbance {name}", traces, x=_TIME, y="m/s^2", height=260, linked="time"))
    note = (
        "What acts beside gravity and the commanded thrust, drag included: v' = g - thrust along the body + f."
        " The bounds of asmf hold by guarantee while the vehicle's stated noise and rate bounds do; the eskf's 3 sigma are its own belief."
    )
    pieces = [html.text(note, "quiet"), *figures]
    if m.reference is not None:
        pieces.append(html.text(f"Reference: {m.reference.name}.", "quiet"))
    for one in m.runs:
        use = flight.inside(one.observed.t_us) & np.isfinite(one.observed.guaranteed)
        if use.any():
            share = 100.0 * float(np.mean(one.observed.guaranteed[use]))
            whose = flight.vehicle_source or "the x500, not of this vehicle"
            pieces.append(
                html.text(
                    f"{one.label}: the data agree with the stated bounds (of {whose}) in {share:.1f} % of the steps.", "quiet"
                )
            )
    return pieces


def _wind(m: Material) -> list[str]:
    flight, figures = m.flight, []
    whose = flight.vehicle_source or "an x500, which this vehicle may not be"
    if flight.vehicle.drag.linear_n_s_m[0] <= 0.0 and flight.vehicle.drag.quadratic_n_s2_m2[0] <= 0.0:
        return [html.text("The airframe has no drag in its file: no wind can be told from the disturbance.", "quiet")]
    said = _autopilots_wind(m)
    for i, name in enumerate(_AXES[:2]):
        traces: list[Any] = []
        for one in m.runs:
            o = one.observed
            if np.isfinite(o.low_m_s2).any():
                low, high = (
                    wind(flight.vehicle, o.v_ned_m_s, f)[:, i]
                    for f in (_with(o.f_ned_m_s2, o.low_m_s2, i), _with(o.f_ned_m_s2, o.high_m_s2, i))
                )
                traces += html.band(f"from the bounds of {one.label}", flight.seconds(o.t_us), low, high)
        for k, one in enumerate(m.runs):
            through = wind(flight.vehicle, one.observed.v_ned_m_s, one.observed.f_ned_m_s2)[:, i]
            traces.append(html.line(one.label, flight.seconds(one.observed.t_us), through, _COLOURS[k % 6]))
        if said is not None:
            traces.append(html.line("the autopilot's own (WIND)", said[0], said[1][:, i], 5, width=2.5))
        figures.append(html.figure(f"Wind towards {name}", traces, x=_TIME, y="m/s", height=260, linked="time"))
    note = f"The wind that gives this disturbance by the drag of {whose}: a wrong thrust scale or a tilted sensor reads as wind too."
    return [html.text(note, "quiet"), *figures] if m.runs else [html.text("No position in this log: no wind.", "quiet")]


def _with(f: Array, end: Array, axis: int) -> Array:
    """f with one axis taken from elsewhere."""
    out = f.copy()
    out[:, axis] = end[:, axis]
    return out


def _autopilots_wind(m: Material) -> tuple[Array, Array] | None:
    """The autopilot's own estimate by its WIND message: (seconds, towards north and east)."""
    found = m.log.find("WIND") if m.log is not None else []
    if m.log is None or not found:
        return None
    rows = m.log.rows(found[0])
    towards = np.radians(rows["direction"].astype(float)) + np.pi
    vector = rows["speed"].astype(float)[:, None] * np.column_stack([np.cos(towards), np.sin(towards)])
    return _log_seconds(m)(rows["t_us"]), vector


def _rates(m: Material) -> list[str]:
    r, figures = m.survey["rates"], []
    if "ways" not in r:
        return [html.text(f"No body rates: {r['problem']}.", "quiet")]
    for i, axis in enumerate("xyz"):
        traces = []
        for k, (name, (t_us, w)) in enumerate(m.rates.items()):
            traces.append(html.line(name, m.flight.seconds(t_us), w[:, i], (5, 1, 0, 2, 3, 6)[k % 6]))
        figures.append(html.figure(f"Body rate {axis}", traces, x=_TIME, y="rad/s", height=240, linked="time"))
    rows = [[w["method"], w["torque"], *w["rms_rad_s"]] for w in r["ways"]]
    heads = ["way to the body rates", "torque", "rms x, rad/s", "rms y, rad/s", "rms z, rad/s"]
    words = f"Against {r['reference']}, {r['from_s']:.1f} to {r['to_s']:.1f} s ({r['span']})."
    return [
        *figures,
        html.text(words, "quiet"),
        html.table(heads, rows),
        *([html.text(r["note"], "quiet")] if r["note"] else []),
    ]


def _tables(m: Material) -> list[str]:
    rows = [[s["name"], s["count"], s["rate_hz"]] for s in m.survey["streams"]]
    note = "A log kept aboard: nothing went over a link."
    return [html.text(note, "quiet"), html.table(["table", "rows", "rate, Hz"], rows)]


def _events(m: Material) -> list[str]:
    if m.log is None:
        return [html.text("Only a tlog holds what was said over the link.", "quiet")]
    seconds, said, modes = _log_seconds(m), [], []
    for stream in m.log.find("STATUSTEXT"):
        rows = m.log.rows(stream)
        said += [
            (float(t), f"{stream.system}/{stream.component}", row["text"].decode("utf-8", "replace"))
            for t, row in zip(seconds(rows["t_us"]), rows, strict=True)
        ]
    for stream in m.log.find("HEARTBEAT", component=1):
        rows = m.log.rows(stream)
        t, end = seconds(rows["t_us"]), float(seconds(rows["t_us"][-1:])[0])
        for name, key in (("armed", (rows["base_mode"] & 128) // 128), ("mode", rows["custom_mode"].astype(np.int64))):
            edges = np.concatenate([[0], np.flatnonzero(np.diff(key)) + 1])
            for k, at in enumerate(edges[:60]):
                to = float(t[edges[k + 1]]) if k + 1 < len(edges) else end
                what = ("disarmed", "armed")[int(key[at])] if name == "armed" else f"custom mode {int(key[at])}"
                modes.append(
                    (
                        f"{stream.system}/{stream.component} {name}",
                        float(t[at]),
                        to,
                        what,
                        (5, 0)[int(key[at])] if name == "armed" else k % 5,
                    )
                )
    figure = html.figure(
        "Armed, and the autopilot's modes", html.spans(modes), x=_TIME, height=200, linked="time", barmode="overlay", hovermode="closest", yaxis={"automargin": True}
    )  # fmt: skip
    rows_said = [[f"{t:.2f}", who, words] for t, who, words in sorted(said)[:400]]
    return [*([figure] if modes else []), html.table(["s", "from", "said"], rows_said)]


def _repeat(m: Material) -> list[str]:
    rows = [[key, value] for key, value in made_by().items() if key != "cpu_features"]
    return [html.code("mavquad replay " + shlex.join(m.command)), html.table(["made by", ""], rows)]
