"""How well a flight went: the companion's trace against the truth in the simulated autopilot's log.

Times are vehicle times (the autopilot's clock) on both sides; the truth is interpolated at the times of the trace. Scored is the
engaged part from `score_from_s` after the engagement to the end of the path.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mavquad.errors import LogError
from mavquad.link.columns import Log
from tools.trace import Array, Trace

TRUTH = ("f_n", "f_e", "f_d", "tau_x", "tau_y", "tau_z", "wind_n", "wind_e", "wind_d", "thrust", "misses", "engaged")


class Truth(NamedTuple):
    """What really happened, per control period of the simulated autopilot; times in vehicle us."""

    t_us: NDArray[np.int64]
    p_ned_m: Array  # (n, 3)
    q_wxyz: Array  # (n, 4)
    omega_rad_s: Array  # (n, 3) body
    extra: dict[str, Array]  # by the names of TRUTH


def truth(log: Log) -> Truth:
    """The truth frames of a sitl.tlog. Raises LogError where it has none."""
    odometry = log.columns("ODOMETRY")
    extra = log.columns("DEBUG_FLOAT_ARRAY", component=int(log.find("ODOMETRY")[0].component))
    extra = extra[extra["name"] == b"truth"]
    if len(extra) < 2:
        raise LogError(f"{log.path}: no truth in it; expected DEBUG_FLOAT_ARRAY 'truth' frames")
    t_us = odometry["time_usec"].astype(np.int64)
    t_extra = extra["time_usec"].astype(np.int64)
    columns = {name: np.interp(t_us, t_extra, extra["data"][:, i].astype(float)) for i, name in enumerate(TRUTH)}
    return Truth(
        t_us,
        np.column_stack([odometry[k] for k in "xyz"]).astype(float),
        odometry["q"].astype(float),
        np.column_stack([odometry[f"{k}speed"] for k in ("roll", "pitch", "yaw")]).astype(float),
        columns,
    )


def at(t_us: NDArray[Any], values: Array, when_us: NDArray[Any]) -> Array:
    """Columns of `values` (n, k) interpolated at `when_us` (m,) -> (m, k)."""
    return np.column_stack([np.interp(when_us, t_us, column) for column in values.T])


def engaged_us(trace: Trace, state: float) -> int | None:
    """The vehicle time of the first engaged step, or None."""
    rows = np.flatnonzero(trace.column("state") == state)
    return int(trace.column("t_us")[rows[0]]) if len(rows) else None


def scored(trace: Trace, state: float, from_s: float, path_s: float) -> NDArray[np.bool_]:
    """Rows that count: engaged, from `from_s` after the engagement until `path_s` after it."""
    start = engaged_us(trace, state)
    if start is None:
        return np.zeros(len(trace.rows), bool)
    t_s = 1e-6 * (trace.column("t_us") - start)
    inside: NDArray[np.bool_] = (trace.column("state") == state) & (t_s >= from_s) & (t_s <= path_s)
    return inside


def position_error(trace: Trace, true: Truth) -> Array:
    """Where the vehicle was, less where the path wanted it (n, 3) NED [m]; NaN where there was no path."""
    return at(true.t_us, true.p_ned_m, trace.column("t_us")) - trace.vector("ref_p")


def position_scores(error: Array) -> dict[str, Any]:
    """rmse per axis and in space, and the largest error [m]."""
    if not len(error) or not np.isfinite(error).all():
        return {"rmse_m": {k: math.nan for k in ("n", "e", "d", "position")}, "max_error_m": math.nan}
    size2 = np.sum(error**2, axis=1)
    axes = dict(zip("ned", (float(x) for x in np.sqrt(np.mean(error**2, axis=0))), strict=True))
    return {"rmse_m": {**axes, "position": float(np.sqrt(size2.mean()))}, "max_error_m": float(np.sqrt(size2.max()))}


def rate_scores(trace: Trace, true: Truth, use: NDArray[np.bool_], gyro: NDArray[Any] | None) -> dict[str, list[float]]:
    """Body-rate rmse per axis [rad/s] of every observer in the trace, and of the gyro's samples over the same time."""
    if not use.any():
        return {}
    t_us = trace.column("t_us")[use]
    real = at(true.t_us, true.omega_rad_s, t_us)
    labels = [name.removesuffix(" w_x") for name in trace.names if name.endswith(" w_x")]
    scores = {label: _rms(trace.vector(f"{label} w", "xyz")[use] - real) for label in labels}
    if gyro is not None:
        stamps = gyro["time_usec"].astype(np.int64)
        inside = (stamps >= t_us[0]) & (stamps <= t_us[-1])
        if inside.any():
            measured = np.column_stack([gyro[f"{axis}gyro"] for axis in "xyz"])[inside].astype(float)
            scores["gyro"] = _rms(measured - at(true.t_us, true.omega_rad_s, stamps[inside]))
    return scores


