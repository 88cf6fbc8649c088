"""The monitor's five pages, each a pure function of a watch: the lines to show in so many columns and rows.

A line is a list of (characters, style); drawing such lines costs a tenth of what tables of a general library do, and a monitor
must be light.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from itertools import zip_longest
from typing import Any, NamedTuple

from mavquad import wire
from mavquad.link import health
from tools.watch import AUTOPILOT, COMPANION, HISTORY, Vehicle, Watch, angles_deg, body_rates, euler_deg, path_error_m

Span = tuple[str, str]
Line = list[Span]
Cell = str | Span | Line
GOOD, POOR, BAD, HEAD, DIM = "green", "yellow", "bold red", "bold", "dim"
BARS = " ▁▂▃▄▅▆▇█"
SEVERITY = (BAD, BAD, BAD, "red", POOR, "cyan", "", DIM)
LANDED = {1: "on ground", 2: "in air", 3: "taking off", 4: "landing"}
STALE_S = 1.0


class Size(NamedTuple):
    width: int
    height: int


# ---- small drawings -----------------------------------------------------------------------------------------------------
def grid(rows: Sequence[Sequence[Cell]], justify: str) -> list[Line]:
    """Rows of cells as lines, each column as wide as its widest cell; justify: a letter (l, r) for each column."""
    lines_of = [[_spans(cell) for cell in row] for row in rows]
    widths = [max((_width(cell) for cell in column), default=0) for column in zip_longest(*lines_of, fillvalue=[])]
    lines = []
    for row in lines_of:
        line: Line = []
        for cell, width, side in zip(row, widths, justify, strict=False):
            pad = (" " * (width - _width(cell)), "")
            line += [pad, *cell, (" ", "")] if side == "r" else [*cell, pad, (" ", "")]
        lines.append(line)
    return lines


def heads(*names: str) -> list[Cell]:
    """The names of columns."""
    return [(name, HEAD) for name in names]


def _spans(cell: Cell) -> Line:
    return [(cell, "")] if isinstance(cell, str) else [cell] if isinstance(cell, tuple) else cell


def _width(line: Line) -> int:
    return sum(len(words) for words, _ in line)


def spark(values: Sequence[float], width: int) -> str:
    """The last `width` values as bars from the least to the greatest; a gap where one is not finite."""
    shown = list(values)[-width:]
    finite = [x for x in shown if math.isfinite(x)]
    if not finite:
        return ""
    low, high = min(finite), max(finite)
    span = high - low or 1.0
    return "".join(BARS[1 + round(7 * (x - low) / span)] if math.isfinite(x) else " " for x in shown)


def band(low: float, x: float, high: float, reach: float, width: int) -> Line:
    """A value between its bounds on a scale of -reach .. reach: ──[══●══]──, the zero as ┼."""
    cells, styles = ["─"] * width, [DIM] * width

    def place(value: float) -> int:
        return max(0, min(width - 1, round((value / reach + 1.0) / 2.0 * (width - 1))))

    cells[place(0.0)] = "┼"
    if math.isfinite(low) and math.isfinite(high):
        a, b = place(low), place(high)
        cells[a : b + 1], styles[a : b + 1] = ["═"] * (b + 1 - a), [GOOD] * (b + 1 - a)
        cells[a], cells[b] = "[", "]"
    if math.isfinite(x):
        cells[place(x)], styles[place(x)] = "●", BAD if x < low or x > high else HEAD
    line: Line = []
    for cell, style in zip(cells, styles, strict=True):
        if line and line[-1][1] == style:
            line[-1] = (line[-1][0] + cell, style)
        else:
            line.append((cell, style))
    return line


def number(x: float | None, form: str = ".2f") -> str:
    """A number, or - where it is not known."""
    return "-" if x is None or not math.isfinite(x) else format(x, form)


def quantile(values: Iterable[float], share: float) -> float:
    """The value below which a share of all lies; NaN of none."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else math.nan


def _colour(good: bool, poor: bool = False) -> str:
    return GOOD if good else POOR if poor else BAD


