"""One control tick as one compiled function: age of positions, joint observer, closed-form MPC, ASMF, attitude, limits.

It calls the very kernels of the companion's stages on one record of gains and one of states; what is written out here is what lies
between them, as `mavquad.samples` and `mavquad.control_step` do it for a vehicle that is engaged. The struct codec stands on either side.
What is no plain tick (a clock that restarts, a position that jumps, setpoints too late) it refuses: those are the pipeline's. A test
compares the bits.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from mavquad import active_tick, flat, paths, position_age, wire
from mavquad.compensate import active_model
from mavquad.control import lagged
from mavquad.control.mpc_flight import QUEUE
from mavquad.errors import ConfigError
from mavquad.estimate import joint_tick
from mavquad.flight import Flight
from mavquad.jit import kernel
from mavquad.link import signals
from mavquad.plan import Plan
from mavquad.setpoint import attitude, limits
from mavquad.wire import Frame

G_M_S2 = 9.80665
_NEVER_US = -(1 << 62)
_LATE_US = 500_000
_NAN3 = (math.nan, math.nan, math.nan)
_ZERO3 = (0.0, 0.0, 0.0)
POSITION, IMU, ECHO, ATTITUDE = 0, 1, 2, 3  # in this order within a call
_NONE: tuple[Any, ...] = (
    (0, _ZERO3, _ZERO3),
    (0, _ZERO3, _ZERO3),
    (0, (1.0, 0.0, 0.0, 0.0), 0.0),
    (0, (1.0, 0.0, 0.0, 0.0), _ZERO3),
)


class Own(NamedTuple):
    """What the stages' faces hand to their kernels besides the gains."""

    authority: float
    minmax: float
    hover_thrust: float  # as the compensator knows it
    compensator_delay_s: float
    compensator_own_delay_s: float
    f_max: float
    predict: bool
    delay_s: float
    delay_down_s: float
    delay_max_s: float
    control_us: int
    reset_m: float


class Fixed(NamedTuple):
    """All that does not change."""

    joint: Any
    model: Any
    law: Any
    correction: active_model.Gains
    gate: limits.Gains
    path: paths.Plan
    own: Own


STATE = flat.record(
    [
        ("joint", joint_tick.RECORD),
        ("active", active_tick.RECORD),
        ("age", position_age.RECORD),
        ("queue", "f8", (QUEUE, 4)),
        ("integral_m_s", "f8", 3),
        ("begun", "?"),  # a command was sent
        ("now_us", "i8"),
        ("pace_us", "i8"),
        ("gap_us", "i8"),
        ("control_us", "i8"),
        ("attitude_us", "i8"),
        ("q_wxyz", "f8", 4),
        ("position_us", "i8"),
        ("p_ned_m", "f8", 3),
        ("v_ned_m_s", "f8", 3),
        ("told", "f8", (2, 3)),  # position and velocity as they came
        ("offset_m", "f8", 3),
        ("imu_us", "i8"),
        ("accel_sum", "f8", 3),
        ("accel_count", "i8"),
        ("accel_us", "i8"),
        ("echo_us", "i8"),
        ("echo_q", "f8", 4),
        ("echo_thrust", "f8"),
        ("followed_us", "i8"),
        ("sent_q", "f8", 4),
        ("sent_thrust", "f8"),
        ("applied_m_s2", "f8"),
        ("hover_thrust", "f8"),
        ("delay_s", "f8"),
        ("path_t0_us", "i8"),
        ("anchor_p_m", "f8", 3),
        ("anchor_yaw_rad", "f8"),
        ("refused", "?"),  # something that is no plain tick
    ]
)


def fixed(plan: Plan) -> np.ndarray:
    """The record of all gains. Raises ConfigError where the plan has other stages than those compiled here."""
    wanted = ("joint", "eskf-mpc", "asmf")
    have = (plan.estimator.label, plan.controller.label, plan.compensator.label if plan.compensator else "none")
    if have != wanted or plan.controller.gains.design is not None or plan.controller.gains.rates or plan.observers:
        raise ConfigError(
            f"the fused tick is joint, eskf-mpc (constrained = off, no rates) and asmf without observers; got {', '.join(have)}"
        )
    assert plan.compensator is not None
    active, mpc = plan.compensator.gains, plan.controller.gains
    own = Own(
        active.authority, float(active.mode == "minmax"), active.hover_thrust, active.delay_s, active.own_delay_s,
        mpc.f_max, mpc.predict, mpc.delay_s, mpc.delay_down_s, mpc.delay_max_s, plan.control_us, plan.settings.safety.reset_m,
    )  # fmt: skip
    joint = plan.estimator.gains._replace(flat=None)
    return flat.of(Fixed(joint, active.model, mpc.law, active.correction, plan.limits, plan.path, own))


