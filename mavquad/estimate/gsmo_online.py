"""Rates without a gain to choose: a bank of observers that differ in bandwidth, judged by prediction alone.

Every member (gsmo_members) predicts the next attitude before it is seen; the member whose recent squared prediction error is
smallest has the right gains, whatever noise and manoeuvre are. All of them run all the time, so a change costs only the time to
notice it. No constant is set per log, rate or vehicle.
"""

import math
from typing import NamedTuple

import numpy as np

from mavquad.estimate import gsmo_members as members
from mavquad.estimate.gsmo_members import COLOURED, EACH, LINEAR, MEMBERS, TAUS_S, THIRD, WHITE
from mavquad.jit import kernel
from mavquad.quat import Quat, Vec3

FORGET = 0.99  # of the squared prediction errors, per sample
LOST_RAD = 0.2  # a member further off than this and 5 times as far as the best is set to the best
FLOOR = 1e-12  # of a score: errors below a millionth of the common scale are all alike

# Logarithms of what a member owes. The first samples cannot tell noise from motion, so the quieter member has the benefit of
# the doubt, until 30 samples were judged. A coloured member must predict 30 % better for good: fast motion, too, can be
# explained as noise.
DOUBT = tuple([0.5 * i for i in range(WHITE)] + [5.0] * COLOURED + [3.0] * THIRD)
DOUBT_SAMPLES = 30.0
HANDICAP = tuple([0.0] * WHITE + [math.log(1.3)] * COLOURED + [0.0] * THIRD)


class Bank(NamedTuple):
    """All members, as arrays that the kernels change in place: views (`of`) of a flat one, which is copied where the old one is still wanted."""

    x: np.ndarray  # (MEMBERS,STATES): gsmo_members has the columns
    p: np.ndarray  # (LINEAR,COVARIANCES)
    v: np.ndarray  # (MEMBERS,3): forgotten squared prediction errors in units of `scale`
    weight: np.ndarray  # (MEMBERS,3)
    scale: np.ndarray  # (3,): recent squared prediction error, common to all members [rad^2]
    best: np.ndarray  # (3,): forgotten number of judged samples, the best member, variance of the samples' noise [rad^2]


_P = MEMBERS * members.STATES
_V = _P + LINEAR * members.COVARIANCES
_WEIGHT, _SCALE = _V + 3 * MEMBERS, _V + 6 * MEMBERS
SIZE = _SCALE + 6


@kernel
def of(flat: np.ndarray) -> Bank:
    """The bank that lies in a flat array (SIZE,), as views."""
    return Bank(
        flat[:_P].reshape((MEMBERS, members.STATES)),
        flat[_P:_V].reshape((LINEAR, members.COVARIANCES)),
        flat[_V:_WEIGHT].reshape((MEMBERS, 3)),
        flat[_WEIGHT:_SCALE].reshape((MEMBERS, 3)),
        flat[_SCALE : _SCALE + 3],
        flat[_SCALE + 3 : SIZE],
    )


@kernel
def new(q: Quat) -> np.ndarray:
    """A flat array with a bank at its first sample."""
    flat = np.zeros(SIZE)
    start(of(flat), q)
    return flat


@kernel
def start(bank: Bank, q: Quat) -> None:
    """The first sample: every member at it, at rest; nothing judged yet."""
    members.start(bank.x, bank.p, q)
    total = 0.0
    for i in range(MEMBERS):
        total += math.exp(-DOUBT[i])
    for i in range(MEMBERS):
        for a in range(3):
            bank.v[i, a] = 0.0
            bank.weight[i, a] = math.exp(-DOUBT[i]) / total
    bank.scale[0], bank.scale[1], bank.scale[2] = 0.0, 0.0, 0.0
    bank.best[0], bank.best[1], bank.best[2] = 0.0, 0.0, 0.0


@kernel
def advance(bank: Bank, gyro: Vec3, a: Vec3, dt_s: float, tick_s: float, gap_s: float) -> None:
    """All members dt_s on, in equal order-2 ticks; past gap_s the torque states fade with 1 s."""
    members.advance(bank.x, gyro, a, dt_s, tick_s, gap_s)


