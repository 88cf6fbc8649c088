"""Eight vehicles of a fleet at a time, side by side in registers: plant, attitude and rate loops that know the truth.

The same step functions as for one vehicle, called with `lanes`; every vehicle keeps its bits (`rates.step_on_truth` alone, step by
step). The last step of a run is that of each vehicle alone: it leaves every field of the record as it should be.

Vehicles that stand, or that are under another loop or rotor model than PX4's attitude loop without inflow, go on alone.
"""

from typing import Any, NamedTuple

import numpy as np

from mavquad.jit import kernel
from sitl import loops, plant, rotation, rotors
from sitl.state import ATTITUDE, PX4
from tools.bulk import rates
from tools.bulk.lanes import WIDTH, any_above, load, store

# rows of the block: what moves, what each step leaves for its next part, constants
_R, _V, _OMEGA, _T, _P, _INTEGRAL, _SUM, _SPUN = 0, 9, 12, 15, 19, 22, 25, 28
_MATRIX, _E, _OUT, _N2 = 31, 40, 43, 47
_WANTED, _YAW, _COLLECTIVE, _LOW, _FULL_TUNED, _J_TUNED = 49, 58, 59, 60, 61, 62
_ATTITUDE_P, _LIMIT, _SLOPE, _FEED, _RATE_P, _RATE_I, _RATE_D = 65, 68, 71, 74, 77, 80, 83
_DT, _KEEP, _FULL, _WIND, _EFFECT, _MASS, _J, _X, _Y, _SPIN, _TORQUE = 86, 87, 88, 89, 92, 96, 97, 100, 104, 108, 112
_DRAG, _DRAG2, _PUSH, _PUSH_T, _GROUND, _ROWS = 113, 116, 119, 122, 125, 126


class _Body(NamedTuple):
    """What `plant.under` asks of the constants."""

    mass_kg: Any
    inertia_kg_m2: Any
    x_m: Any
    y_m: Any
    spin: Any
    torque_per_thrust_m: Any
    drag_linear: Any
    drag_quadratic: Any
    push_n: Any
    push_nm: Any


@kernel
def fit(s, sp, c):
    """Whether a vehicle can go abreast."""
    return sp.kind == ATTITUDE and c.personality == PX4 and c.rotor_model == rotors.NO_INFLOW and not s.grounded


@kernel
def advance(vehicles, setpoints, constants, first, steps):
    """`steps` >= 1 steps of the WIDTH vehicles from `first` on, which all are `fit`."""
    b = np.empty((_ROWS, WIDTH))
    for k in range(WIDTH):
        _gather(b, k, vehicles[first + k], setpoints[first + k], constants[first + k])
    made, above = 0, False
    while made < steps - 1 and not above:
        _turn(b, constants, first)
        above = _move(b)
        made += 1
    for k in range(WIDTH):
        s = vehicles[first + k]
        _scatter(b, k, s, made)
        plant.meet_ground(s, constants[first + k])
    for k in range(WIDTH):
        for _ in range(steps - made):
            rates.step_on_truth(vehicles[first + k], setpoints[first + k], constants[first + k])


@kernel
def _turn(b, constants, first):
    """Attitude and rate loops: thrusts that the loops ask of the rotors, in _OUT."""
    R, w = _nine(b, _R), _three(b, _OMEGA)
    _keep_nine(b, _MATRIX, rotation.mul_t(R, _nine(b, _WANTED)))
    for k in range(WIDTH):
        m = _MATRIX
        left = (b[m, k], b[m + 1, k], b[m + 2, k], b[m + 3, k], b[m + 4, k], b[m + 5, k], b[m + 6, k], b[m + 7, k], b[m + 8, k])
        b[_E, k], b[_E + 1, k], b[_E + 2, k] = rotation.log(left)
    yaw = load(b, _YAW)
    alpha = (_axis(b, 0, yaw * R[6], w[0]), _axis(b, 1, yaw * R[7], w[1]), _axis(b, 2, yaw * R[8], w[2]))
    _keep_three(b, _E, loops.torque(_three(b, _J_TUNED), w, alpha))
    for k in range(WIDTH):
        tau, low, full = (b[_E, k], b[_E + 1, k], b[_E + 2, k]), b[_LOW, k], b[_FULL_TUNED, k]
        T = rotors.allocate(constants[first + k].allocation, b[_COLLECTIVE, k], tau, loops.YAW_SHARE, low, full)
        b[_OUT, k], b[_OUT + 1, k], b[_OUT + 2, k], b[_OUT + 3, k] = T


