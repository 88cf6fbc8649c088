"""The joint observer's samples and ticks as kernels on one record: what `joint_flight` runs and what a fused tick calls."""

import math
from typing import NamedTuple

import numpy as np

from mavquad import flat, quat
from mavquad.estimate import applied_thrust, ekf, leso
from mavquad.jit import kernel
from mavquad.linalg import axpy, finite3

Vec3 = tuple[float, float, float]
Quat = tuple[float, float, float, float]

_COAST_S = 0.5  # the longest silence that is integrated over; beyond it the filter starts again where it is
_LATE_S = 0.25  # a sample older than the filter by more is not used
_ZERO3 = (0.0, 0.0, 0.0)
_NAN3 = (math.nan, math.nan, math.nan)


class Axes(NamedTuple):
    """The three observers: position, velocity, disturbance, its filtered rate; and what is known to have moved them since."""

    z1: Vec3
    z2: Vec3
    z3: Vec3
    rate: Vec3  # m/s^3
    moved_m: Vec3  # by the known acceleration, since the last step
    gained_m_s: Vec3


# All at vehicle time t_us; 0 stamps: no such sample yet.
RECORD = flat.record(
    [
        ("t_us", "i8"),
        ("p_ned_m", "f8", 3),
        ("v_ned_m_s", "f8", 3),
        ("q_wxyz", "f8", 4),
        ("omega_rad_s", "f8", 3),
        ("P", "f8", (12, 12)),
        ("singular", "?"),
        ("axes", "f8", (6, 3)),  # rows as in Axes
        ("axes_us", "i8"),  # of the observers' last step
        ("thrust_m_s2", "f8"),  # behind the rotors' lag
        ("fast_m_s2", "f8", 3),  # the accelerometer's part of the disturbance
        ("offset_m", "f8", 3),
        ("attitude_us", "i8"),
        ("position_us", "i8"),
        ("imu_us", "i8"),
        *applied_thrust.FIELDS,
    ]
)


def start(gains: ekf.EkfGains) -> np.ndarray:
    """The bytes of a record: nothing heard yet."""
    out = np.zeros(1, RECORD)
    first = ekf.init(gains, ekf.NOTHING)
    out["q_wxyz"], out["P"], out["thrust_m_s2"] = first.q_wxyz, first.P, applied_thrust.G_M_S2
    applied_thrust.start(out)
    return out.view(np.uint8)


@kernel
def known(model: ekf.Vehicle, q: Quat, thrust_m_s2: float, v: Vec3) -> Vec3:
    """g e3 - T R e3 - drag v."""
    up = quat.rotate(q, (0.0, 0.0, thrust_m_s2))
    d = model.drag_1_s
    return (-up[0] - d * v[0], -up[1] - d * v[1], model.gravity_m_s2 - up[2] - d * v[2])


@kernel
def carry(
    gains: ekf.EkfGains, state: ekf.EkfState, axes: Axes, thrust_m_s2: float, fast: Vec3, use_filter: bool, dt_s: float
) -> tuple[ekf.EkfState, Axes]:
    """Filter and observers over dt of a constant thrust along the attitude: (filter, observers)."""
    f = (axes.z3[0] + fast[0], axes.z3[1] + fast[1], axes.z3[2] + fast[2])
    v = state.v_ned_m_s if use_filter else axpy(1.0, axes.gained_m_s, axes.z2)
    if use_filter:
        ahead = ekf.predict(gains, state, (thrust_m_s2, (0.0, 0.0, 0.0), f, (0.0, 0.0, 0.0)), dt_s)
    else:
        q = quat.integrate(state.q_wxyz, state.omega_rad_s, dt_s)
        ahead = ekf.EkfState(state.p_ned_m, state.v_ned_m_s, q, state.omega_rad_s, state.P, state.singular)
    a = axpy(0.5, known(gains, state.q_wxyz, thrust_m_s2, v), (0.0, 0.0, 0.0))
    a = axpy(0.5, known(gains, ahead.q_wxyz, thrust_m_s2, v), axpy(1.0, a, fast))
    moved = axpy(0.5 * dt_s * dt_s, a, axpy(dt_s, axes.gained_m_s, axes.moved_m))
    return ahead, Axes(axes.z1, axes.z2, axes.z3, axes.rate, moved, axpy(dt_s, a, axes.gained_m_s))


