"""One event, pure: `feed(plan, flight, arrival_us, frame) -> (flight, outbox)` and `advance(plan, flight, until_us)` for time.

Everything the companion sends is an output of these two: setpoints, commands, answers, heartbeats, published estimates. A
received frame enters with the very stamp under which it is logged; timers fire at their logical due time, before any arrival
stamped at or after it. So a replay of the received frames gives every sent frame and every trace value again, bit for bit.
"""

import math
import zlib
from collections.abc import Callable
from typing import Any

from mavquad import lifecycle, paths, publish, tunables, wire
from mavquad.errors import ConfigError, LinkError
from mavquad.flight import Flight, forget, start
from mavquad.lifecycle import ENGAGED, OBSERVING, STREAMING, Send
from mavquad.link import signals as decode
from mavquad.plan import Plan, build
from mavquad.setpoint import attitude, limits
from mavquad.signals import NAN3, ZERO3, Applied, Attitude, Command, Demand, Position, Setpoint, Target, Vec3
from mavquad.wire import Frame

__all__ = ["Flight", "Plan", "accepts", "advance", "anchor", "build", "feed", "start"]

G_M_S2 = attitude.G_M_S2
_TICK_US = 100_000  # life cycle and watchdog
_HEARTBEAT_US = 1_000_000
_BEHIND_US, _BEHIND_MANY = 500_000, 30  # no link delivers so many in a row so late: a clock restarted soon after it started
_LATE_US = 2_000_000  # a stamp further back than this is a restarted clock, not a late message


# ---- the two entries ----------------------------------------------------------------------------------------------------
def advance(plan: Plan, flight: Flight, until_us: int) -> Flight:
    """Fire every timer due at or before `until_us` (arrival time), each at its own due time."""
    if until_us < flight.due_us and not flight.outbox and not flight.trace:
        return flight
    f = flight.clone()
    _pass_time(flight.tuned or plan, f, until_us)
    return f


def feed(plan: Plan, flight: Flight, arrival_us: int, frame: Frame) -> Flight:
    """Timers up to the arrival, then the frame. What is to be sent is in `.outbox` as (stamp, frame), trace rows in `.trace`.

    A frame that concerns no stage changes no more than the check sum of all that was heard, which the trace carries.
    """
    plan = flight.tuned or plan
    handler = _HANDLERS.get(frame.msgid)
    name = plan.samples.get(frame.msgid)
    known = frame.msgid in wire.ID_SET
    f = flight.clone()
    f.heard_crc = zlib.crc32(frame.raw, f.heard_crc)
    if handler is None and name is None and known:
        _pass_time(plan, f, arrival_us)
        return f
    if not f.heartbeat_us:  # the first event starts the clockwork
        f.heartbeat_us = f.tick_us = f.timesync_us = f.publish_us = arrival_us
        f.due_us = arrival_us
    _pass_time(plan, f, arrival_us)
    if handler is not None:
        handler(plan, f, frame, wire.decode(frame))
    elif not known:
        _count(f, "unknown message")
    elif (frame.system, frame.component) == f.life.target:
        _sample(plan, f, str(name), wire.decode(frame))
    if f.life is not flight.life:
        f.due_us = _next_due_us(f)
    return f


def _pass_time(plan: Plan, f: Flight, until_us: int) -> None:
    while f.due_us <= until_us:
        f.arrival_us = max(f.arrival_us, f.due_us)
        _fire(plan, f, f.arrival_us)
        f.due_us = _next_due_us(f)
    f.arrival_us = max(f.arrival_us, until_us)


def accepts(plan: Plan, flight: Flight, frame: Frame) -> str:
    """ "" where the companion takes the frame, else why not: it belongs in the log of refused frames."""
    own = plan.settings.link
    if (frame.system, frame.component) == (own.system, own.component):
        return "our own address"
    target = flight.life.target
    if target == (0, 0) or (frame.system, frame.component) == target:
        return ""
    if frame.msgid in _FOR_ANYBODY:
        return ""
    return "not from our autopilot"


