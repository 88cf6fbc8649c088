"""The fast lane's kernel: a datagram in, setpoints and log out, where nothing is out of the ordinary.

It does what `samples` and `control_step` do, in their order and with the kernels of their stages, on the record of `lane_record`. What
it does not know it gives back untouched (OTHER): a text, a jump, a sample too late, anything that would be said or counted.
"""

import math

import numpy as np

from mavquad import flat, following, lane_wire, paths, position_age
from mavquad.control import pid
from mavquad.jit import kernel
from mavquad.lane_record import (
    ATTITUDES,
    BACKUP_AT,
    COLUMNS,
    FIXED,
    FIXED_AT,
    FIXED_BYTES,
    HEARD_AT,
    LOG_AT,
    MOST_ROWS,
    OWN_AT,
    PLACES_AT,
    RECORD,
    RING_AT,
    RING_END,
    ROWS_AT,
    SCRATCH_AT,
    SENT,
    SENT_AT,
    STATE_AT,
    STATE_BYTES,
    TABLE_AT,
)
from mavquad.link.scan import STAMP
from mavquad.setpoint import attitude, limits
from mavquad.slowing import LATE_S

DONE, OTHER, TIMERS = 0, 1, 2
# kinds of messages
NOTHING, POSITION, IMU, TARGET, ATTITUDE, EULER, TIMESYNC, LANDED, BATTERY, OTHERS = range(10)
EPOCH_US = 1_700_000_000_000_000
G_M_S2 = attitude.G_M_S2
_SETPOINT, _TIMESYNC = 82, 111  # message ids
_SETPOINT_BYTES, _TIMESYNC_BYTES = 39, 18
_BEHIND_US, _OLD_US, _USUAL_S, _SPARED_US, _DOUBLED_US, _OVER_US = 500_000, 60_000, 2.0, 12_000, 500_000, 1_000_000
_BATTERY_AT = 30  # in the payload of SYS_STATUS
_END_NS = 1 << 61
SAME_CLOCK_US = 2_000_000  # as in `messages`
_LATE_S = LATE_S[0]
_FADE_S = 3.0
_NAN3 = (math.nan, math.nan, math.nan)
_ZERO3 = (0.0, 0.0, 0.0)


@kernel
def feed(memory, data, arrival_us, due_us, lockstep):
    """(verdict, arrival stamp, bytes of log, bytes to send, rows of trace, setpoints, frames, attitudes heard) of one datagram.

    memory: see `lane_record.room`; its state is as it was where the verdict is not DONE. data (n,) uint8. Lockstep: the datagram is a
    whole period and its barrier, whose stamp (not before arrival_us) is the arrival; TIMERS where something falls due by then.
    """
    state, backup = memory[STATE_AT : STATE_AT + STATE_BYTES], memory[BACKUP_AT : BACKUP_AT + STATE_BYTES]
    _copy(state.view(np.int64), backup.view(np.int64))
    told = _feed(memory, data, arrival_us, due_us, lockstep)
    if told[0] == OTHER:
        _copy(backup.view(np.int64), state.view(np.int64))
    return told


