"""Rates without a gain to choose: a bank of observers that differ in bandwidth, judged by prediction alone.

Every member predicts the next attitude before it is seen; the member whose recent squared prediction error is smallest has the
right gains, whatever noise and manoeuvre are. 12 members are linear (a Kalman filter of constant angular acceleration, each with
its own ratio of jerk to noise), 5 are implicit third-order sliding mode observers with their own bound of the jerk. All of them
run all the time, so a change costs only the time to notice it. No constant below is set per log, rate or vehicle.

Source: the tracking index of Kalata 1984 for the linear members, Levant 2003 for the others; the geometry of An et al. 2013.
"""

import math
from typing import NamedTuple

import numpy as np

from mavquad import linalg, quat
from mavquad.estimate import gsmo_implicit, lie
from mavquad.jit import kernel
from mavquad.quat import Quat, Vec3

LINEAR = 12
THIRD = 5
MEMBERS = LINEAR + THIRD
INDEX = tuple(10.0 ** (i - 8) for i in range(LINEAR))  # jerk density T^5 / measurement variance: 1e-8 ... 1e3
JERK = tuple(10.0 ** (0.5 * i - 0.5) for i in range(THIRD))  # L of the third-order members [rad/s^3]: 0.316 ... 31.6
FORGET = 0.99  # of the squared prediction errors, per sample
D_MAX = 500.0  # clamp of the torque states [rad/s^2]
LOST_RAD = 0.2  # a member further off than this and 5 times as far as the best is set to the best


class Bank(NamedTuple):
    """All members, as arrays that the kernels change in place: `copy` it first where the old one is still wanted."""

    x: np.ndarray  # (MEMBERS,10): attitude 4, rates 3 [rad/s], torque over inertia that is not modelled 3 [rad/s^2]
    p: np.ndarray  # (LINEAR,6): covariance 00 01 02 11 12 22 of any one axis, in units of the measurement variance
    v: np.ndarray  # (MEMBERS,3): forgotten squared prediction errors in units of `scale`
    weight: np.ndarray  # (MEMBERS,3)
    scale: np.ndarray  # (3,): recent squared prediction error, common to all members [rad^2]
    best: np.ndarray  # (2,): forgotten number of judged samples, the best member


@kernel
def new(q: Quat) -> Bank:
    bank = Bank(
        np.zeros((MEMBERS, 10)),
        np.zeros((LINEAR, 6)),
        np.zeros((MEMBERS, 3)),
        np.zeros((MEMBERS, 3)),
        np.zeros(3),
        np.zeros(2),
    )
    start(bank, q)
    return bank


@kernel
def copy(bank: Bank) -> Bank:
    return Bank(bank.x.copy(), bank.p.copy(), bank.v.copy(), bank.weight.copy(), bank.scale.copy(), bank.best.copy())


@kernel
def start(bank: Bank, q: Quat) -> None:
    """The first sample: every member at it, at rest; nothing judged yet."""
    for i in range(MEMBERS):
        put_attitude(bank, i, q)
        for j in range(4, 10):
            bank.x[i, j] = 0.0
        for j in range(3):
            bank.v[i, j] = 0.0
            bank.weight[i, j] = 1.0 / MEMBERS
    for i in range(LINEAR):
        bank.p[i, 0] = 1.0
        for j in range(1, 6):
            bank.p[i, j] = 0.0
    bank.scale[0], bank.scale[1], bank.scale[2] = 0.0, 0.0, 0.0
    bank.best[0], bank.best[1] = 0.0, 0.0


@kernel
def put_attitude(bank: Bank, i: int, q: Quat) -> None:
    bank.x[i, 0], bank.x[i, 1], bank.x[i, 2], bank.x[i, 3] = q


@kernel
def attitude(bank: Bank, i: int) -> Quat:
    return (bank.x[i, 0], bank.x[i, 1], bank.x[i, 2], bank.x[i, 3])


