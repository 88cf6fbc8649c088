"""One whole flight as one compiled function: plant, sensors, autopilot, wire, estimator, controller, setpoint gate, scores.

It calls the very step functions of the simulated autopilot and of the companion; what is written out here is what lies between
them, as `sitl.simulation` and `mavquad.pipeline` do it in lockstep: samples at their stamps, float32 on the wire, a constant delay
each way, the companion's turn at the end of each control period. `stepwise` does the same in Python; a test compares the bits.
"""

import math

import numpy as np

from mavquad import paths
from mavquad.control import pid
from mavquad.jit import kernel
from mavquad.setpoint import attitude, limits
from sitl import loops, plant, rotation
from sitl.state import ATTITUDE, POSITION
from sitl.vehicle import air
from tools.bulk import lean
from tools.bulk.state import AUTOPILOT, FLYING, LOST, ON_WIRE, TOUCHED

_FAR_M = 1000.0
_NEVER = 1 << 62


@kernel
def fly(flight, vehicle, setpoint, constants, gusts, noise, wires, gains, gate, path, until_us, trace):
    """Fly on to `until_us`; leaves everything in the records. noise: its generators; wires: what is under way down and up;
    trace: (n, 11) rows filled per control period, none where it is empty."""
    f, s, sp, c, n, w = flight[0], vehicle[0], setpoint[0], constants[0], noise[0], wires[0]
    row = 0
    while f.t_us < until_us and f.ended == FLYING:
        period(f, s, sp, c, n, w, gusts)
        if not f.engaged and f.t_us >= f.engage_us:
            engage(f)
        _hear_echoes(f, w)
        _deliver_down(f, w, gains, gate, path)
        _watch(f, s)
        if row < trace.shape[0]:
            _note(f, s, trace, row)
            row += 1
    return row


