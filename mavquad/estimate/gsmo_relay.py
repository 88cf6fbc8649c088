"""Explicit geometric sliding mode observers: relay, boundary layers, gain schedule, super-twisting.

A copy of the rigid body (q, w) is integrated tick by tick; the attitude mismatch enters through a switching function. Between
samples the last one is moved along with the observed rate, so that every tick compares with a fresh attitude.

Source: An et al. 2013, Eqs. (23)-(30); super-twisting: Levant 1998.

Deviations from the paper:
  Eq. (26)  built from Eq. (24): as printed w1 and w3 are swapped and the factor 1/2 is missing.
  Eq. (27)  the sign also takes that of the scalar part, since q and -q are one attitude.
  Eq. (29)  k2 is an angular acceleration, the same on every axis; as a torque it would scale with the inertia.
  Eq. (30)  order 2 by default (order 1 reproduces the paper), xi starts at zero in each step, the inverse inertia is restored.
"""

import math
from typing import NamedTuple

from mavquad import linalg, quat
from mavquad.estimate import lie
from mavquad.jit import kernel
from mavquad.quat import Quat, Vec3

SIGN, SAT, TANH, SUPER_TWISTING, SCHEDULED = 0, 1, 2, 3, 4  # switching functions


class Gains(NamedTuple):
    """All floats and integers: what one tick needs."""

    shape: int  # SIGN ... SCHEDULED
    order: int  # 1, 2 or 4
    group_map: int  # lie.CAYLEY, EXP or EULER
    hold: bool  # compare with the last sample as it came, instead of moving it along (a baseline)
    k1: float  # rad/s (super-twisting: rad^1/2/s)
    k2: float  # rad/s^2
    quiet_k1: float  # SCHEDULED: the pair once the error is small
    quiet_k2: float
    layer_rad: float  # SAT, TANH: half width of the boundary layer
    gyro: Vec3


class State(NamedTuple):
    q: Quat  # unit, body to world
    w: Vec3  # rad/s, body
    z: Quat  # the last sample, moved along
    calm: int  # SCHEDULED: ticks in a row with a small error; 10 and more means the quiet pair


@kernel
def sign(x: float) -> float:
    """-1, 0 or 1."""
    if x > 0.0:
        return 1.0
    if x < 0.0:
        return -1.0
    return 0.0


@kernel
def switch(shape: int, x: float, layer_rad: float) -> float:
    """The switching function of one axis, in [-1, 1]."""
    if shape == SAT:
        return linalg.clip(x / layer_rad, -1.0, 1.0)
    if shape == TANH:
        return math.tanh(x / layer_rad)
    return sign(x)


@kernel
def count_calm(calm: int, e: Vec3) -> int:
    """The gain schedule's memory: loud above 0.2 rad, quiet after 10 ticks below 0.15 rad, unchanged between."""
    size = max(abs(e[0]), abs(e[1]), abs(e[2]))
    if size > 0.2:
        return 0
    if calm >= 10:
        return 10
    if size < 0.15:
        return calm + 1
    return 0


@kernel
def tick(gains: Gains, state: State, coast: bool, a0: Vec3, a1: Vec3, a2: Vec3, h: float) -> State:
    """One tick of h seconds; a0, a1, a2: torque over inertia [rad/s^2] now, h/2 and h later. coast: no injection."""
    q, w, z, calm = state.q, state.w, state.z, state.calm
    i1 = (0.0, 0.0, 0.0)
    i2 = (0.0, 0.0, 0.0)
    if not coast:
        e = lie.vector_error(z, q)
        k1, k2 = gains.k1, gains.k2
        if gains.shape == SCHEDULED:
            calm = count_calm(calm, e)
            if calm >= 10:
                k1, k2 = gains.quiet_k1, gains.quiet_k2
        s0 = switch(gains.shape, e[0], gains.layer_rad)
        s1 = switch(gains.shape, e[1], gains.layer_rad)
        s2 = switch(gains.shape, e[2], gains.layer_rad)
        i2 = (k2 * s0, k2 * s1, k2 * s2)  # Eq. (29)
        if gains.shape == SUPER_TWISTING:
            i1 = (k1 * math.sqrt(abs(e[0])) * s0, k1 * math.sqrt(abs(e[1])) * s1, k1 * math.sqrt(abs(e[2])) * s2)
        else:
            i1 = (k1 * s0, k1 * s1, k1 * s2)  # Eq. (27)
    if not gains.hold:
        w_mid = linalg.axpy(0.5 * h, lie.rate_derivative(gains.gyro, w, a0), w)
        z = quat.mul(z, quat.cayley(linalg.scale(h, w_mid)))
    if gains.order == 1:
        q, w = lie.step_1(gains.group_map, gains.gyro, q, w, a0, i1, i2, h)
    elif gains.order == 4:
        q, w = lie.step_4(gains.gyro, q, w, a0, a1, a2, i1, i2, h)
    else:
        q, w = lie.step_2(gains.group_map, gains.gyro, q, w, a0, a1, i1, i2, h)
    return State(q, w, z, calm)
