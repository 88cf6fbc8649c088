"""What a log holds, and what its attitude says of the body rates: counts, the observer beside the plain ways, torque from the log."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mavquad import airframe
from mavquad.errors import ConfigError, LogError
from mavquad.link.columns import Log, Stream
from mavquad.link.recording import not_enough_for
from mavquad.plan import OBSERVERS, stage
from tools import rates

_IN_AIR = 2  # MAV_LANDED_STATE
SLOW_HZ = 40.0  # below this, rates of a multirotor cannot be had from attitude


Kept = dict[str, tuple[NDArray[np.int64], rates.Array]]  # by name: vehicle time (n,), body rates (n, 3)


def survey(
    log: Log,
    observers: list[str],
    from_s: float | None,
    to_s: float | None,
    keep: Kept | None = None,
    system: int | None = None,
) -> dict[str, Any]:
    """Everything `replay` prints. The span is [from_s, to_s) after the log's start; without both, the time in the air.

    `keep` takes the rates themselves, for a figure; `system` chooses the vehicle where the log holds several.
    """
    result: dict[str, Any] = {
        "log": str(log.path),
        "bytes": log.size,
        "messages": len(log),
        "span_s": 1e-6 * float(log.t_us.max() - log.t_us.min()),
        "junk_bytes": log.junk_bytes,
        "problem": log.problem or None,
        "streams": streams(log),
        "notes": not_enough_for(log),
    }
    try:
        result["rates"] = body_rates(log, observers, from_s, to_s, keep, system)
    except LogError as error:
        result["rates"] = {"problem": str(error)}
    return result


def streams(log: Log) -> list[dict[str, Any]]:
    """Count and mean rate of every kind of message from every sender."""
    rows = []
    for s in sorted(log.streams, key=lambda s: (s.system, s.component, s.name)):
        t = log.t_us[log.numbers(s)]
        span_s = 1e-6 * float(t.max() - t.min())
        rows.append(
            {
                "system": s.system,
                "component": s.component,
                "name": s.name,
                "count": s.messages,
                "rate_hz": (s.messages - 1) / span_s if span_s > 0.0 else None,
            }
        )
    return rows


def body_rates(
    log: Log,
    observers: list[str],
    from_s: float | None,
    to_s: float | None,
    keep: Kept | None = None,
    system: int | None = None,
) -> dict[str, Any]:
    """rms of each way to the body rates against the zero-phase rate of the same quaternions [rad/s, x y z].

    Raises ConfigError for an observer of another source: the reference is that of the attitude quaternions.
    """
    for spec in observers:
        if "source=mocap" in spec:
            raise ConfigError(
                f"observer {spec!r}: rates are compared on ATTITUDE_QUATERNION here; leave source=mocap away,"
                " or judge a flight by its truth: mavquad paper gsmo --scenario mocap --flight RUN"
            )
    source = _attitude_stream(log, system)
    rows = log.rows(source)
    a = rates.attitudes(
        1000 * rows["time_boot_ms"].astype(np.int64), np.column_stack([rows[f"q{i}"] for i in (1, 2, 3, 4)]).astype(float)
    )
    hz = 1e6 / float(np.median(np.diff(a.t_us)))
    reference = rates.reference(a)
    span, why = _span(log, source, from_s, to_s)
    use = _inside(log, source, rows, a.t_us, span)
    if use.sum() < 100:
        raise LogError(f"{int(use.sum())} attitude samples between {span[0]:.1f} and {span[1]:.1f} s, at least 100 are needed")
    torque, torque_text = _torque(log, source, a, use)
    reported = np.column_stack([rows[f"{k}speed"] for k in ("roll", "pitch", "yaw")]).astype(float)
    places = np.searchsorted(a.t_us, 1000 * rows["time_boot_ms"].astype(np.int64))
    told = np.full_like(reference, np.nan)
    told[np.minimum(places, len(told) - 1)] = reported
    ways = compare(a, reference, use, observers, torque, told, keep=keep)
    return {
        "source": f"{source.system}/{source.component} {source.name}",
        "sample_hz": hz,
        "samples": int(use.sum()),
        "dropped": a.dropped,
        "from_s": span[0],
        "to_s": span[1],
        "span": why,
        "reference": "zero-phase rate of the same quaternions (central difference)",
        "signal_rms_rad_s": rates.rms(reference, use),
        "ways": ways,
        "torque_model": torque_text,
        "note": slow_note(hz),
    }


def compare(
    a: rates.Attitudes,
    reference: rates.Array,
    use: NDArray[np.bool_],
    observers: list[str],
    torque: rates.Array | None,
    told: rates.Array,
    outputs: str = "SERVO_OUTPUT_RAW",
    keep: Kept | None = None,
) -> list[dict[str, Any]]:
    """Each way to the body rates and its rms error per axis over the samples `use`; `told` (n, 3) are the autopilot's own."""
    plain = rates.difference(a)
    ways: list[dict[str, Any]] = []

    def way(name: str, torque: str, rate: rates.Array, **more: Any) -> None:
        ways.append({"method": name, "torque": torque, "rms_rad_s": rates.rms(rate - reference, use), **more})

    if keep is not None:
        keep["reference"] = (a.t_us, reference)
        if np.isfinite(told[use]).any():
            keep["autopilot"] = (a.t_us, told)
    for label in observers:
        w, counts = _observe(label, a, None)
        way(label, "unknown", w, rejected=counts)
        if keep is not None:
            keep[label] = (a.t_us, w)
        if torque is not None:
            way(label, f"from {outputs}", _observe(label, a, torque)[0])
    way("difference", "-", plain)
    way("difference, extrapolated half a sample", "-", rates.extrapolated(plain))
    for cut_hz in (5.0, 20.0):
        way(f"difference, {cut_hz:g} Hz Butterworth", "-", rates.butterworth(a, plain, cut_hz))
    if np.isfinite(told[use]).any():
        way("rates the autopilot reports", "-", told)
    return ways