def begin(f: Flight) -> np.ndarray:
    """The record of the state of an engaged flight on PX4."""
    state = np.zeros(1, STATE)
    s = state[0]
    s["joint"] = f.estimator.view(joint_tick.RECORD)[0]
    s["active"] = f.compensator.record.view(active_tick.RECORD)[0]
    s["age"] = f.position_age.view(position_age.RECORD)[0]
    s["queue"], s["integral_m_s"], s["begun"] = f.controller.queue, f.controller.integral_m_s, f.controller.steps > 0
    s["now_us"], s["pace_us"], s["gap_us"], s["control_us"] = f.now_us, f.pace_us, f.control_gap_us, f.control_us
    heard, sent = f.compensator, f.sent
    assert sent is not None
    s["attitude_us"], s["q_wxyz"] = f.stamps["ATTITUDE_QUATERNION"], f.q_wxyz
    s["position_us"], s["p_ned_m"] = f.stamps["LOCAL_POSITION_NED"], f.position.p_ned_m if f.position else _ZERO3
    s["v_ned_m_s"] = f.position.v_ned_m_s if f.position else _ZERO3
    s["told"] = f.told
    s["offset_m"], s["imu_us"] = f.offset_m, f.stamps.get("HIGHRES_IMU", 0)
    s["accel_sum"], s["accel_count"], s["accel_us"] = heard.imu_sum_m_s2, heard.imu_count, heard.imu_us
    s["echo_us"] = _NEVER_US
    if heard.echo is not None:
        s["echo_us"], s["echo_q"], s["echo_thrust"] = heard.echo.t_us, heard.echo.q_wxyz, heard.echo.thrust
    s["followed_us"] = heard.followed_us
    s["sent_q"], s["sent_thrust"], s["applied_m_s2"] = sent.q_wxyz, sent.thrust, f.applied_thrust_m_s2
    s["hover_thrust"], s["delay_s"] = f.hover_thrust, f.delay_s
    s["path_t0_us"], s["anchor_p_m"], s["anchor_yaw_rad"] = f.path_t0_us, f.anchor_p_m, f.anchor_yaw_rad
    return state


