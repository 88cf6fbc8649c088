"""The compensator `asmf` of a helicopter in flight: the hover model's error with bounds, and the full-state target that flies with it. Pure.

Here the correction is not an acceleration added to a command: surge and sway can only be cancelled by tilting, and separate loops for
attitude and velocity stay metres off (design note of the ASMF, section 7). From the path and the model error f follow the states and
sticks that fly it (`compensate/helicopter.py`), and the sticks go out (SET_ACTUATOR_CONTROL_TARGET, group 0), new ones 50 times a second. The nominal
controller's command flies, through the autopilot's own inner loop, until the filter has settled and whenever authority is taken away.

Sticks as applied come back in ACTUATOR_CONTROL_TARGET; each value is taken to act until its stamp. What has no echo yet is what was
sent one delay before, while our sticks are the ones that are flown.

Source: Song et al. 2011 (paper 004), sections 3 and 4.3; design note of the ASMF, section 7.3.
The bounds are guaranteed while the stated noise and rate bounds hold; the flag says when the data contradict them.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mavquad import active_common, linalg, quat
from mavquad.airframe import Airframe
from mavquad.compensate import helicopter
from mavquad.errors import ConfigError
from mavquad.estimate import asmf, command_line, heli_error
from mavquad.estimate.heli_error import G_M_S2, PHI, THETA, P, Q, R, U, V, W
from mavquad.identify import models
from mavquad.signals import NO_STICKS, ZERO3, Applied, Attitude, Command, Controls, Demand, Estimate, Position, Sticks

TICK_US = 20_000
SLACK_US = 2_000  # a tick is due this much early: stamps are whole milliseconds
GAP_S = 0.5  # a longer silence, or a clock that goes back: begin again
READY_S = 1.0  # of filtering before our sticks fly
FRESH_S = 0.25  # older velocities: the nominal command flies
ECHO_S = 0.3  # an echo older than this says nothing
ALIKE = 0.02  # of full stick: an echo this close to what was sent is ours
PIECES = 5  # of a tick, over which the acting sticks are averaged
_MEASURED = (THETA, PHI, Q, P, R, U, V, W)
_F = tuple(heli_error.N + heli_error.ROWS.index(row) for row in ("u", "v", "w"))
_F_TURN = tuple(heli_error.N + heli_error.ROWS.index(row) for row in ("p", "q"))

PUBLISHED = (
    "f_n", "f_e", "f_d", "f_n_low", "f_e_low", "f_d_low", "f_n_high", "f_e_high", "f_d_high", "f_roll", "f_pitch",
    "half_width", "guarantee", "empty", "inflations", "authority", "given_back_n", "given_back_e", "given_back_d",
    "thrust",  # specific, by the collective that the model thinks acts: what f is measured against
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Params:
    """Bounds of the telemetry, five sigma of Gaussian noise; `b_f` of (u, q, v, p, w, r) per tick of 20 ms."""

    authority: float = 1.0  # share of the model error that the target uses; 0: the nominal controller flies
    e_attitude_rad: float = 0.014
    e_rate_rad_s: float = 0.025
    e_velocity_m_s: float = 0.15
    b_f: tuple[float, ...] = (0.03, 0.2, 0.03, 0.3, 0.06, 0.06)
    delay_s: float = -1.0  # from a measurement to the sticks made of it; -1: as measured, and half a period of the inner loop
    integral_1_s: float = 0.2

    def __post_init__(self) -> None:
        active_common.check(self.authority, self.delay_s)


class Gains(NamedTuple):
    model: heli_error.Gains
    target: helicopter.Gains
    authority: float
    delay_s: float  # -1: as measured
    z_col: float


class State(NamedTuple):
    model: asmf.State | None  # none until there is an attitude, a velocity and the sticks as applied
    filter_us: int  # vehicle time the filter stands at
    begun_us: int
    t_us: int  # of the last step
    memory: helicopter.Target
    sent: command_line.Line  # (lon, lat, ped, col) of ours
    echo: command_line.Line  # as applied, each until its stamp
    followed_us: int  # when an echo last agreed with what was sent
    attitude: Attitude | None
    velocity: Position | None
    velocity_us: int  # of the newest velocity taken
    acting: Sticks  # lon, lat, ped, col
    sticks: Sticks  # last sent, in the same order; NaN where the nominal flies
    authority: float
    shown: tuple[float, ...]  # what is published


_UNKNOWN = (math.nan,) * 12 + (0.0,) * 7 + (math.nan,)


def gains(params: Params, airframe: Airframe) -> Gains:
    """Raises ConfigError for a vehicle whose file has no hover model."""
    p = airframe.hover_model
    if not p:
        raise ConfigError(f"asmf: the file of {airframe.name} has no [hover_model]; fly a stick sweep and identify it")
    model = models.semi_decoupled(models.lon(p), models.lat(p), models.yaw_heave(p))
    e = (params.e_attitude_rad,) * 2 + (params.e_rate_rad_s,) * 3 + (params.e_velocity_m_s,) * 3
    filtered = heli_error.Params(e=e, b_f=params.b_f, tick_s=1e-6 * TICK_US)
    structure = helicopter.Params(tick_s=1e-6 * TICK_US, integral_1_s=params.integral_1_s)
    return Gains(
        heli_error.gains(filtered, model.a, model.b, model.states),
        helicopter.gains(structure, model.a, model.b, model.states),
        params.authority,
        params.delay_s,
        float(model.b[W, 3]),
    )


def init(gains: Gains) -> State:
    """Nothing heard, nothing sent."""
    line = command_line.init(np.zeros(4))
    return State(
        None, 0, 0, 0, helicopter.init_target(), line, line, -(1 << 62), None, None, 0, (0.0,) * 4, NO_STICKS, 0.0, _UNKNOWN
    )  # fmt: skip


def uses(gains: Gains) -> tuple[str, ...]:
    """The kinds of samples that `observe` takes."""
    return ("Attitude", "Position", "Controls")


def observe(gains: Gains, state: State, sample: object) -> State:
    """Keep what arrived until the next step; what is not finite is dropped."""
    if isinstance(sample, Attitude):
        return state._replace(attitude=sample) if active_common.finite((*sample.q_wxyz, *sample.omega_rad_s)) else state
    if isinstance(sample, Position):
        return state._replace(velocity=sample) if active_common.finite((*sample.p_ned_m, *sample.v_ned_m_s)) else state
    if isinstance(sample, Controls):
        if not active_common.finite(sample.sticks):
            return state
        lat, lon, ped, col = sample.sticks
        value = np.array([lon, lat, ped, col])
        followed_us = sample.t_us if _ours(state.sent, sample.t_us, value) else state.followed_us
        return state._replace(echo=command_line.push(state.echo, sample.t_us, value), followed_us=followed_us)
    return state


def step(
    gains: Gains,
    state: State,
    estimate: Estimate,
    nominal: Command,
    applied: Applied,
    t_us: int,
    demand_at: Callable[[int], Demand],
) -> tuple[State, Command]:
    """One control tick: the model error up to t_us, and the sticks that fly the path with it."""
    attitude, velocity = state.attitude, state.velocity
    if attitude is None or velocity is None or t_us - int(state.echo.t_us[0]) > 1e6 * GAP_S:
        return state._replace(model=None, t_us=t_us, sticks=NO_STICKS, authority=0.0, shown=_UNKNOWN), nominal
    if state.model is None or not 0.0 <= 1e-6 * (t_us - state.filter_us) <= GAP_S:
        state = _begin(gains, state, attitude, velocity, t_us)
    ticks = (t_us - state.filter_us + SLACK_US) // TICK_US
    if ticks == 0 and state.t_us > 0:
        return state, nominal._replace(sticks=_wire(state.sticks))
    delay_s = _delay_s(gains, applied)
    state = _estimate(gains, state, attitude, velocity, delay_s, ticks)._replace(t_us=t_us)
    assert state.model is not None
    authority = gains.authority * asmf.authority(state.model, t_us)
    settled = t_us - state.begun_us >= 1e6 * READY_S and 1e-6 * (t_us - velocity.t_us) <= FRESH_S
    if settled and authority > 0.0 and active_common.finite(nominal.a_ned_m_s2):
        state, stick = _fly(gains, state, attitude, velocity, authority, delay_s, t_us, demand_at)
        lon, lat, ped, col = (float(v) for v in stick)
        sticks = (lon, lat, ped, col)
        state = state._replace(sent=command_line.push(state.sent, t_us, stick), sticks=sticks, authority=authority)
    else:
        state = state._replace(sticks=NO_STICKS, authority=0.0, memory=helicopter.init_target())
    state = state._replace(shown=_shown(gains, state, attitude))
    return state, nominal._replace(sticks=_wire(state.sticks))


def published(state: State) -> tuple[float, ...]:
    """What is shown, named by PUBLISHED: f turned to NED with its bounds. NaN before there is an estimate."""
    return state.shown


def _begin(gains: Gains, state: State, attitude: Attitude, velocity: Position, t_us: int) -> State:
    """A first set around what is measured, the rotor's states at rest."""
    x = np.zeros(gains.model.f.shape[0])
    x[list(_MEASURED)] = _outputs(attitude, velocity)
    return state._replace(
        model=asmf.init(gains.model.filter, x), filter_us=t_us - TICK_US, begun_us=t_us, t_us=0, velocity_us=0,
        memory=helicopter.init_target(), sticks=NO_STICKS,
    )  # fmt: skip


