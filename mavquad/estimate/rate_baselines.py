"""The baselines that need no Lie group: quaternion sliding mode with forced renormalisation, and finite differences.

The traditional observers integrate the four components of the quaternion and bring them back to unit length after each step:
what the paper (An et al. 2013, section 1) says harms the tracking. It does not: the equation is linear in q, so a change of
length commutes with it.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from mavquad import linalg, quat
from mavquad.estimate import gsmo_relay, lie
from mavquad.jit import kernel
from mavquad.quat import Quat, Vec3

EULER, RK4, ADDITIVE = 0, 1, 2  # ADDITIVE: Euler with the relay on the four components, a floor


class Gains(NamedTuple):
    scheme: int  # EULER, RK4, ADDITIVE
    hold: bool  # compare with the last sample as it came, instead of moving it along
    k1: float  # rad/s
    k2: float  # rad/s^2
    gyro: Vec3


class State(NamedTuple):
    q: Quat
    w: Vec3
    z: Quat  # the last sample, moved along unless held


@kernel
def rotate_rate(q: Quat, w: Vec3) -> Quat:
    """q' = q (x) w / 2, Eq. (24)."""
    return quat.mul(q, (0.0, 0.5 * w[0], 0.5 * w[1], 0.5 * w[2]))


@kernel
def axpy4(s: float, a: Quat, b: Quat) -> Quat:
    """s a + b."""
    return (s * a[0] + b[0], s * a[1] + b[1], s * a[2] + b[2], s * a[3] + b[3])


@kernel
def tick(gains: Gains, state: State, a0: Vec3, a1: Vec3, a2: Vec3, h: float) -> State:
    """One tick of h seconds; a0, a1, a2: torque over inertia [rad/s^2] now, h/2 and h later."""
    q, w, z = state
    e = lie.vector_error(z, q)
    s = (gsmo_relay.sign(e[0]), gsmo_relay.sign(e[1]), gsmo_relay.sign(e[2]))
    i1, i2 = linalg.scale(gains.k1, s), linalg.scale(gains.k2, s)
    z_next = z
    if not gains.hold:
        w_mid = linalg.axpy(0.5 * h, lie.rate_derivative(gains.gyro, w, a0), w)
        z_next = quat.mul(z, quat.cayley(linalg.scale(h, w_mid)))
    if gains.scheme == RK4:
        l1 = linalg.sub(lie.rate_derivative(gains.gyro, w, a0), i2)
        k1 = rotate_rate(q, linalg.sub(w, i1))
        w2 = linalg.axpy(0.5 * h, l1, w)
        l2 = linalg.sub(lie.rate_derivative(gains.gyro, w2, a1), i2)
        k2 = rotate_rate(axpy4(0.5 * h, k1, q), linalg.sub(w2, i1))
        w3 = linalg.axpy(0.5 * h, l2, w)
        l3 = linalg.sub(lie.rate_derivative(gains.gyro, w3, a1), i2)
        k3 = rotate_rate(axpy4(0.5 * h, k2, q), linalg.sub(w3, i1))
        w4 = linalg.axpy(h, l3, w)
        l4 = linalg.sub(lie.rate_derivative(gains.gyro, w4, a2), i2)
        k4 = rotate_rate(axpy4(h, k3, q), linalg.sub(w4, i1))
        c = h / 6.0
        q = axpy4(c, axpy4(2.0, k2, k1), axpy4(c, axpy4(2.0, k3, k4), q))
        w = linalg.axpy(c, linalg.axpy(2.0, l2, l1), linalg.axpy(c, linalg.axpy(2.0, l3, l4), w))
    else:
        rate = rotate_rate(q, linalg.sub(w, i1))
        if gains.scheme == ADDITIVE:
            same = 1.0 if quat.mul(quat.conj(z), q)[0] >= 0.0 else -1.0
            free = rotate_rate(q, w)
            rate = (
                free[0] - gains.k1 * gsmo_relay.sign(q[0] - same * z[0]),
                free[1] - gains.k1 * gsmo_relay.sign(q[1] - same * z[1]),
                free[2] - gains.k1 * gsmo_relay.sign(q[2] - same * z[2]),
                free[3] - gains.k1 * gsmo_relay.sign(q[3] - same * z[3]),
            )
        w = linalg.axpy(h, linalg.sub(lie.rate_derivative(gains.gyro, w, a0), i2), w)
        q = axpy4(h, rate, q)
    return State(quat.normalize(q), w, z_next)


@kernel
def difference(q_before: Quat, q_now: Quat, dt_s: float) -> Vec3:
    """Mean body rate between two attitudes: log(q_before* (x) q_now)/dt; the rate half a sample ago."""
    return linalg.scale(1.0 / dt_s, quat.log(quat.mul(quat.conj(q_before), q_now)))


@kernel
def difference_run(t_us: np.ndarray, q_wxyz: np.ndarray, extrapolate_s: float) -> np.ndarray:
    """Rates (n,3) at every sample from differences alone; with extrapolate_s = 0 the plain one.

    A positive extrapolate_s carries the last two differences on to the present as a straight line, over half a sample; after a
    gap longer than extrapolate_s the plain difference is given, since a line through it says nothing.
    """
    n = len(t_us)
    out = np.zeros((n, 3))
    last, last_dt = (0.0, 0.0, 0.0), math.inf
    for k in range(1, n):
        dt = 1e-6 * (t_us[k] - t_us[k - 1])
        before = (q_wxyz[k - 1, 0], q_wxyz[k - 1, 1], q_wxyz[k - 1, 2], q_wxyz[k - 1, 3])
        now = (q_wxyz[k, 0], q_wxyz[k, 1], q_wxyz[k, 2], q_wxyz[k, 3])
        if not dt > 0.0:
            out[k] = out[k - 1]
            continue
        d = difference(before, now, dt)
        ahead = dt / (dt + last_dt) if dt + last_dt < extrapolate_s else 0.0
        for i in range(3):
            out[k, i] = d[i] + ahead * (d[i] - last[i])
        last, last_dt = d, dt
    return out


def extrapolated_difference(t_us: npt.NDArray[np.int64], q_wxyz: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Rates (n,3) [rad/s] from the last three samples: the difference carried on by half a sample."""
    return difference_run(t_us, q_wxyz, 1.0)


def plain_difference(t_us: npt.NDArray[np.int64], q_wxyz: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Rates (n,3) [rad/s] from the last two samples, half a sample late."""
    return difference_run(t_us, q_wxyz, 0.0)


def central_difference(t_us: npt.NDArray[np.int64], q_wxyz: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Zero-phase rates (n,3) [rad/s] from the neighbours on both sides: the reference on recordings, not available live."""
    d = difference_run(t_us, q_wxyz, 0.0)
    dt = np.diff(t_us).astype(np.float64)
    out = d.copy()
    weight = (dt[:-1] / (dt[:-1] + dt[1:]))[:, None]
    out[1:-1] = (1.0 - weight) * d[1:-1] + weight * d[2:]
    return out
