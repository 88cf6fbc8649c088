"""The joint observer (and the plain extended state observer) over a whole record, compiled: `joint_flight` on `record.Events`.

The thrust that acts is the record's COMMAND, which here stands for what was sent and for its echo.
"""

import math

from mavquad import quat
from mavquad.estimate import applied_thrust, ekf, joint_tick, record
from mavquad.estimate.joint_flight import Gains
from mavquad.estimate.joint_tick import Axes
from mavquad.jit import kernel
from mavquad.linalg import axpy

_G_M_S2 = applied_thrust.G_M_S2
_ATTITUDE, _POSITION, _IMU, _COMMAND = record.ATTITUDE, record.POSITION, record.IMU, record.COMMAND
_COAST_S, _LATE_S = 0.5, 0.25  # as in joint_flight
_NAN3 = (math.nan, math.nan, math.nan)
_ZERO3 = (0.0, 0.0, 0.0)


def run(gains: Gains, events: record.Events) -> record.Observed:
    """What the observer estimates at the steps; gains of `joint_flight` or `leso_flight`."""
    out = record.outputs(events)
    start = ekf.init(gains.ekf, ekf.NOTHING)
    _run(gains, start, events.kind, events.t_us, events.x, events.step, out.p_ned_m, out.v_ned_m_s, out.f_ned_m_s2)
    return out


@kernel
def _to(gains, state, axes, axes_us, thrust, fast, placed, wanted, now_us, t_us):
    """All at t, if that is ahead: (filter, observers, time of the observers' last step, thrust, now)."""
    dt_s = 1e-6 * (t_us - now_us)
    if dt_s <= 0.0:
        return state, axes, axes_us, thrust, now_us
    if now_us == 0 or dt_s > _COAST_S:
        return state, axes, t_us, thrust, t_us
    now = wanted + math.exp(-dt_s / gains.thrust_lag_s) * (thrust - wanted)
    mean = wanted + (thrust - now) * gains.thrust_lag_s / dt_s
    if not placed:
        q = quat.integrate(state.q_wxyz, state.omega_rad_s, dt_s)
        turned = ekf.EkfState(state.p_ned_m, state.v_ned_m_s, q, state.omega_rad_s, state.P, state.singular)
        return turned, axes, t_us, now, t_us
    moved, ahead = joint_tick.carry(gains.ekf, state, axes, mean, fast, gains.use_filter, dt_s)
    return moved, ahead, axes_us, now, t_us


@kernel
def _turned(state, q, w):
    return ekf.EkfState(state.p_ned_m, state.v_ned_m_s, q, w, state.P, state.singular)


@kernel
def _acting(t_us, command_us, command, before):
    """Of the last two commands the one that acts at t; gravity before the first."""
    return command if command_us <= t_us else before


@kernel
def _placed(gains, state, p, v):
    """The filter begun (again) at a position."""
    P = state.P.copy()
    for i in range(6):
        for j in range(12):
            P[i, j] = 0.0
            P[j, i] = 0.0
    for i in range(6):
        P[i, i] = gains.ekf.noise[2, i]
    return ekf.EkfState(p, v, state.q_wxyz, state.omega_rad_s, P, state.singular)