@kernel
def correct(bank: Bank, q_meas: Quat, T: float, period_s: float, n: int) -> None:
    """One sample T seconds after the last one; n: samples accepted before it (>= 1); the members were advanced to it."""
    if n == 1:
        members.second_sample(bank.p, T)
    per_period5 = 1.0 / period_s**5
    r = np.empty((MEMBERS, 3))
    for i in range(WHITE):
        r[i, 0], r[i, 1], r[i, 2] = members.correct_linear(bank.x, bank.p, i, q_meas, T, 0.0, per_period5)
    for k in range(len(TAUS_S)):
        phi = math.exp(-T / TAUS_S[k])
        for i in range(WHITE + k * EACH, WHITE + (k + 1) * EACH):
            r[i, 0], r[i, 1], r[i, 2] = members.correct_linear(bank.x, bank.p, i, q_meas, T, phi, per_period5)
    for j in range(THIRD):
        i = LINEAR + j
        r[i, 0], r[i, 1], r[i, 2] = members.correct_third(bank.x, j, q_meas, T)
    if n >= 2 and not 2.5 * period_s <= T:
        judge(bank, r, n)
        estimate_noise(bank, r)
    rescue(bank, r)


@kernel
def judge(bank: Bank, r: np.ndarray, n: int) -> None:
    """Prediction errors r (MEMBERS,3) [rad] of one sample enter the score; weights and the best member follow."""
    fresh = bank.best[0] == 0.0
    bank.best[0] = FORGET * bank.best[0] + 1.0
    sharpness = 0.25 * bank.best[0]
    doubt = max(0.0, 1.0 - bank.best[0] / DOUBT_SAMPLES)
    score = np.zeros(MEMBERS)
    for a in range(3):
        x = 0.0
        for i in range(MEMBERS):
            x += bank.weight[i, a] * r[i, a] * r[i, a]
        if fresh:
            bank.scale[a] = max(x, 1e-16)
        inverse = 1.0 / bank.scale[a]
        rate = max(0.1 if x < bank.scale[a] else 0.01, 1.0 / max(n - 1, 1))
        bank.scale[a] = max(bank.scale[a] + rate * (x - bank.scale[a]), 1e-16)
        lowest = math.inf
        for i in range(MEMBERS):
            bank.v[i, a] = FORGET * bank.v[i, a] + r[i, a] * r[i, a] * inverse
            bank.weight[i, a] = math.log(bank.v[i, a] + FLOOR) + HANDICAP[i]
            lowest = min(lowest, bank.weight[i, a])
        total = 0.0
        for i in range(MEMBERS):
            score[i] += bank.weight[i, a]
            power = sharpness * (lowest - bank.weight[i, a]) - doubt * DOUBT[i]
            bank.weight[i, a] = math.exp(power) if power > -50.0 else 0.0
            total += bank.weight[i, a]
        for i in range(MEMBERS):
            bank.weight[i, a] /= total
    best = 0
    for i in range(1, MEMBERS):
        if score[i] < score[best]:
            best = i
    bank.best[1] = best


@kernel
def estimate_noise(bank: Bank, r: np.ndarray) -> None:
    """Variance of the samples' noise per axis, from the prediction error of the best white linear member.

    That has the variance (1 + P) R, and 1/(1 + P) is what a sample leaves of P.
    """
    best, lowest = 0, math.inf
    for i in range(WHITE):
        total = bank.v[i, 0] + bank.v[i, 1] + bank.v[i, 2]
        if total < lowest:
            best, lowest = i, total
    seen = (r[best, 0] ** 2 + r[best, 1] ** 2 + r[best, 2] ** 2) / 3.0 * (1.0 - bank.p[best, members.P00])
    bank.best[2] += (seen - bank.best[2]) / bank.best[0]


@kernel
def rescue(bank: Bank, r: np.ndarray) -> None:
    """A member that is far off where the best is not, or not finite, goes on from the best."""
    m = int(bank.best[1])
    size_m = math.sqrt(r[m, 0] ** 2 + r[m, 1] ** 2 + r[m, 2] ** 2)
    for i in range(MEMBERS):
        size = math.sqrt(r[i, 0] ** 2 + r[i, 1] ** 2 + r[i, 2] ** 2)
        finite = math.isfinite(size)
        for j in range(members.STATES):
            finite = finite and math.isfinite(bank.x[i, j])
        if not finite or (size > LOST_RAD and size > 5.0 * size_m):
            for j in range(members.N):
                bank.x[i, j] = bank.x[m, j]
            for j in range(members.N, members.STATES):
                bank.x[i, j] = 0.0


@kernel
def mixed(bank: Bank) -> tuple[Quat, Vec3]:
    """What is published: the best member's attitude, the rates of all weighted axis by axis."""
    w0, w1, w2 = 0.0, 0.0, 0.0
    for i in range(MEMBERS):
        w0 += bank.weight[i, 0] * bank.x[i, members.W]
        w1 += bank.weight[i, 1] * bank.x[i, members.W + 1]
        w2 += bank.weight[i, 2] * bank.x[i, members.W + 2]
    return members.attitude(bank.x, int(bank.best[1])), (w0, w1, w2)
