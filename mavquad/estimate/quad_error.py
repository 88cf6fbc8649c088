"""Model error of a quadrotor behind its autopilot's attitude loop, with bounds: ten states in the ASMF, and interval observers.

States (v NED, f NED, roll, pitch, f_roll, f_pitch):
  v' = g e3 - R(measured attitude) e3 T_m + f,  T_m the commanded specific thrust through the nominal lag
  roll' = (roll_cmd - roll)/tau + f_roll, pitch alike;  tau = 2 zeta/wn of the autopilot's answer
The measured attitude is an input of the translation, so that the attitude's lag is not booked as a force. What is measured:
attitude, velocity, and by the accelerometer f itself: R (a_imu + e3 T_m).

Source: Song et al. 2011 (paper 004), section 3.1, carried over to a quadrotor by the design note of the ASMF, section 8.
The bounds are guaranteed while the stated noise and rate bounds hold; `asmf.State.guarantee` says when the data contradict them.
"""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from mavquad import linalg, quat
from mavquad.airframe import ModelBounds
from mavquad.errors import ConfigError
from mavquad.estimate import asmf, interval
from mavquad.jit import kernel

Vec3 = tuple[float, float, float]

G_M_S2 = 9.80665
N_STATES, N_OUTPUTS = 10, 8
V, F, ATT, F_ATT = 0, 3, 6, 8  # where each part begins among the states
SLEW_S = 0.08  # for how long a change of the thrust may still be on its way
Y_ATT, Y_V, Y_F = 0, 2, 5  # outputs, in the order in which strips are taken: attitude, velocity, acceleration


@dataclass(frozen=True, slots=True, kw_only=True)
class Params:
    bounds: ModelBounds = field(default_factory=ModelBounds)
    attitude_tau_s: float = 0.133  # of the first-order model: 2 zeta/wn
    thrust_lag_s: float = 0.05
    half_axes: tuple[float, float, float, float] = (0.5, 5.0, 0.1, 1.0)  # v, f, attitude, f_attitude of the first set

    def __post_init__(self) -> None:
        if not (self.attitude_tau_s > 0.0 and self.thrust_lag_s >= 0.0):
            raise ConfigError(
                f"quad_error: attitude_tau_s {self.attitude_tau_s} must be > 0, thrust_lag_s {self.thrust_lag_s} >= 0"
            )


class Gains(NamedTuple):
    filter: asmf.Gains
    tau_s: float
    lag_s: float
    tick_s: float
    b_f_m_s2: float


class State(NamedTuple):
    filter: asmf.State
    intervals: tuple[interval.State, interval.State, interval.State]
    thrust_m_s2: float  # T_m
    attitude_rad: Vec3  # roll, pitch, yaw last measured
    slew_m_s3: float  # of T_m, the largest of the last moments


class Measured(NamedTuple):
    """What arrived since the last tick; NaN where nothing did. Ages in seconds."""

    attitude_rad: Vec3
    velocity_ned_m_s: Vec3
    accel_m_s2: Vec3  # body specific force
    attitude_age_s: float
    velocity_age_s: float
    accel_age_s: float


def gains(params: Params) -> Gains:
    b = params.bounds
    v, f, att, f_att = (10.0 * h * h for h in params.half_axes)
    filter_params = asmf.Params(
        e=(b.e_attitude_rad,) * 2 + (b.e_velocity_m_s,) * 3 + (b.e_acceleration_m_s2,) * 3,
        b=(b.b_velocity_m_s,) * 3 + (b.b_f_m_s2,) * 3 + (b.b_attitude_rad,) * 2 + (b.b_f_attitude_rad_s,) * 2,
        p0=(v,) * 3 + (f,) * 3 + (att,) * 2 + (f_att,) * 2,
        model_error=(3, 4, 5, 8, 9),
    )
    c = np.zeros((N_OUTPUTS, N_STATES))
    for i in range(2):
        c[Y_ATT + i, ATT + i] = 1.0
    for i in range(3):
        c[Y_V + i, V + i] = 1.0
        c[Y_F + i, F + i] = 1.0
    return Gains(
        asmf.gains(filter_params, c),
        params.attitude_tau_s,
        params.thrust_lag_s,
        b.tick_s,
        b.b_f_m_s2,
    )