def _estimate(gains: Gains, state: State, attitude: Attitude, velocity: Position, delay_s: float, ticks: int) -> State:
    """The model error after `ticks` more, from what arrived since the last step."""
    model = state.model
    assert model is not None
    before = model.x
    stick = np.zeros(4)
    for k in range(ticks):
        begin_us = state.filter_us + k * TICK_US
        stick = _acting(state, begin_us, delay_s)
        before = model.x
        known = heli_error.drive(gains.model, model.x, stick)
        model = asmf.predict(gains.model.filter, model, gains.model.f, known, 1.0, begin_us + TICK_US)
    filter_us = state.filter_us + ticks * TICK_US
    y = _outputs(attitude, velocity)
    if velocity.t_us <= state.velocity_us:
        y[5:] = math.nan
    slope = np.abs(model.x - before)[list(_MEASURED)] * (1e6 / TICK_US)
    late = slope * (1e-6 * abs(filter_us - attitude.t_us))
    v = np.abs(y[5:])
    e_attitude = gains.model.filter.e[0]
    late[5:] = slope[5:] * (1e-6 * abs(filter_us - velocity.t_us)) + e_attitude * (v.sum() - v)
    model = asmf.update(gains.model.filter, model, y, late, filter_us)
    lon, lat, ped, col = (float(s) for s in stick)
    return state._replace(
        model=model, filter_us=filter_us, velocity_us=max(velocity.t_us, state.velocity_us), acting=(lon, lat, ped, col)
    )


