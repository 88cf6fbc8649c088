"""mavquad report: a flight's run folder, or a campaign's results, as one page: how it went, how we know, compared with what.

Example:
  mavquad report runs/20250101-120000-circle-7
  mavquad report runs/20250101-120000-circle-7 --out circle.html
  mavquad report reference.sqlite --baseline pid
"""

import argparse
import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mavquad import config
from mavquad.errors import LogError
from mavquad.link.columns import Log
from tools import page as html
from tools import score
from tools.trace import Array, Trace, read_trace

_AXES = (("n", "north"), ("e", "east"), ("d", "down"))
_TIME = "vehicle time, s"
_ARROWS = 14


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of a report."""
    parser.add_argument("run", type=Path, help="a run folder, or the SQLite file of a campaign")
    parser.add_argument("--out", type=Path, metavar="FILE", help="where to write it (default: report.html in the folder)")
    parser.add_argument("--baseline", metavar="VARIANT", help="of a campaign: what the others are compared with (default: pid)")


def run(args: argparse.Namespace) -> int:
    """Write the page and say where it lies."""
    if args.run.is_file():
        from tools import campaign_report

        print(campaign_report.write(args.run, args.out, args.baseline))
    else:
        print(flight(args.run, args.out))
    return 0


class Material(NamedTuple):
    """What a run folder holds."""

    run: Path
    result: dict[str, Any]  # summary.json
    trace: Trace
    truth: score.Truth
    sitl: dict[str, Any]  # sitl.toml
    made_by: dict[str, str]
    companion: dict[str, Any]  # companion.json
    texts: list[tuple[float, str, str]]  # vehicle time [s], who, what
    gyro: Any  # HIGHRES_IMU columns, or None


def flight(run: Path, out: Path | None = None) -> Path:
    """The page of one flight, written. Raises LogError where the folder is no whole flight."""
    m = _read(run)
    title = f"{m.result['scenario']}, seed {m.result['seed']}: {m.result['controller']} on {m.result['vehicle']} with {m.result['personality']}"
    sections = [
        ("Path", [_space(m)]),
        ("Position", _position(m)),
        ("Attitude and body rates", [*_attitude(m), *_rates(m)]),
        ("Disturbance", _disturbance(m)),
        ("What happened when", _timeline(m)),
        ("Speed of the companion", _latency(m)),
        ("To repeat this flight", _repeat(m)),
    ]
    path = out or run / "report.html"
    try:
        path.write_text(html.page(title, sections, _lead(m)), encoding="utf-8")
    except OSError as error:
        raise LogError(f"{path}: cannot be written: {error.strerror}") from None
    return path


def _read(run: Path) -> Material:
    try:
        result = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise LogError(f"{run / 'summary.json'}: {error}; expected the run folder of a flight") from None
    log = Log(run / "flight.tlog")
    gyro = log.find("HIGHRES_IMU")
    return Material(
        run,
        result,
        read_trace(run / "flight.trace"),
        score.truth(Log(run / "sitl.tlog")),
        config.read(run / "sitl.toml"),
        config.read(run / "plan.toml").get("made_by", {}),
        json.loads((run / "companion.json").read_text(encoding="utf-8") or "{}"),
        _texts(log),
        log.rows(gyro[0]) if gyro else None,
    )


def _texts(log: Log) -> list[tuple[float, str, str]]:
    """Every STATUSTEXT with the log's time since its start."""
    start = int(log.t_us[0])
    found = []
    for stream in log.find("STATUSTEXT"):
        for row in log.rows(stream):
            words = row["text"].decode("utf-8", "replace")
            found.append((1e-6 * (int(row["t_us"]) - start), f"{stream.system}/{stream.component}", words))
    return sorted(found)