@kernel
def _axis(b, i, yaw, w):
    """Wanted angular acceleration of one axis; its integral moves on."""
    target = loops.towards(load(b, _ATTITUDE_P + i), load(b, _E + i), yaw, load(b, _LIMIT + i))
    gains = load(b, _RATE_P + i), load(b, _RATE_I + i), load(b, _RATE_D + i)
    alpha, moved = loops.spin(target - w, load(b, _SLOPE + i), load(b, _FEED + i), load(b, _INTEGRAL + i), *gains)
    store(b, _INTEGRAL + i, moved)
    return alpha


@kernel
def _move(b):
    """The plant under those thrusts. Returns whether some vehicle may have met the ground."""
    R, v, w, T = _nine(b, _R), _three(b, _V), _three(b, _OMEGA), _four(b, _T)
    dt, keep, full, tuned, wind = load(b, _DT), load(b, _KEEP), load(b, _FULL), load(b, _FULL_TUNED), _three(b, _WIND)
    out = (load(b, _OUT) / tuned, load(b, _OUT + 1) / tuned, load(b, _OUT + 2) / tuned, load(b, _OUT + 3) / tuned)
    T_mid = plant.lagged(T, out, full, keep)
    _keep_four(b, _T, plant.lagged(T_mid, out, full, keep))
    k1, j1, _, _ = _rates_of_change(b, v, R, w, T, wind)
    h = 0.5 * dt
    v_mid, w_mid = plant.after(v, k1, h), plant.after(w, j1, h)
    R_mid = rotation.mul(R, _exp(b, (h * w[0], h * w[1], h * w[2])))
    k2, j2, f, alpha = _rates_of_change(b, v_mid, R_mid, w_mid, T_mid, wind)
    _keep_three(b, _SUM, plant.after(_three(b, _SUM), f, 1.0))
    _keep_three(b, _SPUN, plant.after(_three(b, _SPUN), alpha, 1.0))
    _keep_nine(b, _R, rotation.orthonormal(rotation.mul(R, _exp(b, (dt * w_mid[0], dt * w_mid[1], dt * w_mid[2])))))
    p = plant.after(_three(b, _P), v_mid, dt)
    _keep_three(b, _P, p)
    _keep_three(b, _V, plant.after(v, k2, dt))
    _keep_three(b, _OMEGA, plant.after(w, j2, dt))
    return any_above(p[2], load(b, _GROUND))


@kernel
def _rates_of_change(b, v, R, w, T0, wind):
    body = _Body(
        load(b, _MASS),
        _three(b, _J),
        _four(b, _X),
        _four(b, _Y),
        _four(b, _SPIN),
        load(b, _TORQUE),
        _three(b, _DRAG),
        _three(b, _DRAG2),
        _three(b, _PUSH),
        _three(b, _PUSH_T),
    )
    e = _four(b, _EFFECT)
    air = rotation.apply_t(R, (wind[0] - v[0], wind[1] - v[1], wind[2] - v[2]))
    return plant.under(R, w, air, T0, (e[0] * T0[0], e[1] * T0[1], e[2] * T0[2], e[3] * T0[3]), body)


@kernel
def _exp(b, r):
    store(b, _N2, rotation.square(r))
    for k in range(WIDTH):
        b[_N2, k], b[_N2 + 1, k] = rotation.shares(b[_N2, k])
    return rotation.turned(r, load(b, _N2), load(b, _N2 + 1))