def _fly(
    gains: Gains,
    state: State,
    attitude: Attitude,
    velocity: Position,
    authority: float,
    delay_s: float,
    t_us: int,
    demand_at: Callable[[int], Demand],
) -> tuple[State, np.ndarray]:
    """Sticks (lon, lat, ped, col) for the moment at which they will act."""
    assert state.model is not None
    x = state.model.x
    ahead = round(1e6 * delay_s / TICK_US)
    later = x
    if ahead > 0:
        waiting = np.array([_acting(state, t_us + i * TICK_US, delay_s) for i in range(ahead)])
        later = heli_error.ahead(gains.model, x, waiting)
    ahead_s = 1e-6 * ahead * TICK_US
    psi = quat.yaw(attitude.q_wxyz)
    v_now = quat.rotate(quat.from_euler(x[PHI], x[THETA], psi), (x[U], x[V], x[W]))
    psi += 0.5 * ahead_s * float(x[R] + later[R])
    v_later = quat.rotate(quat.from_euler(later[PHI], later[THETA], psi), (later[U], later[V], later[W]))
    place = linalg.axpy(1e-6 * (t_us - velocity.t_us), v_now, velocity.p_ned_m)
    place = linalg.axpy(0.5 * ahead_s, linalg.add(v_now, v_later), place)
    demand = demand_at(t_us + ahead * TICK_US)
    level = quat.from_euler(0.0, 0.0, psi)
    error = quat.rotate_back(level, linalg.sub(demand.p_ned_m, place))
    v_path, a_path = quat.rotate_back(level, demand.v_ned_m_s), quat.rotate_back(level, demand.a_ned_m_s2)
    turn = demand.yaw_rad - psi
    integral = state.memory.integral_m
    memory, x_s, u_s = helicopter.target(
        gains.target, state.memory, later, authority * x[heli_error.N :], v_path, a_path, demand.yaw_rate_rad_s
    )
    heading = math.atan2(math.sin(turn), math.cos(turn))
    memory, stick = helicopter.target_sticks(gains.target, memory, later[: heli_error.N], x_s, u_s, error, heading)
    if t_us - state.followed_us > 1e6 * ECHO_S:  # somebody else flies: an integral would wind up
        memory = memory._replace(integral_m=integral)
    return state._replace(memory=memory), stick