def _attitude_stream(log: Log, system: int | None) -> Stream:
    found = log.find("ATTITUDE_QUATERNION", system)
    if not found:
        raise LogError(f"{log.path}: no ATTITUDE_QUATERNION in it: no body rates from attitude")
    return max(found, key=lambda s: (s.component == 1, s.messages))


def _span(log: Log, source: Stream, from_s: float | None, to_s: float | None) -> tuple[tuple[float, float], str]:
    """Seconds after the log's start, and how they were chosen."""
    start = int(log.t_us.min())
    whole = (0.0, 1e-6 * float(log.t_us.max() - start) + 1e-6)
    if from_s is not None or to_s is not None:
        return (whole[0] if from_s is None else from_s, whole[1] if to_s is None else to_s), "as asked for"
    states = log.find("EXTENDED_SYS_STATE", source.system, source.component)
    if states:
        rows = log.rows(states[0])
        t = 1e-6 * (rows["t_us"][rows["landed_state"] == _IN_AIR] - start)
        if len(t) > 1 and t[-1] - t[0] > 5.0:
            return (float(t[0]), float(t[-1])), "in the air, by EXTENDED_SYS_STATE"
    return whole, "the whole log"


def _inside(
    log: Log, source: Stream, rows: NDArray[Any], t_us: NDArray[np.int64], span: tuple[float, float]
) -> NDArray[np.bool_]:
    """Which samples (vehicle time) lie in a span of log time."""
    boot = 1000 * rows["time_boot_ms"].astype(np.int64)
    order = np.argsort(boot, kind="stable")
    log_s = np.interp(t_us, boot[order], 1e-6 * (rows["t_us"] - log.t_us.min())[order])
    inside: NDArray[np.bool_] = (log_s >= span[0]) & (log_s < span[1])
    return inside