# ---- the pages ----------------------------------------------------------------------------------------------------------
def link(watch: Watch, vehicle: Vehicle | None, size: Size) -> list[Line]:
    """Each stream: rate, what was asked for, age, jitter, count; each sender: loss."""
    seconds = max(1e-6 * (watch.now_us - watch.start_us), 1e-3)
    rates = f"{watch.frames / seconds:.0f}/s, {1e-3 * watch.bytes / seconds:.1f} kB/s"
    lines: list[Line] = [[(f"{watch.frames} frames, {rates}, {watch.junk_bytes} bytes of junk", "")], [("lost ", "")]]
    for (system, component), source in sorted(watch.sources.items()):
        share = source.lost / (source.lost + source.received)
        lines[1] += [
            (f" {system}/{component} ", ""),
            (f"{source.lost} ({100 * share:.2f} %)", _colour(share <= 0.001, share <= 0.01)),
        ]
    asked = {(v.system, AUTOPILOT, msgid): request for v in watch.vehicles.values() for msgid, request in v.requests.items()}
    rows = [heads("from", "message", "rate", "asked", "", "age", "jitter", "count")]
    for key in sorted({*watch.streams, *asked}, key=lambda item: (item[0], item[1], _name(item[2]))):
        stream, request = watch.streams.get(key), asked.get(key)
        row: list[Cell] = [f"{key[0]}/{key[1]}", _name(key[2])]
        if stream is None:
            row.append(("-", BAD))
        else:
            rate, late = health.rate_hz(stream), health.age_s(stream, watch.now_us) > max(STALE_S, 5e-6 * stream.period_us)
            row.append((f"{rate:.1f} Hz" if rate else "-", BAD if late else ""))
        row.append(number(request.hz, "g") if request else "")
        row.append((request.result, _colour(request.result == "granted", request.result == "asked")) if request else "")
        if stream is not None:
            row += [f"{health.age_s(stream, watch.now_us):.2f} s", f"{1e-3 * stream.jitter_us:.1f} ms", str(stream.messages)]
        rows.append(row)
    return lines + grid(rows, "llrrlrrr")


def flight(watch: Watch, vehicle: Vehicle | None, size: Size) -> list[Line]:
    """Mode, attitude, rates, position, path error, battery."""
    if vehicle is None:
        return _nobody(watch)
    landed, battery = vehicle.message("EXTENDED_SYS_STATE"), vehicle.message("SYS_STATUS")
    head: Line = [
        ("mode ", ""), (vehicle.mode, HEAD), ("  ", ""), ("armed", BAD) if vehicle.armed else ("disarmed", GOOD),
        (f"  {LANDED.get(landed.landed_state, '') if landed else ''}  companion ", ""), (vehicle.companion or "-", HEAD),
        (f"  battery {battery.battery_remaining if battery else '-'} %", ""),
    ]  # fmt: skip
    bars = max(10, size.width - 46)
    angles, rates = angles_deg(vehicle), body_rates(vehicle)
    here, there = vehicle.message("LOCAL_POSITION_NED"), vehicle.message("POSITION_TARGET_LOCAL_NED")
    rows: list[list[Cell]] = [
        heads("", "roll", "pitch", "yaw"),
        ["attitude (deg)", *_three(angles, "+.1f"), band(math.nan, angles[0], math.nan, 45.0, bars) if angles else ""],
        ["rates (deg/s)", *_three([math.degrees(x) for x in rates] if rates else None, "+.1f")],
        [],
        heads("", "north", "east", "down"),
        ["position (m)", *_three((here.x, here.y, here.z) if here else None, "+.2f")],
        ["velocity (m/s)", *_three((here.vx, here.vy, here.vz) if here else None, "+.2f")],
    ]
    if there is not None:
        rows.append(["target (m)", *_three((there.x, there.y, there.z), "+.2f")])
    rows += [["path error (m)", number(path_error_m(vehicle))], []]
    for axis, name in enumerate(("roll rate", "pitch rate", "yaw rate")):
        past = [values[axis] for values in vehicle.history.get("rates", ())]
        rows.append([name, "", "", "", spark(past, bars)])
    age = watch.newest_age_s(vehicle.system, "ATTITUDE_QUATERNION", "ATTITUDE")
    clock = f"  autopilot clock {1e-3 * vehicle.boot_ms:.1f} s, restarts {vehicle.restarts}"
    tail: Line = [("attitude ", ""), (f"{number(age)} s old", _colour(age < 0.1, age < STALE_S)), (clock, "")]
    return [head, [], *grid(rows, "lrrrl"), [], tail]