class Tick:
    """Frames in, SET_ATTITUDE_TARGET out."""

    def __init__(self, plan: Plan, f: Flight) -> None:
        self.fixed, self.state = fixed(plan), begin(f)
        own = plan.settings.link
        self._address = {"system": own.system, "component": own.component}
        self._target = f.life.target
        self.seq = f.seq

    def feed(self, frames: list[Frame]) -> list[bytes]:
        """Frames that arrived together. Raises ConfigError where they hold what is no plain tick."""
        out, slots, last = [], list(_NONE), -1
        for frame in frames:
            kind = _KINDS.get(frame.msgid)
            if kind is None:
                continue
            if kind <= last:
                out += self._run(slots)
                slots = list(_NONE)
            slots[kind], last = _DECODERS[kind](wire.decode(frame)), kind
        return out + self._run(slots) if last >= 0 else out

    def _run(self, slots: list[Any]) -> list[bytes]:
        stepped, now_us, q, thrust = tick(self.fixed, self.state, *slots)
        if not stepped:
            if self.state["refused"][0]:
                raise ConfigError("a clock that restarts or a position that jumps is no plain tick: feed the pipeline")
            return []
        fields = ((now_us // 1000) & 0xFFFFFFFF, *self._target, 7, q, 0.0, 0.0, 0.0, thrust, _ZERO3)
        raw = wire.encode("SET_ATTITUDE_TARGET", fields, seq=self.seq, **self._address)
        self.seq = (self.seq + 1) & 0xFF
        return [raw]


def _echo(m: Any) -> tuple[Any, ...]:
    t_us, q, _, thrust, _ = signals.target(m)
    return t_us, q, thrust


_KINDS = {wire.ID[n]: i for i, n in enumerate(("LOCAL_POSITION_NED", "HIGHRES_IMU", "ATTITUDE_TARGET", "ATTITUDE_QUATERNION"))}
_DECODERS = (
    lambda m: tuple(signals.position(m)),
    lambda m: tuple(signals.imu(m)),
    _echo,
    lambda m: tuple(signals.attitude_quaternion(m)),
)


@kernel
def tick(fixed, state, position, imu, echo, attitude_):
    """(whether a setpoint is due, vehicle time, attitude, collective) after at most one sample of each kind; stamp 0: none came."""
    g, s = fixed[0], state[0]
    for t_us in (position[0], imu[0], echo[0], attitude_[0]):
        if 0 < t_us < s.now_us - _LATE_US:
            s.refused = True
    if position[0] > s.position_us:
        _hear_position(g, s, position)
    if imu[0] > s.imu_us:
        _hear_imu(g, s, imu)
    if echo[0] > s.echo_us and echo[0] > 0:
        _hear_echo(s, echo)
    due = False
    if attitude_[0] > s.attitude_us:
        due = _hear_attitude(g, s, attitude_)
    if due and not s.refused:
        _control(g, s)
        return True, s.now_us, (s.sent_q[0], s.sent_q[1], s.sent_q[2], s.sent_q[3]), s.sent_thrust
    return False, s.now_us, (1.0, 0.0, 0.0, 0.0), 0.0


@kernel
def _hear_position(g, s, position):
    t_us, p, v = position
    frozen = v[0] != 0.0 or v[1] != 0.0 or v[2] != 0.0
    for i in range(3):
        frozen = frozen and s.told[0, i] == p[i] and s.told[1, i] == v[i]
    if frozen:
        return
    flat.put3(s.told[0], p)
    flat.put3(s.told[1], v)
    s.now_us = max(s.now_us, t_us)
    position_age.hear_in(s.age, t_us, v)
    p, v = position_age.carried_by(s.age, p, v)
    p = (p[0] - s.offset_m[0], p[1] - s.offset_m[1], p[2] - s.offset_m[2])
    dt_s = 1e-6 * (t_us - s.position_us)
    for i in range(3):
        if abs(p[i] - s.p_ned_m[i] - 0.5 * dt_s * (v[i] + s.v_ned_m_s[i])) > g.own.reset_m + 2.0 * dt_s:
            s.refused = True
    s.position_us = t_us
    flat.put3(s.p_ned_m, p)
    flat.put3(s.v_ned_m_s, v)
    joint_tick.hear_position(g.joint, s.joint, t_us, p, v)


@kernel
def _hear_imu(g, s, imu):
    t_us, accel, gyro = imu
    s.imu_us, s.now_us = t_us, max(s.now_us, t_us)
    position_age.feel_in(s.age, t_us, accel, _quat(s.q_wxyz))
    joint_tick.hear_imu(g.joint, s.joint, t_us, accel, gyro)
    for i in range(3):
        s.accel_sum[i] += accel[i]
    s.accel_count += 1
    s.accel_us += t_us


@kernel
def _hear_echo(s, echo):
    t_us, q, thrust = echo
    s.now_us = max(s.now_us, t_us)
    joint_tick.applied_thrust.hear(s.joint, t_us, thrust)
    if active_tick.follows(s.active, t_us, q):
        s.followed_us = t_us
    s.echo_us, s.echo_thrust = t_us, thrust
    for i in range(4):
        s.echo_q[i] = q[i]


@kernel
def _hear_attitude(g, s, sample):
    """An attitude; whether it is time for a control step."""
    t_us, q, w = sample
    s.attitude_us, s.now_us = t_us, max(s.now_us, t_us)
    joint_tick.hear_attitude(g.joint, s.joint, t_us, q, w)
    for i in range(4):
        s.q_wxyz[i] = q[i]
    gap_us = s.now_us - s.pace_us if s.pace_us > 0 else 0
    s.pace_us = s.now_us
    if 0 < gap_us < 200_000:
        s.gap_us = gap_us if s.gap_us == 0 else min(gap_us, s.gap_us)
    return t_us - s.control_us >= g.own.control_us - s.gap_us // 2


@kernel
def _control(g, s):
    """estimate -> control -> compensate -> setpoint, once, at the newest attitude."""
    t_us = s.attitude_us
    dt_s = min(0.2, 1e-6 * (t_us - s.control_us))
    s.control_us = t_us
    own, q_sent = g.own, _quat(s.sent_q)
    p, v, q, _, f, delay_s, thrust = joint_tick.estimate(g.joint, s.joint, t_us, t_us, s.applied_m_s2, s.delay_s)

    delays = lagged.delays_of(own.predict, own.delay_s, own.delay_down_s, own.delay_max_s, delay_s)
    law, queue = lagged.law_of(g.law), s.queue[:]
    integral = flat.vec3(s.integral_m_s)
    wanted = _wanted(g.path, s, t_us, delays)
    aim = (p, v, q, thrust, f, 1e-6 * t_us)
    _, _, _, _, e_p, _, _, free, _, a = lagged.aimed(
        law, own.f_max, own.predict, queue, integral, s.begun, aim, delays, wanted, dt_s
    )
    queue, integral, cancelled = lagged.sent(law, queue, integral, e_p, free, a, f, 1e-6 * t_us + delays[0], dt_s)
    s.queue[:] = queue
    flat.put3(s.integral_m_s, integral)
    s.begun = True

    heard = (
        s.attitude_us, _quat(s.q_wxyz), s.position_us, flat.vec3(s.v_ned_m_s), s.echo_us, _quat(s.echo_q), s.echo_thrust,
        s.followed_us, flat.vec3(s.accel_sum), s.accel_count, s.accel_us,
    )  # fmt: skip
    c = g.correction
    correction = active_model.Gains(
        c.horizontal_max_m_s2, c.vertical_max_m_s2, c.tau_s, c.f_attitude_max_rad_s, c.ramp_s, c.off_s, c.half_width_m_s2
    )
    mine = (own.authority, own.minmax, own.hover_thrust, own.compensator_delay_s, own.compensator_own_delay_s)
    nominal = (a, s.anchor_yaw_rad, cancelled)
    active = math.isfinite(a[0] + a[1] + a[2])
    a, _ = active_tick.advance(
        g.model, correction, mine, s.active, t_us, active, (q_sent, s.applied_m_s2, s.delay_s), heard, nominal
    )
    flat.put3(s.accel_sum, _ZERO3)
    s.accel_count, s.accel_us = 0, 0

    aimed_q, size, _ = attitude.pointing(a, s.anchor_yaw_rad, g.gate.tilt_rad)
    gate = limits.Gains(
        g.gate.cos_tilt,
        g.gate.tilt_rad,
        g.gate.rate_rad_s,
        g.gate.turn_rad_s,
        g.gate.thrust_min,
        g.gate.thrust_max,
        g.gate.thrust_slew_per_s,
    )
    collective = s.hover_thrust * size / G_M_S2
    sent_q, _, collective, _ = limits.apply_kernel(gate, q_sent, s.sent_thrust, aimed_q, _ZERO3, collective, dt_s)
    for i in range(4):
        s.sent_q[i] = sent_q[i]
    s.sent_thrust, s.applied_m_s2 = collective, G_M_S2 * collective / s.hover_thrust


@kernel
def _wanted(path, s, t_us, delays):
    """The path where the prediction ends, the vertical axis by its own delay."""
    if delays[1] == delays[2]:
        return _demand(path, s, t_us + round(1e6 * delays[1]))
    level, down = _demand(path, s, t_us + round(1e6 * delays[1])), _demand(path, s, t_us + round(1e6 * delays[2]))
    return (
        lagged.mixed(level[0], down[0]), lagged.mixed(level[1], down[1]), lagged.mixed(level[2], down[2]), lagged.mixed(level[3], down[3])
    )  # fmt: skip


@kernel
def _demand(path, s, t_us):
    plan = paths.Plan(
        path.kind, path.a, path.b, path.s_end, path.s_dot, path.ramp_s, path.duration_s, path.cos_course, path.sin_course
    )
    p, v, a, j = paths.evaluate(plan, 1e-6 * (t_us - s.path_t0_us))
    return (s.anchor_p_m[0] + p[0], s.anchor_p_m[1] + p[1], s.anchor_p_m[2] + p[2]), v, a, j


@kernel
def _quat(a):
    return (a[0], a[1], a[2], a[3])
