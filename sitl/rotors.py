"""Four rotors in one plane: where they sit, what they give together, how wanted torque is spread, what wind does to them.

Numbering and turning as in `mavquad.airframe.Rotors`; in FRD axes a rotor at (x, y) with thrust T up gives torque
(-y T, x T, s c T), where s = +1 for one that turns counter-clockwise seen from above.

Source of the wind models: Yang, Lyu, Chai 2022 (model P, momentum theory as printed) and Glauert's inflow (model G).
Deviations from the paper: model P has the sign of the axial inflow backwards, hence model G. Rotor inertia is left out.
"""

import math
from typing import NamedTuple

import numpy as np

from mavquad.airframe import Airframe
from mavquad.errors import ConfigError
from mavquad.jit import kernel

NO_INFLOW, MODEL_P, MODEL_G = 0, 1, 2
MODELS = {"none": NO_INFLOW, "P": MODEL_P, "G": MODEL_G}


class Geometry(NamedTuple):
    """Rotor places and spins. x_m, y_m, spin: (4,) each; c_m: torque per thrust."""

    x_m: tuple[float, float, float, float]
    y_m: tuple[float, float, float, float]
    spin: tuple[float, float, float, float]
    c_m: float


def geometry(airframe: Airframe) -> Geometry:
    """Rotor places of a quadrotor. Raises ConfigError for another kind of vehicle."""
    rotors = airframe.rotors
    if airframe.kind != "quadrotor" or rotors is None:
        raise ConfigError(f"airframe {airframe.name!r} is a {airframe.kind}: the simulator flies a quadrotor, e.g. x500")
    d = rotors.arm_m
    if rotors.layout == "x":
        h = d / math.sqrt(2.0)
        return Geometry((h, -h, h, -h), (h, -h, -h, h), (1.0, 1.0, -1.0, -1.0), rotors.torque_per_thrust_m)
    return Geometry((d, 0.0, -d, 0.0), (0.0, d, 0.0, -d), (-1.0, 1.0, -1.0, 1.0), rotors.torque_per_thrust_m)


def allocation(airframe: Airframe) -> np.ndarray:
    """(4, 4): thrusts of the rotors from (collective N, torque x, y, z N m)."""
    g = geometry(airframe)
    effect = np.array([np.ones(4), -np.array(g.y_m), np.array(g.x_m), g.c_m * np.array(g.spin)])
    return np.linalg.inv(effect)


@kernel
def wrench(x, y, s, c, T):
    """(collective, torque x, y, z) of four thrusts; x, y, s, T: (4,)."""
    return (
        T[0] + T[1] + T[2] + T[3],
        -(y[0] * T[0] + y[1] * T[1] + y[2] * T[2] + y[3] * T[3]),
        x[0] * T[0] + x[1] * T[1] + x[2] * T[2] + x[3] * T[3],
        c * (s[0] * T[0] + s[1] * T[1] + s[2] * T[2] + s[3] * T[3]),
    )


@kernel
def allocate(A, collective, tau, yaw_share, low, high):
    """Four thrusts within low..high: yaw is cut first (to `yaw_share` of the mean thrust), then the collective gives way to
    roll and pitch where both fit, then each is clipped. A: (4, 4) of `allocation`."""
    tx, ty, tz = tau
    base = 0.25 * collective
    limit = yaw_share * max(base, low)
    worst = abs(A[0, 3] * tz)
    if worst > limit:
        tz = tz * limit / worst
    T0 = A[0, 0] * collective + A[0, 1] * tx + A[0, 2] * ty + A[0, 3] * tz
    T1 = A[1, 0] * collective + A[1, 1] * tx + A[1, 2] * ty + A[1, 3] * tz
    T2 = A[2, 0] * collective + A[2, 1] * tx + A[2, 2] * ty + A[2, 3] * tz
    T3 = A[3, 0] * collective + A[3, 1] * tx + A[3, 2] * ty + A[3, 3] * tz
    over = max(T0, T1, T2, T3) - high
    under = low - min(T0, T1, T2, T3)
    shift = 0.0
    if over > 0.0:
        shift = -over
    elif under > 0.0:
        shift = min(under, -over)
    return (
        min(high, max(low, T0 + shift)),
        min(high, max(low, T1 + shift)),
        min(high, max(low, T2 + shift)),
        min(high, max(low, T3 + shift)),
    )


@kernel
def in_wind(model, T0, u, v, w, rho, disk):
    """Thrust of one rotor that gives T0 in still air, in relative air (u, v, w) in body axes at the rotor (w down)."""
    if model == NO_INFLOW or T0 <= 0.0:
        return T0
    v_d = math.sqrt(T0 / (2.0 * rho * disk))
    lateral = u * u + v * v
    if model == MODEL_P:
        return 2.0 * rho * disk * v_d * math.sqrt(lateral + (v_d + w) * (v_d + w))
    v_i = v_d
    for _ in range(4):
        root = max(0.3 * v_d, math.sqrt(lateral + (v_i + w) * (v_i + w)))
        v_i = 0.5 * (v_i + v_d * v_d / root)
    return max(0.0, T0 * (1.0 - 0.45 * (v_i + w - v_d) / v_d))
