"""What the companion does with each message that is no sample: one handler per message, one table. Pure."""

import math
from collections.abc import Callable
from typing import Any

from mavquad import lifecycle, outbox, publish, strangers, tunables, wire
from mavquad.errors import ConfigError
from mavquad.flight import Flight
from mavquad.link import signals as decode
from mavquad.plan import Plan
from mavquad.wire import Frame

_DOES_NOT_EXIST = 1  # MAV_PARAM_ERROR

SAME_CLOCK_US = 2_000_000  # between an answer and the newest sample, where both are by one clock


def _heartbeat(plan: Plan, f: Flight, frame: Frame, m: Any) -> None:
    known = f.life.target != (0, 0)
    f.life, sends = lifecycle.on_heartbeat(f.life, (frame.system, frame.component), m, f.arrival_us, plan.settings)
    outbox.send_all(plan, f, sends)
    if not f.life.armed and known and f.position is not None and (frame.system, frame.component) == f.life.target:
        f.origin_m = f.position.p_ned_m


def _command_ack(plan: Plan, f: Flight, frame: Frame, m: Any) -> None:
    if (frame.system, frame.component) == f.life.target:
        f.life, sends = lifecycle.on_ack(f.life, m, f.arrival_us, plan.settings)
        outbox.send_all(plan, f, sends)


def _command(plan: Plan, f: Flight, frame: Frame, m: Any) -> None:
    own = plan.settings.link
    if m.target_component != own.component or m.target_system not in (0, own.system):
        return
    f.life, sends, result = lifecycle.on_request(f.life, m.command, f.arrival_us)
    outbox.send(plan, f, "COMMAND_ACK", (m.command, result, 0, 0, frame.system, frame.component))
    outbox.send_all(plan, f, sends)


def _statustext(plan: Plan, f: Flight, frame: Frame, m: Any) -> None:
    if (frame.system, frame.component) == f.life.target:
        f.life, sends = lifecycle.on_text(f.life, m, f.arrival_us)
        outbox.send_all(plan, f, sends)
    elif strangers.is_notice(frame) and f.life.target != (0, 0):
        outbox.say(plan, f, m.text, 4)


def _timesync(plan: Plan, f: Flight, frame: Frame, m: Any) -> None:
    if m.tc1 == 0:
        outbox.send(plan, f, "TIMESYNC", (publish.nanoseconds(f.arrival_us), m.ts1, frame.system, frame.component))
    elif (frame.system, frame.component) == f.life.target:
        round_trip_s = 1e-9 * (publish.nanoseconds(f.arrival_us) - m.ts1)
        if 0.0 <= round_trip_s < 2.0 and f.slow < 2:  # a late companion measures itself
            f.delay_s += (round_trip_s - f.delay_s) * (0.1 if f.delay_s else 1.0)
        if 0.0 <= round_trip_s < 2.0:
            _set_apart(f, publish.arrival_us(m.ts1), m.tc1 // 1000)


def _set_apart(f: Flight, asked_us: int, answered_us: int) -> None:
    """The autopilot's clock showed answered_us after we asked: no sample is stamped earlier against ours than that.

    A simulated vehicle's clock that stood still, or runs slower than ours, would else pass for our own lateness.
    """
    if abs(answered_us - f.now_us) < SAME_CLOCK_US:
        f.lateness_us = max(f.lateness_us, asked_us - answered_us)


def _param_value(plan: Plan, f: Flight, frame: Frame, m: Any) -> None:
    if (frame.system, frame.component) != f.life.target:
        return
    value = m.param_value
    if f.life.autopilot != lifecycle.ARDUPILOT and m.param_type <= 6:
        value = float(decode.int_of_float(value, m.param_type))
    if not math.isfinite(value):
        outbox.count(f, "PARAM_VALUE refused")
        return
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
        else:
            _no_param(plan, f, frame, m)
    elif m.param_id in names:
        _send_param(plan, f, names.index(m.param_id))
    else:
        _no_param(plan, f, frame, m)


def _param_set(plan: Plan, f: Flight, frame: Frame, m: Any) -> None:
    if not _for_us(plan, m):
        return
    names = [t.name for t in tunables.tunables(plan)]
    if m.param_id not in names:
        _no_param(plan, f, frame, m)
        return
    try:
        f.tuned = plan = tunables.change(plan, m.param_id, m.param_value)
        words = f"mavquad: {m.param_id} = {m.param_value:g}"
    except ConfigError:
        words = f"mavquad: {m.param_id} = {m.param_value:g} refused"
    outbox.send(plan, f, "STATUSTEXT", lifecycle.text(words)[1])
    _send_param(plan, f, names.index(m.param_id))


def _send_param(plan: Plan, f: Flight, index: int) -> None:
    known = tunables.tunables(plan)
    outbox.send(plan, f, "PARAM_VALUE", (known[index].name, known[index].value, 9, len(known), index))


def _no_param(plan: Plan, f: Flight, frame: Frame, m: Any) -> None:
    """Said by who was asked by name; to a question for everybody, others have the answer."""
    if m.target_component == plan.settings.link.component:
        fields = (frame.system, frame.component, m.param_id, getattr(m, "param_index", -1), _DOES_NOT_EXIST)
        outbox.send(plan, f, "PARAM_ERROR", fields)


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
    "COMMAND_LONG": _command,
    "COMMAND_INT": _command,
    "STATUSTEXT": _statustext,
    "TIMESYNC": _timesync,
    "PARAM_VALUE": _param_value,
    "PARAM_REQUEST_LIST": _param_request_list,
    "PARAM_REQUEST_READ": _param_request_read,
    "PARAM_SET": _param_set,
    "HOME_POSITION": _home,
    "EXTENDED_SYS_STATE": _extended_state,
    "SYS_STATUS": _sys_status,
}
HANDLERS = {wire.ID[name]: handler for name, handler in _BY_NAME.items()}