# ---- the first screen ---------------------------------------------------------------------------------------------------
def _lead(m: Material) -> str:
    r = m.result
    good = r["ok"]
    verdict = "The flight went well." if good else f"The flight did not go as it should: {'; '.join(r['failures'])}."
    rmse, latency = r.get("rmse_m") or {}, r.get("latency_us") or {}
    boxes = [
        (
            "position rmse",
            f"{_n(rmse.get('position'))} m",
            f"n {_n(rmse.get('n'))}, e {_n(rmse.get('e'))}, d {_n(rmse.get('d'))}",
        ),
        ("largest error", f"{_n(r.get('max_error_m'))} m", f"over {_n(r.get('scored_s'), 1)} s"),
        ("setpoints", str(r["setpoints_sent"]), f"{r['setpoint_misses']} periods missed, {r['messages_lost']} messages lost"),
        (
            "stimulus to setpoint",
            f"{_n(latency.get('p50'), 0)} us",
            f"p99 {_n(latency.get('p99'), 0)}, max {_n(latency.get('max'), 0)} us",
        ),
        ("speed", f"{_n(r['realtime_factor'], 1)} x", f"{_n(r['duration_s'], 1)} s of flight in {_n(r['wall_s'], 1)} s"),
        ("landed", "yes" if r["landed"] else "no", f"autopilot {r['personality']}, attitude from {r['attitude']}"),
    ]
    how = (
        "How we know: every error here is the simulated vehicle's true state against the path that was to be flown, from 3 s after"
        " engagement to the end of the path. The companion never sees that truth; it lies only in the simulator's own log."
    )
    return (
        html.text(verdict, f"verdict {'good' if good else 'bad'}") + html.cards(boxes) + html.text(how, "quiet") + _compared(m)
    )


def _compared(m: Material) -> str:
    """This flight beside the others of its scenario in the same folder, and body rates beside the gyro's."""
    rows = [_row(m.result, "this flight")]
    for path in sorted(m.run.resolve().parent.glob("*/summary.json")):
        if path.parent != m.run.resolve():
            try:
                other = json.loads(path.read_text(encoding="utf-8"))
            except (OSError, ValueError):
                continue
            if other.get("scenario") == m.result["scenario"] and other.get("rmse_m"):
                rows.append(_row(other, path.parent.name))
    heads = ["compared with", "controller", "compensator", "autopilot", "seed", "rmse, m", "largest, m", "ok"]
    tables = html.table(heads, rows[:13])
    if len(rows) == 1:
        other = "pid" if m.result["controller"] == "autopilot" else "autopilot"
        hint = f"No other flight of this scenario lies beside it. The same wind flown by a rival: mavquad fly {m.result['scenario']}"
        tables += html.text(f"{hint} --seed {m.result['seed']} --controller {other}; then this report again.", "quiet")
    rates = m.result.get("rate_rmse_rad_s") or {}
    if rates:
        tables += html.table(
            ["body rates, rmse in rad/s", "x", "y", "z"], [[name, *(float(x) for x in axes)] for name, axes in rates.items()]
        )
    return tables


def _row(r: dict[str, Any], name: str) -> list[Any]:
    rmse = (r.get("rmse_m") or {}).get("position")
    return [name, r["controller"], r["compensator"], r["personality"], r["seed"], rmse, r.get("max_error_m"), bool(r["ok"])]


# ---- figures ------------------------------------------------------------------------------------------------------------
def _s(t_us: Any) -> Array:
    return 1e-6 * np.asarray(t_us, float)


def _flying(m: Material) -> Trace:
    """The rows with a path to follow."""
    rows = m.trace.rows[np.isfinite(m.trace.column("ref_p_n"))]
    return Trace(m.trace.names, rows)


