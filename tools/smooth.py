"""A reference for logs without truth: an offline Rauch-Tung-Striebel smoother (filterpy) of the same measurements.

Per axis of the world position, velocity and disturbance acceleration f, which walks at random; measured are the autopilot's position
and velocity. The known acceleration (gravity, commanded thrust behind the rotors' lag along the reported attitude) is integrated
twice and taken off the measurements first, since filterpy's smoother knows no input: for a linear model the two are the same.
It looks into the future, and it shares its measurements with what it judges: a reference, not truth.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.signal import lfilter

from mavquad.errors import LogError
from tools.observers import Reference
from tools.recorded import G_M_S2, Flown

Array = NDArray[Any]
NAME = "offline Rauch-Tung-Striebel smoother (filterpy) of the same measurements; not truth"
SIGMA_M, SIGMA_M_S = 0.02, 0.03  # of telemetry, as the observers take it
F_GROWTH_M2_S5 = 2.0  # of f's variance per second: 0.02 per 10 ms, the extended-state filter's
_GAP_S = 1.0  # a longer silence cuts the record: nothing is smoothed across it


def reference(flight: Flown, steps_us: Array) -> Reference:
    """Smoothed position, velocity and disturbance at the steps. Raises LogError where there is no position in the log."""
    if flight.position is None:
        raise LogError(f"{flight.recording.path}: no position in it: nothing to compare a disturbance with")
    t_us, p, v = _increasing(*flight.position.columns)
    if t_us.size < 10:
        raise LogError(f"{flight.recording.path}: {t_us.size} positions in it, at least 10 are needed for a reference")
    moved, gained = _known_motion(flight, t_us)
    cuts = np.flatnonzero(np.diff(t_us) > 1e6 * _GAP_S) + 1
    out = np.full((3, t_us.size, 3), np.nan)
    for part in np.split(np.arange(t_us.size), cuts):
        if part.size >= 10:
            out[:, part] = _smoothed(1e-6 * np.diff(t_us[part]), p[part] - moved[part], v[part] - gained[part])
    out[0] += moved
    out[1] += gained
    columns = [_at(steps_us, t_us, values) for values in out]
    return Reference(NAME, False, steps_us, *columns)


def _increasing(t_us: Array, p: Array, v: Array) -> tuple[Array, Array, Array]:
    order = np.argsort(t_us, kind="stable")
    t_us, p, v = t_us[order], p[order], v[order]
    keep = np.concatenate([[True], np.diff(t_us) > 0])
    return t_us[keep], p[keep], v[keep]


def _known_motion(flight: Flown, t_us: Array) -> tuple[Array, Array]:
    """What gravity and the commanded thrust alone would have moved and gained since the first of t_us: (n, 3) each."""
    ta, q, _ = _increasing(flight.attitude.columns[0], *flight.attitude.columns[1:3])
    thrust = _thrust(flight, ta)
    w, x, y, z = q.T
    up = np.column_stack([2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)])
    a = np.array([0.0, 0.0, G_M_S2]) - thrust[:, None] * up
    dt = (1e-6 * np.diff(ta))[:, None]
    gained = np.vstack([np.zeros(3), np.cumsum(0.5 * dt * (a[1:] + a[:-1]), axis=0)])
    moved = np.vstack([np.zeros(3), np.cumsum(dt * gained[:-1] + dt**2 * (2.0 * a[:-1] + a[1:]) / 6.0, axis=0)])
    columns = [
        np.column_stack([np.interp(t_us.astype(float), ta.astype(float), c) for c in values.T]) for values in (moved, gained)
    ]
    return columns[0], columns[1]


def _thrust(flight: Flown, t_us: Array) -> Array:
    """Specific thrust that acted at each time, behind the rotors' lag."""
    if flight.command is None:
        return np.full(t_us.size, G_M_S2)
    order = np.argsort(flight.command.t_us, kind="stable")
    at = np.searchsorted(flight.command.t_us[order], t_us, side="right") - 1
    sent = np.where(at >= 0, flight.command.thrust_m_s2[order][np.maximum(at, 0)], G_M_S2)
    lag_s = flight.vehicle.rotors.lag_s if flight.vehicle.rotors else 0.0
    period_s = 1e-6 * float(np.median(np.diff(t_us)))
    if lag_s <= 0.0 or flight.command.source.endswith("felt"):
        return sent
    keep = math.exp(-period_s / lag_s)
    lagged: Array = lfilter([1.0 - keep], [1.0, -keep], sent, zi=keep * sent[:1])[0]
    return lagged


def _smoothed(dt_s: Array, p: Array, v: Array) -> Array:
    """(3, n, 3) position, velocity, f from positions and velocities (n, 3); one filter for the three axes."""
    from filterpy.kalman import KalmanFilter  # slow to import, drags much along

    n = len(p)
    f = KalmanFilter(dim_x=9, dim_z=6)
    f.x = np.column_stack([p[0], v[0], np.zeros(3)]).reshape(9, 1)
    f.P = np.diag([SIGMA_M**2, SIGMA_M_S**2, 9.0] * 3)
    f.H = block_diag(*[[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]] * 3)
    f.R = np.diag([SIGMA_M**2, SIGMA_M_S**2] * 3)
    models: dict[float, tuple[Array, Array]] = {}
    Fs, Qs = [np.eye(9)], [np.zeros((9, 9))]
    for step_s in np.round(dt_s, 6).tolist():
        if step_s not in models:
            models[step_s] = _model(step_s)
        Fs.append(models[step_s][0])
        Qs.append(models[step_s][1])
    z = np.column_stack([p[:, 0], v[:, 0], p[:, 1], v[:, 1], p[:, 2], v[:, 2]])[:, :, None]
    means, covariances, _, _ = f.batch_filter(z, Fs=Fs, Qs=Qs)
    # filterpy's smoother reaches from k to k + 1 by F[k + 1], as its filter does
    x, _, _, _ = f.rts_smoother(means, covariances, Fs=Fs, Qs=Qs)
    return np.moveaxis(x.reshape(n, 3, 3), 2, 0)


def _model(dt_s: float) -> tuple[Array, Array]:
    """F and Q (9, 9) over dt of three triple integrators driven by white noise."""
    one = np.array([[1.0, dt_s, 0.5 * dt_s**2], [0.0, 1.0, dt_s], [0.0, 0.0, 1.0]])
    q = np.array(
        [
            [dt_s**5 / 20.0, dt_s**4 / 8.0, dt_s**3 / 6.0],
            [dt_s**4 / 8.0, dt_s**3 / 3.0, dt_s**2 / 2.0],
            [dt_s**3 / 6.0, dt_s**2 / 2.0, dt_s],
        ]
    )
    return block_diag(one, one, one), block_diag(*[F_GROWTH_M2_S5 * q] * 3)


def _at(when_us: Array, t_us: Array, values: Array) -> Array:
    """Columns (n, 3) at other times, NaN outside."""
    x, grid = when_us.astype(float), t_us.astype(float)
    return np.column_stack([np.interp(x, grid, c, np.nan, np.nan) for c in values.T])
