"""A watch in one line, as JSON, or as a verdict: for terminals without a screen, for scripts, for a check before flight."""

import math
from typing import Any

from tools.watch import AUTOPILOT, Vehicle, Watch, angles_deg, body_rates, path_error_m

ATTITUDE = ("ATTITUDE_QUATERNION", "ATTITUDE")
_MIN_ATTITUDE_HZ, _MAX_AGE_S, _MAX_LOSS = 10.0, 0.5, 0.01
_CRITICAL = 2  # MAV_SEVERITY


def status(watch: Watch, system: int | None = None) -> dict[str, Any]:
    """Everything of the line as plain numbers; None where it is not known. One vehicle: the first heard unless chosen."""
    vehicle = chosen(watch, system)
    seconds = 1e-6 * (watch.now_us - watch.start_us) if watch.frames else 0.0
    base: dict[str, Any] = {
        "t_s": round(seconds, 3),
        "frames": watch.frames,
        "loss": round(watch.loss(), 6),
        "junk_bytes": watch.junk_bytes,
        "strangers": watch.strangers,
    }
    if vehicle is None:
        return base | {"system": None}
    here = vehicle.message("LOCAL_POSITION_NED")
    disturbance = vehicle.arrays.get("disturb")
    asmf = vehicle.arrays.get("asmf")
    return base | {
        "system": vehicle.system,
        "state": vehicle.companion or None,
        "mode": vehicle.mode,
        "armed": vehicle.armed,
        "lost": vehicle.lost,
        "loss": round(watch.loss(vehicle.system), 6),
        "attitude_hz": round(watch.rate_hz(vehicle.system, *ATTITUDE), 2),
        "position_hz": round(watch.rate_hz(vehicle.system, "LOCAL_POSITION_NED"), 2),
        "age_s": _number(watch.newest_age_s(vehicle.system, *ATTITUDE)),
        "attitude_deg": _numbers(angles_deg(vehicle)),
        "rates_rad_s": _numbers(body_rates(vehicle)),
        "position_m": _numbers((here.x, here.y, here.z) if here else None),
        "path_error_m": _number(path_error_m(vehicle)),
        "disturbance_m_s2": _numbers(disturbance[1][:3] if disturbance else None),
        "bounds_m_s2": [_numbers(asmf[1][3:6]), _numbers(asmf[1][6:9])] if asmf else None,
        "round_trip_ms": _number(_median(vehicle.round_trip_ms)),
        "restarts": vehicle.restarts,
    }


def line(watch: Watch, system: int | None = None) -> str:
    """The second's line: time, state, mode, rates, age, loss, attitude, position error, disturbance."""
    s = status(watch, system)
    if s["system"] is None:
        return f"{s['t_s']:8.1f} s  no autopilot heard; {s['frames']} frames"
    words = [
        f"{s['t_s']:8.1f} s ",
        f"{s['state'] or '-':11}",
        f"{s['mode']}{' armed' if s['armed'] else ''}{' LOST' if s['lost'] else ''}",
        f"att {s['attitude_hz']:.0f} Hz",
        f"age {_show(s['age_s'], '.2f')} s",
        f"loss {100 * s['loss']:.1f} %",
        f"rpy {_vector(s['attitude_deg'], '+.1f')} deg",
    ]
    if s["position_m"] is not None:
        words.append(f"p {_vector(s['position_m'], '+.1f')} m")
    if s["path_error_m"] is not None:
        words.append(f"err {s['path_error_m']:.2f} m")
    if s["disturbance_m_s2"] is not None:
        words.append(f"f {_vector(s['disturbance_m_s2'], '+.2f')} m/s2")
    return "  ".join(words)


def faults(watch: Watch, system: int | None = None) -> list[str]:
    """Why one would not fly with this link, each with what was expected; empty: nothing speaks against it."""
    vehicle = chosen(watch, system)
    if vehicle is None:
        heard = ", ".join(f"{s}/{c}" for s, c in watch.sources) or "nobody"
        return [f"no HEARTBEAT of an autopilot; heard: {heard}"]
    found = []
    hz, age, loss = (
        watch.rate_hz(vehicle.system, *ATTITUDE),
        watch.newest_age_s(vehicle.system, *ATTITUDE),
        watch.loss(vehicle.system),
    )
    if vehicle.lost:
        found.append(f"HEARTBEAT is {watch.age_s(vehicle.heard_us):.1f} s old, expected < 2 s")
    if hz < _MIN_ATTITUDE_HZ:
        found.append(f"attitude at {hz:.1f} Hz, expected >= {_MIN_ATTITUDE_HZ:g} Hz (ask with --request-rates)")
    elif age > _MAX_AGE_S:
        found.append(f"attitude is {age:.2f} s old, expected < {_MAX_AGE_S:g} s")
    if loss > _MAX_LOSS:
        found.append(f"{100 * loss:.1f} % of the frames lost, expected <= {100 * _MAX_LOSS:g} %")
    if vehicle.restarts:
        found.append(f"the autopilot restarted {vehicle.restarts} times")
    found += [f"{words} ({frames} frames)" for words, frames in watch.strangers.items()]
    critical = [
        t
        for t in watch.texts
        if t.severity <= _CRITICAL and t.sender.startswith(f"{vehicle.system}/") and not t.words.startswith("link:")
    ]
    if critical:
        found.append(f"{len(critical)} critical texts, the last: {critical[-1].words}")
    return found


def verdict(watch: Watch, system: int | None = None) -> str:
    """One line: good, or what is not."""
    found = faults(watch, system)
    vehicle = chosen(watch, system)
    name = f"{vehicle.system}/{AUTOPILOT}" if vehicle else "link"
    return f"{name}: good" if not found else f"{name}: {'; '.join(found)}"


def chosen(watch: Watch, system: int | None) -> Vehicle | None:
    """The vehicle asked for, or the first one heard."""
    if system is not None:
        return watch.vehicles.get(system)
    return next(iter(watch.vehicles.values()), None)


def _median(values: Any) -> float:
    ordered = sorted(values)
    return ordered[len(ordered) // 2] if ordered else math.nan


def _number(x: float) -> float | None:
    return round(float(x), 6) if math.isfinite(x) else None


def _numbers(values: Any) -> list[float | None] | None:
    return None if values is None else [_number(x) for x in values]


def _show(x: float | None, form: str) -> str:
    return "-" if x is None else format(x, form)


def _vector(values: Any, form: str) -> str:
    return "-" if values is None else " ".join(_show(x, form) for x in values)
