"""A recorded flight as one sequence of events, and what an observer made of it: the form in which whole records are observed.

An observer of a record is one compiled loop over these events, built from the step kernels that fly; the tests hold both equal.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

ATTITUDE, POSITION, IMU, COMMAND = 0, 1, 2, 3
WIDTH = 7  # of a row: attitude q_wxyz, omega_rad_s; position p_ned_m, v_ned_m_s; imu accel_m_s2, gyro_rad_s; command roll, pitch, m/s^2

Array = NDArray[Any]


class Events(NamedTuple):
    """Samples of all kinds in the order of arrival."""

    kind: Array  # (n,) int64
    t_us: Array  # (n,) int64 vehicle time
    x: Array  # (n, WIDTH)
    step: Array  # (n,) bool: after this attitude the observer is asked for its estimate


class Observed(NamedTuple):
    """What one observer estimated at the m steps; NaN where it knew nothing. `sigma` and `low`/`high` only of those that say."""

    t_us: Array  # (m,)
    p_ned_m: Array  # (m, 3)
    v_ned_m_s: Array
    f_ned_m_s2: Array
    low_m_s2: Array  # (m, 3) of f
    high_m_s2: Array
    guaranteed: Array  # (m,) 1: the bounds hold by guarantee, 0: the data contradict them; NaN: no guarantee is claimed


def events(parts: dict[int, tuple[Array, Array, Array]], period_us: int) -> Events:
    """One sequence from (arrival_us (n,), t_us (n,), values (n, k)) of each kind; steps at least about period_us apart.

    Samples that are not finite are left out. What arrived at the same time stands in the order position, imu, command, attitude.
    """
    arrivals, stamps, kinds, rows = [], [], [], []
    for kind in (POSITION, IMU, COMMAND, ATTITUDE):
        if kind not in parts:
            continue
        arrival, t_us, values = parts[kind]
        good = np.isfinite(values).all(axis=1)
        row = np.zeros((int(good.sum()), WIDTH))
        row[:, : values.shape[1]] = values[good]
        arrivals.append(arrival[good])
        stamps.append(t_us[good])
        kinds.append(np.full(len(row), kind))
        rows.append(row)
    order = np.argsort(np.concatenate(arrivals), kind="stable") if arrivals else np.zeros(0, np.int64)
    if not order.size:
        return Events(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, WIDTH)), np.zeros(0, bool))
    kind, t_us = np.concatenate(kinds).astype(np.int64)[order], np.concatenate(stamps).astype(np.int64)[order]
    return Events(kind, t_us, np.concatenate(rows)[order], _steps(kind, t_us, period_us))


def _steps(kind: Array, t_us: Array, period_us: int) -> Array:
    """Attitudes that are newer than all before, each about a period (within half a sample) after the last one chosen."""
    step = np.zeros(kind.size, bool)
    at = np.flatnonzero(kind == ATTITUDE)
    if not at.size:
        return step
    t = t_us[at]
    newest = np.concatenate([[True], t[1:] > np.maximum.accumulate(t)[:-1]])
    at, t = at[newest], t[newest]
    gap = int(np.median(np.diff(t))) if t.size > 1 else 0
    due = int(t[0])
    for i, stamp in zip(at.tolist(), t.tolist(), strict=True):
        if stamp >= due - gap // 2:
            step[i] = True
            due = max(due + period_us, stamp + period_us // 2)
    return step


def outputs(events: Events) -> Observed:
    """Room for what is estimated at the steps, filled with NaN."""
    t_us = events.t_us[events.step]
    p, v, f, low, high = np.full((5, t_us.size, 3), np.nan)
    return Observed(t_us, p, v, f, low, high, np.full(t_us.size, np.nan))