@kernel
def advance(bank: Bank, gyro: Vec3, a: Vec3, dt_s: float, tick_s: float, gap_s: float) -> None:
    """All members dt_s on, in equal order-2 ticks; past gap_s the torque states fade with 1 s."""
    zero = (0.0, 0.0, 0.0)
    n = max(1, math.ceil(dt_s / tick_s - 1e-9))
    h = dt_s / n
    fade = math.exp(-h)
    for i in range(MEMBERS):
        q = attitude(bank, i)
        w = (bank.x[i, 4], bank.x[i, 5], bank.x[i, 6])
        d = (bank.x[i, 7], bank.x[i, 8], bank.x[i, 9])
        for k in range(n):
            f = linalg.add(a, d)
            q, w = lie.step_2(lie.CAYLEY, gyro, q, w, f, f, zero, zero, h)
            if k * h > gap_s:
                d = linalg.scale(fade, d)
        put_attitude(bank, i, q)
        for j in range(3):
            bank.x[i, 4 + j] = w[j]
            bank.x[i, 7 + j] = d[j]


@kernel
def linear_gains(bank: Bank, i: int, T: float, period_s: float) -> Vec3:
    """Covariance of linear member i over T seconds and one sample; its three gains. bank.p in place."""
    p00, p01, p02 = bank.p[i, 0], bank.p[i, 1], bank.p[i, 2]
    p11, p12, p22 = bank.p[i, 3], bank.p[i, 4], bank.p[i, 5]
    half = 0.5 * T * T
    jerk = INDEX[i] / period_s**5
    T2 = T * T
    T3 = T2 * T
    # M = F P F' + jerk Gamma with F = [1 T T^2/2; 0 1 T; 0 0 1]
    f00, f01, f02 = p00 + T * p01 + half * p02, p01 + T * p11 + half * p12, p02 + T * p12 + half * p22
    f11, f12 = p11 + T * p12, p12 + T * p22
    m00 = f00 + T * f01 + half * f02 + jerk * T3 * T2 / 20.0
    m01 = f01 + T * f02 + jerk * T2 * T2 / 8.0
    m02 = f02 + jerk * T3 / 6.0
    m11 = f11 + T * f12 + jerk * T3 / 3.0
    m12 = f12 + jerk * half
    m22 = p22 + jerk * T
    s = m00 + 1.0
    g0, g1, g2 = m00 / s, m01 / s, m02 / s
    bank.p[i, 0] = g0  # m00 - m00^2/s
    bank.p[i, 1] = m01 / s  # m01 - m00 m01/s
    bank.p[i, 2] = m02 / s
    bank.p[i, 3] = m11 - g1 * m01
    bank.p[i, 4] = m12 - g1 * m02
    bank.p[i, 5] = m22 - g2 * m02
    return (g0, g1, g2)


@kernel
def third_order(bank: Bank, j: int, r: Vec3, T: float) -> Vec3:
    """Correction of third-order member j (0 ...): rates and torque state in place; the attitude's share is given back."""
    i = LINEAR + j
    y0, w0, d0 = gsmo_implicit.correct_axis(gsmo_implicit.THIRD_ORDER, 0.0, 0.0, JERK[j], -r[0], T)
    y1, w1, d1 = gsmo_implicit.correct_axis(gsmo_implicit.THIRD_ORDER, 0.0, 0.0, JERK[j], -r[1], T)
    y2, w2, d2 = gsmo_implicit.correct_axis(gsmo_implicit.THIRD_ORDER, 0.0, 0.0, JERK[j], -r[2], T)
    bank.x[i, 4] -= w0
    bank.x[i, 5] -= w1
    bank.x[i, 6] -= w2
    bank.x[i, 7] -= d0
    bank.x[i, 8] -= d1
    bank.x[i, 9] -= d2
    return (r[0] + y0, r[1] + y1, r[2] + y2)


@kernel
def second_sample(bank: Bank, T: float) -> None:
    """Before the second sample: rates and torque states become unknown."""
    for i in range(LINEAR):
        bank.p[i, 3] = 1e4 / (T * T)
        bank.p[i, 5] = 1e2 / (T * T * T * T)


