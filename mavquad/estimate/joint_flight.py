"""The joint observer over MAVLink: filter and extended state observer on telemetry that comes late, twice, in parts or not.

The filter is `ekf` with every sample absorbed at its stamp: attitude and rates move it on, position and velocity correct it. The
observers of the three axes are `leso` in the current form, stepped by the position samples with the period that passed; the
known acceleration between them is that of the applied thrust along the reported attitude. The attitude loop is the autopilot's:
its torque is not known, so the rates are a random walk and there is no rotational disturbance.

With use_filter False the observers take the raw position and give the state too: the plain ADRC observer (`leso_flight`).

Deviations from the paper:
  input     what was sent one measured delay ago, or what the autopilot echoes, behind the rotors' lag.
  drag      the airframe's linear drag is part of the model, so that f changes with the wind and not with the path.
  forward   besides its own lag the disturbance can be led by a time of the controller's choice (lead_s).
  offset    telemetry's velocity is not the derivative of its position: the slow part of the position is anchored to the raw one.
  accelerometer   on request the measured specific force takes over the fast part of the disturbance.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

from mavquad import adrc_checks, quat
from mavquad.airframe import Airframe
from mavquad.errors import ConfigError
from mavquad.estimate import applied_thrust, ekf, leso
from mavquad.estimate.applied_thrust import Thrust
from mavquad.jit import kernel
from mavquad.linalg import axpy, finite3
from mavquad.signals import NAN3, ZERO3, Applied, Attitude, Estimate, Imu, Position, Quat, Target, Vec3

G_M_S2 = applied_thrust.G_M_S2
_COAST_S = 0.5  # the longest silence that is integrated over; beyond it the filter starts again where it is
_LATE_S = 0.25  # a sample older than the filter by more is not used
_PERIOD_S = 0.02  # of the position stream, as far as the checks go


@dataclass(frozen=True, slots=True, kw_only=True)
class Params:
    """Noise as 1 sigma of telemetry, growth as density per second, bandwidths of the observers."""

    sigma_position_m: float = 0.02
    sigma_velocity_m_s: float = 0.03
    sigma_angle_rad: float = 0.003
    sigma_rate_rad_s: float = 0.01
    q_velocity: float = 0.005  # (m/s)^2/s
    q_rate: float = 40.0  # (rad/s)^2/s: the autopilot's torque is not known
    w0_xy_rad_s: float = 8.0
    w0_z_rad_s: float = 8.0
    feedforward: float = 1.0
    tau_f_s: float = 0.1
    lead_s: float = 0.0
    butterworth: bool = False
    use_filter: bool = True
    drag: float = 1.0  # share of the airframe file's linear drag taken as known
    echo: bool = True
    thrust_lag_s: float = -1.0  # of the rotors; < 0: from the airframe
    accel_tau_s: float = 0.0  # > 0: low-pass of the accelerometer's part of the disturbance
    anchor_s: float = 1.5  # time constant of the raw position's slow part (0: off)

    def __post_init__(self) -> None:
        for name in ("sigma_position_m", "sigma_velocity_m_s", "sigma_angle_rad", "sigma_rate_rad_s", "q_velocity", "q_rate"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0.0):
                raise ConfigError(f"joint.{name} = {getattr(self, name)}: expected a finite number > 0")
        for name in ("w0_xy_rad_s", "w0_z_rad_s"):
            if not 0.2 <= getattr(self, name) <= leso.MAX_W0_DT / _PERIOD_S:
                raise ConfigError(
                    f"joint.{name} = {getattr(self, name)}: expected 0.2 to {leso.MAX_W0_DT / _PERIOD_S:g} rad/s"
                    f" (w0*dt at most {leso.MAX_W0_DT} with positions at 50 Hz)"
                )
        if not 0.0 <= self.feedforward <= 1.0 or not 0.0 <= self.tau_f_s <= 2.0 or not 0.0 <= self.lead_s <= 0.5:
            raise ConfigError(
                f"joint: feedforward = {self.feedforward}, tau_f_s = {self.tau_f_s}, lead_s = {self.lead_s}:"
                " expected 0 to 1, 0 to 2 s and 0 to 0.5 s"
            )
        if not 0.0 <= self.drag <= 2.0 or not self.thrust_lag_s <= 1.0 or not 0.0 <= self.accel_tau_s <= 5.0:
            raise ConfigError(
                f"joint: drag = {self.drag}, thrust_lag_s = {self.thrust_lag_s}, accel_tau_s = {self.accel_tau_s}:"
                " expected 0 to 2, at most 1 s, and 0 (off) to 5 s"
            )
        if not (self.anchor_s == 0.0 or 0.2 <= self.anchor_s <= 60.0):
            raise ConfigError(f"joint.anchor_s = {self.anchor_s}: expected 0 (off) or 0.2 to 60 s")


class Gains(NamedTuple):
    ekf: ekf.EkfGains
    w0: Vec3
    feedforward: float
    tau_f_s: float
    lead_s: float
    butterworth: bool
    use_filter: bool
    echo: bool
    thrust_lag_s: float
    accel_tau_s: float
    anchor_s: float


class Axes(NamedTuple):
    """The three observers: position, velocity, disturbance, its filtered rate; and what is known to have moved them since."""

    z1: Vec3
    z2: Vec3
    z3: Vec3
    rate: Vec3  # m/s^3
    moved_m: Vec3  # by the known acceleration, since the last step
    gained_m_s: Vec3


class State(NamedTuple):
    """All at vehicle time t_us; 0 stamps: no such sample yet."""

    t_us: int
    ekf: ekf.EkfState
    axes: Axes
    axes_us: int  # of the observers' last step
    thrust: Thrust
    thrust_m_s2: float  # behind the rotors' lag
    fast_m_s2: Vec3  # the accelerometer's part of the disturbance
    offset_m: Vec3
    attitude_us: int
    position_us: int
    imu_us: int


def gains(params: Params, airframe: Airframe) -> Gains:
    """Raises ConfigError where filter and observers would not be stable together."""
    drag = params.drag * airframe.drag.linear_n_s_m[0] / airframe.body.mass_kg
    model = ekf.EkfModel(G_M_S2, drag, airframe.body.inertia_kg_m2, 0.0)
    filter_gains = ekf.gains(
        ekf.EkfParams(
            q_velocity=params.q_velocity,
            q_rate=params.q_rate,
            sigma_position_m=params.sigma_position_m,
            sigma_velocity_m_s=params.sigma_velocity_m_s,
            sigma_angle_rad=params.sigma_angle_rad,
            sigma_rate_rad_s=params.sigma_rate_rad_s,
        ),
        model,
    )
    lag_s = params.thrust_lag_s if params.thrust_lag_s >= 0.0 else (airframe.rotors.lag_s if airframe.rotors else 0.0)
    return Gains(
        filter_gains,
        (params.w0_xy_rad_s, params.w0_xy_rad_s, params.w0_z_rad_s),
        params.feedforward,
        params.tau_f_s,
        params.lead_s,
        params.butterworth,
        params.use_filter,
        params.echo,
        max(lag_s, 1e-3),
        params.accel_tau_s,
        params.anchor_s,
    )


def checks(params: Params) -> list[adrc_checks.Finding]:
    """Filter and observers together, positions at 50 Hz: unstable is refused, little damping is a warning."""
    if not params.use_filter:
        return []
    r = (params.sigma_position_m**2, params.sigma_velocity_m_s**2)
    kalman = adrc_checks.steady_gains((1e-6, params.q_velocity), r, _PERIOD_S)
    return [
        adrc_checks.joint_check(f"joint.w0_{n}", w, kalman) for n, w in (("xy", params.w0_xy_rad_s), ("z", params.w0_z_rad_s))
    ]


def init(gains: Gains) -> State:
    still = Axes(ZERO3, ZERO3, ZERO3, ZERO3, ZERO3, ZERO3)
    return State(0, ekf.init(gains.ekf, ekf.NOTHING), still, 0, applied_thrust.NONE, G_M_S2, ZERO3, ZERO3, 0, 0, 0)


@kernel
def known(model: ekf.Vehicle, q: Quat, thrust_m_s2: float, v: Vec3) -> Vec3:
    """g e3 - T R e3 - drag v."""
    up = quat.rotate(q, (0.0, 0.0, thrust_m_s2))
    d = model.drag_1_s
    return (-up[0] - d * v[0], -up[1] - d * v[1], model.gravity_m_s2 - up[2] - d * v[2])


@kernel
def carry(
    gains: ekf.EkfGains, state: ekf.EkfState, axes: Axes, thrust_m_s2: float, fast: Vec3, use_filter: bool, dt_s: float
) -> tuple[ekf.EkfState, Axes]:
    """Filter and observers over dt of a constant thrust along the attitude: (filter, observers)."""
    f = (axes.z3[0] + fast[0], axes.z3[1] + fast[1], axes.z3[2] + fast[2])
    v = state.v_ned_m_s if use_filter else axpy(1.0, axes.gained_m_s, axes.z2)
    if use_filter:
        ahead = ekf.predict(gains, state, (thrust_m_s2, (0.0, 0.0, 0.0), f, (0.0, 0.0, 0.0)), dt_s)
    else:
        q = quat.integrate(state.q_wxyz, state.omega_rad_s, dt_s)
        ahead = ekf.EkfState(state.p_ned_m, state.v_ned_m_s, q, state.omega_rad_s, state.P, state.singular)
    a = axpy(0.5, known(gains, state.q_wxyz, thrust_m_s2, v), (0.0, 0.0, 0.0))
    a = axpy(0.5, known(gains, ahead.q_wxyz, thrust_m_s2, v), axpy(1.0, a, fast))
    moved = axpy(0.5 * dt_s * dt_s, a, axpy(dt_s, axes.gained_m_s, axes.moved_m))
    return ahead, Axes(axes.z1, axes.z2, axes.z3, axes.rate, moved, axpy(dt_s, a, axes.gained_m_s))


@kernel
def observed(axes: Axes, y: Vec3, w0: Vec3, tau_f_s: float, butterworth: bool, dt_s: float) -> Axes:
    """The three observers at a sample y, dt after the last: current form, with the known motion as it was."""
    z1, z2, z3, rate = axes.z1, axes.z2, axes.z3, axes.rate
    alpha = dt_s / (tau_f_s + dt_s)
    for i in range(3):
        L = leso.closed_form(min(w0[i], leso.MAX_W0_DT / dt_s), dt_s, butterworth)
        p = axes.z1[i] + dt_s * axes.z2[i] + 0.5 * dt_s * dt_s * axes.z3[i] + axes.moved_m[i]
        e = y[i] - p
        if not math.isfinite(e):
            e = 0.0
        v = axes.z2[i] + dt_s * axes.z3[i] + axes.gained_m_s[i]
        slope = L[2] * e / dt_s
        z1 = _put(z1, i, p + L[0] * e)
        z2 = _put(z2, i, v + L[1] * e)
        z3 = _put(z3, i, axes.z3[i] + L[2] * e)
        rate = _put(rate, i, axes.rate[i] + alpha * (slope - axes.rate[i]))
    return Axes(z1, z2, z3, rate, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


@kernel
def _put(v: Vec3, i: int, x: float) -> Vec3:
    if i == 0:
        return (x, v[1], v[2])
    if i == 1:
        return (v[0], x, v[2])
    return (v[0], v[1], x)


@kernel
def compensated(axes: Axes, w0: Vec3, feedforward: float, lead_s: float, butterworth: bool) -> Vec3:
    """z3 with what it lags behind under its present rate, and led by lead_s."""
    orders = 2.0 if butterworth else 3.0
    x = feedforward * orders
    return (
        axes.z3[0] + (x / w0[0] + lead_s) * axes.rate[0],
        axes.z3[1] + (x / w0[1] + lead_s) * axes.rate[1],
        axes.z3[2] + (x / w0[2] + lead_s) * axes.rate[2],
    )


def observe(gains: Gains, state: State, sample: object) -> State:
    """Absorb one sample; what is not finite, repeated or far too late is left out."""
    if isinstance(sample, Attitude):
        return _attitude(gains, state, sample)
    if isinstance(sample, Position):
        return _position(gains, state, sample)
    if isinstance(sample, Imu):
        return _imu(gains, state, sample)
    if isinstance(sample, Target):
        return state._replace(thrust=applied_thrust.hear(state.thrust, sample))
    return state


def _to(gains: Gains, state: State, t_us: int) -> State:
    """The state at t, if that is ahead."""
    dt_s = 1e-6 * (t_us - state.t_us)
    if dt_s <= 0.0:
        return state
    if not state.t_us or dt_s > _COAST_S:
        return state._replace(t_us=t_us, axes_us=t_us)
    wanted = applied_thrust.acting(state.thrust, t_us, gains.echo)
    now = wanted + math.exp(-dt_s / gains.thrust_lag_s) * (state.thrust_m_s2 - wanted)
    mean = wanted + (state.thrust_m_s2 - now) * gains.thrust_lag_s / dt_s
    if not state.position_us:  # nothing to carry but the attitude, and no disturbance to learn
        turned = quat.integrate(state.ekf.q_wxyz, state.ekf.omega_rad_s, dt_s)
        return state._replace(t_us=t_us, axes_us=t_us, thrust_m_s2=now, ekf=state.ekf._replace(q_wxyz=turned))
    moved, axes = carry(gains.ekf, state.ekf, state.axes, mean, state.fast_m_s2, gains.use_filter, dt_s)
    return state._replace(t_us=t_us, ekf=moved, axes=axes, thrust_m_s2=now)


def _age_s(state: State, stamp_us: int) -> float:
    return 1e-6 * max(0, state.t_us - stamp_us)


def _attitude(gains: Gains, state: State, sample: Attitude) -> State:
    q, w = sample.q_wxyz, sample.omega_rad_s
    if sample.t_us <= state.attitude_us or not all(map(math.isfinite, (*q, *w))):
        return state
    first = not state.attitude_us
    state = _to(gains, state, sample.t_us)
    age_s = _age_s(state, sample.t_us)
    if age_s > _LATE_S:
        return state
    q = quat.integrate(q, w, age_s)
    if first or not gains.use_filter:
        moved = state.ekf._replace(q_wxyz=q, omega_rad_s=w)
    else:
        moved = ekf.update(gains.ekf, state.ekf, _rows(NAN3, NAN3, quat.to_euler(q), w))
    return state._replace(ekf=moved, attitude_us=sample.t_us)


def _rows(p: Vec3, v: Vec3, eta: Vec3, w: Vec3) -> ekf.Row12:
    return (*p, *v, *eta, *w)


def _position(gains: Gains, state: State, sample: Position) -> State:
    p, v = sample.p_ned_m, sample.v_ned_m_s
    if sample.t_us <= state.position_us or not finite3(p):
        return state
    if not state.position_us or 1e-6 * (sample.t_us - state.position_us) > _COAST_S:
        return _placed(gains, state, sample)
    state = _to(gains, state, sample.t_us)
    age_s = _age_s(state, sample.t_us)
    if age_s > _LATE_S:
        return state
    x = state.axes
    speed = state.ekf.v_ned_m_s if gains.use_filter else axpy(1.0, x.gained_m_s, x.z2)
    thrust = known(gains.ekf, state.ekf.q_wxyz, state.thrust_m_s2, speed)
    a = axpy(1.0, thrust, axpy(1.0, x.z3, state.fast_m_s2))
    p = axpy(age_s, speed, p)  # the sample carried forward to the filter's time
    v = axpy(age_s, a, v)
    moved = state.ekf
    y = p
    offset = state.offset_m
    if gains.use_filter:
        moved = ekf.update(gains.ekf, moved, _rows(p, v, NAN3, NAN3))
        y = moved.p_ned_m
        if gains.anchor_s > 0.0:
            w = 1.0 - math.exp(-1e-6 * (sample.t_us - state.position_us) / gains.anchor_s)
            miss = axpy(-1.0, moved.p_ned_m, p)
            offset = axpy(w, axpy(-1.0, offset, miss), offset)
    since_s = max(1e-3, 1e-6 * (state.t_us - state.axes_us))
    axes = observed(x, y, gains.w0, gains.tau_f_s, gains.butterworth, since_s)
    return state._replace(ekf=moved, axes=axes, axes_us=state.t_us, position_us=sample.t_us, offset_m=offset)


def _placed(gains: Gains, state: State, sample: Position) -> State:
    """Begin, or begin again after a silence, at a position; the disturbance is kept, its rate is not."""
    v = sample.v_ned_m_s if finite3(sample.v_ned_m_s) else ZERO3
    t_us = max(state.t_us, sample.t_us)
    P = state.ekf.P.copy()
    P[:6, :] = P[:, :6] = 0.0
    P[range(6), range(6)] = gains.ekf.noise[ekf.P0, :6]
    moved = state.ekf._replace(p_ned_m=sample.p_ned_m, v_ned_m_s=v, P=P)
    axes = Axes(sample.p_ned_m, v, state.axes.z3, ZERO3, ZERO3, ZERO3)
    return state._replace(t_us=t_us, ekf=moved, axes=axes, axes_us=t_us, position_us=sample.t_us, offset_m=ZERO3)


def _imu(gains: Gains, state: State, sample: Imu) -> State:
    """The gyro where no attitude with rates comes; the accelerometer where it is asked for."""
    if sample.t_us <= state.imu_us:
        return state
    silent = state.attitude_us == 0 or sample.t_us - state.attitude_us > 100_000
    if not silent and gains.accel_tau_s == 0.0:
        return state
    state = _to(gains, state, sample.t_us)
    if _age_s(state, sample.t_us) > _LATE_S:
        return state
    if silent and finite3(sample.gyro_rad_s):
        if gains.use_filter:
            state = state._replace(ekf=ekf.update(gains.ekf, state.ekf, _rows(NAN3, NAN3, NAN3, sample.gyro_rad_s)))
        else:
            state = state._replace(ekf=state.ekf._replace(omega_rad_s=sample.gyro_rad_s))
    if gains.accel_tau_s > 0.0 and state.position_us and finite3(sample.accel_m_s2):
        speed = state.ekf.v_ned_m_s
        felt = axpy(1.0, quat.rotate(state.ekf.q_wxyz, sample.accel_m_s2), (0.0, 0.0, gains.ekf.gravity_m_s2))
        rest = axpy(-1.0, known(gains.ekf, state.ekf.q_wxyz, state.thrust_m_s2, speed), felt)
        since_s = 1e-6 * (sample.t_us - state.imu_us) if state.imu_us else 0.0
        w = 1.0 - math.exp(-min(since_s, _COAST_S) / gains.accel_tau_s)
        state = state._replace(fast_m_s2=axpy(w, axpy(-1.0, state.fast_m_s2, rest), state.fast_m_s2))
    return state._replace(imu_us=sample.t_us)


def step(gains: Gains, state: State, applied: Applied, t_us: int) -> tuple[State, Estimate]:
    """Once per control tick: remember what was sent, and say where the vehicle is at t."""
    state = _to(gains, state._replace(thrust=applied_thrust.remember(state.thrust, applied)), t_us)
    q, w = state.ekf.q_wxyz, state.ekf.omega_rad_s
    if not state.position_us or not state.attitude_us:
        return state, Estimate(t_us, NAN3, NAN3, q, w, NAN3, NAN3)
    x = state.axes
    if gains.use_filter:
        p, v = axpy(1.0, state.offset_m, state.ekf.p_ned_m), state.ekf.v_ned_m_s
    else:
        since_s = 1e-6 * (state.t_us - state.axes_us)
        p = axpy(1.0, axpy(0.5 * since_s * since_s, x.z3, x.moved_m), axpy(since_s, x.z2, x.z1))
        v = axpy(1.0, axpy(since_s, x.z3, x.gained_m_s), x.z2)
    f = compensated(x, gains.w0, gains.feedforward, gains.lead_s, gains.butterworth)
    f = axpy(-gains.ekf.drag_1_s, v, axpy(1.0, f, state.fast_m_s2))
    return state, Estimate(t_us, p, v, q, w, f, NAN3, state.thrust.delay_s, state.thrust_m_s2)


def uses(gains: Gains) -> tuple[str, ...]:
    """The kinds of samples that `observe` keeps."""
    return ("Attitude", "Imu", "Position", "Target")