def _space(m: Material) -> str:
    part = _flying(m)
    paths = [("true path", m.truth.p_ned_m, 0)]
    if len(part.rows):
        paths.append(("wanted", part.vector("ref_p"), 1))
        paths.append(("estimated", part.vector("p"), 2))
    wind = np.column_stack([m.truth.extra[f"wind_{k}"] for k in "ned"])
    airborne = np.flatnonzero(m.truth.p_ned_m[:, 2] < -0.3)
    arrows = None
    if len(airborne) and np.abs(wind).max() > 0.1:
        at = airborne[:: max(1, len(airborne) // _ARROWS)]
        arrows = (m.truth.p_ned_m[at], wind[at])
    return html.path3d("The flight in space, and the wind upon it" if arrows else "The flight in space", paths, arrows)


def _position(m: Material) -> list[str]:
    part = _flying(m)
    if not len(part.rows):
        return [html.text("No path was flown.")]
    t, error = _s(part.column("t_us")), score.position_error(part, m.truth)
    lines = [html.line(name, t, error[:, i], i) for i, (_, name) in enumerate(_AXES)]
    lines.append(html.line("distance", t, np.linalg.norm(error, axis=1), 5, dash="dot"))
    seen = part.vector("p") - score.at(m.truth.t_us, m.truth.p_ned_m, part.column("t_us"))
    estimate = [html.line(name, t, seen[:, i], i) for i, (_, name) in enumerate(_AXES)]
    return [
        html.figure("True position less wanted position", lines, x=_TIME, y="m", linked="time"),
        html.figure("Estimated position less true position", estimate, x=_TIME, y="m", height=230, linked="time"),
    ]


def _attitude(m: Material) -> list[str]:
    t_true, true = _s(m.truth.t_us), np.degrees(_euler(m.truth.q_wxyz))
    t = _s(m.trace.column("t_us"))
    sent = np.degrees(_euler(m.trace.vector("sent_q", "wxyz")))
    thrust = html.figure(
        "Collective sent", [html.line("thrust", t, m.trace.column("sent_thrust"), 0), html.line("hover", t, m.trace.column("hover_thrust"), 5)],
        x=_TIME, y="0 to 1", height=210, linked="time",
    )  # fmt: skip
    figures = []
    for i, name in enumerate(("roll", "pitch")):
        traces = [html.line("true", t_true, true[:, i], 0), html.line("setpoint", t, sent[:, i], 1, dash="dot")]
        figures.append(html.figure(f"{name.capitalize()}", traces, x=_TIME, y="deg", height=230, linked="time"))
    return [*figures, thrust]


def _rates(m: Material) -> list[str]:
    t_true, figures = _s(m.truth.t_us), []
    labels = [name.removesuffix(" w_x") for name in m.trace.names if name.endswith(" w_x")]
    t = _s(m.trace.column("t_us"))
    for i, axis in enumerate("xyz"):
        traces = [html.line("true", t_true, m.truth.omega_rad_s[:, i], 5, width=3)]
        if m.gyro is not None and i < 3:
            traces.append(html.line("gyro", _s(m.gyro["time_usec"]), m.gyro[f"{axis}gyro"], 1))
        traces += [
            html.line(label, t, m.trace.column(f"{label} w_{axis}"), (0, 2, 3, 4, 6)[k % 5]) for k, label in enumerate(labels)
        ]
        figures.append(html.figure(f"Body rate {axis}", traces, x=_TIME, y="rad/s", height=240, linked="time"))
    return figures


def _disturbance(m: Material) -> list[str]:
    """True, estimated and bounded; the bounds of whoever publishes them."""
    t_true, t, figures = _s(m.truth.t_us), _s(m.trace.column("t_us")), []
    real = score.model_error(m.trace, m.truth) if "asmf f_n" in m.trace.names else None
    for i, (axis, name) in enumerate(_AXES):
        traces: list[Any] = []
        for low, high, who in _bounds(m.trace.names, axis):
            traces += html.band(f"bounds, {who}", t, m.trace.column(low), m.trace.column(high))
        traces.append(html.line("true", t_true, m.truth.extra[f"f_{axis}"], 5, width=2.5))
        if real is not None:
            traces.append(html.line("true, against asmf's model", t, real[:, i], 6))
        estimates = [("estimator", f"f_{axis}"), ("asmf", f"asmf f_{axis}")]
        for k, (who, column) in enumerate(estimates):
            if column in m.trace.names and np.isfinite(m.trace.column(column)).any():
                traces.append(html.line(who, t, m.trace.column(column), (0, 3)[k]))
        figures.append(html.figure(f"Disturbance {name}", traces, x=_TIME, y="m/s^2", height=240, linked="time"))
    wind = [html.line(name, t_true, m.truth.extra[f"wind_{axis}"], i) for i, (axis, name) in enumerate(_AXES)]
    if not np.isfinite(m.trace.column("f_n")).any():
        figures.insert(0, html.text("The estimator of this flight estimates no disturbance.", "quiet"))
    note = "The true disturbance is what acts beside gravity and the thrust that the rotors would give in still air."
    if real is not None:
        note += (
            " The bounds are those of what the compensator's model lacks, thrust included: guaranteed while the stated noise and"
            " rate bounds hold; the flag says when the data contradict them."
        )
    return [html.text(note, "quiet"), *figures, html.figure("Wind", wind, x=_TIME, y="m/s", height=230, linked="time")]


def _bounds(names: Iterable[str], axis: str) -> list[tuple[str, str, str]]:
    names = set(names)
    pairs = ((f"{who} f_{axis}_low", f"{who} f_{axis}_high", who) for who in ("asmf", "interval"))
    return [pair for pair in pairs if {pair[0], pair[1]} <= names]


def _timeline(m: Material) -> list[str]:
    entries: list[tuple[str, float, float, str, int]] = []
    end = float(_s(m.truth.t_us)[-1])
    states = m.result["states"]
    for k, state in enumerate(states):
        to = states[k + 1]["t_s"] if k + 1 < len(states) else end
        entries.append(("companion", state["t_s"], to, state["state"], k % 5))
    for gust in m.sitl.get("wind", {}).get("gusts", []):
        entries.append(("gust", gust["t_s"], gust["t_s"] + gust["duration_s"], f"{gust['speed_m_s']:g} m/s", 3))
    for fault in m.sitl.get("faults", []):
        to = fault["t_s"] + fault["duration_s"] if fault.get("duration_s") else end
        entries.append(("fault", fault["t_s"], to, f"{fault['kind']} {fault.get('sensor') or ''}".strip(), 4))
    t, limited = _s(m.trace.column("t_us")), m.trace.column("limited") > 0
    for start, to in _spans(t, limited):
        entries.append(("limits gate", start, to, "limited", 1))
    figure = html.figure(
        "States, faults and interventions", html.spans(entries), x=_TIME, height=220, linked="time", barmode="overlay", hovermode="closest",
        yaxis={"automargin": True},
    )  # fmt: skip
    said = html.table(["s", "from", "said"], [[f"{t:.2f}", who, words] for t, who, words in m.texts])
    return [figure, html.table(["s", "state", "reason"], [[s["t_s"], s["state"], s["reason"]] for s in states]), said]


def _spans(t: Array, on: Any, most: int = 60) -> list[tuple[float, float]]:
    """Stretches of time where `on` holds; short gaps are closed until there are few enough to draw."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]]).astype(int)))
    spans = [(float(t[a]), float(t[min(b, len(t) - 1)])) for a, b in edges.reshape(-1, 2)]
    gap = 0.05
    while len(spans) > most:
        merged = [spans[0]]
        for start, end in spans[1:]:
            if start - merged[-1][1] < gap:
                merged[-1] = (merged[-1][0], end)
            else:
                merged.append((start, end))
        spans, gap = merged, 2.0 * gap
    return spans


def _latency(m: Material) -> list[str]:
    histogram = m.companion.get("latency_histogram")
    pieces = []
    if histogram and sum(histogram["counts"]):
        edges = np.array(histogram["edges_us"])
        labels = [f"{x:.0f}" for x in np.sqrt(edges[1:] * edges[:-1])]
        used = np.flatnonzero(histogram["counts"])
        keep = slice(int(used[0]), int(used[-1]) + 1)
        bars = html.bars("control steps", labels[keep], histogram["counts"][keep])
        pieces.append(html.figure("From a datagram's arrival to the setpoint on its way", [bars], x="us", y="control steps", height=260, xaxis={"type": "category", "title": {"text": "us"}}))  # fmt: skip
    per = m.result.get("messages_per_period") or {}
    rows = [
        ["messages received", m.result["messages_received"]],
        ["messages lost", m.result["messages_lost"]],
        ["messages a control period, received", per.get("received")],
        ["messages a control period, sent", per.get("sent")],
        ["link delay as measured, s", m.result.get("delay_s")],
    ]
    granted = [[name, hz] for name, hz in (m.result.get("granted_hz") or {}).items()]
    return [*pieces, html.table(["link", ""], rows), html.table(["message", "granted, Hz"], granted)]


def _repeat(m: Material) -> list[str]:
    rows = [[key, value] for key, value in m.made_by.items() if key != "cpu_features"]
    verify = f"mavquad replay {m.run / 'flight.tlog'} --verify"
    return [
        html.code(m.result["command"]),
        html.text("That its log gives every sent frame and every trace value again, bit for bit:", "quiet"),
        html.code(verify),
        html.table(["made by", ""], rows),
    ]


def _euler(q_wxyz: Array) -> Array:
    """Roll, pitch, yaw (n, 3) [rad] of unit quaternions; NaN stays NaN."""
    w, x, y, z = np.asarray(q_wxyz, float).T
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return np.column_stack([roll, pitch, yaw])


def _n(value: Any, digits: int = 3) -> str:
    return "-" if value is None or (isinstance(value, float) and math.isnan(value)) else f"{value:.{digits}f}"