_FOR_ANYBODY = frozenset(
    wire.ID[name]
    for name in (
        "HEARTBEAT",
        "COMMAND_LONG",
        "COMMAND_INT",
        "PARAM_REQUEST_READ",
        "PARAM_REQUEST_LIST",
        "PARAM_SET",
        "TIMESYNC",
        "PING",
    )
)


# ---- sending ------------------------------------------------------------------------------------------------------------
def _send(plan: Plan, f: Flight, name: str, fields: tuple[Any, ...]) -> None:
    own = plan.settings.link
    raw = wire.encode(name, fields, seq=f.seq, system=own.system, component=own.component)
    f.seq = (f.seq + 1) & 0xFF
    f.outbox.append((f.arrival_us, raw))


def _send_all(plan: Plan, f: Flight, sends: tuple[Send, ...]) -> None:
    for name, fields in sends:
        _send(plan, f, name, fields)


def _count(f: Flight, what: str) -> None:
    counts = dict(f.counts)
    counts[what] = counts.get(what, 0) + 1
    f.counts = counts


# ---- time ---------------------------------------------------------------------------------------------------------------
def _next_due_us(f: Flight) -> int:
    due = min(f.heartbeat_us, f.tick_us, f.timesync_us, f.publish_us)
    life_due = lifecycle.due_us(f.life)
    return min(due, max(life_due, f.arrival_us)) if life_due else due


def _fire(plan: Plan, f: Flight, now_us: int) -> None:
    if now_us >= f.heartbeat_us:
        f.heartbeat_us = now_us + _HEARTBEAT_US
        _send(plan, f, "HEARTBEAT", (18, lifecycle.INVALID, 0, 0, 4, 3))
    if now_us >= f.timesync_us:
        f.timesync_us = now_us + round(1e6 / plan.settings.link.timesync_hz)
        if f.life.target != (0, 0):
            _send(plan, f, "TIMESYNC", (0, publish.nanoseconds(now_us), *f.life.target))
    if now_us >= f.publish_us:
        f.publish_us = now_us + round(1e6 / plan.settings.link.publish_hz)
        _send_all(plan, f, publish.estimates(plan, f))
    due = lifecycle.due_us(f.life)
    if due and now_us >= due:
        f.life, sends = lifecycle.on_time(f.life, now_us)
        _send_all(plan, f, sends)
    if now_us >= f.tick_us:
        f.tick_us = now_us + _TICK_US
        _tick(plan, f, now_us)


def vehicle_now_us(f: Flight) -> int:
    """Vehicle time at the last event, carried on from the newest sample by the arrival clock."""
    if not f.now_us:
        return 0
    return f.now_us + max(0, f.arrival_us - f.stamps.get("arrival of newest", f.arrival_us))


def _age_s(f: Flight, *names: str) -> float:
    newest = max((f.stamps.get(f"{name} arrived", -1) for name in names), default=-1)
    return math.inf if newest < 0 else 1e-6 * (f.arrival_us - newest)


def _tick(plan: Plan, f: Flight, now_us: int) -> None:
    safety = plan.settings.safety
    attitude_age, position_age = _age_s(f, "ATTITUDE_QUATERNION", "ATTITUDE"), _age_s(f, "LOCAL_POSITION_NED")
    p, v = (f.position.p_ned_m, f.position.v_ned_m_s) if f.position else (ZERO3, ZERO3)
    sight = lifecycle.Sight(attitude_age, position_age, f.origin_m[2] - p[2], math.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2))
    before = f.life
    f.life, sends = lifecycle.on_tick(f.life, sight, now_us, plan.settings)
    _send_all(plan, f, sends)
    if f.life.state == STREAMING and (before.state != STREAMING or not lifecycle.guided(f.life)):
        anchor(plan, f)  # until our setpoints are flown the start point goes along with the vehicle
    if f.life.state == ENGAGED and before.state != ENGAGED:
        f.path_t0_us = f.now_us + round(1e6 * plan.settings.settle_s)
    if f.life.state in (STREAMING, ENGAGED):
        age = max(attitude_age, position_age)
        if age > safety.release_s:
            _release(plan, f, f"no telemetry for {age:.1f} s")
        elif age > safety.hold_s and f.sent is not None:
            _hold(plan, f, level=age > safety.level_s)
        elif f.late_us and now_us - f.late_us > 500_000:
            _release(plan, f, "this companion is too late")
        _bounds(plan, f, p)