def _observe(label: str, a: rates.Attitudes, torque: rates.Array | None) -> tuple[rates.Array, dict[str, int]]:
    """One observer over the record in bulk: rates (n, 3), and the samples it refused by reason."""
    chosen = stage("observer", label, OBSERVERS, {}, airframe.load("x500"))  # by default nothing of it is used
    w, _, counts = chosen.module.run_record(chosen.gains, a.t_us, a.q_wxyz, torque)
    return w, {name: int(value) for name, value in counts._asdict().items()}


def _torque(log: Log, source: Stream, a: rates.Attitudes, use: NDArray[np.bool_]) -> tuple[rates.Array | None, dict[str, Any]]:
    found = log.find("SERVO_OUTPUT_RAW", source.system, source.component)
    if not found:
        return None, {"problem": "no SERVO_OUTPUT_RAW"}
    rows = log.rows(found[0])
    wrapped = rows["time_usec"].astype(np.int64)
    t_us = wrapped + np.concatenate([[0], np.cumsum(np.where(np.diff(wrapped) < -(1 << 31), 1 << 32, 0))])
    u = (np.column_stack([rows[f"servo{i}_raw"] for i in (1, 2, 3, 4)]).astype(float) - 1000.0) / 1000.0
    return fitted(a, t_us, u, use)


def fitted(
    a: rates.Attitudes, t_us: NDArray[np.int64], u: rates.Array, use: NDArray[np.bool_]
) -> tuple[rates.Array | None, dict[str, Any]]:
    """Torque over inertia at every attitude sample by outputs u (m, 4) 0..1, None where they do not tell it; the model in words."""
    try:
        model, torque = rates.fit_torque(a, t_us, u, use)
    except LogError as error:
        return None, {"problem": str(error)}
    return torque, {
        "form": "w' = A u + b, u the four outputs 0..1 behind a first-order lag; least squares on this span",
        "A_rad_s2": model.A.tolist(),
        "b_rad_s2": model.b.tolist(),
        "lag_s": model.lag_s,
        "explained": model.explained.tolist(),
    }


def slow_note(hz: float) -> str | None:
    """What is to be said of rates from attitude at so many samples a second."""
    return f"{hz:.0f} Hz is too slow for the rates of a multirotor: read them as trends" if hz < SLOW_HZ else None


def finite(value: Any) -> Any:
    """The same for JSON: numbers that are not finite become null."""
    if isinstance(value, dict):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def show(result: dict[str, Any]) -> None:
    """The survey on stdout, for people."""
    print(f"{result['log']}: {result['messages']} messages in {result['span_s']:.1f} s, {result['junk_bytes']} bytes of junk")
    for s in result["streams"]:
        rate = "" if s["rate_hz"] is None else f"{s['rate_hz']:8.2f} Hz"
        who = "" if s["system"] is None else f"{s['system']:3}/{s['component']:<3} "
        print(f"  {who}{s['name']:28} {s['count']:8} {rate}")
    for note in result["notes"]:
        print(f"  {note}")
    r = result["rates"]
    if "ways" not in r:
        print(f"no body rates: {r['problem']}")
        return
    print(f"\nbody rates from {r['source']} at {r['sample_hz']:.0f} Hz, {r['from_s']:.1f} to {r['to_s']:.1f} s ({r['span']})")
    print(f"reference: {r['reference']}, rms {_axes(r['signal_rms_rad_s'])} rad/s")
    print(f"  {'way':42} {'torque':22} rms error x y z, rad/s")
    for w in r["ways"]:
        print(f"  {w['method']:42} {w['torque']:22} {_axes(w['rms_rad_s'])}")
    model = r["torque_model"]
    if "explained" in model:
        explained = " ".join(f"{100 * x:.0f}" for x in model["explained"])
        print(f"torque over inertia from the log explains {explained} % of the angular acceleration (x y z)")
    if r["note"]:
        print(f"note: {r['note']}")


def _axes(values: list[float]) -> str:
    return " ".join(f"{x:.4f}" for x in values)
