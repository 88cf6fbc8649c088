"""Multiplicative extended Kalman filter for body rates from attitude: the baseline with covariances.

States: attitude error (rotation vector, body side), rates and, with nine states, a torque bias; six states are nine whose bias
has no variance. Motion: the rigid body driven by the torque over inertia, white angular acceleration, and a random walk of the
bias.

Source: Lefferts, Markley & Shuster 1982, with rates as states instead of a gyro.
"""

from typing import NamedTuple

import numpy as np

from mavquad import linalg, quat
from mavquad.estimate import lie
from mavquad.jit import kernel
from mavquad.quat import Quat, Vec3


class Gains(NamedTuple):
    accel_noise: float  # rad/s^2/sqrt(Hz): white angular acceleration
    bias_walk: float  # rad/s^3/sqrt(Hz): walk of the torque bias; 0 with six states
    attitude_noise_rad: float  # per axis, 1 sigma
    start_rad: float  # 1 sigma of the start
    start_rad_s: float
    start_rad_s2: float  # 0 with six states
    gyro: Vec3


class State(NamedTuple):
    q: Quat
    w: Vec3
    d: Vec3  # torque bias over inertia [rad/s^2]
    p: np.ndarray  # (9,9) covariance of (attitude, rates, bias)


@kernel
def init(gains: Gains, q: Quat, w: Vec3) -> State:
    """Start at (q, w), no bias, with the variances of the gains."""
    p = np.zeros((9, 9))
    for i in range(3):
        p[i, i] = gains.start_rad**2
        p[3 + i, 3 + i] = gains.start_rad_s**2
        p[6 + i, 6 + i] = gains.start_rad_s2**2
    return State(q, w, (0.0, 0.0, 0.0), p)


@kernel
def transition(gains: Gains, w: Vec3, h: float) -> np.ndarray:
    """(9,9) transition of the error state over h, to second order in h: 1 + F h + (F h)^2/2."""
    g = gains.gyro
    f = np.zeros((9, 9))
    f[0, 1], f[0, 2] = w[2], -w[1]  # -w x (attitude error)
    f[1, 0], f[1, 2] = -w[2], w[0]
    f[2, 0], f[2, 1] = w[1], -w[0]
    f[3, 4], f[3, 5] = g[0] * w[2], g[0] * w[1]  # gyroscopic term
    f[4, 3], f[4, 5] = g[1] * w[2], g[1] * w[0]
    f[5, 3], f[5, 4] = g[2] * w[1], g[2] * w[0]
    for i in range(3):
        f[i, 3 + i] = 1.0
        f[3 + i, 6 + i] = 1.0
    out = np.zeros((9, 9))
    for i in range(9):
        for j in range(9):
            total = 0.0
            for k in range(9):
                total += f[i, k] * f[k, j]
            out[i, j] = h * f[i, j] + 0.5 * h * h * total
        out[i, i] += 1.0
    return out


@kernel
def predict(gains: Gains, state: State, a0: Vec3, a1: Vec3, h: float) -> State:
    """h seconds on; a0, a1: torque over inertia now and h/2 later."""
    zero = (0.0, 0.0, 0.0)
    q, w = lie.step_2(lie.CAYLEY, gains.gyro, state.q, state.w, linalg.add(a0, state.d), linalg.add(a1, state.d), zero, zero, h)
    phi = transition(gains, linalg.scale(0.5, linalg.add(w, state.w)), h)
    half = np.zeros((9, 9))
    p = np.zeros((9, 9))
    for i in range(9):
        for j in range(9):
            total = 0.0
            for k in range(9):
                total += phi[i, k] * state.p[k, j]
            half[i, j] = total
    for i in range(9):
        for j in range(i + 1):
            total = 0.0
            for k in range(9):
                total += half[i, k] * phi[j, k]
            p[i, j] = total
            p[j, i] = total
    qa, qd = gains.accel_noise**2, gains.bias_walk**2
    for i in range(3):
        p[i, i] += qa * h**3 / 3.0
        p[i, 3 + i] += qa * h**2 / 2.0
        p[3 + i, i] += qa * h**2 / 2.0
        p[3 + i, 3 + i] += qa * h + qd * h**3 / 3.0
        p[3 + i, 6 + i] += qd * h**2 / 2.0
        p[6 + i, 3 + i] += qd * h**2 / 2.0
        p[6 + i, 6 + i] += qd * h
    return State(q, w, state.d, p)


@kernel
def update(gains: Gains, state: State, q_meas: Quat) -> State:
    """One attitude sample (unit)."""
    r = quat.log(quat.mul(quat.conj(state.q), q_meas))
    s = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            s[i, j] = state.p[i, j]
        s[i, i] += gains.attitude_noise_rad**2
    lower = np.zeros((3, 3))
    linalg.cholesky(s, lower)
    gain_t = np.zeros((3, 9))  # S^-1 H P
    for i in range(3):
        for j in range(9):
            gain_t[i, j] = state.p[i, j]
    linalg.cholesky_solve(lower, gain_t)
    x = np.zeros(9)
    p = np.zeros((9, 9))
    for i in range(9):
        x[i] = gain_t[0, i] * r[0] + gain_t[1, i] * r[1] + gain_t[2, i] * r[2]
        for j in range(9):
            correction = gain_t[0, i] * state.p[0, j] + gain_t[1, i] * state.p[1, j] + gain_t[2, i] * state.p[2, j]
            p[i, j] = state.p[i, j] - correction
    linalg.symmetrize(p)
    return State(
        quat.mul(state.q, quat.exp((x[0], x[1], x[2]))),
        (state.w[0] + x[3], state.w[1] + x[4], state.w[2] + x[5]),
        (state.d[0] + x[6], state.d[1] + x[7], state.d[2] + x[8]),
        p,
    )