@kernel
def _run(gains, state, kinds, stamps, x, steps, out_p, out_v, out_f):
    axes = Axes(_ZERO3, _ZERO3, _ZERO3, _ZERO3, _ZERO3, _ZERO3)
    now_us, axes_us, attitude_us, position_us, imu_us, command_us = 0, 0, 0, 0, 0, 0
    thrust, command, before = _G_M_S2, _G_M_S2, _G_M_S2
    fast, offset = _ZERO3, _ZERO3
    row = 0
    for i in range(kinds.size):
        kind, t_us = kinds[i], stamps[i]
        a = (x[i, 0], x[i, 1], x[i, 2])
        b = (x[i, 3], x[i, 4], x[i, 5])
        if kind == _COMMAND:
            if t_us > command_us:
                before, command, command_us = command, x[i, 2], t_us
        elif kind == _ATTITUDE and t_us > attitude_us:
            first = attitude_us == 0
            wanted = _acting(t_us, command_us, command, before)
            state, axes, axes_us, thrust, now_us = _to(
                gains, state, axes, axes_us, thrust, fast, position_us > 0, wanted, now_us, t_us
            )
            age_s = 1e-6 * max(0, now_us - t_us)
            if age_s <= _LATE_S:
                w = (x[i, 4], x[i, 5], x[i, 6])
                q = quat.integrate((x[i, 0], x[i, 1], x[i, 2], x[i, 3]), w, age_s)
                if first or not gains.use_filter:
                    state = _turned(state, q, w)
                else:
                    state = ekf.update(gains.ekf, state, _NAN3 + _NAN3 + quat.to_euler(q) + w)
                attitude_us = t_us
        elif kind == _POSITION and t_us > position_us:
            if position_us == 0 or 1e-6 * (t_us - position_us) > _COAST_S:
                now_us = max(now_us, t_us)
                state = _placed(gains, state, a, b)
                axes = Axes(a, b, axes.z3, _ZERO3, _ZERO3, _ZERO3)
                axes_us, position_us, offset = now_us, t_us, _ZERO3
            else:
                wanted = _acting(t_us, command_us, command, before)
                state, axes, axes_us, thrust, now_us = _to(
                    gains, state, axes, axes_us, thrust, fast, True, wanted, now_us, t_us
                )
                age_s = 1e-6 * max(0, now_us - t_us)
                if age_s <= _LATE_S:
                    state, axes, offset = _position(
                        gains, state, axes, thrust, fast, offset, a, b, age_s, 1e-6 * (t_us - position_us), now_us - axes_us
                    )
                    axes_us, position_us = now_us, t_us
        elif kind == _IMU and t_us > imu_us:
            silent = attitude_us == 0 or t_us - attitude_us > 100_000
            if silent or gains.accel_tau_s > 0.0:
                wanted = _acting(t_us, command_us, command, before)
                state, axes, axes_us, thrust, now_us = _to(
                    gains, state, axes, axes_us, thrust, fast, position_us > 0, wanted, now_us, t_us
                )
                if 1e-6 * max(0, now_us - t_us) <= _LATE_S:
                    if silent and gains.use_filter:
                        state = ekf.update(gains.ekf, state, _NAN3 + _NAN3 + _NAN3 + b)
                    elif silent:
                        state = _turned(state, state.q_wxyz, b)
                    if gains.accel_tau_s > 0.0 and position_us > 0:
                        since_s = 1e-6 * (t_us - imu_us) if imu_us > 0 else 0.0
                        fast = _felt(gains, state, thrust, fast, a, min(since_s, _COAST_S))
                    imu_us = t_us
        if steps[i]:
            if position_us > 0 and attitude_us > 0:
                p, v, f = _read(gains, state, axes, 1e-6 * (now_us - axes_us), fast, offset)
                for k in range(3):
                    out_p[row, k], out_v[row, k], out_f[row, k] = p[k], v[k], f[k]
            row += 1


@kernel
def _position(gains, state, axes, thrust, fast, offset, p, v, age_s, since_s, since_axes_us):
    """A position sample absorbed: (filter, observers, offset)."""
    speed = state.v_ned_m_s if gains.use_filter else axpy(1.0, axes.gained_m_s, axes.z2)
    known = joint_tick.known(gains.ekf, state.q_wxyz, thrust, speed)
    a = axpy(1.0, known, axpy(1.0, axes.z3, fast))
    p = axpy(age_s, speed, p)
    v = axpy(age_s, a, v)
    y = p
    if gains.use_filter:
        state = ekf.update(gains.ekf, state, p + v + _NAN3 + _NAN3)
        y = state.p_ned_m
        if gains.anchor_s > 0.0:
            w = 1.0 - math.exp(-since_s / gains.anchor_s)
            miss = axpy(-1.0, state.p_ned_m, p)
            offset = axpy(w, axpy(-1.0, offset, miss), offset)
    dt_s = max(1e-3, 1e-6 * since_axes_us)
    return state, joint_tick.observed(axes, y, gains.w0, gains.tau_f_s, gains.butterworth, dt_s), offset


@kernel
def _felt(gains, state, thrust, fast, accel, since_s):
    """The accelerometer's part of the disturbance after a sample."""
    felt = axpy(1.0, quat.rotate(state.q_wxyz, accel), (0.0, 0.0, gains.ekf.gravity_m_s2))
    rest = axpy(-1.0, joint_tick.known(gains.ekf, state.q_wxyz, thrust, state.v_ned_m_s), felt)
    w = 1.0 - math.exp(-since_s / gains.accel_tau_s)
    return axpy(w, axpy(-1.0, fast, rest), fast)


@kernel
def _read(gains, state, axes, since_s, fast, offset):
    """Position, velocity, disturbance at the present time."""
    if gains.use_filter:
        p, v = axpy(1.0, offset, state.p_ned_m), state.v_ned_m_s
    else:
        p = axpy(1.0, axpy(0.5 * since_s * since_s, axes.z3, axes.moved_m), axpy(since_s, axes.z2, axes.z1))
        v = axpy(1.0, axpy(since_s, axes.z3, axes.gained_m_s), axes.z2)
    f = joint_tick.compensated(axes, gains.w0, gains.feedforward, gains.lead_s, gains.butterworth)
    return p, v, axpy(-gains.ekf.drag_1_s, v, axpy(1.0, f, fast))
