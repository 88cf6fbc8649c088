"""One control tick of the compensator `asmf` as one kernel on one record: what `active_flight` steps and what a fused tick calls."""

import math

import numpy as np

from mavquad import flat, linalg, quat
from mavquad.compensate import active_model
from mavquad.estimate import asmf, command_line, interval, quad_error
from mavquad.jit import kernel

G_M_S2 = 9.80665
GAP_S = 0.5  # a longer silence, or a clock that goes back: begin again
ECHO_S = 0.3  # an echo older than this says nothing
FOLLOWED_RAD = 0.03  # the autopilot acts on our setpoints where its echo is this close to one of them
STALE_S, STALE_TAU_S = 1.0, 2.0  # without velocity: f fades
SETTLE_TICKS = 400  # in which the half-width of a quiet vehicle is reached
WOUND_UP_M_S2 = 1.0  # how far beyond the bounds a controller's own estimate is believed
SHOWN = 20
_LINE = 40  # commands remembered
_NEVER_US = -(1 << 62)
_ZERO3 = (0.0, 0.0, 0.0)
_NAN3 = (math.nan, math.nan, math.nan)

RECORD = flat.record(
    [
        ("t_us", "i8"),  # of the last step
        ("active", "?"),  # a nominal command was there to be corrected
        ("begun", "?"),  # there is a model
        ("authority", "f8"),
        ("left", "f8"),  # authority by the filter's own judgement
        ("velocity_us", "i8"),  # of the newest velocity taken
        ("f_ned_m_s2", "f8", 3),  # as cancelled
        ("given_back_m_s2", "f8", 3),
        # roll, pitch, specific thrust as sent, newest first
        ("line_us", "i8", _LINE),
        ("line", "f8", (_LINE, 3)),
        # quad_error.State
        ("x", "f8", quad_error.N_STATES),
        ("p", "f8", (quad_error.N_STATES, quad_error.N_STATES)),
        ("guarantee", "?"),
        ("clean", "i8"),
        ("empty", "i8"),
        ("inflations", "i8"),
        ("delta", "f8"),
        ("n_bad", "i8", quad_error.N_OUTPUTS),
        ("inflated_us", "i8", asmf.OFF_ABOVE + 1),
        ("interval", "f8", (3, 2)),
        ("interval_n_bad", "i8", 3),
        ("interval_empty", "i8", 3),
        ("thrust_m_s2", "f8"),
        ("attitude_rad", "f8", 3),
        ("slew_m_s3", "f8"),
        # published bounds of f
        ("cuts", "f8", (3, 2)),
        ("consistent", "i8", 3),
        ("shown", "f8", SHOWN),
    ]
)


def start() -> np.ndarray:
    """The bytes of a record: nothing heard, nothing sent, as if gravity had been commanded for ever."""
    out = np.zeros(1, RECORD)
    line = command_line.init(np.array([0.0, 0.0, G_M_S2]), _LINE)
    out["line_us"][0], out["line"][0] = line.t_us, line.value
    out["shown"][0, :12] = out["shown"][0, 19] = math.nan
    return out.view(np.uint8)


@kernel
def quiet_half_width(model):
    """The ellipsoid's half-width of f [m/s^2] where everything arrives and nothing happens: what wide is measured against."""
    g = model[0]
    state = quad_error.init(g, _ZERO3, _ZERO3, G_M_S2)
    measured = quad_error.Measured(_ZERO3, _ZERO3, (0.0, 0.0, -G_M_S2), 0.0, 0.0, 0.0)
    for k in range(SETTLE_TICKS):
        state = quad_error.step(g, state, (0.0, 0.0, G_M_S2), measured, g.tick_s, round(1e6 * k * g.tick_s))
    return _half_width(state.filter.p)


@kernel
def followed(state, echo_us, q_wxyz):
    """Whether the autopilot's echo is close to what was sent shortly before."""
    return follows(state.view(RECORD)[0], echo_us, q_wxyz)


@kernel
def follows(s, echo_us, q_wxyz):
    """`followed` on a record's item."""
    roll, pitch, _ = quat.to_euler(q_wxyz)
    for i in range(_LINE):
        if not 0 <= echo_us - s.line_us[i] <= 1e6 * ECHO_S:
            continue
        if abs(roll - s.line[i, 0]) < FOLLOWED_RAD and abs(pitch - s.line[i, 1]) < FOLLOWED_RAD:
            return True
    return False


@kernel
def blind(state, t_us, active):
    """A tick without an attitude or a velocity yet."""
    out = state.copy()
    s = out.view(RECORD)[0]
    s.t_us, s.active, s.authority = t_us, active, 0.0
    _show(s)
    return out