@kernel
def period(f, s, sp, c, n, w, gusts):
    """The autopilot's side of one control period."""
    end_us = f.t_us + f.period_us
    while f.t_us < end_us:
        due_us = min(end_us, f.attitude_due_us, f.position_due_us, _deliver_up(f, sp, w))
        if not f.engaged:
            due_us = min(due_us, f.echo_due_us)
        steps = max(1, -(-(due_us - f.t_us) // f.step_us))
        for _ in range(steps):
            lean.draw(s, c, n)
            loops.run(s, sp, c)
            if s.step % c.air_every == 0:
                air(s, c, gusts, n.normals)
            plant.step(s, c)
            lean.sense(s, c, n.normals)
        f.t_us += steps * f.step_us
        if f.t_us >= f.position_due_us:
            _send_position(f, s, w)
        if f.t_us >= f.attitude_due_us:
            _send_attitude(f, s, w)
        if not f.engaged and f.t_us >= f.echo_due_us:
            _send_echo(f, s, w)


@kernel
def _send_position(f, s, w):
    """Position and velocity as float32."""
    f.position_due_us += f.position_us
    at = w.positions[f.position_next % ON_WIRE]
    at.t_us = f.t_us
    for i in range(3):
        at.p[i] = np.float64(np.float32(s.nav_p_ned_m[i]))
        at.v[i] = np.float64(np.float32(s.nav_v_ned_m_s[i]))
    f.position_next += 1


@kernel
def _send_attitude(f, s, w):
    """The AHRS's quaternion; beside it the true position, for the scores."""
    f.attitude_due_us += f.attitude_us
    lean.quaternion(s)
    to = w.attitudes[f.attitude_next % ON_WIRE]
    to.t_us = f.t_us
    q = _as_sent((s.ahrs_q_wxyz[0], s.ahrs_q_wxyz[1], s.ahrs_q_wxyz[2], s.ahrs_q_wxyz[3]))
    to.q[0], to.q[1], to.q[2], to.q[3] = q
    for i in range(3):
        to.p_true[i] = s.p_ned_m[i]
    f.attitude_next += 1


@kernel
def _send_echo(f, s, w):
    """What the autopilot's own loop asks for in the hover before."""
    f.echo_due_us += f.echo_us
    echo = w.echoes[f.echo_next % ON_WIRE]
    echo.t_us = f.t_us
    echo.thrust = np.float64(np.float32(s.thrust))
    q = _as_sent(rotation.to_quaternion(rotation.matrix(s.target_R)))
    echo.upright = 1.0 - 2.0 * (q[1] * q[1] + q[2] * q[2])
    f.echo_next += 1


@kernel
def _as_sent(q):
    """A quaternion as the companion reads it: float32 on the wire, then made unit."""
    w, x = np.float64(np.float32(q[0])), np.float64(np.float32(q[1]))
    y, z = np.float64(np.float32(q[2])), np.float64(np.float32(q[3]))
    k = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    return (k * w, k * x, k * y, k * z)


@kernel
def _deliver_up(f, sp, w):
    """Setpoints that have arrived at the autopilot, into the record that its loops read. Returns when the next one does."""
    while f.setpoint_first < f.setpoint_next and w.setpoints[f.setpoint_first % ON_WIRE].due_us <= f.t_us:
        got = w.setpoints[f.setpoint_first % ON_WIRE]
        f.setpoint_first += 1
        if f.controller == AUTOPILOT:
            sp.kind = POSITION
            sp.yaw_rad = got.yaw
            for i in range(3):
                sp.p_ned_m[i], sp.v_ned_m_s[i], sp.a_ned_m_s2[i] = got.p[i], got.v[i], got.a[i]
        else:
            q = got.q
            norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
            R = rotation.from_quaternion((q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm))
            sp.kind = ATTITUDE
            sp.thrust = min(1.0, max(0.0, got.thrust))
            for i in range(3):
                sp.rates_rad_s[i] = 0.0
            for i in range(9):
                sp.R[i] = R[i]
    return w.setpoints[f.setpoint_first % ON_WIRE].due_us if f.setpoint_first < f.setpoint_next else _NEVER


@kernel
def _deliver_down(f, w, gains, gate, path):
    """The companion's turn at the end of a control period: samples that have arrived, oldest first; control on the attitudes."""
    heard_us = f.t_us - f.delay_us
    while f.attitude_first < f.attitude_next and w.attitudes[f.attitude_first % ON_WIRE].t_us <= heard_us:
        sampled = w.attitudes[f.attitude_first % ON_WIRE]
        _hear_positions(f, w, sampled.t_us)
        gap_us = sampled.t_us - f.last_attitude_us
        if 0 < gap_us < 200_000:
            f.gap_us = gap_us if f.gap_us == 0 else min(gap_us, f.gap_us)
        f.last_attitude_us = sampled.t_us
        since_us = sampled.t_us - f.control_us
        if f.control_us == 0 or since_us >= f.wanted_gap_us - f.gap_us // 2:
            dt_s = min(0.2, 1e-6 * since_us) if f.control_us else 1e-6 * f.wanted_gap_us
            _control(f, sampled, w, gains, gate, path, dt_s)
        f.attitude_first += 1
    _hear_positions(f, w, heard_us)


@kernel
def _hear_positions(f, w, until_us):
    while f.position_first < f.position_next and w.positions[f.position_first % ON_WIRE].t_us <= until_us:
        heard = w.positions[f.position_first % ON_WIRE]
        f.position_stamp_us = heard.t_us
        for i in range(3):
            f.p[i], f.v[i] = heard.p[i], heard.v[i]
        f.position_first += 1


@kernel
def _hear_echoes(f, w):
    """In the hover before setpoints flow, the thrust that the autopilot holds is what carries this vehicle."""
    while f.echo_first < f.echo_next and w.echoes[f.echo_first % ON_WIRE].t_us <= f.t_us - f.delay_us:
        echo = w.echoes[f.echo_first % ON_WIRE]
        if not f.engaged and 0.05 < echo.thrust < 0.95:
            f.hover_thrust += 0.05 * (echo.thrust * echo.upright - f.hover_thrust)
        f.echo_thrust = echo.thrust
        f.echo_first += 1


@kernel
def _control(f, sampled, w, gains, gate, path, dt_s):
    """estimate -> control -> setpoint, once, on one attitude sample."""
    t_us = sampled.t_us
    f.control_us = t_us
    for i in range(4):
        f.estimate_q[i] = sampled.q[i]
    if not f.engaged:
        return
    if f.score_from_us < 0:  # relative until the first of these steps
        f.score_from_us, f.score_to_us = t_us - f.score_from_us, t_us + f.score_to_us
    age_s = min(f.carry_s, max(0.0, 1e-6 * (t_us - f.position_stamp_us)))
    v = (f.v[0], f.v[1], f.v[2])
    p = (f.p[0] + age_s * v[0], f.p[1] + age_s * v[1], f.p[2] + age_s * v[2])
    dp, dv, da, _ = paths.evaluate(path, 1e-6 * (t_us - f.path_t0_us))
    ref = (f.anchor_p[0] + dp[0], f.anchor_p[1] + dp[1], f.anchor_p[2] + dp[2])
    to = w.setpoints[f.setpoint_next % ON_WIRE]
    if f.controller == AUTOPILOT:
        to.yaw = np.float64(np.float32(f.anchor_yaw))
        for i in range(3):
            to.p[i] = np.float64(np.float32(ref[i]))
            to.v[i] = np.float64(np.float32(dv[i]))
            to.a[i] = np.float64(np.float32(da[i]))
    else:
        integral, a = pid.law(gains, (f.integral[0], f.integral[1], f.integral[2]), p, v, ref, dv, da, dt_s)
        for i in range(3):
            f.integral[i] = integral[i]
        thrust = attitude.thrust_vector(a, gate.tilt_rad, 0.2 * attitude.G_M_S2, 1.8 * attitude.G_M_S2)
        wanted, size = attitude.attitude(thrust, f.anchor_yaw)
        last = (f.sent_q[0], f.sent_q[1], f.sent_q[2], f.sent_q[3])
        collective = f.hover_thrust * size / attitude.G_M_S2
        sent, _, collective, _ = limits.apply_kernel(gate, last, f.sent_thrust, wanted, (0.0, 0.0, 0.0), collective, dt_s)
        for i in range(4):
            f.sent_q[i] = sent[i]
            to.q[i] = np.float64(np.float32(sent[i]))
        f.sent_thrust = collective
        to.thrust = np.float64(np.float32(collective))
    to.due_us = f.t_us + max(f.step_us, f.delay_us)  # even without delay the loop that runs now is over before
    f.setpoint_next += 1
    f.control_steps += 1
    if f.score_from_us <= t_us <= f.score_to_us:
        total = 0.0
        for i in range(3):
            e = sampled.p_true[i] - ref[i]
            f.sum_e2[i] += e * e
            total += e * e
        f.max_e2 = max(f.max_e2, total)
        f.scored += 1


@kernel
def engage(f):
    """Setpoints flow from here: the path begins where the vehicle is, with a first setpoint that changes nothing."""
    f.engaged = 1
    q = f.estimate_q
    f.anchor_yaw = math.atan2(2.0 * (q[0] * q[3] + q[1] * q[2]), 1.0 - 2.0 * (q[2] * q[2] + q[3] * q[3]))
    for i in range(3):
        f.anchor_p[i] = f.p[i]
        f.integral[i] = 0.0
    for i in range(4):
        f.sent_q[i] = q[i]
    f.sent_thrust = f.echo_thrust if f.echo_thrust > 0.05 else f.hover_thrust
    f.path_t0_us = f.last_attitude_us + f.settle_us


@kernel
def _watch(f, s):
    far = abs(s.p_ned_m[0]) + abs(s.p_ned_m[1]) + abs(s.p_ned_m[2])
    if s.grounded:
        f.ended = TOUCHED
    elif not far < _FAR_M:
        f.ended = LOST


@kernel
def _note(f, s, trace, row):
    trace[row, 0] = f.t_us
    for i in range(3):
        trace[row, 1 + i], trace[row, 4 + i], trace[row, 7 + i] = s.p_ned_m[i], s.v_ned_m_s[i], s.R[3 * i + 2]
    trace[row, 10] = s.thrust