@kernel
def _gather(b, k, s, sp, c):
    """Everything of one vehicle into its lane."""
    b[_YAW, k] = sp.rates_rad_s[2]
    b[_FULL_TUNED, k], b[_LOW, k] = c.tuned_thrust_max_n, c.idle * c.tuned_thrust_max_n
    b[_COLLECTIVE, k] = 4.0 * c.tuned_thrust_max_n * sp.thrust
    b[_DT, k], b[_KEEP, k], b[_FULL, k] = c.dt_s, plant.kept(c.dt_s, c.lag_s), c.thrust_max_n
    b[_MASS, k], b[_TORQUE, k], b[_GROUND, k] = c.mass_kg, c.torque_per_thrust_m, c.ground_d_m
    for i in range(9):
        b[_R + i, k], b[_WANTED + i, k] = s.R[i], sp.R[i]
    for i in range(4):
        b[_T + i, k], b[_EFFECT + i, k] = s.thrust_n[i], c.effectiveness[i]
        b[_X + i, k], b[_Y + i, k], b[_SPIN + i, k] = c.x_m[i], c.y_m[i], c.spin[i]
    for i in range(3):
        b[_P + i, k], b[_V + i, k], b[_OMEGA + i, k] = s.p_ned_m[i], s.v_ned_m_s[i], s.omega_rad_s[i]
        b[_INTEGRAL + i, k], b[_SLOPE + i, k], b[_FEED + i, k] = s.rate_integral[i], s.rates_slope[i], s.target_accel_rad_s2[i]
        b[_SUM + i, k], b[_SPUN + i, k], b[_WIND + i, k] = s.disturbance_m_s2[i], s.disturbance_rad_s2[i], s.wind_ned_m_s[i]
        b[_J_TUNED + i, k], b[_ATTITUDE_P + i, k], b[_LIMIT + i, k] = c.tuned_inertia[i], c.attitude_p[i], c.rate_limit[i]
        b[_RATE_P + i, k], b[_RATE_I + i, k], b[_RATE_D + i, k] = c.rate_p[i], c.dt_s * c.rate_i[i], c.rate_d[i]
        b[_J + i, k], b[_DRAG + i, k], b[_DRAG2 + i, k] = c.inertia_kg_m2[i], c.drag_linear[i], c.drag_quadratic[i]
        b[_PUSH + i, k], b[_PUSH_T + i, k] = c.push_n[i], c.push_nm[i]


@kernel
def _scatter(b, k, s, made):
    """What moved of one vehicle back into its record."""
    s.step += made
    s.summed += made
    for i in range(9):
        s.R[i] = b[_R + i, k]
    for i in range(4):
        s.thrust_n[i] = b[_T + i, k]
    for i in range(3):
        s.p_ned_m[i], s.v_ned_m_s[i], s.omega_rad_s[i] = b[_P + i, k], b[_V + i, k], b[_OMEGA + i, k]
        s.rate_integral[i] = b[_INTEGRAL + i, k]
        s.disturbance_m_s2[i], s.disturbance_rad_s2[i] = b[_SUM + i, k], b[_SPUN + i, k]


# ---- rows as vectors and matrices ---------------------------------------------------------------------------------------------
@kernel
def _three(b, i):
    return (load(b, i), load(b, i + 1), load(b, i + 2))


@kernel
def _four(b, i):
    return (load(b, i), load(b, i + 1), load(b, i + 2), load(b, i + 3))


@kernel
def _nine(b, i):
    A, B, C = _three(b, i), _three(b, i + 3), _three(b, i + 6)
    return (A[0], A[1], A[2], B[0], B[1], B[2], C[0], C[1], C[2])


@kernel
def _keep_three(b, i, x):
    store(b, i, x[0])
    store(b, i + 1, x[1])
    store(b, i + 2, x[2])


@kernel
def _keep_four(b, i, x):
    _keep_three(b, i, (x[0], x[1], x[2]))
    store(b, i + 3, x[3])


@kernel
def _keep_nine(b, i, A):
    _keep_three(b, i, (A[0], A[1], A[2]))
    _keep_three(b, i + 3, (A[3], A[4], A[5]))
    _keep_three(b, i + 6, (A[6], A[7], A[8]))