@kernel
def _feed(memory, data, arrival_us, due_us, lockstep):
    g = memory[FIXED_AT:STATE_AT][:FIXED_BYTES].view(FIXED)[0]
    s = memory[STATE_AT:BACKUP_AT][:STATE_BYTES].view(RECORD)[0]
    table, places = memory[TABLE_AT:LOG_AT].view(np.int16), memory[PLACES_AT:SCRATCH_AT].view(np.int64)
    log, own, wire = memory[LOG_AT:OWN_AT], memory[OWN_AT:SENT_AT], memory[SENT_AT:ROWS_AT]
    heard = memory[HEARD_AT:PLACES_AT].view(np.float64)
    rows, scratch = memory[ROWS_AT:HEARD_AT].view(np.float64), memory[SCRATCH_AT:].view(np.float64)
    body = scratch.view(np.uint8)
    frames, end = lane_wire.take(data, table, g.target_system, g.target_component, log, places)
    if frames <= 0:
        return OTHER, arrival_us, 0, 0, 0, 0, 0, 0
    barrier = frames
    if lockstep:
        barrier = frames - 1
        lane_wire.payload(log, places[barrier], body[:_TIMESYNC_BYTES])
        asked, sent_ns = scratch.view(np.int64)[0], scratch.view(np.int64)[1]
        if table[lane_wire.message_id(log, places[barrier])] >> 8 != TIMESYNC or asked != 0 or not 0 <= sent_ns < _END_NS:
            return OTHER, arrival_us, 0, 0, 0, 0, 0, 0
        stamp_us = EPOCH_US + sent_ns // 1000
        if stamp_us < arrival_us:
            return OTHER, arrival_us, 0, 0, 0, 0, 0, 0
        arrival_us = stamp_us
    if arrival_us >= due_us:
        return TIMERS, arrival_us, 0, 0, 0, 0, 0, 0
    s.arrival_us = max(s.arrival_us, arrival_us)
    written = count = setpoints = attitudes = 0
    for i in range(frames):
        at = places[i]
        lane_wire.stamped(log, at - STAMP, arrival_us)
        s.heard_crc = lane_wire.crc32(log, at, at + lane_wire.whole(log, at), s.heard_crc)
        _counted(s, np.int64(log[at + 4]))
        kind = table[lane_wire.message_id(log, at)] >> 8
        good, due = True, False
        if kind == ATTITUDE:
            good, due = _hear_attitude(g, s, log, at, scratch)
            _told(s, heard[ATTITUDES * attitudes : ATTITUDES * (attitudes + 1)], due)
            attitudes += 1
        elif kind == IMU:
            good = _hear_imu(s, log, at, scratch)
        elif kind == POSITION:
            good = _hear_position(g, s, log, at, scratch)
        elif kind == TARGET:
            good = _hear_target(s, log, at, scratch)
        elif kind == TIMESYNC:
            good, answers = _hear_time(g, s, log, at, scratch, not lockstep or i == barrier)
            if answers:
                written = _send(g, s, own, written, _TIMESYNC, g.timesync_extra, body, g.timesync_bytes)
        elif kind == EULER:
            good = s.attitude_arrival_us >= 0 and s.arrival_us - s.attitude_arrival_us < _DOUBLED_US
        elif kind in (LANDED, BATTERY):
            good = _as_before(g, s, log, at, kind, body)
        elif kind == OTHERS:
            good = False
        if due:
            if count == MOST_ROWS or not _control(g, s, rows[COLUMNS * count : COLUMNS * (count + 1)], scratch):
                return OTHER, arrival_us, 0, 0, 0, 0, 0, 0
            count += 1
            if s.flying:
                written = _send(g, s, own, written, _SETPOINT, g.setpoint_extra, body, _SETPOINT_BYTES)
                setpoints += 1
        if not good or written > own.size - 128:
            return OTHER, arrival_us, 0, 0, 0, 0, 0, 0
    sent = _gather(own, written, wire)
    end = _behind_barrier(log, places[barrier] - STAMP if lockstep else end, end, own, written, lockstep)
    return DONE, arrival_us, end, sent, count, setpoints, frames, attitudes


@kernel
def _copy(words, to):
    """All but the ring of what was sent."""
    for i in range(RING_AT):
        to[i] = words[i]
    for i in range(RING_END, words.size):
        to[i] = words[i]


# ---- frames -------------------------------------------------------------------------------------------------------------
@kernel
def _counted(s, seq):
    """As `health.on_frame`."""
    gap = (seq - s.source_seq - 1) & 0xFF
    s.received += 1
    if gap < 128:
        s.source_seq, s.lost = seq, s.lost + gap
    else:
        s.lost = max(0, s.lost - 1)


@kernel
def _send(g, s, own, at, number, extra, body, length):
    """A frame of ours from `body`, with its stamp, behind those before; where it ends."""
    end = lane_wire.put(own, at + 8, s.arrival_us, number, extra, s.seq, g.system, g.component, body, length)
    own[at] = end - at - 8  # its record's length first
    s.seq = (s.seq + 1) & 0xFF
    return end


@kernel
def _gather(own, written, wire):
    """Our frames one behind the other as they are sent; bytes."""
    at = sent = 0
    while at < written:
        n = np.int64(own[at]) - STAMP
        for i in range(n):
            wire[sent + i] = own[at + 8 + STAMP + i]
        sent += n
        at += 8 + STAMP + n
    return sent