def _bounds(plan: Plan, f: Flight, p: Vec3) -> None:
    safety = plan.settings.safety
    if f.life.state != ENGAGED or f.life.ended:
        return
    why = ""
    if math.hypot(p[0] - f.origin_m[0], p[1] - f.origin_m[1]) > safety.fence_m:
        why = f"fence of {safety.fence_m:g} m crossed"
    elif f.origin_m[2] - p[2] > safety.ceiling_m:
        why = f"ceiling of {safety.ceiling_m:g} m crossed"
    elif 0.0 <= f.battery_percent < safety.battery_percent:
        why = f"battery at {f.battery_percent:.0f} %"
    if why:
        _send(plan, f, "STATUSTEXT", lifecycle.text(f"mavquad: {why}, landing", 4)[1])
        f.life = f.life._replace(ended=True)


def _release(plan: Plan, f: Flight, why: str) -> None:
    f.life, sends = lifecycle.release(f.life, f.arrival_us, why)
    _send_all(plan, f, sends)


def _hold(plan: Plan, f: Flight, level: bool) -> None:
    """Telemetry is stale: the last setpoint again, or level at hover thrust."""
    assert f.sent is not None
    wanted = f.sent._replace(omega_rad_s=ZERO3, type_mask=7)
    if level:
        yaw = f.anchor_yaw_rad
        wanted = Setpoint((math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)), ZERO3, f.hover_thrust, 7)
    _count(f, "held level" if level else "held")
    _put(plan, f, wanted, 1e-6 * _TICK_US)


# ---- messages -----------------------------------------------------------------------------------------------------------
def _heartbeat(plan: Plan, f: Flight, frame: Frame, m: Any) -> None:
    known = f.life.target != (0, 0)
    f.life, sends = lifecycle.on_heartbeat(f.life, (frame.system, frame.component), m, f.arrival_us, plan.settings)
    _send_all(plan, f, sends)
    if not f.life.armed and known and f.position is not None and (frame.system, frame.component) == f.life.target:
        f.origin_m = f.position.p_ned_m


def _command_ack(plan: Plan, f: Flight, frame: Frame, m: Any) -> None:
    if (frame.system, frame.component) == f.life.target:
        f.life, sends = lifecycle.on_ack(f.life, m, f.arrival_us, plan.settings)
        _send_all(plan, f, sends)


def _command_long(plan: Plan, f: Flight, frame: Frame, m: Any) -> None:
    own = plan.settings.link
    if m.target_component != own.component or m.target_system not in (0, own.system):
        return
    f.life, sends, result = lifecycle.on_request(f.life, m.command, f.arrival_us)
    _send(plan, f, "COMMAND_ACK", (m.command, result, 0, 0, frame.system, frame.component))
    _send_all(plan, f, sends)


def _timesync(plan: Plan, f: Flight, frame: Frame, m: Any) -> None:
    if m.tc1 == 0:
        _send(plan, f, "TIMESYNC", (publish.nanoseconds(f.arrival_us), m.ts1, frame.system, frame.component))
    elif (frame.system, frame.component) == f.life.target:
        round_trip_s = 1e-9 * (publish.nanoseconds(f.arrival_us) - m.ts1)
        if 0.0 <= round_trip_s < 2.0:
            f.delay_s += (round_trip_s - f.delay_s) * (0.1 if f.delay_s else 1.0)


def _param_value(plan: Plan, f: Flight, frame: Frame, m: Any) -> None:
    if (frame.system, frame.component) != f.life.target:
        return
    value = m.param_value
    if f.life.autopilot != lifecycle.ARDUPILOT and m.param_type <= 6:
        value = float(decode.int_of_float(value, m.param_type))
    f.life = lifecycle.on_param(f.life, m.param_id, value, f.arrival_us)
    if m.param_id in ("MPC_THR_HOVER", "MOT_THST_HOVER") and 0.05 < value < 0.95:
        f.hover_thrust = value


