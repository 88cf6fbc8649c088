"""The members of the bank (gsmo_online): what they are, how each takes a sample.

Linear members are Kalman filters of constant angular acceleration, the same on every axis, whose measurement noise is white or
fades with a time constant of its own (then the noise is a state, since what can be predicted of it must not be taken for
motion). Third-order members are implicit sliding mode observers. A member's attitude correction turns the body, so a linear
member's rates turn with it: they belong to the world until the next sample.

Source: the tracking index of Kalata 1984 for the linear members, Levant 2003 for the others; the geometry of An et al. 2013.
"""

import math

import numpy as np

from mavquad import linalg, quat
from mavquad.estimate import gsmo_implicit, lie
from mavquad.jit import kernel
from mavquad.quat import Quat, Vec3

WHITE = 12  # linear members with white noise
THIRD = 5  # third-order members
TAUS_S = (0.05, 0.2, 0.8)  # time constants of coloured noise
EACH = 4  # linear members for each of them
COLOURED = EACH * len(TAUS_S)
MEMBERS = WHITE + COLOURED + THIRD
LINEAR = WHITE + COLOURED  # these come first

# jerk density T^5 / measurement variance: 1e-8 ... 1e3 white, 1e-6 ... 1e-3 coloured
INDEX = tuple([10.0 ** (i - 8) for i in range(WHITE)] + [10.0 ** (i - 6) for _ in TAUS_S for i in range(EACH)])
JERK = tuple(10.0 ** (0.5 * i - 0.5) for i in range(THIRD))  # L of the third-order members [rad/s^3]: 0.316 ... 31.6
WHITE_SHARE = 0.01  # of a coloured member's noise variance: keeps its gains finite
D_MAX = 500.0  # clamp of the torque states [rad/s^2]

# columns of a member's state: attitude 4, rates 3 [rad/s], torque over inertia not modelled 3 [rad/s^2], predictable noise 3 [rad]
W, D, N, STATES = 4, 7, 10, 13
# columns of a covariance of (angle, rate, acceleration, noise) of any one axis, in units of the noise variance
P00, P01, P02, P11, P12, P22, P03, P13, P23, P33, COVARIANCES = range(11)


@kernel
def attitude(x: np.ndarray, i: int) -> Quat:
    return (x[i, 0], x[i, 1], x[i, 2], x[i, 3])


@kernel
def put_attitude(x: np.ndarray, i: int, q: Quat) -> None:
    x[i, 0], x[i, 1], x[i, 2], x[i, 3] = q


@kernel
def start(x: np.ndarray, p: np.ndarray, q: Quat) -> None:
    """Every member at a first sample, at rest; the sample's error is all of the attitude's."""
    for i in range(MEMBERS):
        put_attitude(x, i, q)
        for j in range(W, STATES):
            x[i, j] = 0.0
    for i in range(LINEAR):
        for j in range(COVARIANCES):
            p[i, j] = 0.0
        p[i, P00], p[i, P33], p[i, P03] = 1.0, 1.0, -1.0


@kernel
def second_sample(p: np.ndarray, T: float) -> None:
    """Before the second sample: rate and acceleration are as uncertain as a member's own jerk makes them within a second."""
    for i in range(LINEAR):
        p[i, P11] = min(1e4, INDEX[i] / (T * T * T)) / (T * T)
        p[i, P22] = min(1e2, INDEX[i] / T) / (T * T * T * T)


@kernel
def advance(x: np.ndarray, gyro: Vec3, a: Vec3, dt_s: float, tick_s: float, gap_s: float) -> None:
    """All members dt_s on, in equal order-2 ticks; past gap_s the torque states fade with 1 s."""
    zero = (0.0, 0.0, 0.0)
    n = max(1, math.ceil(dt_s / tick_s - 1e-9))
    h = dt_s / n
    fade = math.exp(-h)
    for i in range(MEMBERS):
        q = attitude(x, i)
        w = (x[i, W], x[i, W + 1], x[i, W + 2])
        d = (x[i, D], x[i, D + 1], x[i, D + 2])
        for k in range(n):
            f = linalg.add(a, d)
            q, w = lie.step_2(lie.CAYLEY, gyro, q, w, f, f, zero, zero, h)
            if k * h > gap_s:
                d = linalg.scale(fade, d)
        put_attitude(x, i, q)
        for j in range(3):
            x[i, W + j] = w[j]
            x[i, D + j] = d[j]