@kernel
def tick(model, correction, own, state, t_us, active, applied, heard, nominal):
    """(record, acceleration, disturbance cancelled) of a tick. The model error up to t_us, and the nominal command corrected by it.

    own: authority, minmax (0 or 1), hover thrust, delay [s] (-1: as measured), the autopilot's own delay; applied: attitude,
    thrust, measured delay as sent; heard: stamp and attitude, stamp and velocity, the echo's stamp, attitude and collective, when one
    last agreed with what was sent, sum, number and sum of stamps of the accelerometer samples; nominal: acceleration, heading,
    what it cancels.
    """
    out = state.copy()
    s = out.view(RECORD)[0]
    a, cancelled = advance(model[0], correction, own, s, t_us, active, applied, heard, nominal)
    return out, a, cancelled


@kernel
def advance(g, correction, own, s, t_us, active, applied, heard, nominal):
    """`tick` in place, on a record's item."""
    q_sent, thrust_sent, _ = applied
    attitude_us, q_wxyz, velocity_us, velocity, _, _, _, _, accel_sum, accel_count, accel_us = heard
    if math.isfinite(q_sent[0] + q_sent[1] + q_sent[2] + q_sent[3]) and math.isfinite(thrust_sent):
        _push(s, q_sent, thrust_sent)
    dt_s = 1e-6 * (t_us - s.t_us)
    begin = not s.begun or not 0.0 < dt_s <= GAP_S or (active and not s.active)
    command = _acting(own, s, applied, heard, t_us, dt_s)
    attitude = quat.to_euler(q_wxyz)
    if begin:
        _keep(s, quad_error.init(g, velocity, attitude, command[2]))
        s.begun, s.authority, s.velocity_us, s.left = True, 0.0, t_us, 1.0
    else:
        new_attitude, new_velocity = attitude_us > s.t_us, velocity_us > s.velocity_us
        accel, mean_us = _NAN3, t_us
        if accel_count > 0:
            accel, mean_us = linalg.scale(1.0 / accel_count, accel_sum), accel_us // accel_count
        measured = quad_error.Measured(
            attitude if new_attitude else _NAN3,
            velocity if new_velocity else _NAN3,
            accel,
            max(0.0, 1e-6 * (t_us - attitude_us)),
            max(0.0, 1e-6 * (t_us - velocity_us)),
            max(0.0, 1e-6 * (t_us - mean_us)),
        )
        after = quad_error.step(g, _model(s), command, measured, dt_s, t_us)
        _keep(s, after)
        s.left = asmf.authority(after.filter, t_us)
        if new_velocity:
            s.velocity_us = velocity_us
    s.t_us, s.active = t_us, active
    a, cancelled = nominal[0], nominal[2]
    if active:
        a, cancelled = _correct(correction, own, s, nominal, t_us, 0.0 if begin else dt_s)
    else:
        s.authority = 0.0
        flat.put3(s.given_back_m_s2, _ZERO3)
    _show(s)
    return a, cancelled


@kernel
def _push(s, q_sent, thrust_sent):
    roll, pitch, _ = quat.to_euler(q_sent)
    line = command_line.push(command_line.Line(s.line_us[:], s.line[:]), s.t_us, np.array([roll, pitch, thrust_sent]))
    s.line_us[:] = line.t_us
    s.line[:] = line.value


@kernel
def _acting(own, s, applied, heard, t_us, dt_s):
    """(roll, pitch, specific thrust) that the vehicle acted on since the last step: ours, or the autopilot's own target."""
    _, _, hover_thrust, delay_s, own_delay_s = own
    _, _, _, _, echo_us, echo_q, echo_thrust, followed_us, _, _, _ = heard
    if 0.0 <= 1e-6 * (t_us - echo_us) <= ECHO_S and t_us - followed_us > 1e6 * ECHO_S:
        roll, pitch, _ = quat.to_euler(echo_q)
        return (roll, pitch, G_M_S2 * echo_thrust / hover_thrust)
    if delay_s < 0.0:
        delay_s = applied[2] if math.isfinite(applied[2]) else 0.0
    line = command_line.Line(s.line_us[:], s.line[:])
    middle_us = t_us - round(1e6 * (0.5 * dt_s + delay_s))
    thrust = s.line[command_line.index_at(line, middle_us), 2]
    tilt = command_line.index_at(line, middle_us - round(1e6 * own_delay_s))
    return (s.line[tilt, 0], s.line[tilt, 1], thrust)