@kernel
def init(gains: Gains, velocity_ned_m_s: Vec3, attitude_rad: Vec3, thrust_m_s2: float) -> State:
    """Start at a measured velocity and attitude, thrust as commanded."""
    x = np.zeros(N_STATES)
    for i in range(3):
        x[V + i] = velocity_ned_m_s[i]
    for i in range(2):
        x[ATT + i] = attitude_rad[i]
    unknown = interval.State(-math.inf, math.inf, 0, 0)
    return State(asmf.init(gains.filter, x), (unknown, unknown, unknown), thrust_m_s2, attitude_rad, 0.0)


@kernel
def nominal_acceleration(attitude_rad: Vec3, thrust_m_s2: float) -> Vec3:
    """g e3 - R e3 T: what the model says v' is, NED."""
    up = quat.rotate(quat.from_euler(attitude_rad[0], attitude_rad[1], attitude_rad[2]), (0.0, 0.0, thrust_m_s2))
    return (-up[0], -up[1], G_M_S2 - up[2])


@kernel
def transition(tau_s: float, dt_s: float) -> np.ndarray:
    """F (10, 10) over dt, f held."""
    f = np.zeros((N_STATES, N_STATES))
    decay = math.exp(-dt_s / tau_s)
    for i in range(3):
        f[V + i, V + i] = 1.0
        f[V + i, F + i] = dt_s
        f[F + i, F + i] = 1.0
    for i in range(2):
        f[ATT + i, ATT + i] = decay
        f[ATT + i, F_ATT + i] = tau_s * (1.0 - decay)
        f[F_ATT + i, F_ATT + i] = 1.0
    return f


@kernel
def thrust_after(thrust_m_s2: float, command_m_s2: float, lag_s: float, dt_s: float) -> float:
    """Specific thrust dt later, through a first-order lag."""
    if lag_s <= 0.0:
        return command_m_s2
    return command_m_s2 + (thrust_m_s2 - command_m_s2) * math.exp(-dt_s / lag_s)


@kernel
def drive(tau_s: float, dt_s: float, a_nominal: Vec3, command: Vec3) -> np.ndarray:
    """(10,) the known part of one tick: dt a_nominal on v, the commanded attitude through its lag."""
    out = np.zeros(N_STATES)
    for i in range(3):
        out[V + i] = dt_s * a_nominal[i]
    for i in range(2):
        out[ATT + i] = (1.0 - math.exp(-dt_s / tau_s)) * command[i]
    return out


@kernel
def outputs(measured: Measured, attitude_rad: Vec3, thrust_m_s2: float) -> np.ndarray:
    """(8,) roll, pitch, v, f = R (a_imu + e3 T_m); NaN where nothing arrived. Attitude is the latest there is."""
    y = np.empty(N_OUTPUTS)
    for i in range(2):
        y[Y_ATT + i] = measured.attitude_rad[i]
    a = measured.accel_m_s2
    f = quat.rotate(quat.from_euler(attitude_rad[0], attitude_rad[1], attitude_rad[2]), (a[0], a[1], a[2] + thrust_m_s2))
    for i in range(3):
        y[Y_V + i] = measured.velocity_ned_m_s[i]
        y[Y_F + i] = f[i]
    return y