@kernel
def judge(bank: Bank, r: np.ndarray, n: int) -> None:
    """Prediction errors r (MEMBERS,3) [rad] of one sample enter the score; weights and the best member follow."""
    fresh = bank.best[0] == 0.0
    bank.best[0] = FORGET * bank.best[0] + 1.0
    for a in range(3):
        x = 0.0
        for i in range(MEMBERS):
            x += bank.weight[i, a] * r[i, a] * r[i, a]
        if fresh:
            bank.scale[a] = max(x, 1e-16)
        inverse = 1.0 / bank.scale[a]
        lowest = math.inf
        for i in range(MEMBERS):
            bank.v[i, a] = FORGET * bank.v[i, a] + r[i, a] * r[i, a] * inverse
            lowest = min(lowest, bank.v[i, a])
        rate = max(0.1 if x < bank.scale[a] else 0.01, 1.0 / max(n - 3, 1))
        bank.scale[a] = max(bank.scale[a] + rate * (x - bank.scale[a]), 1e-16)
        total = 0.0
        for i in range(MEMBERS):
            weight = ((bank.v[i, a] + 1e-12) / (lowest + 1e-12)) ** (-0.25 * bank.best[0])
            bank.weight[i, a] = weight
            total += weight
        for i in range(MEMBERS):
            bank.weight[i, a] /= total
    best, lowest = 0, math.inf
    for i in range(MEMBERS):
        score = math.log(bank.v[i, 0]) + math.log(bank.v[i, 1]) + math.log(bank.v[i, 2])
        if score < lowest:
            best, lowest = i, score
    bank.best[1] = best


@kernel
def rescue(bank: Bank, r: np.ndarray) -> None:
    """A member that is far off where the best is not, or not finite, goes on from the best."""
    m = int(bank.best[1])
    size_m = math.sqrt(r[m, 0] ** 2 + r[m, 1] ** 2 + r[m, 2] ** 2)
    for i in range(MEMBERS):
        size = math.sqrt(r[i, 0] ** 2 + r[i, 1] ** 2 + r[i, 2] ** 2)
        total = 0.0
        for j in range(10):
            total += bank.x[i, j]
        if not math.isfinite(total) or not math.isfinite(size) or (size > LOST_RAD and size > 5.0 * size_m):
            for j in range(10):
                bank.x[i, j] = bank.x[m, j]


@kernel
def correct(bank: Bank, q_meas: Quat, T: float, period_s: float, n: int) -> None:
    """One sample T seconds after the last one; n: samples accepted before it (>= 1); the members were advanced to it."""
    if n == 1:
        second_sample(bank, T)
    r = np.empty((MEMBERS, 3))
    for i in range(MEMBERS):
        r_i = lie.attitude_error(attitude(bank, i), q_meas)
        r[i, 0], r[i, 1], r[i, 2] = r_i
        if i < LINEAR:
            g0, g1, g2 = linear_gains(bank, i, T, period_s)
            turn = linalg.scale(g0, r_i)
            for j in range(3):
                bank.x[i, 4 + j] += g1 * r_i[j]
                bank.x[i, 7 + j] += g2 * r_i[j]
        else:
            turn = third_order(bank, i - LINEAR, r_i, T)
        for j in range(3):
            bank.x[i, 7 + j] = linalg.clip(bank.x[i, 7 + j], -D_MAX, D_MAX)
        put_attitude(bank, i, quat.mul(attitude(bank, i), quat.exp(turn)))
    if n >= 4 and not 2.5 * period_s <= T:
        judge(bank, r, n)
    rescue(bank, r)


@kernel
def mixed(bank: Bank) -> tuple[Quat, Vec3]:
    """What is published: the best member's attitude, the rates of all weighted axis by axis."""
    w0, w1, w2 = 0.0, 0.0, 0.0
    for i in range(MEMBERS):
        w0 += bank.weight[i, 0] * bank.x[i, 4]
        w1 += bank.weight[i, 1] * bank.x[i, 5]
        w2 += bank.weight[i, 2] * bank.x[i, 6]
    return attitude(bank, int(bank.best[1])), (w0, w1, w2)


@kernel
def noise_rad(bank: Bank) -> float:
    """Noise of the samples (1 sigma, per axis) as the best linear member has it; 0 before anything was judged.

    Its prediction error has the variance (1 + P) R, and 1/(1 + P) is what is left of P after a sample.
    """
    best, lowest = 0, math.inf
    for i in range(LINEAR):
        total = bank.v[i, 0] + bank.v[i, 1] + bank.v[i, 2]
        if total < lowest:
            best, lowest = i, total
    variance = (bank.scale[0] + bank.scale[1] + bank.scale[2]) / 3.0
    return math.sqrt(max(variance * (1.0 - bank.p[best, 0]), 0.0))