@kernel
def linear_gains(p: np.ndarray, i: int, T: float, phi: float, jerk: float, share: float) -> tuple[float, float, float, float]:
    """Covariance p[i] over T seconds and one sample, in place; gains of angle, rate, acceleration, noise.

    phi is what is left of the noise after T (0: white), jerk the density, share that of white noise beside coloured.
    """
    p00, p01, p02, p11, p12, p22 = p[i, P00], p[i, P01], p[i, P02], p[i, P11], p[i, P12], p[i, P22]
    half, T2 = 0.5 * T * T, T * T
    # M = F P F' + jerk Gamma with F = [1 T T^2/2; 0 1 T; 0 0 1] and, for the noise, phi
    f02, f12 = p02 + T * p12 + half * p22, p12 + T * p22
    f01, f11 = p01 + T * p11 + half * p12, p11 + T * p12
    m00 = p00 + T * p01 + half * p02 + T * f01 + half * f02 + jerk * T2 * T2 * T / 20.0
    m01 = f01 + T * f02 + jerk * T2 * T2 / 8.0
    m02 = f02 + jerk * T2 * T / 6.0
    m11 = f11 + T * f12 + jerk * T2 * T / 3.0
    m12 = f12 + jerk * half
    m22 = p22 + jerk * T
    m03 = phi * (p[i, P03] + T * p[i, P13] + half * p[i, P23])
    m13 = phi * (p[i, P13] + T * p[i, P23])
    m23 = phi * p[i, P23]
    m33 = 1.0 + phi * phi * (p[i, P33] - 1.0)
    s = m00 + 2.0 * m03 + m33 + share
    c0, c1, c2, c3 = m00 + m03, m01 + m13, m02 + m23, m03 + m33
    g0, g1, g2, g3 = c0 / s, c1 / s, c2 / s, c3 / s
    p[i, P00], p[i, P01], p[i, P02] = m00 - g0 * c0, m01 - g0 * c1, m02 - g0 * c2
    p[i, P11], p[i, P12], p[i, P22] = m11 - g1 * c1, m12 - g1 * c2, m22 - g2 * c2
    p[i, P03], p[i, P13], p[i, P23], p[i, P33] = m03 - g0 * c3, m13 - g1 * c3, m23 - g2 * c3, m33 - g3 * c3
    return g0, g1, g2, g3


@kernel
def correct_linear(x: np.ndarray, p: np.ndarray, i: int, q_meas: Quat, T: float, phi: float, per_period5: float) -> Vec3:
    """Linear member i takes a sample; its prediction error [rad]."""
    e = lie.attitude_error(attitude(x, i), q_meas)
    n = (phi * x[i, N], phi * x[i, N + 1], phi * x[i, N + 2])
    r = linalg.sub(e, n)
    g0, g1, g2, g3 = linear_gains(p, i, T, phi, INDEX[i] * per_period5, 0.0 if phi == 0.0 else WHITE_SHARE)
    turn = quat.exp(linalg.scale(g0, r))
    w = (x[i, W] + g1 * r[0], x[i, W + 1] + g1 * r[1], x[i, W + 2] + g1 * r[2])
    x[i, W], x[i, W + 1], x[i, W + 2] = quat.rotate_back(turn, w)
    for j in range(3):
        x[i, D + j] = linalg.clip(x[i, D + j] + g2 * r[j], -D_MAX, D_MAX)
        x[i, N + j] = n[j] + g3 * r[j]
    put_attitude(x, i, quat.mul(attitude(x, i), turn))
    return r


@kernel
def correct_third(x: np.ndarray, j: int, q_meas: Quat, T: float) -> Vec3:
    """Third-order member j (0 ...) takes a sample; its prediction error [rad]."""
    i = LINEAR + j
    r = lie.attitude_error(attitude(x, i), q_meas)
    y0, w0, d0 = gsmo_implicit.correct_axis(gsmo_implicit.THIRD_ORDER, 0.0, 0.0, JERK[j], -r[0], T)
    y1, w1, d1 = gsmo_implicit.correct_axis(gsmo_implicit.THIRD_ORDER, 0.0, 0.0, JERK[j], -r[1], T)
    y2, w2, d2 = gsmo_implicit.correct_axis(gsmo_implicit.THIRD_ORDER, 0.0, 0.0, JERK[j], -r[2], T)
    put_attitude(x, i, quat.mul(attitude(x, i), quat.exp((r[0] + y0, r[1] + y1, r[2] + y2))))
    x[i, W], x[i, W + 1], x[i, W + 2] = x[i, W] - w0, x[i, W + 1] - w1, x[i, W + 2] - w2
    x[i, D] = linalg.clip(x[i, D] - d0, -D_MAX, D_MAX)
    x[i, D + 1] = linalg.clip(x[i, D + 1] - d1, -D_MAX, D_MAX)
    x[i, D + 2] = linalg.clip(x[i, D + 2] - d2, -D_MAX, D_MAX)
    return r