@kernel
def widening(
    gains: Gains, measured: Measured, attitude_rate: Vec3, attitude_rad: Vec3, a_ned: Vec3, y: np.ndarray
) -> np.ndarray:
    """(8,) what each |error| may exceed its e by: age times rate; for f the box of the body axes, turned, and R's own error."""
    late = np.zeros(N_OUTPUTS)
    for i in range(2):
        late[Y_ATT + i] = abs(attitude_rate[i]) * measured.attitude_age_s
    q = quat.from_euler(attitude_rad[0], attitude_rad[1], attitude_rad[2])
    axes = (quat.rotate(q, (1.0, 0.0, 0.0)), quat.rotate(q, (0.0, 1.0, 0.0)), quat.rotate(q, (0.0, 0.0, 1.0)))
    e_att = gains.filter.e[Y_ATT]
    f_sum = abs(y[Y_F]) + abs(y[Y_F + 1]) + abs(y[Y_F + 2])
    for i in range(3):
        late[Y_V + i] = abs(a_ned[i]) * measured.velocity_age_s
        turned_box = abs(axes[0][i]) + abs(axes[1][i]) + abs(axes[2][i]) - 1.0
        turned_f = f_sum - abs(y[Y_F + i])
        aged = gains.b_f_m_s2 * measured.accel_age_s / gains.tick_s
        late[Y_F + i] = max(turned_box, 0.0) * gains.filter.e[Y_F + i] + e_att * turned_f + aged
    return late


@kernel
def step(gains: Gains, state: State, command: Vec3, measured: Measured, dt_s: float, t_us: int) -> State:
    """One tick: predict over dt with the command that acted in it (roll, pitch, specific thrust), then take what arrived."""
    thrust = thrust_after(state.thrust_m_s2, command[2], gains.lag_s, dt_s)
    attitude, rate = state.attitude_rad, (0.0, 0.0, 0.0)
    if linalg.finite3(measured.attitude_rad):
        attitude = measured.attitude_rad
        if dt_s > 0.0:
            rate = linalg.scale(1.0 / dt_s, linalg.sub(attitude, state.attitude_rad))
    before = nominal_acceleration(state.attitude_rad, state.thrust_m_s2)
    after = nominal_acceleration(attitude, thrust)
    known = drive(gains.tau_s, dt_s, linalg.scale(0.5, linalg.add(before, after)), command)
    ticks = dt_s / gains.tick_s
    inner = asmf.predict(gains.filter, state.filter, transition(gains.tau_s, dt_s), known, ticks, t_us)
    y = outputs(measured, attitude, thrust)
    a_ned = linalg.add(after, (inner.x[F], inner.x[F + 1], inner.x[F + 2]))
    late = widening(gains, measured, rate, attitude, a_ned, y)
    # the thrust that acts may be a moment before or behind the model's: while it changes f may jump by as much
    slew = state.slew_m_s3 * math.exp(-dt_s / SLEW_S)
    if dt_s > 0.0:
        slew = max(slew, abs(thrust - state.thrust_m_s2) / dt_s)
    up = quat.rotate(quat.from_euler(attitude[0], attitude[1], attitude[2]), (0.0, 0.0, slew * dt_s))
    for i in range(3):
        late[Y_F + i] += abs(up[i]) * min(1.0, measured.accel_age_s / max(dt_s, 1e-6))
    inner = asmf.update(gains.filter, inner, y, late, t_us)
    b, e, ix, iy, iz = gains.b_f_m_s2 * ticks, gains.filter.e, state.intervals[0], state.intervals[1], state.intervals[2]
    ix = interval.update(interval.predict(ix, b + abs(up[0])), y[Y_F], e[Y_F] + late[Y_F])
    iy = interval.update(interval.predict(iy, b + abs(up[1])), y[Y_F + 1], e[Y_F + 1] + late[Y_F + 1])
    iz = interval.update(interval.predict(iz, b + abs(up[2])), y[Y_F + 2], e[Y_F + 2] + late[Y_F + 2])
    return State(inner, (ix, iy, iz), thrust, attitude, slew)


@kernel
def bounds_f(state: State, axis: int) -> interval.Cut:
    """The published interval of f on one axis [m/s^2]: the interval observer's cut with the ellipsoid's."""
    centre, half = state.filter.x[F + axis], math.sqrt(max(state.filter.p[F + axis, F + axis], 0.0))
    seen = state.intervals[axis]
    return interval.cut(seen.low, seen.high, centre - half, centre + half)