def _param_request_list(plan: Plan, f: Flight, frame: Frame, m: Any) -> None:
    if not _for_us(plan, m):
        return
    for i in range(len(tunables.tunables(plan))):
        _send_param(plan, f, i)


def _param_request_read(plan: Plan, f: Flight, frame: Frame, m: Any) -> None:
    if not _for_us(plan, m):
        return
    names = [t.name for t in tunables.tunables(plan)]
    if m.param_index >= 0:
        if m.param_index < len(names):
            _send_param(plan, f, m.param_index)
    elif m.param_id in names:
        _send_param(plan, f, names.index(m.param_id))


def _param_set(plan: Plan, f: Flight, frame: Frame, m: Any) -> None:
    if not _for_us(plan, m):
        return
    names = [t.name for t in tunables.tunables(plan)]
    if m.param_id not in names:
        return
    try:
        f.tuned = plan = tunables.change(plan, m.param_id, m.param_value)
        words = f"mavquad: {m.param_id} = {m.param_value:g}"
    except ConfigError:
        words = f"mavquad: {m.param_id} = {m.param_value:g} refused"
    _send(plan, f, "STATUSTEXT", lifecycle.text(words)[1])
    _send_param(plan, f, names.index(m.param_id))


def _send_param(plan: Plan, f: Flight, index: int) -> None:
    known = tunables.tunables(plan)
    _send(plan, f, "PARAM_VALUE", (known[index].name, known[index].value, 9, len(known), index))


def _for_us(plan: Plan, m: Any) -> bool:
    own = plan.settings.link
    return m.target_system in (0, own.system) and m.target_component in (0, own.component)


def _home(plan: Plan, f: Flight, frame: Frame, m: Any) -> None:
    if (frame.system, frame.component) == f.life.target:
        f.life = f.life._replace(home_alt_m=1e-3 * m.altitude)


def _extended_state(plan: Plan, f: Flight, frame: Frame, m: Any) -> None:
    if (frame.system, frame.component) == f.life.target:
        f.life = f.life._replace(landed=m.landed_state)


def _sys_status(plan: Plan, f: Flight, frame: Frame, m: Any) -> None:
    if (frame.system, frame.component) == f.life.target:
        f.battery_percent = float(m.battery_remaining)


_BY_NAME: dict[str, Callable[[Plan, Flight, Frame, Any], None]] = {
    "HEARTBEAT": _heartbeat,
    "COMMAND_ACK": _command_ack,
    "COMMAND_LONG": _command_long,
    "TIMESYNC": _timesync,
    "PARAM_VALUE": _param_value,
    "PARAM_REQUEST_LIST": _param_request_list,
    "PARAM_REQUEST_READ": _param_request_read,
    "PARAM_SET": _param_set,
    "HOME_POSITION": _home,
    "EXTENDED_SYS_STATE": _extended_state,
    "SYS_STATUS": _sys_status,
}
_HANDLERS = {wire.ID[name]: handler for name, handler in _BY_NAME.items()}


# ---- samples --------------------------------------------------------------------------------------------------------------
def _sample(plan: Plan, f: Flight, name: str, m: Any) -> None:
    try:
        sample: Any = decode.DECODERS[name](m)
    except LinkError:
        _count(f, f"{name} refused")
        return
    if name == "SERVO_OUTPUT_RAW":
        sample = sample._replace(t_us=decode.unwrap_us(sample.t_us, f.now_us))
    t_us = sample.t_us
    f.behind = f.behind + 1 if t_us < f.now_us - _BEHIND_US else 0
    if t_us < f.now_us - _LATE_US or f.behind > _BEHIND_MANY:
        _restarted(plan, f)
    elif t_us <= f.stamps.get(name, -1):
        _count(f, f"{name} late or twice")
        return
    f.stamps = stamps = dict(f.stamps)
    stamps[name], stamps[f"{name} arrived"] = t_us, f.arrival_us
    if t_us > f.now_us:
        f.now_us = t_us
        stamps["arrival of newest"] = f.arrival_us
    if name == "ATTITUDE" and f.arrival_us - stamps.get("ATTITUDE_QUATERNION arrived", -(1 << 62)) < 500_000:
        return  # the quaternion says the same, more often and without angles
    if isinstance(sample, Position):
        sample = _continuous(plan, f, sample)
    elif isinstance(sample, Target):
        f.echo = sample
        _learn_hover(f, sample)
        _recognise(f, sample)
    f.estimator = plan.estimator.module.observe(plan.estimator.gains, f.estimator, sample)
    if plan.compensator is not None:
        f.compensator = plan.compensator.module.observe(plan.compensator.gains, f.compensator, sample)
    if plan.observers:
        f.observers = tuple(
            s.module.observe(s.gains, state, sample) for s, state in zip(plan.observers, f.observers, strict=True)
        )
    if isinstance(sample, Attitude):
        _pace(f)
        _punctual(plan, f, t_us)
        gap_us = t_us - f.control_us
        if not f.control_us or gap_us >= plan.control_us - f.control_gap_us // 2:
            _control(plan, f, t_us, min(0.2, 1e-6 * gap_us) if f.control_us else 1e-6 * plan.control_us)


