"""A controller that excites for identification, above a slow position hold: a multirotor's attitude setpoint, a helicopter's sticks.

One axis after the other: quiet, sweep, quiet; then doublets on both axes for a check that no fit has seen. The excitation goes on
the log beside the setpoint (DEBUG_VECT "EXCITE"), both on the vehicle's clock. A helicopter's sticks: stick_sweep.

Source: identification note, section 7 (Song et al. 2011, paper 004, section 4.2).

Deviations from the paper:
  section 4.2  nobody holds a stick: the position hold stays closed at 0.5 rad/s, far below what it is to tell apart.

Any abort sets the excitation to zero in the very sample that shows its reason, for the rest of the flight; the hold stays. A pilot
takes the vehicle by its mode switch: the companion releases at once.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

from mavquad import quat, stick_sweep
from mavquad.airframe import Airframe
from mavquad.control import pid
from mavquad.errors import ConfigError
from mavquad.identify import excitation
from mavquad.identify.excitation import Sweep
from mavquad.signals import Command, Demand, Estimate, Vec3

AXES = ("roll", "pitch", "yaw", "thrust")
G_M_S2 = 9.80665
LEAD_S = 5.0  # of plain hold before the first sweep
DOUBLET_S = 1.2  # each way
WHY = ("", "tilt", "speed", "height lost", "link age")


@dataclass(frozen=True, slots=True, kw_only=True)
class Params:
    axes: tuple[str, ...] = ("roll", "pitch")
    amplitude_rad: float = 0.1  # roll, pitch
    yaw_amplitude_rad: float = 0.2
    thrust_amplitude: float = 0.05  # of full collective
    f_start_hz: float = 0.1
    f_end_hz: float = 5.0
    sweep_s: float = 70.0
    quiet_s: float = 3.0
    check_s: float = 25.0  # of doublets on roll and pitch at the end; 0: none
    stick_amplitude: tuple[float, float, float, float] = (0.12, 0.2, 0.1, 0.1)  # helicopter: lat, lon, ped, col of full stick
    stick_f_start_hz: float = 0.05
    stick_f_end_hz: float = 8.0
    stick_sweep_s: float = 90.0
    stick_quiet_s: float = 5.0
    stick_records: int = 2  # sweeps of each stick
    hold_rad_s: float = 0.5
    tilt_max_deg: float = 25.0
    speed_max_m_s: float = 5.0
    height_loss_m: float = 3.0
    link_age_s: float = 0.3

    def __post_init__(self) -> None:
        unknown = [axis for axis in self.axes if axis not in AXES]
        if unknown or not self.axes:
            raise ConfigError(f"sweep.axes = {list(self.axes)}: expected some of {', '.join(AXES)}")
        if not self.amplitude_rad < math.radians(self.tilt_max_deg):
            raise ConfigError(
                f"sweep.amplitude_rad = {self.amplitude_rad}: expected below sweep.tilt_max_deg ({self.tilt_max_deg} deg), which aborts"
            )
        if not 0.1 <= self.hold_rad_s <= 2.0 or self.check_s < 0.0:
            raise ConfigError(
                f"sweep: hold_rad_s = {self.hold_rad_s}, check_s = {self.check_s}: expected 0.1 to 2 rad/s and >= 0"
            )
        for limit in (self.speed_max_m_s, self.height_loss_m, self.link_age_s):
            if not limit > 0.0:
                raise ConfigError(f"sweep: speed_max_m_s, height_loss_m, link_age_s must be > 0, got {limit}")
        if len(self.stick_amplitude) != 4 or not all(0.0 < x <= 0.5 for x in self.stick_amplitude) or self.stick_records < 1:
            raise ConfigError(
                f"sweep: stick_amplitude = {list(self.stick_amplitude)}, stick_records = {self.stick_records}: expected four of"
                " (0, 0.5] and at least 1"
            )
        _sweep(self, self.axes[0])
        excitation.check_rate(_stick_sweep(self), stick_sweep.PERIOD_S)


class Gains(NamedTuple):
    hold: pid.Gains
    axes: tuple[str, ...]
    sweeps: tuple[Sweep, ...]
    doublet_rad: float
    check_s: float
    tilt_cos: float
    speed_max_m_s: float
    height_loss_m: float
    link_age_s: float
    g_over_hover_m_s2: float  # specific thrust per collective
    sticks: stick_sweep.Program | None  # of a helicopter; None: the attitude setpoint is swept


class State(NamedTuple):
    hold: pid.State
    t_s: float  # since the first step
    excited: tuple[float, float, float, float]  # roll, pitch, yaw [rad], collective; or sticks: as added in this step
    aborted: int  # index of WHY; 0: not


def gains(params: Params, airframe: Airframe) -> Gains:
    hold = pid.gains(pid.Params(wc_rad_s=params.hold_rad_s, integral=0.2), airframe)
    return Gains(
        hold,
        params.axes,
        tuple(_sweep(params, axis) for axis in params.axes),
        params.amplitude_rad,
        params.check_s,
        math.cos(math.radians(params.tilt_max_deg)),
        params.speed_max_m_s,
        params.height_loss_m,
        params.link_age_s,
        G_M_S2 / airframe.hover_thrust,
        _program(params) if airframe.kind == "helicopter" else None,
    )


def init(gains: Gains) -> State:
    return State(pid.init(gains.hold), 0.0, (0.0, 0.0, 0.0, 0.0), 0)


def duration_s(params: Params, kind: str = "quadrotor") -> float:
    """How long the whole sequence takes on this kind of vehicle."""
    if kind == "helicopter":
        return LEAD_S + stick_sweep.PERIOD_S * len(_program(params))
    return LEAD_S + sum(_sweep(params, axis).total_s for axis in params.axes) + params.check_s


def step(gains: Gains, state: State, estimate: Estimate, demand: Demand, preview: object, dt_s: float) -> tuple[State, Command]:
    """One control step: the hold's command, leaned and turned by the excitation."""
    hold, command = pid.step(gains.hold, state.hold, estimate, demand, preview, dt_s)
    aborted = state.aborted or _abort(gains, estimate, demand, dt_s)
    excited = (0.0, 0.0, 0.0, 0.0) if aborted else excitation_at(gains, state.t_s)
    if gains.sticks is not None:
        return State(hold, state.t_s + dt_s, excited, aborted), command
    roll, pitch, yaw, collective = excited
    right, ahead = G_M_S2 * math.tan(roll), -G_M_S2 * math.tan(pitch)
    heading = demand.yaw_rad + yaw
    c, s = math.cos(heading), math.sin(heading)
    a = command.a_ned_m_s2
    leaned: Vec3 = (a[0] + c * ahead - s * right, a[1] + s * ahead + c * right, a[2] - gains.g_over_hover_m_s2 * collective)
    return State(hold, state.t_s + dt_s, excited, aborted), command._replace(a_ned_m_s2=leaned, yaw_rad=heading)


