"""One control step: estimate -> control -> compensate -> setpoint, and the gate before the wire. Pure."""

import math

from mavquad import following, lifecycle, outbox, paths, publish
from mavquad.flight import Flight, vehicle_now_us
from mavquad.lifecycle import ENGAGED, STREAMING
from mavquad.link import signals as decode
from mavquad.plan import Plan
from mavquad.setpoint import attitude, limits
from mavquad.signals import NAN3, NO_STICKS, ZERO3, Applied, Command, Demand, Quat, Setpoint, Sticks, Vec3

G_M_S2 = attitude.G_M_S2
_OVER_US = 1_000_000  # after the end of the path, before landing


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


def step(plan: Plan, f: Flight, t_us: int, dt_s: float) -> None:
    """estimate -> control -> compensate -> setpoint, once."""
    f.control_us = t_us
    sent = f.sent or Setpoint((1.0, 0.0, 0.0, 0.0), ZERO3, f.hover_thrust, 7)
    q_sent = sent.q_wxyz
    rates = sent.omega_rad_s if sent.type_mask != 7 else NAN3
    applied = Applied(t_us, q_sent, f.applied_thrust_m_s2, rates, f.delay_s, f.age_s, sent.thrust if f.sent else math.nan)
    f.estimator, estimate = plan.estimator.module.step(plan.estimator.gains, f.estimator, applied, t_us)
    f.estimate = estimate
    flying = f.life.state in (STREAMING, ENGAGED) and f.anchor > 0
    active = flying and not f.catching_up
    if f.catching_up:
        f.skipped_s += dt_s
    else:
        dt_s, f.skipped_s, f.put_us = min(0.2, dt_s + f.skipped_s), 0.0, f.arrival_us
    demand = demand_at(plan, f, t_us) if flying else Demand(t_us, NAN3, ZERO3, ZERO3, ZERO3, 0.0, 0.0)
    nominal = command = Command(NAN3, 0.0, 0.0, NAN3, ZERO3)
    if active:
        before = f.controller
        gains = plan.slowed[f.slow - 1] if f.slow else plan.controller.gains
        f.controller, nominal = plan.controller.module.step(
            gains, f.controller, estimate, demand, lambda t: demand_at(plan, f, t), dt_s
        )
        command = nominal
        if "messages" in vars(plan.controller.module):  # a controller with something to say beside its setpoint
            said = plan.controller.module.messages(plan.controller.gains, before, f.controller, t_us, f.life.target)
            outbox.send_all(plan, f, said)
    if plan.compensator is not None:
        f.compensator, corrected = plan.compensator.module.step(
            plan.compensator.gains, f.compensator, estimate, nominal, applied, t_us, lambda t: demand_at(plan, f, t)
        )
        if active:
            command = corrected
            if "track" in vars(plan.controller.module):  # its integral must not wind up behind what cancels in its place
                f.controller = plan.controller.module.track(gains, f.controller, estimate, command.f_cancelled_m_s2)
    bits = 0
    if active:
        if plan.settings.controller == "autopilot":
            _position_setpoint(plan, f, demand)
        else:
            bits = _put(plan, f, _setpoint(plan, f, command), dt_s, command.sticks)
            _say_which_loop(plan, f, command)
            _watch(plan, f, t_us, estimate.q_wxyz)
        if f.life.state == ENGAGED and t_us >= f.path_t0_us + round(1e6 * plan.path.duration_s) + _OVER_US:
            f.life = f.life._replace(ended=True)
    f.trace.append(publish.trace_row(plan, f, t_us, estimate, demand, nominal, command, bits))


def _setpoint(plan: Plan, f: Flight, command: Command) -> Setpoint:
    """Attitude and collective from the wanted acceleration."""
    gains = plan.limits
    q, size, upward = attitude.pointing(command.a_ned_m_s2, command.yaw_rad, gains.tilt_rad)
    # ArduCopter multiplies by 1/cos(tilt) itself: it gets the vertical part only
    specific = upward if f.life.autopilot == lifecycle.ARDUPILOT else size
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
        outbox.say(plan, f, words, 6 if ours else 4)