def _pace(f: Flight) -> None:
    """The period of the stream that paces the control."""
    gap = f.now_us - f.stamps.get("pace", f.now_us)
    f.stamps["pace"] = f.now_us
    if 0 < gap < 200_000:
        f.control_gap_us = gap if not f.control_gap_us else min(gap, f.control_gap_us)


def _punctual(plan: Plan, f: Flight, t_us: int) -> None:
    """Our own lateness: arrival against stamp, beside the best seen (which may creep up, clocks drift)."""
    offset = f.arrival_us - t_us
    f.lateness_us = min(offset, f.lateness_us + 20)
    if offset - f.lateness_us > round(1e6 * plan.settings.safety.late_s):
        f.late_us = f.late_us or f.arrival_us
    else:
        f.late_us = 0


def _restarted(plan: Plan, f: Flight) -> None:
    """The autopilot's clock went back by more than a late message could: it has restarted."""
    forget(plan, f)
    f.epoch += 1
    _count(f, "autopilot restarts")
    if f.life.state in (STREAMING, ENGAGED):
        _release(plan, f, "autopilot restarted")
    life = lifecycle.init(plan.settings)
    f.life = life._replace(rates=tuple(r._replace(granted_hz=math.nan) for r in f.life.rates), said="")
    _send(plan, f, "STATUSTEXT", lifecycle.text("mavquad: autopilot restarted, beginning again", 4)[1])


def _continuous(plan: Plan, f: Flight, sample: Position) -> Position:
    """The position without the autopilot's own resets: a jump that velocity cannot explain moves our frame, not the vehicle."""
    p = (sample.p_ned_m[0] - f.offset_m[0], sample.p_ned_m[1] - f.offset_m[1], sample.p_ned_m[2] - f.offset_m[2])
    last = f.position
    if last is not None:
        dt_s = 1e-6 * (sample.t_us - last.t_us)
        jump = [p[i] - last.p_ned_m[i] - 0.5 * dt_s * (sample.v_ned_m_s[i] + last.v_ned_m_s[i]) for i in range(3)]
        if max(abs(x) for x in jump) > plan.settings.safety.reset_m + 2.0 * dt_s and f.life.state in (STREAMING, ENGAGED):
            f.offset_m = (f.offset_m[0] + jump[0], f.offset_m[1] + jump[1], f.offset_m[2] + jump[2])
            p = (p[0] - jump[0], p[1] - jump[1], p[2] - jump[2])
            _count(f, "position resets")
            _send(plan, f, "STATUSTEXT", lifecycle.text(f"mavquad: position reset of {math.hypot(*jump):.2f} m", 4)[1])
    f.position = sample._replace(p_ned_m=p)
    return f.position


def _learn_hover(f: Flight, target: Target) -> None:
    """In the hover before setpoints flow, the thrust the autopilot holds is what carries this vehicle."""
    if f.life.steady_us and f.life.state == OBSERVING and 0.05 < target.thrust < 0.95:
        q = target.q_wxyz
        upright = 1.0 - 2.0 * (q[1] * q[1] + q[2] * q[2])
        f.hover_thrust += 0.05 * (target.thrust * upright - f.hover_thrust)