@kernel
def _correct(correction, own, s, nominal, t_us, dt_s):
    """(acceleration to command, disturbance cancelled): the controller's own estimate takes what authority leaves."""
    wanted, yaw_rad, own_f = nominal
    f = (s.x[3], s.x[4], s.x[5])
    if own[1] > 0.0:
        f = (0.5 * (s.cuts[0, 0] + s.cuts[0, 1]), 0.5 * (s.cuts[1, 0] + s.cuts[1, 1]), 0.5 * (s.cuts[2, 0] + s.cuts[2, 1]))
    stale_s = 1e-6 * (t_us - s.velocity_us) - STALE_S
    if stale_s > 0.0:
        f = linalg.scale(math.exp(-dt_s / STALE_TAU_S), (s.f_ned_m_s2[0], s.f_ned_m_s2[1], s.f_ned_m_s2[2]))
    if not math.isfinite(own_f[0] + own_f[1] + own_f[2]):
        own_f = _ZERO3
    allowed = own[0] * s.left * active_model.gain_of_bounds(correction, _half_width(s.p))
    authority = active_model.ramped(correction, s.authority, allowed, dt_s)
    rest, most = 1.0 - authority, WOUND_UP_M_S2
    believed = (
        rest * linalg.clip(own_f[0], s.cuts[0, 0] - most, s.cuts[0, 1] + most),
        rest * linalg.clip(own_f[1], s.cuts[1, 0] - most, s.cuts[1, 1] + most),
        rest * linalg.clip(own_f[2], s.cuts[2, 0] - most, s.cuts[2, 1] + most),
    )
    given_back = linalg.sub(own_f, believed)
    a = active_model.correct(correction, linalg.add(wanted, given_back), yaw_rad, f, (s.x[8], s.x[9]), authority)
    s.authority = authority
    flat.put3(s.f_ned_m_s2, f)
    flat.put3(s.given_back_m_s2, given_back)
    return a, linalg.axpy(authority, f, believed)


@kernel
def _half_width(p):
    return math.sqrt(max(p[3, 3], p[4, 4], p[5, 5], 0.0))


@kernel
def _model(s):
    """The filter's state out of the record."""
    inner = asmf.State(s.x[:], s.p[:], s.guarantee, s.clean, s.empty, s.inflations, s.delta, s.n_bad[:], s.inflated_us[:])
    attitude = (s.attitude_rad[0], s.attitude_rad[1], s.attitude_rad[2])
    return quad_error.State(inner, (_interval(s, 0), _interval(s, 1), _interval(s, 2)), s.thrust_m_s2, attitude, s.slew_m_s3)


@kernel
def _interval(s, i):
    return interval.State(s.interval[i, 0], s.interval[i, 1], s.interval_n_bad[i], s.interval_empty[i])


@kernel
def _keep(s, model):
    """The filter's state into the record, with the published bounds."""
    inner = model.filter
    s.x[:] = inner.x
    s.p[:] = inner.p
    s.guarantee, s.clean, s.empty, s.inflations, s.delta = (
        inner.guarantee,
        inner.clean,
        inner.empty,
        inner.inflations,
        inner.delta,
    )
    s.n_bad[:] = inner.n_bad
    s.inflated_us[:] = inner.inflated_us
    s.thrust_m_s2, s.slew_m_s3 = model.thrust_m_s2, model.slew_m_s3
    flat.put3(s.attitude_rad, model.attitude_rad)
    for i in range(3):
        seen, cut = model.intervals[i], quad_error.bounds_f(model, i)
        s.interval[i, 0], s.interval[i, 1], s.interval_n_bad[i], s.interval_empty[i] = (
            seen.low,
            seen.high,
            seen.n_bad,
            seen.empty,
        )
        s.cuts[i, 0], s.cuts[i, 1], s.consistent[i] = cut.low, cut.high, int(cut.consistent)


@kernel
def _show(s):
    """What is published, in the order of `active_flight.PUBLISHED`."""
    to = s.shown
    to[15] = s.authority
    for i in range(3):
        to[16 + i] = s.given_back_m_s2[i]
    if not s.begun:
        return
    for i in range(3):
        to[i], to[3 + i], to[6 + i] = s.x[3 + i], s.cuts[i, 0], s.cuts[i, 1]
    to[9], to[10], to[11] = s.x[8], s.x[9], _half_width(s.p)
    to[12] = 1.0 if s.guarantee and s.consistent[0] * s.consistent[1] * s.consistent[2] > 0 else 0.0
    to[13], to[14], to[19] = float(s.empty), float(s.inflations), s.thrust_m_s2