@kernel
def _behind_barrier(log, barrier, end, own, written, lockstep):
    """Our records into the log behind those heard; in lockstep the barrier comes before its answer, the last of ours. Its end."""
    kept = end - barrier
    hold = own.size - kept
    for i in range(kept):  # own's far end is free
        own[hold + i] = log[barrier + i]
    at, to = 0, barrier
    while at < written:
        n = np.int64(own[at])
        if lockstep and at + 8 + n == written:
            for i in range(kept):
                log[to + i] = own[hold + i]
            to += kept
        for i in range(n):
            log[to + i] = own[at + 8 + i]
        to += n
        at += 8 + n
    return to


@kernel
def _as_before(g, s, log, at, kind, body):
    """Whether a slow message says what it said before."""
    if kind == LANDED:
        lane_wire.payload(log, at, body[:2])
        return body[1] == s.landed
    lane_wire.payload(log, at, body[:32])
    left = np.int64(body[_BATTERY_AT])
    return np.float64(left - 256 if left > 127 else left) == s.battery_percent


@kernel
def _hear_time(g, s, log, at, scratch, answers):
    """(whether it is known, whether an answer is in scratch)."""
    lane_wire.payload(log, at, scratch.view(np.uint8)[:_TIMESYNC_BYTES])
    numbers = scratch.view(np.int64)
    now_ns = (s.arrival_us - EPOCH_US) * 1000
    if not -_END_NS < numbers[1] < _END_NS or not -_END_NS < numbers[0] < _END_NS:
        return False, False
    if numbers[0] == 0:
        numbers[0] = now_ns
        body = scratch.view(np.uint8)
        body[16], body[17] = g.target_system, g.target_component
        return answers, answers
    round_trip_s = 1e-9 * (now_ns - numbers[1])
    if 0.0 <= round_trip_s < 2.0:
        s.delay_s += (round_trip_s - s.delay_s) * (0.1 if s.delay_s != 0.0 else 1.0)
        answered_us = numbers[0] // 1000
        if abs(answered_us - s.now_us) < SAME_CLOCK_US:
            s.lateness_us = max(s.lateness_us, EPOCH_US + numbers[1] // 1000 - answered_us)
    return True, False


# ---- samples ------------------------------------------------------------------------------------------------------------
@kernel
def _stamped(s, t_us, last_us):
    """Whether a sample comes in its order; vehicle time goes on with it."""
    if t_us < s.now_us - _BEHIND_US or t_us <= last_us:
        return False
    if t_us > s.now_us:
        s.now_us, s.newest_arrival_us = t_us, s.arrival_us
    return True


@kernel
def _unit(w, x, y, z):
    """(whether it is one, the quaternion)."""
    n2 = w * w + x * x + y * y + z * z
    if not 0.9 < n2 < 1.1:
        return False, (1.0, 0.0, 0.0, 0.0)
    k = 1.0 / math.sqrt(n2)
    return True, (k * w, k * x, k * y, k * z)


@kernel
def _three(v, at):
    return (np.float64(v[at]), np.float64(v[at + 1]), np.float64(v[at + 2]))


@kernel
def _quat(a):
    return (a[0], a[1], a[2], a[3])


@kernel
def _put4(to, q):
    to[0], to[1], to[2], to[3] = q[0], q[1], q[2], q[3]


@kernel
def _hear_position(g, s, log, at, scratch):
    lane_wire.payload(log, at, scratch.view(np.uint8)[:28])
    t_us, values = 1000 * np.int64(scratch.view(np.uint32)[0]), scratch.view(np.float32)
    p, v = _three(values, 1), _three(values, 4)
    if not math.isfinite(p[0] + p[1] + p[2] + v[0] + v[1] + v[2]) or t_us <= s.position_stamp_us:
        return False
    frozen = v[0] != 0.0 or v[1] != 0.0 or v[2] != 0.0
    for i in range(3):
        frozen = frozen and s.told_p_m[i] == p[i] and s.told_v_m_s[i] == v[i]
    if frozen or not _stamped(s, t_us, s.position_stamp_us):
        return False
    flat.put3(s.told_p_m, p)
    flat.put3(s.told_v_m_s, v)
    s.position_stamp_us, s.position_arrival_us = t_us, s.arrival_us
    if not s.released:
        position_age.hear_in(s.age, t_us, v)
    p, v = position_age.carried_by(s.age, p, v)
    p = (p[0] - s.offset_m[0], p[1] - s.offset_m[1], p[2] - s.offset_m[2])
    dt_s = 1e-6 * (t_us - s.position_us)
    half, most = 0.5 * dt_s, g.reset_m + 2.0 * dt_s
    for i in range(3):
        if s.leading and abs(p[i] - s.p_ned_m[i] - half * (v[i] + s.v_ned_m_s[i])) > most:
            return False
    s.position_us = t_us
    flat.put3(s.p_ned_m, p)
    flat.put3(s.v_ned_m_s, v)
    return True


@kernel
def _hear_imu(s, log, at, scratch):
    if s.imu_arrival_us >= 0 and s.arrival_us - s.imu_arrival_us < _SPARED_US:
        return True
    lane_wire.payload(log, at, scratch.view(np.uint8)[:32])
    t_us, values = scratch.view(np.int64)[0], scratch.view(np.float32)
    accel, gyro = _three(values, 2), _three(values, 5)
    total = accel[0] + accel[1] + accel[2] + gyro[0] + gyro[1] + gyro[2]
    if not math.isfinite(total) or not 0 <= t_us < 1 << 62 or not _stamped(s, t_us, s.imu_stamp_us):
        return False
    s.imu_stamp_us, s.imu_arrival_us = t_us, s.arrival_us
    position_age.feel_in(s.age, t_us, accel, _quat(s.q_wxyz))
    return True


@kernel
def _hear_target(s, log, at, scratch):
    lane_wire.payload(log, at, scratch.view(np.uint8)[:37])
    t_us, values, mask = (
        1000 * np.int64(scratch.view(np.uint32)[0]),
        scratch.view(np.float32),
        np.int64(scratch.view(np.uint8)[36]),
    )
    good, q = _unit(np.float64(values[1]), np.float64(values[2]), np.float64(values[3]), np.float64(values[4]))
    omega, thrust = _three(values, 5), np.float64(values[8])
    if not good or not math.isfinite(thrust) or not _stamped(s, t_us, s.target_stamp_us):
        return False
    s.target_stamp_us, s.target_arrival_us = t_us, s.arrival_us
    s.echo_us, s.echo_thrust, s.echo_mask = t_us, thrust, mask
    _put4(s.echo_q, q)
    flat.put3(s.echo_omega_rad_s, omega)
    if s.learning and 0.05 < thrust < 0.95:
        upright = 1.0 - 2.0 * (q[1] * q[1] + q[2] * q[2])
        s.hover_thrust += 0.05 * (thrust * upright - s.hover_thrust)
    for i in range(s.sent_count):
        x, y = s.ring_xy[i, 0], s.ring_xy[i, 1]
        if abs(q[1] - x) < 1e-6 and abs(q[2] - y) < 1e-6 and abs(q[1]) + abs(q[2]) > 1e-4:
            delay_s = 1e-6 * (t_us - s.ring_us[i])
            if 0.0 <= delay_s < 1.0:
                known = not math.isnan(s.delay_echo_s)
                s.delay_echo_s = s.delay_echo_s + 0.05 * (delay_s - s.delay_echo_s) if known else delay_s
            break
    return True


@kernel
def _hear_attitude(g, s, log, at, scratch):
    """(whether it is plain, whether it is time for a control step)."""
    lane_wire.payload(log, at, scratch.view(np.uint8)[:32])
    t_us, values = 1000 * np.int64(scratch.view(np.uint32)[0]), scratch.view(np.float32)
    good, q = _unit(np.float64(values[1]), np.float64(values[2]), np.float64(values[3]), np.float64(values[4]))
    omega = _three(values, 5)
    if not good or not math.isfinite(omega[0] + omega[1] + omega[2]) or not _stamped(s, t_us, s.attitude_stamp_us):
        return False, False
    s.attitude_stamp_us, s.attitude_arrival_us = t_us, s.arrival_us
    _put4(s.q_wxyz, q)
    flat.put3(s.omega_rad_s, omega)
    gap_us = s.now_us - s.pace_us if s.pace_us != 0 else 0
    s.pace_us = s.now_us
    if 0 < gap_us < 200_000:
        s.control_gap_us = gap_us if s.control_gap_us == 0 else min(gap_us, s.control_gap_us)
    if not _punctual(g, s, t_us):
        return False, False
    return True, s.control_us == 0 or t_us - s.control_us >= g.control_us - s.control_gap_us // 2


@kernel
def _told(s, to, due):
    """The newest attitude as observers are told it; its stamp from -1 downwards where a control step follows."""
    to[0] = -1 - s.attitude_stamp_us if due else s.attitude_stamp_us
    for i in range(4):
        to[1 + i] = s.q_wxyz[i]
    for i in range(3):
        to[5 + i] = s.omega_rad_s[i]


@kernel
def _punctual(g, s, t_us):
    """As `samples._punctual`; False where it would say or skip something."""
    offset = s.arrival_us - t_us
    s.lateness_us = min(offset, s.lateness_us + 20)
    late_us = offset - s.lateness_us
    w = min(1.0, 1e-6 * s.control_gap_us / _USUAL_S)
    s.usual_us = float(offset) if math.isnan(s.usual_us) else s.usual_us + w * (offset - s.usual_us)
    s.age_s = 1e-6 * min(float(_OLD_US), max(float(-_OLD_US), offset - s.usual_us))
    if late_us > _OLD_US and s.arrival_us - s.put_us < g.control_us // 2:
        return False
    s.late_s = max(1e-6 * late_us, s.late_s * math.exp(-1e-6 * s.control_gap_us / _FADE_S))
    if s.late_s >= _LATE_S:
        return False
    if late_us > g.late_us:
        s.late_us = s.late_us if s.late_us != 0 else s.arrival_us
    else:
        s.late_us = 0
    return True


# ---- one control step -----------------------------------------------------------------------------------------------------
@kernel
def _control(g, s, row, scratch):
    """As `control_step.step`: the row of the trace, and the setpoint in scratch where one is sent. False where it is not plain."""
    t_us = s.attitude_stamp_us
    dt_s = min(0.2, 1e-6 * (t_us - s.control_us)) if s.control_us != 0 else 1e-6 * g.control_us
    s.control_us = t_us
    age_s = min(g.carry_s, max(0.0, 1e-6 * (t_us - s.position_us)))
    v, q, omega = flat.vec3(s.v_ned_m_s), _quat(s.q_wxyz), flat.vec3(s.omega_rad_s)
    p = (s.p_ned_m[0] + age_s * v[0], s.p_ned_m[1] + age_s * v[1], s.p_ned_m[2] + age_s * v[2])
    s.estimate_us = t_us
    flat.put3(s.estimate_p_m, p)
    flat.put3(s.estimate_v_m_s, v)
    _put4(s.estimate_q, q)
    flat.put3(s.estimate_omega_rad_s, omega)
    dt_s, s.skipped_s, s.put_us = min(0.2, dt_s + s.skipped_s), 0.0, s.arrival_us
    p_ref, v_ref, a_ref, a, bits = _NAN3, _ZERO3, _ZERO3, _NAN3, 0
    if s.flying:
        p_ref, v_ref, a_ref = _demand(g.path, s, t_us)
        integral, a = pid.law(_law(g.pid), flat.vec3(s.integral_m_s2), p, v, p_ref, v_ref, a_ref, dt_s)
        flat.put3(s.integral_m_s2, integral)
        bits = _put(g, s, a, dt_s)
        if not _watched(g, s, t_us, q):
            return False
    _row(s, row, t_us, p, v, q, omega, p_ref, v_ref, a_ref, a, bits)
    if s.flying:
        _fields(g, s, scratch)
    return True


@kernel
def _demand(path, s, t_us):
    plan = paths.Plan(
        path.kind, path.a, path.b, path.s_end, path.s_dot, path.ramp_s, path.duration_s, path.cos_course, path.sin_course
    )
    p, v, a, _ = paths.evaluate(plan, 1e-6 * (t_us - s.path_t0_us))
    return (s.anchor_p_m[0] + p[0], s.anchor_p_m[1] + p[1], s.anchor_p_m[2] + p[2]), v, a


@kernel
def _law(k):
    return pid.Gains(
        k.kp, k.kd, k.ki, flat.vec3(k.drag_linear_1_s), flat.vec3(k.drag_quadratic_1_m), k.accel_max_m_s2, k.integral_max_m_s2
    )


@kernel
def _put(g, s, a, dt_s):
    """Attitude and collective through the gate; the bits of what it changed."""
    gate = limits.Gains(
        g.gate.cos_tilt,
        g.gate.tilt_rad,
        g.gate.rate_rad_s,
        g.gate.turn_rad_s,
        g.gate.thrust_min,
        g.gate.thrust_max,
        g.gate.thrust_slew_per_s,
    )
    q, size, upward = attitude.pointing(a, s.anchor_yaw_rad, gate.tilt_rad)
    thrust = s.hover_thrust * (upward if g.ardupilot else size) / G_M_S2
    q, _, thrust, bits = limits.apply_kernel(gate, _quat(s.sent_q), s.sent_thrust, q, _ZERO3, thrust, dt_s)
    s.interventions += 1 if bits != 0 else 0
    _put4(s.sent_q, q)
    s.sent_thrust, s.applied_m_s2 = thrust, G_M_S2 * thrust / s.hover_thrust
    if g.ardupilot:
        s.applied_m_s2 /= max(0.3, 1.0 - 2.0 * (q[1] * q[1] + q[2] * q[2]))
    if s.sent_count == SENT:
        for i in range(SENT - 1):
            s.ring_us[i], s.ring_xy[i, 0], s.ring_xy[i, 1] = s.ring_us[i + 1], s.ring_xy[i + 1, 0], s.ring_xy[i + 1, 1]
        s.sent_count -= 1
    s.ring_us[s.sent_count], s.ring_xy[s.sent_count, 0], s.ring_xy[s.sent_count, 1] = _vehicle_now_us(s), q[1], q[2]
    s.sent_count += 1
    return bits


@kernel
def _vehicle_now_us(s):
    return s.now_us + max(0, s.arrival_us - s.newest_arrival_us) if s.now_us != 0 else 0


@kernel
def _watched(g, s, t_us, q):
    """False where it is to be said that setpoints are not followed, or again; or where the path is over."""
    if not s.engaged:
        following.reset_in(s.following)
        s.follows = 1
        return True
    response = (g.natural_frequency_rad_s, g.damping, g.response_delay_s)
    follows = following.step_in(s.following, s.follows != 0, response, t_us, _quat(s.sent_q), q, s.delay_s)
    over = t_us >= s.path_t0_us + g.duration_us + _OVER_US
    return follows == (s.follows != 0) and (s.ended != 0 or not over)


@kernel
def _fields(g, s, scratch):
    """SET_ATTITUDE_TARGET."""
    values, body = scratch.view(np.float32), scratch.view(np.uint8)
    scratch.view(np.uint32)[0] = _vehicle_now_us(s) // 1000 & 0xFFFFFFFF
    for i in range(4):
        values[1 + i] = s.sent_q[i]
    values[5], values[6], values[7], values[8] = 0.0, 0.0, 0.0, s.sent_thrust
    body[36], body[37], body[38] = g.target_system, g.target_component, 7


@kernel
def _row(s, row, t_us, p, v, q, omega, p_ref, v_ref, a_ref, a, bits):
    """As `publish.trace_row`."""
    row[0], row[1], row[2] = t_us, s.arrival_us, s.state
    for i in range(3):
        row[3 + i], row[6 + i], row[13 + i] = p[i], v[i], omega[i]
        row[16 + i], row[19 + i] = math.nan, math.nan
        row[22 + i], row[25 + i], row[28 + i], row[31 + i], row[34 + i] = p_ref[i], v_ref[i], a_ref[i], a[i], a[i]
    sent = s.has_sent != 0
    for i in range(4):
        row[9 + i], row[37 + i] = q[i], s.sent_q[i] if sent else math.nan
    row[41], row[42], row[43], row[44] = s.sent_thrust if sent else math.nan, bits, s.hover_thrust, s.delay_s
    row[45] = s.heard_crc