def model_error(trace: Trace, true: Truth) -> Array:
    """What the compensator's model really lacked (n, 3) NED [m/s^2]: the disturbance, and thrust other than the model thinks."""
    t_us = trace.column("t_us")
    w, x, y, z = at(true.t_us, true.q_wxyz, t_us).T
    axis = np.column_stack([2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)])
    missing = trace.column("asmf thrust") - np.interp(t_us, true.t_us, true.extra["thrust"])
    force = np.column_stack([np.interp(t_us, true.t_us, true.extra[f"f_{i}"]) for i in "ned"])
    return force + missing[:, None] * axis


def bounds_scores(trace: Trace, true: Truth) -> dict[str, Any]:
    """How the published bounds of the model error did: truth inside, their width, how often the data contradicted them."""
    if "asmf f_n" not in trace.names or not len(trace.rows):
        return {}
    real = model_error(trace, true)
    low, high = (np.column_stack([trace.column(f"asmf f_{i}_{side}") for i in "ned"]) for side in ("low", "high"))
    known = np.isfinite(low).all(axis=1)
    if not known.any():
        return {}
    inside = np.all((real >= low) & (real <= high), axis=1)[known]
    return {
        "bounds": {
            "inside_pct": 100.0 * float(inside.mean()),
            "half_width_m_s2": 0.5 * float((high - low)[known].mean()),
            "f_error_m_s2": float(np.abs(trace.vector("asmf f") - real)[known].mean()),
            "guarantee_pct": 100.0 * float(trace.column("asmf guarantee")[known].mean()),
            "empty": int(trace.column("asmf empty")[-1]),
            "inflations": int(trace.column("asmf inflations")[-1]),
        }
    }


def disturbance_scores(trace: Trace, true: Truth) -> dict[str, Any]:
    """How the estimated disturbance acceleration follows the true one, over the axes together, each less its mean.

    correlation at once; lag_s: the delay (0 to 1 s) at which the estimate fits best, and the correlation there; rms error [m/s^2].
    Nothing where the flight has no estimate, or nothing to follow.
    """
    estimate, t_us = trace.vector("f"), trace.column("t_us")
    known = np.isfinite(estimate).all(axis=1)
    if known.sum() < 100:
        return {}
    estimate, t_us = estimate[known], t_us[known]

    def real(lag_s: float) -> Array:
        force = [np.interp(t_us - 1e6 * lag_s, true.t_us, true.extra[f"f_{i}"]) for i in "ned"]
        return np.column_stack(force)

    def correlation(lag_s: float) -> float:
        a, b = real(lag_s), estimate
        a, b = a - a.mean(axis=0), b - b.mean(axis=0)
        size = float(np.sqrt(np.sum(a**2) * np.sum(b**2)))
        return float(np.sum(a * b)) / size if size > 0.0 else math.nan

    lags = np.arange(0.0, 1.0, 0.01)
    found = [correlation(lag) for lag in lags]
    if not np.isfinite(found).all():
        return {}
    best = int(np.argmax(found))
    error = float(np.sqrt(np.mean(np.sum((estimate - real(0.0)) ** 2, axis=1))))
    return {
        "disturbance": {"correlation": found[0], "lag_s": float(lags[best]), "best": found[best], "error_m_s2": error},
    }


def messages_lost(log: Log, systems: set[tuple[int, int]] | None = None) -> int:
    """Gaps in the sequence numbers of every sender (or of those given), added up."""
    senders: dict[tuple[int, int], list[tuple[NDArray[np.int64], NDArray[np.uint8]]]] = {}
    for stream in log.streams:
        key = (stream.system, stream.component)
        if stream.msgid in log.dialect.classes and (systems is None or key in systems):
            senders.setdefault(key, []).append((log.numbers(stream), log.rows(stream)["frame_seq"]))
    lost = 0
    for parts in senders.values():
        numbers = np.concatenate([n for n, _ in parts])
        seq = np.concatenate([s for _, s in parts])[np.argsort(numbers)].astype(np.int64)
        gaps = np.diff(seq) % 256
        lost += int(np.sum(gaps[gaps > 0] - 1))
    return lost


def _rms(error: Array) -> list[float]:
    return [float(x) for x in np.sqrt(np.mean(error**2, axis=0))]
