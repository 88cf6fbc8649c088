"""One event, pure: `feed(plan, flight, arrival_us, frame) -> (flight, outbox)` and `advance(plan, flight, until_us)` for time.

Everything the companion sends is an output of these two: setpoints, commands, answers, heartbeats, published estimates. A
received frame enters with the very stamp under which it is logged; timers fire at their logical due time, before any arrival
stamped at or after it. So a replay of the received frames gives every sent frame and every trace value again, bit for bit.
"""

import math
import zlib
from collections.abc import Iterable

from mavquad import control_step, delayed, lifecycle, messages, outbox, publish, samples, strangers, wire
from mavquad.flight import Flight, start
from mavquad.lifecycle import ENGAGED, STREAMING
from mavquad.plan import Plan, build
from mavquad.signals import ZERO3, Vec3
from mavquad.wire import Frame

__all__ = ["Flight", "Plan", "accepts", "advance", "build", "feed", "feed_all", "start"]

_TICK_US = 100_000  # life cycle and watchdog
_HEARTBEAT_US = 1_000_000


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
    return feed_all(plan, flight, arrival_us, (frame,))


def feed_all(plan: Plan, flight: Flight, arrival_us: int, frames: Iterable[Frame]) -> Flight:
    """Frames that arrived together, in their order: the same as `feed` for each, with one copy of the state for all."""
    f = flight.clone()
    for frame in frames:
        _take(f.tuned or plan, f, arrival_us, frame)
    return f


def _take(plan: Plan, f: Flight, arrival_us: int, frame: Frame) -> None:
    msgid = frame.msgid
    handler = messages.HANDLERS.get(msgid)
    name = plan.samples.get(msgid)
    f.heard_crc = zlib.crc32(frame.raw, f.heard_crc)
    concerns = handler is not None or name is not None or msgid not in wire.ID_SET
    if concerns and not f.heartbeat_us:  # the first event starts the clockwork
        f.heartbeat_us = f.tick_us = f.timesync_us = f.publish_us = f.due_us = arrival_us
    if f.due_us <= arrival_us:
        _pass_time(plan, f, arrival_us)
    elif arrival_us > f.arrival_us:
        f.arrival_us = arrival_us
    if not concerns:
        return
    life = f.life
    if handler is not None:
        handler(plan, f, frame, wire.decode(frame))
    elif name is None:
        outbox.count(f, "unknown message")
    elif (frame.system, frame.component) == life.target:
        samples.take(plan, f, name, frame)
    if f.life is not life:
        f.due_us = _next_due_us(f)


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
        return strangers.OURSELVES
    if frame.msgid == _SETUP_SIGNING:
        return "a key sent over the link"
    target = flight.life.target
    if target == (0, 0) or (frame.system, frame.component) == target:
        return ""
    if frame.msgid in _FOR_ANYBODY:
        return ""
    return "not from our autopilot"


_SETUP_SIGNING = wire.ID["SETUP_SIGNING"]
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


# ---- time ---------------------------------------------------------------------------------------------------------------
def _next_due_us(f: Flight) -> int:
    due = min(f.heartbeat_us, f.tick_us, f.timesync_us, f.publish_us)
    life_due = lifecycle.due_us(f.life)
    return min(due, max(life_due, f.arrival_us)) if life_due else due


def _fire(plan: Plan, f: Flight, now_us: int) -> None:
    if now_us >= f.heartbeat_us:
        f.heartbeat_us = now_us + _HEARTBEAT_US
        outbox.send(plan, f, "HEARTBEAT", (18, lifecycle.INVALID, 0, 0, 4, 3))
    if now_us >= f.timesync_us:
        f.timesync_us = now_us + round(1e6 / plan.settings.link.timesync_hz)
        if f.life.target != (0, 0):
            outbox.send(plan, f, "TIMESYNC", (0, publish.nanoseconds(now_us), *f.life.target))
    if now_us >= f.publish_us:
        f.publish_us = now_us + round(1e6 / plan.settings.link.publish_hz)
        outbox.send_all(plan, f, publish.estimates(plan, f))
    due = lifecycle.due_us(f.life)
    if due and now_us >= due:
        f.life, sends = lifecycle.on_time(f.life, now_us)
        outbox.send_all(plan, f, sends)
    if now_us >= f.tick_us:
        f.tick_us = now_us + _TICK_US
        _tick(plan, f, now_us)


def _age_s(f: Flight, *names: str) -> float:
    newest = max(f.arrivals.get(name, -1) for name in names)
    return math.inf if newest < 0 else 1e-6 * (f.arrival_us - newest)


def _tick(plan: Plan, f: Flight, now_us: int) -> None:
    safety = plan.settings.safety
    attitude_age, position_age = _age_s(f, "ATTITUDE_QUATERNION", "ATTITUDE"), _age_s(f, "LOCAL_POSITION_NED")
    p, v = (f.position.p_ned_m, f.position.v_ned_m_s) if f.position else (ZERO3, ZERO3)
    sight = lifecycle.Sight(attitude_age, position_age, f.origin_m[2] - p[2], math.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2))
    before = f.life
    f.life, sends = lifecycle.on_tick(f.life, sight, now_us, plan.settings)
    outbox.send_all(plan, f, sends)
    if f.life.state == STREAMING and (before.state != STREAMING or not lifecycle.guided(f.life)):
        control_step.anchor(plan, f)  # until our setpoints are flown the start point goes along with the vehicle
    if f.life.state == ENGAGED and before.state != ENGAGED:
        f.path_t0_us = f.now_us + round(1e6 * plan.settings.settle_s)
    if f.life.state in (STREAMING, ENGAGED):
        age = max(attitude_age, position_age)
        if age > safety.release_s:
            outbox.release(plan, f, f"no telemetry for {age:.1f} s")
        elif age > safety.hold_s and f.sent is not None:
            control_step.hold(plan, f, 1e-6 * _TICK_US, level=age > safety.level_s)
        elif f.late_us and now_us - f.late_us > 500_000:
            outbox.release(plan, f, f"this companion is too late, {f.late_s:.2f} s")
        _adapt(plan, f)
        _bounds(plan, f, p)


def _adapt(plan: Plan, f: Flight) -> None:
    """A controller that the link's delay would make oscillate flies slower."""
    now = f.tuned or plan
    adapted = delayed.adapt(now, f.delay_s)
    if adapted is not now:
        f.tuned = adapted
        slow = delayed.slowed(adapted)
        outbox.say(
            plan, f, f"delay of {1e3 * f.delay_s:.0f} ms, {'flying slower' if slow else 'in time again'}", 4 if slow else 6
        )


def _bounds(plan: Plan, f: Flight, p: Vec3) -> None:
    safety = plan.settings.safety
    if f.life.state != ENGAGED or f.life.ended:
        return
    why = ""
    if math.hypot(p[0] - f.origin_m[0], p[1] - f.origin_m[1]) > safety.fence_m:
        why = f"fence of {safety.fence_m:g} m crossed"
    elif f.origin_m[2] - p[2] > safety.ceiling_m:
        why = f"ceiling of {safety.ceiling_m:g} m crossed"
    elif f.delay_s > safety.delay_s:
        why = f"delay of {1e3 * f.delay_s:.0f} ms cannot be flown"
    elif 0.0 <= f.battery_percent < safety.battery_percent:
        why = f"battery at {f.battery_percent:.0f} %"
    if why:
        outbox.say(plan, f, f"{why}, landing", 4)
        f.life = f.life._replace(ended=True)
