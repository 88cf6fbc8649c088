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

import numpy as np

from mavquad import adrc_checks, flat
from mavquad.airframe import Airframe
from mavquad.errors import ConfigError
from mavquad.estimate import applied_thrust, ekf, joint_tick, leso
from mavquad.signals import NAN3, Applied, Attitude, Estimate, Imu, Position, Target, Vec3

G_M_S2 = applied_thrust.G_M_S2
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
    flat: np.ndarray | None = None  # (1,) the rest as one record, for the kernels


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
    made = Gains(
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
    return made._replace(flat=flat.of(made))


def checks(params: Params) -> list[adrc_checks.Finding]:
    """Filter and observers together, positions at 50 Hz: unstable is refused, little damping is a warning."""
    if not params.use_filter:
        return []
    r = (params.sigma_position_m**2, params.sigma_velocity_m_s**2)
    kalman = adrc_checks.steady_gains((1e-6, params.q_velocity), r, _PERIOD_S)
    return [
        adrc_checks.joint_check(f"joint.w0_{n}", w, kalman) for n, w in (("xy", params.w0_xy_rad_s), ("z", params.w0_z_rad_s))
    ]


def init(gains: Gains) -> np.ndarray:
    """Nothing heard yet: the state is a record of `joint_tick`."""
    return joint_tick.start(gains.ekf)


def observe(gains: Gains, state: np.ndarray, sample: object) -> np.ndarray:
    """Absorb one sample; what is not finite, repeated or far too late is left out."""
    if isinstance(sample, Attitude):
        taken, after = joint_tick.with_attitude(gains.flat, state, sample.t_us, sample.q_wxyz, sample.omega_rad_s)
    elif isinstance(sample, Position):
        taken, after = joint_tick.with_position(gains.flat, state, sample.t_us, sample.p_ned_m, sample.v_ned_m_s)
    elif isinstance(sample, Imu):
        taken, after = joint_tick.with_imu(gains.flat, state, sample.t_us, sample.accel_m_s2, sample.gyro_rad_s)
    elif isinstance(sample, Target):
        return joint_tick.with_echo(state, sample.t_us, sample.thrust)
    else:
        return state
    return after if taken else state


def step(gains: Gains, state: np.ndarray, applied: Applied, t_us: int) -> tuple[np.ndarray, Estimate]:
    """Once per control tick: remember what was sent, and say where the vehicle is at t."""
    state, now = joint_tick.with_sent(gains.flat, state, t_us, applied.t_us, applied.thrust_m_s2, applied.delay_s)
    p, v, q, w, f, delay_s, thrust_m_s2 = now
    if not math.isfinite(p[0]):
        return state, Estimate(t_us, NAN3, NAN3, q, w, NAN3, NAN3)
    return state, Estimate(t_us, p, v, q, w, f, NAN3, delay_s, thrust_m_s2)


def uses(gains: Gains) -> tuple[str, ...]:
    """The kinds of samples that `observe` keeps."""
    return ("Attitude", "Imu", "Position", "Target")
