"""Implicit (backward-Euler) sliding mode observers: the relay, super-twisting and third order without chattering.

Between samples the rigid body is propagated without injection. At a sample T seconds after the last one the attitude error
b (rotation vector of q_meas* (x) q, shortest way) is taken back to the y that solves the backward-Euler inclusion, each axis
by itself; the rate, and for the third order the torque state, take their share.

Source: Acary & Brogliato 2010 (relay); Brogliato, Polyakov & Efimov 2020 (super-twisting); Levant 2003 (third order). The
geometry (increments in the Lie algebra) is that of An et al. 2013; the paper itself has the explicit relay only.
"""

import math
from typing import NamedTuple

from mavquad import linalg, quat
from mavquad.estimate import lie
from mavquad.jit import kernel
from mavquad.quat import Quat, Vec3

RELAY, SUPER_TWISTING, THIRD_ORDER = 0, 1, 2


class Gains(NamedTuple):
    kind: int  # RELAY ... THIRD_ORDER
    group_map: int  # lie.CAYLEY or EXP
    k1: float  # rad/s (super-twisting: rad^1/2/s)
    k2: float  # rad/s^2
    L: float  # THIRD_ORDER: bound of the jerk that is not modelled [rad/s^3]
    d_max: float  # clamp of the torque state [rad/s^2]
    forget_s: float  # time constant of the torque state while no sample comes
    gyro: Vec3


class State(NamedTuple):
    q: Quat  # unit, body to world
    w: Vec3  # rad/s, body
    d: Vec3  # torque over inertia that is not modelled [rad/s^2]; stays zero below the third order


@kernel
def predict(gains: Gains, state: State, stale: bool, a0: Vec3, a1: Vec3, h: float) -> State:
    """One order-2 tick without injection. stale: the torque state fades, so that a long gap does not run away with it."""
    q, w = lie.step_2(
        gains.group_map,
        gains.gyro,
        state.q,
        state.w,
        linalg.add(a0, state.d),
        linalg.add(a1, state.d),
        (0.0, 0.0, 0.0),
        (0.0, 0.0, 0.0),
        h,
    )
    d = state.d
    if stale:
        d = linalg.scale(math.exp(-h / gains.forget_s), d)
    return State(q, w, d)


@kernel
def solve_cubic(a2: float, a1: float, excess: float) -> float:
    """The one root z >= 0 of z^3 + a2 z^2 + a1 z = excess >= 0 (a1, a2 > 0), by Newton's method.

    The left side is convex for z >= 0 and the start lies at or above the root, so every step comes down onto it.
    """
    z = min(excess ** (1.0 / 3.0), excess / a1)
    for _ in range(50):
        step = (((z + a2) * z + a1) * z - excess) / ((3.0 * z + 2.0 * a2) * z + a1)
        z -= step
        if step <= 1e-15 * z:
            break
    return max(z, 0.0)


@kernel
def correct_axis(kind: int, k1: float, k2: float, L: float, b: float, T: float) -> tuple[float, float, float]:
    """One axis: (y, decrement of w, decrement of d) for an attitude error b [rad] met T seconds after the last sample."""
    if kind == RELAY:
        g = T * (k1 + T * k2)
        sigma = linalg.clip(b / g, -1.0, 1.0)
        return b - g * sigma, T * k2 * sigma, 0.0
    sign = 1.0 if b >= 0.0 else -1.0
    size = abs(b)
    if kind == SUPER_TWISTING:
        g = T * T * k2
        if size <= g:
            return 0.0, b / T, 0.0  # T k2 sigma with sigma = b / (T^2 k2)
        root = 0.5 * (math.sqrt(T * T * k1 * k1 + 4.0 * (size - g)) - T * k1)
        return sign * root * root, sign * T * k2, 0.0
    g = 1.1 * T * T * T * L
    if size <= g:
        sigma = b / g
        return 0.0, 1.1 * T * T * L * sigma, 1.1 * T * L * sigma
    third = L ** (1.0 / 3.0)
    z = solve_cubic(2.0 * T * third, 2.12 * T * T * third * third, size - g)
    return sign * z * z * z, sign * (2.12 * T * third * third * z + 1.1 * T * T * L), sign * 1.1 * T * L


@kernel
def correct(gains: Gains, state: State, q_meas: Quat, T: float) -> State:
    """The sample's share: q_meas unit, T > 0 seconds since the last accepted sample."""
    b = lie.attitude_error(q_meas, state.q)
    y0, w0, d0 = correct_axis(gains.kind, gains.k1, gains.k2, gains.L, b[0], T)
    y1, w1, d1 = correct_axis(gains.kind, gains.k1, gains.k2, gains.L, b[1], T)
    y2, w2, d2 = correct_axis(gains.kind, gains.k1, gains.k2, gains.L, b[2], T)
    limit = gains.d_max
    return State(
        quat.mul(state.q, quat.exp((y0 - b[0], y1 - b[1], y2 - b[2]))),
        (state.w[0] - w0, state.w[1] - w1, state.w[2] - w2),
        (
            linalg.clip(state.d[0] - d0, -limit, limit),
            linalg.clip(state.d[1] - d1, -limit, limit),
            linalg.clip(state.d[2] - d2, -limit, limit),
        ),
    )