def estimates(watch: Watch, vehicle: Vehicle | None, size: Size) -> list[Line]:
    """The companion's estimates beside the autopilot's values; disturbance and guaranteed bounds as bands; the last minute."""
    if vehicle is None:
        return _nobody(watch)
    if not {"rates", "disturb", "asmf"} & set(vehicle.arrays):
        return [
            [(f"No estimates on this link. A companion ({vehicle.system}/{COMPANION}) publishes them", "")],
            [("at up to 10 Hz, as DEBUG_FLOAT_ARRAY named rates, disturb and asmf.", "")],
        ]
    width = max(12, min(HISTORY, size.width - 46))
    rates, observed = body_rates(vehicle), vehicle.arrays.get("rates")
    rows = [heads("body rate (rad/s)", "autopilot", "observer", "apart", "observer, last minute")]
    for axis, name in enumerate("xyz"):
        theirs = rates[axis] if rates else math.nan
        ours = observed[1][axis] if observed else math.nan
        past = [values[axis] for values in vehicle.history.get("rates estimate", ())]
        rows.append([name, *(number(x, "+.3f") for x in (theirs, ours, ours - theirs)), spark(past, width)])
    lines = [*grid(rows, "lrrrl"), *_observer(observed[1] if observed else ()), []]
    if {"disturb", "asmf"} & set(vehicle.arrays):
        lines += [*_disturbance(vehicle, size), []]
        values = vehicle.arrays.get("disturb", (0, (math.nan,) * 8))[1]
        torque = " ".join(number(x, "+.2f") for x in values[3:6])
        lines.append([(f"torque disturbance (rad/s2) {torque}  hover thrust {number(values[7], '.3f')}", "")])
    if "asmf" in vehicle.arrays:
        b = vehicle.arrays["asmf"][1]
        said = ("hold", GOOD) if b[12] > 0.5 else ("are contradicted by the data", BAD)
        more = f", half-width {number(b[11])} m/s2, widened {b[14]:.0f} times, authority {number(b[15])}"
        lines.append([("bounds ", ""), said, (more, "")])
    wind = vehicle.message("WIND_COV") or vehicle.message("WIND")
    if wind is not None:
        lines.append([(f"wind by the autopilot: {_wind(wind)}", "")])
    return lines


def _observer(values: Sequence[float]) -> list[Line]:
    """What the observed rates are worth, as a companion publishes it behind them (gsmo.published)."""
    if len(values) < 24 or not values[14] > 0.0:
        return []
    age_s, _, noise_rad, _, coasting, stale, settled, accepted = values[7:15]
    names = ("not finite", "norm", "repeated", "late", "gaps", "restarts", "lost", "torque", "stamp")
    counted = ", ".join(f"{name} {n:.0f}" for name, n in zip(names, values[15:24], strict=True) if n > 0.0)
    said = ("stale", BAD) if stale else ("coasting", BAD) if coasting else ("settled", GOOD) if settled else ("settling", "")
    noise = f", noise {math.degrees(noise_rad):.2f} deg" if math.isfinite(noise_rad) else ""
    return [
        [
            ("observer ", ""),
            said,
            (f", age {1e3 * age_s:.0f} ms{noise}, {accepted:.0f} samples; {counted or 'none refused'}", ""),
        ]
    ]


def _disturbance(vehicle: Vehicle, size: Size) -> list[Line]:
    """The joint observer's and the set-membership filter's disturbance, the latter's bounds; the truth where a log holds it."""
    values = vehicle.arrays["disturb"][1] if "disturb" in vehicle.arrays else (math.nan,) * 8
    bounds = vehicle.arrays["asmf"][1] if "asmf" in vehicle.arrays else (math.nan,) * 19
    truth = vehicle.arrays["truth"][1] if "truth" in vehicle.arrays else None
    reach = 1.2 * max([1.0, *[abs(x) for x in (*values[:3], *bounds[:9]) if math.isfinite(x)]])
    rows = [
        heads("disturbance (m/s2)", "joint", "asmf", "bounds", *(["truth"] if truth else []), f"-{reach:.1f} .. {reach:.1f}")
    ]
    past: list[list[Cell]] = [heads("last minute")]
    history = vehicle.history.get("asmf estimate" if "asmf" in vehicle.arrays else "disturb estimate", ())
    bars = max(12, size.width - (56 if truth else 48))
    for axis, name in enumerate(("north", "east", "down")):
        ours, low, high = bounds[axis], bounds[3 + axis], bounds[6 + axis]
        row: list[Cell] = [name, number(values[axis], "+.2f"), number(ours, "+.2f")]
        row.append(f"{number(low, '+.2f')} {number(high, '+.2f')}")
        if truth:
            row.append(number(truth[axis], "+.2f"))
        rows.append([*row, band(low, ours if math.isfinite(ours) else values[axis], high, reach, bars)])
        past.append([name, spark([v[axis] for v in history], max(12, size.width - 14))])
    return [*grid(rows, "lrrrrl" if truth else "lrrrl"), [], *grid(past, "ll")]