def _recognise(f: Flight, target: Target) -> None:
    """The echo of a setpoint of ours tells how long it took to get there; an autopilot that shapes its targets never echoes one."""
    _, x, y, _ = target.q_wxyz
    for t_us, sent_x, sent_y in f.setpoints:
        if abs(x - sent_x) < 1e-6 and abs(y - sent_y) < 1e-6 and abs(x) + abs(y) > 1e-4:
            delay_s = 1e-6 * (target.t_us - t_us)
            if 0.0 <= delay_s < 1.0:
                f.delay_echo_s = delay_s if math.isnan(f.delay_echo_s) else f.delay_echo_s + 0.05 * (delay_s - f.delay_echo_s)
            return


# ---- control ----------------------------------------------------------------------------------------------------------------
def anchor(plan: Plan, f: Flight) -> None:
    """Where the path begins, and a first setpoint that changes nothing."""
    e = f.estimate
    p = f.position.p_ned_m if f.position else ZERO3
    q = e.q_wxyz if e else (1.0, 0.0, 0.0, 0.0)
    yaw = math.atan2(2.0 * (q[0] * q[3] + q[1] * q[2]), 1.0 - 2.0 * (q[2] * q[2] + q[3] * q[3]))
    f.anchor, f.anchor_p_m, f.anchor_yaw_rad, f.path_t0_us = max(1, f.now_us), p, yaw, 1 << 62
    thrust = f.echo.thrust if f.echo is not None and f.echo.thrust > 0.05 else f.hover_thrust
    f.sent = Setpoint(q, ZERO3, thrust, 7)
    f.controller = plan.controller.module.init(plan.controller.gains)


def demand_at(plan: Plan, f: Flight, t_us: int) -> Demand:
    """Where the path wants the vehicle at a vehicle time."""
    return paths.demand(plan.path, f.path_t0_us, f.anchor_p_m, f.anchor_yaw_rad, t_us)


def _control(plan: Plan, f: Flight, t_us: int, dt_s: float) -> None:
    """estimate -> control -> compensate -> setpoint, once."""
    f.control_us = t_us
    sent = f.sent or Setpoint((1.0, 0.0, 0.0, 0.0), ZERO3, f.hover_thrust, 7)
    q_sent = sent.q_wxyz
    applied = Applied(t_us, q_sent, f.applied_thrust_m_s2, sent.omega_rad_s if sent.type_mask != 7 else NAN3, f.delay_s)
    f.estimator, estimate = plan.estimator.module.step(plan.estimator.gains, f.estimator, applied, t_us)
    f.estimate = estimate
    active = f.life.state in (STREAMING, ENGAGED) and f.anchor > 0
    demand = demand_at(plan, f, t_us) if active else Demand(t_us, NAN3, ZERO3, ZERO3, ZERO3, 0.0, 0.0)
    nominal = command = Command(NAN3, 0.0, 0.0, NAN3, ZERO3)
    if active:
        before = f.controller
        f.controller, nominal = plan.controller.module.step(
            plan.controller.gains, f.controller, estimate, demand, lambda t: demand_at(plan, f, t), dt_s
        )
        command = nominal
        if hasattr(plan.controller.module, "messages"):  # a controller with something to say beside its setpoint
            _send_all(plan, f, plan.controller.module.messages(before, f.controller, t_us))
    if plan.compensator is not None:
        f.compensator, corrected = plan.compensator.module.step(
            plan.compensator.gains, f.compensator, estimate, nominal, applied, t_us
        )
        if active:
            command = corrected
    bits = 0
    if active and plan.settings.controller == "autopilot":
        _position_setpoint(plan, f, demand)
    elif active:
        bits = _put(plan, f, _setpoint(plan, f, command), dt_s)
        _say_which_loop(plan, f, command)
        if t_us >= f.path_t0_us + round(1e6 * plan.path.duration_s) + 1_000_000 and f.life.state == ENGAGED:
            f.life = f.life._replace(ended=True)
    if (
        active
        and plan.settings.controller == "autopilot"
        and t_us >= f.path_t0_us + round(1e6 * plan.path.duration_s) + 1_000_000
    ):
        f.life = f.life._replace(ended=True)
    f.trace.append(publish.trace_row(plan, f, t_us, estimate, demand, nominal, command, bits))


