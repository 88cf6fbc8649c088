"""A sample from the autopilot: late, repeated or of a restarted clock, else into every stage; the attitude paces the control. Pure."""

import math
from typing import Any

from mavquad import control_step, lifecycle, outbox, position_age, slowing, wire
from mavquad.errors import LinkError
from mavquad.flight import Flight, forget
from mavquad.lifecycle import ENGAGED, OBSERVING, RELEASED, STREAMING
from mavquad.link import signals as decode
from mavquad.plan import Plan
from mavquad.signals import Attitude, Imu, Position, Target
from mavquad.wire import Frame

_BEHIND_US, _BEHIND_MANY = 500_000, 30  # no link delivers so many in a row so late: a clock restarted soon after it started
_LATE_US = 2_000_000  # a stamp further back than this is a restarted clock, not a late message
_OLD_US = 60_000  # a sample this late, right behind another, comes out of a queue
_USUAL_S = 2.0  # memory of the mean age, that of the round trip
_WITH_ATTITUDE = ("ATTITUDE_QUATERNION", "ATTITUDE")
_SPARED_US = 12_000  # between accelerometer samples that only the age of positions needs
_DOUBLED_US = 500_000  # ATTITUDE is left out while the quaternion was heard so recently


def take(plan: Plan, f: Flight, name: str, frame: Frame) -> None:
    """One message of the autopilot that some stage uses."""
    if name == "ATTITUDE" and f.arrival_us - f.arrivals.get("ATTITUDE_QUATERNION", -_DOUBLED_US) < _DOUBLED_US:
        return  # the quaternion says the same, more often and without angles
    if name == "HIGHRES_IMU" and plan.imu_spared and f.arrival_us - f.arrivals.get(name, -_SPARED_US) < _SPARED_US:
        return
    try:
        sample: Any = decode.DECODERS[name](wire.decode(frame))
    except LinkError:
        outbox.count(f, f"{name} refused")
        return
    observed = name in _WITH_ATTITUDE and math.isnan(sample.omega_rad_s[0])  # it sends an attitude without rates
    if observed and not plan.observers:
        outbox.count(f, f"{name} refused")
        return
    if name == "SERVO_OUTPUT_RAW":
        sample = sample._replace(t_us=decode.unwrap_us(sample.t_us, f.now_us))
    t_us = sample.t_us
    f.behind = f.behind + 1 if t_us < f.now_us - _BEHIND_US else 0
    if t_us < f.now_us - _LATE_US or f.behind > _BEHIND_MANY:
        _restarted(plan, f)
    elif t_us <= f.stamps.get(name, -1):
        outbox.count(f, f"{name} late or twice")
        return
    kind = type(sample)
    if kind is Position:
        told = (sample.p_ned_m, sample.v_ned_m_s)
        if told == f.told and any(sample.v_ned_m_s):  # it moves and never gets anywhere: no news, however fresh its stamp
            outbox.count(f, "position frozen")
            return
        f.told = told
    f.stamps[name], f.arrivals[name] = t_us, f.arrival_us
    if t_us > f.now_us:
        f.now_us, f.newest_arrival_us = t_us, f.arrival_us
    if kind is Position:
        if f.life.state != RELEASED:  # a touch-down would spoil what is known
            f.position_age = position_age.hear(f.position_age, t_us, sample.v_ned_m_s)
        p, v = position_age.carried(f.position_age, sample.p_ned_m, sample.v_ned_m_s)
        sample = _continuous(plan, f, sample._replace(p_ned_m=p, v_ned_m_s=v))
    elif kind is Imu:
        f.position_age = position_age.feel(f.position_age, t_us, sample.accel_m_s2, f.q_wxyz)
        if plan.imu_spared:
            return
    elif kind is Target:
        f.echo = sample
        _learn_hover(f, sample)
        _recognise(f, sample)
    if plan.observers:
        f.observers = tuple(
            [s.module.observe(s.gains, state, sample) for s, state in zip(plan.observers, f.observers, strict=True)]
        )
    if (kind is Attitude or kind is Imu) and (observed or plan.settings.body_rates == "observer"):
        sample = _with_observed_rates(plan, f, sample)
    f.estimator = plan.estimator.module.observe(plan.estimator.gains, f.estimator, sample)
    if plan.compensator is not None:
        f.compensator = plan.compensator.module.observe(plan.compensator.gains, f.compensator, sample)
    if kind is Attitude:
        f.q_wxyz = sample.q_wxyz
        _pace(f)
        _punctual(plan, f, t_us)
        gap_us = t_us - f.control_us
        if not f.control_us or gap_us >= plan.control_us - f.control_gap_us // 2:
            control_step.step(plan, f, t_us, min(0.2, 1e-6 * gap_us) if f.control_us else 1e-6 * plan.control_us)