def setpoints(watch: Watch, vehicle: Vehicle | None, size: Size) -> list[Line]:
    """What is asked of the autopilot, what it acts on, what it does; delays."""
    if vehicle is None:
        return _nobody(watch)
    echo, sent = vehicle.message("ATTITUDE_TARGET"), vehicle.setpoint
    ages = [watch.newest_age_s(vehicle.system, *names) for names in (("ATTITUDE_TARGET",), ("ATTITUDE_QUATERNION", "ATTITUDE"))]
    rows = [heads("", "roll", "pitch", "yaw (deg)", "thrust", "age")]
    if sent:
        asked = f"asked (mask {sent[1].type_mask})"
        rows.append([asked, *_three(euler_deg(sent[1].q), "+.1f"), f"{sent[1].thrust:.3f}", f"{watch.age_s(sent[0]):.2f} s"])
    else:
        rows.append(["asked", "-", "-", "-", "-", "-"])
    acted = _three(euler_deg(echo.q) if echo else None, "+.1f")
    rows.append(["acted on", *acted, number(echo.thrust if echo else None, ".3f"), f"{number(ages[0])} s"])
    rows.append(["is", *_three(angles_deg(vehicle), "+.1f"), "", f"{number(ages[1])} s"])
    said: list[Line] = [
        [(f"{_name(msgid)} from {system}/{component} at {health.rate_hz(stream):.1f} Hz", "")]
        for (system, component, msgid), stream in sorted(watch.streams.items())
        if _name(msgid).startswith("SET_") and "TARGET" in _name(msgid)
    ]
    delays = [heads("delay (ms)", "n", "median", "95 %", "max", "spread")]
    for name, values in (("TIMESYNC round trip", vehicle.round_trip_ms), ("setpoint to its echo", vehicle.echo_ms)):
        shown = [number(x, ".1f") for x in (quantile(values, 0.5), quantile(values, 0.95), max(values, default=math.nan))]
        delays.append([name, str(len(values)), *shown, histogram(list(values), max(8, size.width - 56))])
    delay = vehicle.arrays["disturb"][1][6] if "disturb" in vehicle.arrays else math.nan
    tail: Line = [(f"delay as the companion measures it: {number(1e3 * delay, '.1f')} ms", "")]
    return [*grid(rows, "lrrrrr"), [], *(said or [[("nobody sends setpoints", "")]]), [], *grid(delays, "lrrrrl"), [], tail]


def messages(watch: Watch, vehicle: Vehicle | None, size: Size) -> list[Line]:
    """STATUSTEXT of everybody, commands, changes of mode: the newest below."""
    lines: list[Line] = []
    for text in list(watch.texts)[-max(1, size.height) :]:
        t_s = 1e-6 * (text.t_us - watch.start_us)
        lines.append([(f"{t_s:9.2f} s  {text.sender:8} {text.words}", SEVERITY[min(text.severity, 7)])])
    return lines or [[("no texts yet", "")]]


PAGES: dict[str, Callable[[Watch, Vehicle | None, Size], list[Line]]] = {
    "link": link,
    "flight": flight,
    "estimates": estimates,
    "setpoints": setpoints,
    "messages": messages,
}


def histogram(values: list[float], bins: int) -> str:
    """How values are spread from the least to the greatest."""
    if not values:
        return ""
    low, span = min(values), (max(values) - min(values)) or 1.0
    counts = [0] * bins
    for x in values:
        counts[min(bins - 1, int(bins * (x - low) / span))] += 1
    most = max(counts)
    return "".join(BARS[math.ceil(8 * n / most)] for n in counts)


def _name(msgid: int) -> str:
    return wire.NAME.get(msgid, f"UNKNOWN_{msgid}")


def _nobody(watch: Watch) -> list[Line]:
    heard = ", ".join(f"{s}/{c}" for s, c in sorted(watch.sources)) or "nobody"
    return [[(f"No HEARTBEAT of an autopilot yet; heard: {heard}", "")]]


def _three(values: Sequence[float] | None, form: str) -> list[str]:
    return ["-"] * 3 if values is None else [number(x, form) for x in values]


def _wind(wind: Any) -> str:
    if hasattr(wind, "wind_x"):
        return f"north {wind.wind_x:+.1f} east {wind.wind_y:+.1f} m/s"
    return f"{wind.speed:.1f} m/s from {wind.direction % 360.0:.0f} deg"