def _setpoint(plan: Plan, f: Flight, command: Command) -> Setpoint:
    """Attitude and collective from the wanted acceleration."""
    gains = plan.limits
    thrust = attitude.thrust_vector(command.a_ned_m_s2, gains.tilt_rad, 0.2 * G_M_S2, 1.8 * G_M_S2)
    q, size = attitude.attitude(thrust, command.yaw_rad)
    # ArduCopter multiplies by 1/cos(tilt) itself: it gets the vertical part only
    specific = thrust[2] if f.life.autopilot == lifecycle.ARDUPILOT else size
    omega, mask = ZERO3, 7
    if math.isfinite(command.omega_rad_s[0]):
        omega = command.omega_rad_s
        mask = 128 if plan.settings.loop == "rates" else 0
        if mask == 0 and f.life.autopilot == lifecycle.ARDUPILOT:
            omega = _unrotate(q, omega)
    return Setpoint(q, omega, f.hover_thrust * specific / G_M_S2, mask)


def _say_which_loop(plan: Plan, f: Flight, command: Command) -> None:
    """With body rates asked for: whose attitude loop flies, whenever that changes. A late link leaves it to the autopilot."""
    if plan.settings.loop != "rates":
        return
    ours = math.isfinite(command.omega_rad_s[0])
    if ours != f.own_attitude_loop:
        f.own_attitude_loop = ours
        words = "attitude loop closed here" if ours else f"delay {1e3 * f.delay_s:.0f} ms: autopilot's attitude loop"
        _send(plan, f, "STATUSTEXT", lifecycle.text(f"mavquad: {words}", 6 if ours else 4)[1])


def _unrotate(q: tuple[float, float, float, float], w: Vec3) -> Vec3:
    """ArduCopter rotates the rates given with an attitude by that attitude's heading: turn them back before."""
    yaw = math.atan2(2.0 * (q[0] * q[3] + q[1] * q[2]), 1.0 - 2.0 * (q[2] * q[2] + q[3] * q[3]))
    c, s = math.cos(yaw), math.sin(yaw)
    return (c * w[0] + s * w[1], -s * w[0] + c * w[1], w[2])


def _put(plan: Plan, f: Flight, wanted: Setpoint, dt_s: float) -> int:
    """Through the gate and on the wire."""
    last = f.sent or wanted
    setpoint, bits = limits.apply(plan.limits, last, wanted, dt_s)
    f.interventions += bits != 0
    f.sent, f.sent_us = setpoint, f.now_us
    f.applied_thrust_m_s2 = G_M_S2 * setpoint.thrust / f.hover_thrust
    if f.life.autopilot == lifecycle.ARDUPILOT:
        q = setpoint.q_wxyz
        f.applied_thrust_m_s2 /= max(0.3, 1.0 - 2.0 * (q[1] * q[1] + q[2] * q[2]))
    stamp_ms = (vehicle_now_us(f) // 1000) & 0xFFFFFFFF
    f.setpoints = (*f.setpoints[-24:], (vehicle_now_us(f), setpoint.q_wxyz[1], setpoint.q_wxyz[2]))
    _send(plan, f, "SET_ATTITUDE_TARGET", decode.attitude_setpoint(stamp_ms, *f.life.target, setpoint))
    return bits


def _position_setpoint(plan: Plan, f: Flight, demand: Demand) -> None:
    """The autopilot's own loop gets the path: position, velocity, acceleration, heading."""
    stamp_ms = (vehicle_now_us(f) // 1000) & 0xFFFFFFFF
    p = [demand.p_ned_m[i] + f.offset_m[i] for i in range(3)]
    f.sent, f.sent_us = f.sent or Setpoint((1.0, 0.0, 0.0, 0.0), ZERO3, f.hover_thrust, 7), f.now_us
    fields = (stamp_ms, *f.life.target, 1, 1 << 11, *p, *demand.v_ned_m_s, *demand.a_ned_m_s2, demand.yaw_rad, 0.0)
    _send(plan, f, "SET_POSITION_TARGET_LOCAL_NED", fields)