def _watch(plan: Plan, f: Flight, t_us: int, q_wxyz: Quat) -> None:
    """Say within a second when an autopilot in our mode does not fly what is sent, and when it does again."""
    if f.life.state != ENGAGED or f.sent is None or f.sticks is not None:
        f.following = following.START
        return
    follows = f.following.follows
    f.following = following.step(plan.airframe.attitude, f.following, t_us, f.sent.q_wxyz, q_wxyz, f.delay_s)
    if f.following.follows != follows:
        outbox.say(plan, f, "setpoints are not followed" if follows else "setpoints are followed again", 4 if follows else 6)
        if follows:
            outbox.count(f, "not followed")


def _unrotate(q: tuple[float, float, float, float], w: Vec3) -> Vec3:
    """ArduCopter rotates the rates given with an attitude by that attitude's heading: turn them back before."""
    yaw = math.atan2(2.0 * (q[0] * q[3] + q[1] * q[2]), 1.0 - 2.0 * (q[2] * q[2] + q[3] * q[3]))
    c, s = math.cos(yaw), math.sin(yaw)
    return (c * w[0] + s * w[1], -s * w[0] + c * w[1], w[2])


def _put(plan: Plan, f: Flight, wanted: Setpoint, dt_s: float, sticks: Sticks = NO_STICKS) -> int:
    """Through the gate and on the wire. Sticks, where there are some, go in place of the attitude, which is kept for the way back."""
    last = f.sent or wanted
    setpoint, bits = limits.apply(plan.limits, last, wanted, dt_s)
    f.interventions += bits != 0
    f.sent = setpoint
    f.applied_thrust_m_s2 = G_M_S2 * setpoint.thrust / f.hover_thrust
    if f.life.autopilot == lifecycle.ARDUPILOT:
        q = setpoint.q_wxyz
        f.applied_thrust_m_s2 /= max(0.3, 1.0 - 2.0 * (q[1] * q[1] + q[2] * q[2]))
    if math.isfinite(sticks[0]):
        f.sticks, stick_bits = limits.sticks(f.sticks, sticks, dt_s)
        outbox.send(plan, f, "SET_ACTUATOR_CONTROL_TARGET", decode.stick_setpoint(vehicle_now_us(f), *f.life.target, f.sticks))
        return stick_bits
    f.sticks = None
    stamp_ms = (vehicle_now_us(f) // 1000) & 0xFFFFFFFF
    f.setpoints = (*f.setpoints[-24:], (vehicle_now_us(f), setpoint.q_wxyz[1], setpoint.q_wxyz[2]))
    outbox.send(plan, f, "SET_ATTITUDE_TARGET", decode.attitude_setpoint(stamp_ms, *f.life.target, setpoint))
    return bits


def _position_setpoint(plan: Plan, f: Flight, demand: Demand) -> None:
    """The autopilot's own loop gets the path: position, velocity, acceleration, heading."""
    stamp_ms = (vehicle_now_us(f) // 1000) & 0xFFFFFFFF
    p = [demand.p_ned_m[i] + f.offset_m[i] for i in range(3)]
    f.sent = f.sent or Setpoint((1.0, 0.0, 0.0, 0.0), ZERO3, f.hover_thrust, 7)
    fields = (stamp_ms, *f.life.target, 1, 1 << 11, *p, *demand.v_ned_m_s, *demand.a_ned_m_s2, demand.yaw_rad, 0.0)
    outbox.send(plan, f, "SET_POSITION_TARGET_LOCAL_NED", fields)


def hold(plan: Plan, f: Flight, dt_s: float, level: bool) -> None:
    """Telemetry is stale: the last setpoint again, or level at hover thrust."""
    assert f.sent is not None
    wanted = f.sent._replace(omega_rad_s=ZERO3, type_mask=7)
    if level:
        yaw = f.anchor_yaw_rad
        wanted = Setpoint((math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)), ZERO3, f.hover_thrust, 7)
    outbox.count(f, "held level" if level else "held")
    _put(plan, f, wanted, dt_s)