def _with_observed_rates(plan: Plan, f: Flight, sample: Any) -> Any:
    """The sample with the first observer's rates in place of a gyro's: what every estimator and controller takes them from."""
    if "body rates observed" not in f.counts:
        outbox.say(plan, f, f"body rates by {plan.observers[0].label.partition(':')[0]}", 5)
    outbox.count(f, "body rates observed")
    stage, state = plan.observers[0], f.observers[0]
    _, w = stage.module.predict(stage.gains, state, sample.t_us)
    return sample._replace(omega_rad_s=w) if type(sample) is Attitude else sample._replace(gyro_rad_s=w)


def _pace(f: Flight) -> None:
    """The period of the stream that paces the control."""
    gap = f.now_us - f.pace_us if f.pace_us else 0
    f.pace_us = f.now_us
    if 0 < gap < 200_000:
        f.control_gap_us = gap if not f.control_gap_us else min(gap, f.control_gap_us)


def _punctual(plan: Plan, f: Flight, t_us: int) -> None:
    """Our own lateness: arrival against stamp, beside the best seen (which may creep up, clocks drift)."""
    offset = f.arrival_us - t_us
    best = f.lateness_us + 20
    f.lateness_us = offset if offset < best else best
    late_us = offset - f.lateness_us
    _age(f, offset)
    f.catching_up = late_us > _OLD_US and f.arrival_us - f.put_us < plan.control_us // 2
    f.late_s = slowing.fade(f.late_s, 1e-6 * late_us, 1e-6 * f.control_gap_us)
    slow = slowing.level(f.slow, f.late_s)
    if slow != f.slow:
        f.slow = slow
        if f.life.state in (STREAMING, ENGAGED):
            words = f"{1e3 * f.late_s:.0f} ms late, flying slower" if slow else "in time again"
            outbox.say(plan, f, words, 4 if slow else 6)
    if late_us > round(1e6 * plan.settings.safety.late_s):
        f.late_us = f.late_us or f.arrival_us
    else:
        f.late_us = 0


def _age(f: Flight, offset_us: int) -> None:
    """How much older than usual this sample is: what a link's jitter adds to the mean delay. Lateness beyond that is ours."""
    w = min(1.0, 1e-6 * f.control_gap_us / _USUAL_S)
    f.usual_us = float(offset_us) if math.isnan(f.usual_us) else f.usual_us + w * (offset_us - f.usual_us)
    f.age_s = 1e-6 * min(_OLD_US, max(-_OLD_US, offset_us - f.usual_us))


def _restarted(plan: Plan, f: Flight) -> None:
    """The autopilot's clock went back by more than a late message could: it has restarted."""
    forget(plan, f)
    f.epoch += 1
    outbox.count(f, "autopilot restarts")
    if f.life.state in (STREAMING, ENGAGED):
        outbox.release(plan, f, "autopilot restarted")
    life = lifecycle.init(plan.settings)
    f.life = life._replace(rates=tuple(r._replace(granted_hz=math.nan) for r in f.life.rates), said="")
    outbox.say(plan, f, "autopilot restarted, beginning again", 4)


def _continuous(plan: Plan, f: Flight, sample: Position) -> Position:
    """The position without the autopilot's own resets: a jump that velocity cannot explain moves our frame, not the vehicle."""
    (x, y, z), (v_n, v_e, v_d), offset = sample.p_ned_m, sample.v_ned_m_s, f.offset_m
    p = (x - offset[0], y - offset[1], z - offset[2])
    last = f.position
    if last is not None:
        dt_s = 1e-6 * (sample.t_us - last.t_us)
        (x, y, z), (w_n, w_e, w_d) = last.p_ned_m, last.v_ned_m_s
        half = 0.5 * dt_s
        jump = (p[0] - x - half * (v_n + w_n), p[1] - y - half * (v_e + w_e), p[2] - z - half * (v_d + w_d))
        most = plan.settings.safety.reset_m + 2.0 * dt_s
        jumped = abs(jump[0]) > most or abs(jump[1]) > most or abs(jump[2]) > most
        if jumped and f.life.state in (STREAMING, ENGAGED):
            f.offset_m = (offset[0] + jump[0], offset[1] + jump[1], offset[2] + jump[2])
            p = (p[0] - jump[0], p[1] - jump[1], p[2] - jump[2])
            outbox.count(f, "position resets")
            outbox.say(plan, f, f"position reset of {math.hypot(*jump):.2f} m", 4)
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