@kernel
def observed(axes: Axes, y: Vec3, w0: Vec3, tau_f_s: float, butterworth: bool, dt_s: float) -> Axes:
    """The three observers at a sample y, dt after the last: current form, with the known motion as it was."""
    z1, z2, z3, rate = axes.z1, axes.z2, axes.z3, axes.rate
    alpha = dt_s / (tau_f_s + dt_s)
    for i in range(3):
        L = leso.closed_form(min(w0[i], leso.MAX_W0_DT / dt_s), dt_s, butterworth)
        p = axes.z1[i] + dt_s * axes.z2[i] + 0.5 * dt_s * dt_s * axes.z3[i] + axes.moved_m[i]
        e = y[i] - p
        if not math.isfinite(e):
            e = 0.0
        v = axes.z2[i] + dt_s * axes.z3[i] + axes.gained_m_s[i]
        slope = L[2] * e / dt_s
        z1 = _put(z1, i, p + L[0] * e)
        z2 = _put(z2, i, v + L[1] * e)
        z3 = _put(z3, i, axes.z3[i] + L[2] * e)
        rate = _put(rate, i, axes.rate[i] + alpha * (slope - axes.rate[i]))
    return Axes(z1, z2, z3, rate, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


@kernel
def _put(v: Vec3, i: int, x: float) -> Vec3:
    if i == 0:
        return (x, v[1], v[2])
    if i == 1:
        return (v[0], x, v[2])
    return (v[0], v[1], x)


@kernel
def compensated(axes: Axes, w0: Vec3, feedforward: float, lead_s: float, butterworth: bool) -> Vec3:
    """z3 with what it lags behind under its present rate, and led by lead_s."""
    orders = 2.0 if butterworth else 3.0
    x = feedforward * orders
    return (
        axes.z3[0] + (x / w0[0] + lead_s) * axes.rate[0],
        axes.z3[1] + (x / w0[1] + lead_s) * axes.rate[1],
        axes.z3[2] + (x / w0[2] + lead_s) * axes.rate[2],
    )


# ---- on a record's item: g of the gains' record, s of the state's; changed in place --------------------------------------
@kernel
def _filter_gains(g):
    e = g.ekf
    return ekf.EkfGains(e.gravity_m_s2, e.drag_1_s, flat.vec3(e.inertia_kg_m2), e.rate_drag_nm_s, e.noise[:])


@kernel
def _filter(s):
    q = (s.q_wxyz[0], s.q_wxyz[1], s.q_wxyz[2], s.q_wxyz[3])
    return ekf.EkfState(flat.vec3(s.p_ned_m), flat.vec3(s.v_ned_m_s), q, flat.vec3(s.omega_rad_s), s.P[:], s.singular)


@kernel
def _keep_filter(s, state):
    flat.put3(s.p_ned_m, state.p_ned_m)
    flat.put3(s.v_ned_m_s, state.v_ned_m_s)
    flat.put3(s.omega_rad_s, state.omega_rad_s)
    for i in range(4):
        s.q_wxyz[i] = state.q_wxyz[i]
    s.P[:] = state.P
    s.singular = state.singular


@kernel
def _axes(s):
    a = s.axes
    return Axes(flat.vec3(a[0]), flat.vec3(a[1]), flat.vec3(a[2]), flat.vec3(a[3]), flat.vec3(a[4]), flat.vec3(a[5]))


@kernel
def _keep_axes(s, axes):
    flat.put3(s.axes[0], axes.z1)
    flat.put3(s.axes[1], axes.z2)
    flat.put3(s.axes[2], axes.z3)
    flat.put3(s.axes[3], axes.rate)
    flat.put3(s.axes[4], axes.moved_m)
    flat.put3(s.axes[5], axes.gained_m_s)


@kernel
def _to(g, s, t_us):
    """All at t, if that is ahead."""
    dt_s = 1e-6 * (t_us - s.t_us)
    if dt_s <= 0.0:
        return
    if s.t_us == 0 or dt_s > _COAST_S:
        s.t_us, s.axes_us = t_us, t_us
        return
    wanted = applied_thrust.acting(s, t_us, g.echo)
    now = wanted + math.exp(-dt_s / g.thrust_lag_s) * (s.thrust_m_s2 - wanted)
    mean = wanted + (s.thrust_m_s2 - now) * g.thrust_lag_s / dt_s
    s.t_us, s.thrust_m_s2 = t_us, now
    state = _filter(s)
    if s.position_us == 0:  # nothing to carry but the attitude, and no disturbance to learn
        s.axes_us = t_us
        turned = quat.integrate(state.q_wxyz, state.omega_rad_s, dt_s)
        for i in range(4):
            s.q_wxyz[i] = turned[i]
        return
    moved, axes = carry(_filter_gains(g), state, _axes(s), mean, flat.vec3(s.fast_m_s2), g.use_filter, dt_s)
    _keep_filter(s, moved)
    _keep_axes(s, axes)


@kernel
def _update(g, s, p, v, eta, w):
    """A measurement absorbed by the filter, NaN where there is none."""
    _keep_filter(s, ekf.update(_filter_gains(g), _filter(s), p + v + eta + w))


@kernel
def _age_s(s, stamp_us):
    return 1e-6 * max(0, s.t_us - stamp_us)


@kernel
def hear_attitude(g, s, t_us, q, w):
    """An attitude with rates; False where it is not finite, repeated or far too late."""
    if t_us <= s.attitude_us or not (finite3(w) and math.isfinite(q[0] + q[1] + q[2] + q[3])):
        return False
    first = s.attitude_us == 0
    _to(g, s, t_us)
    age_s = _age_s(s, t_us)
    if age_s > _LATE_S:
        return False
    q = quat.integrate(q, w, age_s)
    if first or not g.use_filter:
        for i in range(4):
            s.q_wxyz[i] = q[i]
        flat.put3(s.omega_rad_s, w)
    else:
        _update(g, s, _NAN3, _NAN3, quat.to_euler(q), w)
    s.attitude_us = t_us
    return True


@kernel
def hear_position(g, s, t_us, p, v):
    """A position with its velocity; False where it is not finite, repeated or far too late."""
    if t_us <= s.position_us or not finite3(p):
        return False
    if s.position_us == 0 or 1e-6 * (t_us - s.position_us) > _COAST_S:
        _place(g, s, t_us, p, v)
        return True
    _to(g, s, t_us)
    age_s = _age_s(s, t_us)
    if age_s > _LATE_S:
        return False
    x = _axes(s)
    speed = flat.vec3(s.v_ned_m_s) if g.use_filter else axpy(1.0, x.gained_m_s, x.z2)
    thrust = known(_filter_gains(g), _filter(s).q_wxyz, s.thrust_m_s2, speed)
    a = axpy(1.0, thrust, axpy(1.0, x.z3, flat.vec3(s.fast_m_s2)))
    p = axpy(age_s, speed, p)  # the sample carried forward to the filter's time
    v = axpy(age_s, a, v)
    y = p
    if g.use_filter:
        _update(g, s, p, v, _NAN3, _NAN3)
        y = flat.vec3(s.p_ned_m)
        if g.anchor_s > 0.0:
            w = 1.0 - math.exp(-1e-6 * (t_us - s.position_us) / g.anchor_s)
            offset = flat.vec3(s.offset_m)
            flat.put3(s.offset_m, axpy(w, axpy(-1.0, offset, axpy(-1.0, y, p)), offset))
    since_s = max(1e-3, 1e-6 * (s.t_us - s.axes_us))
    _keep_axes(s, observed(x, y, flat.vec3(g.w0), g.tau_f_s, g.butterworth, since_s))
    s.axes_us, s.position_us = s.t_us, t_us
    return True


@kernel
def _place(g, s, t_us, p, v):
    """Begin, or begin again after a silence, at a position; the disturbance is kept, its rate is not."""
    if not finite3(v):
        v = _ZERO3
    for i in range(6):
        for j in range(12):
            s.P[i, j] = 0.0
            s.P[j, i] = 0.0
    for i in range(6):
        s.P[i, i] = g.ekf.noise[ekf.P0, i]
    flat.put3(s.p_ned_m, p)
    flat.put3(s.v_ned_m_s, v)
    _keep_axes(s, Axes(p, v, flat.vec3(s.axes[2]), _ZERO3, _ZERO3, _ZERO3))
    flat.put3(s.offset_m, _ZERO3)
    s.t_us = max(s.t_us, t_us)
    s.axes_us, s.position_us = s.t_us, t_us


@kernel
def hear_imu(g, s, t_us, accel, gyro):
    """The gyro where no attitude with rates comes; the accelerometer where it is asked for. False where neither is."""
    if t_us <= s.imu_us:
        return False
    silent = s.attitude_us == 0 or t_us - s.attitude_us > 100_000
    if not silent and g.accel_tau_s == 0.0:
        return False
    _to(g, s, t_us)
    if _age_s(s, t_us) > _LATE_S:
        return False
    if silent and finite3(gyro):
        if g.use_filter:
            _update(g, s, _NAN3, _NAN3, _NAN3, gyro)
        else:
            flat.put3(s.omega_rad_s, gyro)
    if g.accel_tau_s > 0.0 and s.position_us > 0 and finite3(accel):
        gains, state = _filter_gains(g), _filter(s)
        felt = axpy(1.0, quat.rotate(state.q_wxyz, accel), (0.0, 0.0, gains.gravity_m_s2))
        rest = axpy(-1.0, known(gains, state.q_wxyz, s.thrust_m_s2, state.v_ned_m_s), felt)
        since_s = 1e-6 * (t_us - s.imu_us) if s.imu_us > 0 else 0.0
        w = 1.0 - math.exp(-min(since_s, _COAST_S) / g.accel_tau_s)
        fast = flat.vec3(s.fast_m_s2)
        flat.put3(s.fast_m_s2, axpy(w, axpy(-1.0, fast, rest), fast))
    s.imu_us = t_us
    return True


@kernel
def estimate(g, s, t_us, sent_us, thrust_m_s2, delay_s):
    """Remember what was sent and go on to t: (p, v, q, rates, disturbance, delay, thrust), p, v and disturbance NaN where not known."""
    applied_thrust.remember(s, sent_us, thrust_m_s2, delay_s)
    _to(g, s, t_us)
    state = _filter(s)
    q, w = state.q_wxyz, state.omega_rad_s
    if s.position_us == 0 or s.attitude_us == 0:
        return _NAN3, _NAN3, q, w, _NAN3, s.delay_s, s.thrust_m_s2
    x = _axes(s)
    if g.use_filter:
        p, v = axpy(1.0, flat.vec3(s.offset_m), state.p_ned_m), state.v_ned_m_s
    else:
        since_s = 1e-6 * (s.t_us - s.axes_us)
        p = axpy(1.0, axpy(0.5 * since_s * since_s, x.z3, x.moved_m), axpy(since_s, x.z2, x.z1))
        v = axpy(1.0, axpy(since_s, x.z3, x.gained_m_s), x.z2)
    f = compensated(x, flat.vec3(g.w0), g.feedforward, g.lead_s, g.butterworth)
    f = axpy(-g.ekf.drag_1_s, v, axpy(1.0, f, flat.vec3(s.fast_m_s2)))
    return p, v, q, w, f, s.delay_s, s.thrust_m_s2


# ---- on records: what was handed in stays as it was --------------------------------------------------------------------
@kernel
def with_attitude(gains, state, t_us, q, w):
    """(whether it was taken, the record with an attitude)."""
    out = state.copy()
    return hear_attitude(gains[0], out.view(RECORD)[0], t_us, q, w), out


@kernel
def with_position(gains, state, t_us, p, v):
    """(whether it was taken, the record with a position)."""
    out = state.copy()
    return hear_position(gains[0], out.view(RECORD)[0], t_us, p, v), out


@kernel
def with_imu(gains, state, t_us, accel, gyro):
    """(whether it was taken, the record with an accelerometer's and a gyro's sample)."""
    out = state.copy()
    return hear_imu(gains[0], out.view(RECORD)[0], t_us, accel, gyro), out


@kernel
def with_echo(state, t_us, collective):
    """The record with the autopilot's echo of a setpoint."""
    out = state.copy()
    applied_thrust.hear(out.view(RECORD)[0], t_us, collective)
    return out


@kernel
def with_sent(gains, state, t_us, sent_us, thrust_m_s2, delay_s):
    """(the record at t with what was sent, `estimate`)."""
    out = state.copy()
    return out, estimate(gains[0], out.view(RECORD)[0], t_us, sent_us, thrust_m_s2, delay_s)
