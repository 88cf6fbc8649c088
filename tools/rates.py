"""Body rates of a recorded flight, from its attitude quaternions alone: the observer beside the plain ways to differentiate.

The reference is the zero-phase rate of the same quaternions (central difference): the best that a recording of an autopilot holds.
Its gyro is low-pass filtered and its attitude was integrated from it; neither is truth.

Torque over inertia comes from SERVO_OUTPUT_RAW by least squares on the log itself: w' = A u + b, with u the four outputs (0..1)
behind a first-order lag, whose time constant is the best of a grid; the w' is the reference's own derivative.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, lfilter, lfilter_zi

from mavquad.errors import LogError

Array = NDArray[np.float64]
LAGS_S = (0.0, 0.01, 0.02, 0.03, 0.05, 0.075, 0.1, 0.15)  # of the motors, tried in turn


class Attitudes(NamedTuple):
    """One stream of attitude quaternions in vehicle time, strictly increasing, without sign jumps."""

    t_us: NDArray[np.int64]
    q_wxyz: Array  # (n, 4)
    dropped: int  # repeated, late or broken samples


class TorqueModel(NamedTuple):
    """Torque over inertia from four outputs: w' = A lag(u) + b."""

    A: Array  # (3, 4) [rad/s^2 per full output]
    b: Array  # (3,)
    lag_s: float
    explained: Array  # (3,) share of the variance of w'


def attitudes(t_us: NDArray[np.int64], q_wxyz: Array) -> Attitudes:
    """Good samples only: finite, |q| within 5 % of 1, time running forward; each with the sign nearest to the one before."""
    norm = np.linalg.norm(q_wxyz, axis=1)
    good = np.isfinite(norm) & (np.abs(norm - 1.0) < 0.05)
    good &= np.concatenate([[True], t_us[1:] > np.maximum.accumulate(t_us)[:-1]]) if len(t_us) else good
    t, q = t_us[good], q_wxyz[good] / norm[good, None]
    if len(t) < 4:
        raise LogError(f"{len(t)} usable attitude quaternions, at least 4 are needed for a rate")
    flips = np.cumprod(np.where(np.sum(q[1:] * q[:-1], axis=1) < 0.0, -1.0, 1.0))
    q[1:] *= flips[:, None]
    return Attitudes(t, q, int(len(t_us) - len(t)))


def turn(q0: Array, q1: Array) -> Array:
    """The rotation vectors (n, 3) of conj(q0) * q1: what a body turned from q0 to q1, in body axes [rad]."""
    w = np.sum(q0 * q1, axis=1)
    v = q0[:, :1] * q1[:, 1:] - q1[:, :1] * q0[:, 1:] - np.cross(q0[:, 1:], q1[:, 1:])
    size = np.linalg.norm(v, axis=1)
    angle = 2.0 * np.arctan2(size, np.abs(w)) * np.where(w < 0.0, -1.0, 1.0)
    return v * np.where(size > 1e-12, angle / np.maximum(size, 1e-12), 2.0)[:, None]


def reference(a: Attitudes) -> Array:
    """Zero-phase rates (n, 3): from the sample before to the sample after. NaN at both ends and beside gaps."""
    t = 1e-6 * a.t_us
    out = np.full((len(t), 3), np.nan)
    span = t[2:] - t[:-2]
    out[1:-1] = turn(a.q_wxyz[:-2], a.q_wxyz[2:]) / span[:, None]
    steps = np.diff(t)
    gap = (steps[1:] > 2.5 * np.median(steps)) | (steps[:-1] > 2.5 * np.median(steps))
    out[1:-1][gap] = np.nan
    return out


def difference(a: Attitudes) -> Array:
    """The newest rate known at each sample (n, 3): from the sample before; half a sample late. The first is zero."""
    rate = turn(a.q_wxyz[:-1], a.q_wxyz[1:]) / (1e-6 * np.diff(a.t_us))[:, None]
    return np.vstack([np.zeros(3), rate])


def extrapolated(rate: Array) -> Array:
    """A plain difference carried on by half a sample: as new as the sample itself, and noisier."""
    ahead = rate.copy()
    ahead[2:] += 0.5 * (rate[2:] - rate[1:-1])
    return ahead


def butterworth(a: Attitudes, rate: Array, cut_hz: float) -> Array:
    """Second-order low-pass of a rate at the stream's median sample rate, causal, started at the first value."""
    sample_hz = 1e6 / float(np.median(np.diff(a.t_us)))
    if cut_hz >= 0.5 * sample_hz:
        return rate.copy()
    b, c = butter(2, cut_hz, fs=sample_hz)
    return lfilter(b, c, rate, axis=0, zi=lfilter_zi(b, c)[:, None] * rate[0])[0]


def fit_torque(a: Attitudes, t_servo_us: NDArray[np.int64], u: Array, within: NDArray[np.bool_]) -> tuple[TorqueModel, Array]:
    """The model of torque over inertia fitted on samples `within`, and the torque it gives at every attitude sample (n, 3).

    t_servo_us (m,), u (m, 4) 0..1. Raises LogError where the outputs do not move enough to tell their effect.
    """
    w = reference(a)
    t = 1e-6 * a.t_us
    accel = np.gradient(w, t, axis=0)
    use = within & np.isfinite(accel).all(axis=1)
    if use.sum() < 200:
        raise LogError(f"{int(use.sum())} samples to fit a torque model on, at least 200 are needed")
    best: tuple[float, TorqueModel, Array] | None = None
    for lag_s in LAGS_S:
        lagged = np.column_stack([np.interp(t, 1e-6 * t_servo_us, column) for column in _lag(t_servo_us, u, lag_s).T])
        rows = np.column_stack([lagged, np.ones(len(t))])
        solution, _, rank, _ = np.linalg.lstsq(rows[use], accel[use], rcond=None)
        if rank < 5:
            raise LogError("the four outputs do not move enough, or not independently: no torque model can be fitted")
        given = rows @ solution
        left = np.sum((accel[use] - given[use]) ** 2, axis=0)
        whole = np.sum((accel[use] - accel[use].mean(0)) ** 2, axis=0)
        score = float(np.sum(left / whole))
        if best is None or score < best[0]:
            best = (score, TorqueModel(solution[:4].T.copy(), solution[4].copy(), lag_s, 1.0 - left / whole), given)
    assert best is not None
    return best[1], best[2]


def _lag(t_us: NDArray[np.int64], u: Array, lag_s: float) -> Array:
    if lag_s == 0.0:
        return u
    period_s = 1e-6 * float(np.median(np.diff(t_us)))
    keep = math.exp(-period_s / lag_s)
    return lfilter([1.0 - keep], [1.0, -keep], u, axis=0, zi=keep * u[:1])[0]


def rms(error: Array, use: NDArray[np.bool_]) -> list[float]:
    """Root mean square per axis over the samples `use` where it is known."""
    return [float(x) for x in np.sqrt(np.nanmean(error[use] ** 2, axis=0))]