def excitation_at(gains: Gains, t_s: float) -> tuple[float, float, float, float]:
    """(roll, pitch, yaw [rad], collective) of the sequence at `t_s`; of a helicopter its sticks (lat, lon, ped, col)."""
    if gains.sticks is not None:
        return stick_sweep.at(gains.sticks, t_s - LEAD_S)
    found = [0.0, 0.0, 0.0, 0.0]
    at = t_s - LEAD_S
    for axis, sweep in zip(gains.axes, gains.sweeps, strict=True):
        if 0.0 <= at < sweep.total_s:
            found[AXES.index(axis)] = excitation.value(sweep, at)
        at -= sweep.total_s
    if 0.0 <= at < gains.check_s:
        found[0] = gains.doublet_rad * _doublet(at, DOUBLET_S)
        found[1] = gains.doublet_rad * _doublet(at, 1.7 * DOUBLET_S)  # never in step with roll
    return (found[0], found[1], found[2], found[3])


def messages(
    gains: Gains, before: State, after: State, t_us: int, target: tuple[int, int]
) -> tuple[tuple[str, tuple[Any, ...]], ...]:
    """What goes on the wire to `target` beside the setpoint: the excitation at every step, and why it ended."""
    roll, pitch, yaw, collective = after.excited
    sends: list[tuple[str, tuple[Any, ...]]]
    if gains.sticks is not None:
        controls = (*after.excited, 0.0, 0.0, 0.0, 0.0)
        sends = [("SET_ACTUATOR_CONTROL_TARGET", (t_us, stick_sweep.PASSTHROUGH, *target, controls))]
    else:
        sends = [("DEBUG_VECT", ("EXCITE", t_us, roll, pitch, yaw or collective))]
    if after.aborted and not before.aborted:
        sends.append(("STATUSTEXT", (4, f"mavquad: sweep aborted: {WHY[after.aborted]}"[:50], 0, 0)))
    return tuple(sends)


def _abort(gains: Gains, estimate: Estimate, demand: Demand, dt_s: float) -> int:
    upright = quat.rotate(estimate.q_wxyz, (0.0, 0.0, 1.0))[2]
    v = estimate.v_ned_m_s
    if not upright > gains.tilt_cos:  # also a NaN
        return 1
    if not math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]) < gains.speed_max_m_s:
        return 2
    if not estimate.p_ned_m[2] - demand.p_ned_m[2] < gains.height_loss_m:
        return 3
    return 4 if dt_s > gains.link_age_s else 0


def _doublet(t_s: float, half_s: float) -> float:
    """+1, -1, 0: three pieces of `half_s`."""
    return (1.0, -1.0, 0.0)[int(t_s / half_s) % 3]


def _sweep(params: Params, axis: str) -> Sweep:
    amplitude = {"yaw": params.yaw_amplitude_rad, "thrust": params.thrust_amplitude}.get(axis, params.amplitude_rad)
    return Sweep(
        amplitude=amplitude,
        f_start_hz=params.f_start_hz,
        f_end_hz=params.f_end_hz,
        duration_s=params.sweep_s,
        quiet_s=params.quiet_s,
        fade_s=2.0,
    )


def _stick_sweep(params: Params) -> Sweep:
    return Sweep(
        amplitude=max(params.stick_amplitude),
        f_start_hz=params.stick_f_start_hz,
        f_end_hz=params.stick_f_end_hz,
        duration_s=params.stick_sweep_s,
        quiet_s=params.stick_quiet_s,
    )


def _program(params: Params) -> stick_sweep.Program:
    return stick_sweep.program(params.axes, params.stick_amplitude, _stick_sweep(params), params.stick_records, params.check_s)