def _shown(gains: Gains, state: State, attitude: Attitude) -> tuple[float, ...]:
    inner = state.model
    assert inner is not None
    x, p = inner.x, inner.p
    axes = [quat.rotate(attitude.q_wxyz, unit) for unit in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))]
    turned = np.array(axes).T  # body to NED
    f = turned @ x[list(_F)]
    half = np.sqrt(np.maximum(np.diag(turned @ p[np.ix_(_F, _F)] @ turned.T), 0.0))
    half += gains.model.filter.e[0] * np.abs(f).sum()  # of the attitude it is turned by
    return (
        *(float(v) for v in f), *(float(v) for v in f - half), *(float(v) for v in f + half),
        float(x[_F_TURN[0]]), float(x[_F_TURN[1]]), float(half.max()),
        1.0 if inner.guarantee else 0.0, float(inner.empty), float(inner.inflations), state.authority, *ZERO3,
        G_M_S2 - gains.z_col * state.acting[3],
    )  # fmt: skip


def _acting(state: State, begin_us: int, delay_s: float) -> np.ndarray:
    """(4,) mean of the sticks over one tick: as echoed, or as sent one delay before where there is no echo yet."""
    echo, sent = state.echo, state.sent
    newest_us = int(echo.t_us[0])
    ours = newest_us - state.followed_us <= 1e6 * ECHO_S
    total = np.zeros(4)
    for k in range(PIECES):
        at_us = begin_us + (2 * k + 1) * TICK_US // (2 * PIECES)
        if at_us > newest_us and ours:
            total += sent.value[command_line.index_at(sent, at_us - round(1e6 * delay_s))]
        else:
            total += echo.value[max(0, command_line.index_at(echo, at_us - 1) - 1)]
    return total / PIECES


def _ours(sent: command_line.Line, t_us: int, value: np.ndarray) -> bool:
    """Whether these sticks are some that were sent shortly before."""
    recent = (t_us - sent.t_us >= 0) & (t_us - sent.t_us <= 1e6 * ECHO_S)
    return bool(np.any(recent & (np.abs(sent.value - value).max(axis=1) < ALIKE)))


def _outputs(attitude: Attitude, velocity: Position) -> np.ndarray:
    """(8,) theta, phi, q, p, r, u, v, w as measured."""
    roll, pitch, _ = quat.to_euler(attitude.q_wxyz)
    p, q, r = attitude.omega_rad_s
    return np.array([pitch, roll, q, p, r, *quat.rotate_back(attitude.q_wxyz, velocity.v_ned_m_s)])


def _delay_s(gains: Gains, applied: Applied) -> float:
    if gains.delay_s >= 0.0:
        return gains.delay_s
    return active_common.measured_delay_s(applied) + 0.5e-6 * TICK_US


def _wire(sticks: Sticks) -> Sticks:
    """(lon, lat, ped, col) in the order of MAVLink's controls: roll, pitch, yaw, throttle."""
    lon, lat, ped, col = sticks
    return (lat, lon, ped, col)
