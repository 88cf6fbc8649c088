"""One flight of the whole cascade as compiled steps: sense, want, act. `fly` runs them in one loop, the QP runs between them.

Every estimate and control step is mavquad's own; this file only sets the order of one control period (10 ms): measure, correct,
control from the estimate, limit, allocate, predict with what was really applied, and move the plant ten steps.
"""

import math
from typing import NamedTuple

import numpy as np

from mavquad.control import adrc, attitude_mpc, mpc
from mavquad.control.adrc import HanGains
from mavquad.control.attitude_mpc import AttitudeGains
from mavquad.control.mpc import MpcGains
from mavquad.estimate import extended_state_kf as eskf
from mavquad.jit import kernel
from tools.papers.quad_in_wind import plant
from tools.papers.quad_in_wind.plant import Quad, Work

DT = 0.01
PLANT_DT, PLANT_STEPS = 0.001, 10
FILTER, HAN, LINEAR = 0, 1, 2  # estimators
YAW_REF = 0.0


class Flight(NamedTuple):
    """What one configuration is. Gains schedules are (S, 6): row k, the last one held."""

    quad: Quad
    mpc: MpcGains
    attitude: AttitudeGains
    han: HanGains
    han_yaw: HanGains
    estimator: int
    posterior: bool  # control from X(k|k), not from X(k|k-1)
    k_position: np.ndarray
    k_angle: np.ndarray
    compensate_angles: bool
    lead_s: float  # the acceleration reference is read this much ahead
    printed_targets: bool
    delay_steps: int  # the outer command acts this late
    predict: bool
    slew_m_s3: float  # 0: none


class Loop(NamedTuple):
    """Everything that changes in flight, as arrays."""

    x: np.ndarray  # (13,) plant
    motors: np.ndarray  # (4,) N
    command: np.ndarray  # (4,) N
    est: np.ndarray  # (6,3) n e d roll pitch yaw: prior, then posterior
    prior: np.ndarray  # (6,3)
    y: np.ndarray  # (6,2) as measured
    integral: np.ndarray  # (3,)
    inputs: np.ndarray  # (n+1,3) U, ux, uy under way, oldest first; row 0 acted in the last period
    queue: np.ndarray  # (n+1,3) the accelerations they mean
    last: np.ndarray  # (3,) thrust acceleration last commanded
    error: np.ndarray  # (3,3) [p, v, integral] error per axis
    td: np.ndarray  # (3,2) tracking differentiators of the ADRC
    wanted: np.ndarray  # (3,) roll, pitch, yaw
    u_applied: np.ndarray  # (1,)
    f_true: np.ndarray  # (6,)
    targets: np.ndarray  # (3,N,2)
    target_inputs: np.ndarray  # (3,N)
    work: Work


def loop(flight: Flight, p_ned_m: tuple[float, float, float], yaw_rad: float) -> Loop:
    """At rest at p, level; filters at the truth, f = 0; hover commands under way."""
    n = flight.delay_steps
    weight = flight.quad.mass_kg * flight.mpc.gravity
    x = np.zeros(13)
    x[:3], x[6], x[9] = p_ned_m, math.cos(0.5 * yaw_rad), math.sin(0.5 * yaw_rad)
    est = np.zeros((6, 3))
    est[:3, 0], est[5, 0] = p_ned_m, yaw_rad
    inputs = np.zeros((n + 1, 3))
    inputs[:, 0] = weight
    td = np.zeros((3, 2))
    td[2, 0] = yaw_rad
    hover = np.full(4, weight / 4.0)
    return Loop(
        x=x,
        motors=hover.copy(),
        command=hover.copy(),
        est=est,
        prior=est.copy(),
        y=np.zeros((6, 2)),
        integral=np.zeros(3),
        inputs=inputs,
        queue=np.zeros((n + 1, 3)),
        last=np.zeros(3),
        error=np.zeros((3, 3)),
        td=td,
        wanted=np.zeros(3),
        u_applied=np.array([weight]),
        f_true=np.zeros(6),
        targets=np.zeros((3, flight.mpc.horizon, 2)),
        target_inputs=np.zeros((3, flight.mpc.horizon)),
        work=plant.work(),
    )


@kernel
def reference(t):
    """The paper's spiral, NED: position, velocity, acceleration."""
    w = math.pi / 20.0
    c, s = math.cos(w * t), math.sin(w * t)
    return (
        (0.5 * c, 0.5 * s, -(3.0 - 2.0 * c)),
        (-0.5 * w * s, 0.5 * w * c, -2.0 * w * s),
        (-0.5 * w * w * c, -0.5 * w * w * s, -2.0 * w * w * c),
    )


@kernel
def euler(x):
    """(roll, pitch, yaw) and their rates of a plant state."""
    q0, q1, q2, q3 = x[6], x[7], x[8], x[9]
    roll = math.atan2(2.0 * (q0 * q1 + q2 * q3), 1.0 - 2.0 * (q1 * q1 + q2 * q2))
    pitch = math.asin(min(1.0, max(-1.0, 2.0 * (q0 * q2 - q3 * q1))))
    yaw = math.atan2(2.0 * (q0 * q3 + q1 * q2), 1.0 - 2.0 * (q2 * q2 + q3 * q3))
    cr, sr = math.cos(roll), math.sin(roll)
    side = x[11] * sr + x[12] * cr
    return (roll, pitch, yaw), (x[10] + side * math.tan(pitch), x[11] * cr - x[12] * sr, side / math.cos(pitch))


@kernel
def lost(x):
    """Tilt above 80 deg, or more than 60 m away."""
    tilt = 1.0 - 2.0 * (x[7] * x[7] + x[8] * x[8])
    return not (tilt > math.cos(math.radians(80.0)) and abs(x[0]) + abs(x[1]) + abs(x[2]) < 60.0)


@kernel
def sense(fl, lp, k, noise):
    """Measure (noise (12,): p, v, angles, angle rates) and correct the estimate."""
    angles, rates = euler(lp.x)
    for i in range(3):
        lp.y[i, 0] = lp.x[i] + noise[i]
        lp.y[i, 1] = lp.x[3 + i] + noise[3 + i]
        lp.y[3 + i, 0] = angles[i] + noise[6 + i]
        lp.y[3 + i, 1] = rates[i] + noise[9 + i]
    lp.y[5, 0] = lp.est[5, 0] + attitude_mpc.wrap(lp.y[5, 0] - lp.est[5, 0])
    lp.prior[:] = lp.est
    if fl.estimator == FILTER:
        for i in range(6):
            gains = fl.k_position if i < 3 else fl.k_angle
            g = gains[min(k, gains.shape[0] - 1)]
            x = eskf.correct(
                (g[0], g[1], g[2], g[3], g[4], g[5]), (lp.est[i, 0], lp.est[i, 1], lp.est[i, 2]), lp.y[i, 0], lp.y[i, 1]
            )
            lp.est[i, 0], lp.est[i, 1], lp.est[i, 2] = x


@kernel
def acting(fl, lp):
    """The (6,3) estimate the control acts on: posterior, prior, or an ESO's with positions and angles as measured."""
    if fl.estimator == FILTER:
        return lp.est if fl.posterior else lp.prior
    out = lp.est.copy()
    for i in range(6):
        out[i, 0] = lp.y[i, 0]
    return out


@kernel
def direction(angles):
    """(u_x, u_y, cos roll cos pitch): R e3."""
    sr, cr = math.sin(angles[0]), math.cos(angles[0])
    sp, cp = math.sin(angles[1]), math.cos(angles[1])
    sy, cy = math.sin(angles[2]), math.cos(angles[2])
    return cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr


@kernel
def want(fl, lp, t):
    """The thrust acceleration the closed form wants; leaves the error for the QP."""
    g = fl.mpc
    e = acting(fl, lp)
    p, v = (e[0, 0], e[1, 0], e[2, 0]), (e[0, 1], e[1, 1], e[2, 1])
    f = (mpc.clip(e[0, 2], g.f_max), mpc.clip(e[1, 2], g.f_max), mpc.clip(e[2, 2], g.f_max))
    ux, uy, cos_tilt = direction((e[3, 0], e[4, 0], e[5, 0]))
    n = fl.delay_steps
    if fl.predict and n > 0:
        s = lp.u_applied[0] / g.mass_kg
        next_ux, next_uy, _ = direction((e[3, 0] + DT * e[3, 1], e[4, 0] + DT * e[4, 1], e[5, 0] + DT * e[5, 1]))
        a_now = (-s * ux, -s * uy, g.gravity - s * cos_tilt)
        j_now = (-s * (next_ux - ux) / DT, -s * (next_uy - uy) / DT, 0.0)
        p, v = mpc.ahead(p, v, a_now, j_now, f, lp.queue[1:], n, DT, g.response)
        t += n * DT
    pr, vr, ar = reference(t)
    ar = reference(t + fl.lead_s)[2]
    if fl.printed_targets:
        _printed_targets(fl, lp, t, pr, vr)
    for i in range(3):
        lp.error[i, 0], lp.error[i, 1], lp.error[i, 2] = p[i] - pr[i], v[i] - vr[i], lp.integral[i]
    integral = (lp.integral[0], lp.integral[1], lp.integral[2])
    return mpc.demand(g, p, v, f, pr, vr, ar, integral, max(mpc.COS_FLOOR, cos_tilt), lp.targets, lp.target_inputs)


@kernel
def _printed_targets(fl, lp, t, pr, vr):
    """The increments of Eq. (13), inputs in accelerations."""
    before = reference(t - DT)[2]
    for j in range(fl.mpc.horizon):
        p, v, _ = reference(t + (j + 1) * DT)
        a = reference(t + j * DT)[2]
        for i in range(3):
            lp.targets[i, j, 0] = p[i] - pr[i]
            lp.targets[i, j, 1] = v[i] - vr[i]
            lp.target_inputs[i, j] = a[i] - before[i]


@kernel
def act(fl, lp, a, busy, wind):
    """Limit the wanted acceleration, send it, close the attitude loop, predict the estimate, move the plant.

    busy: the QP holds a constraint. Returns whether any input was limited.
    """
    g, quad = fl.mpc, fl.quad
    e = acting(fl, lp)
    angles, rates = (e[3, 0], e[4, 0], e[5, 0]), (e[3, 1], e[4, 1], e[5, 1])
    ux, uy, cos_true = direction(angles)
    cos_tilt = max(mpc.COS_FLOOR, cos_true)
    out = mpc.thrust(g, a, cos_tilt)
    limited = mpc.acceleration(g, out, cos_tilt)
    saturated = out.saturated
    if fl.slew_m_s3 > 0.0:
        limited, bit = mpc.slew(limited, (lp.last[0], lp.last[1], lp.last[2]), fl.slew_m_s3, DT)
        out = mpc.thrust(g, limited, cos_tilt)
        limited = mpc.acceleration(g, out, cos_tilt)
        saturated = saturated or bit
    lp.last[0], lp.last[1], lp.last[2] = limited
    # the command under way
    n = fl.delay_steps
    for i in range(n):
        lp.inputs[i] = lp.inputs[i + 1]
        lp.queue[i] = lp.queue[i + 1]
    lp.inputs[n, 0], lp.inputs[n, 1], lp.inputs[n, 2] = out.u_n, out.ux, out.uy
    lp.queue[n, 0], lp.queue[n, 1], lp.queue[n, 2] = limited
    roll, pitch = mpc.angles(lp.inputs[0, 1], lp.inputs[0, 2], angles[2])
    lp.wanted[0], lp.wanted[1], lp.wanted[2] = roll, pitch, YAW_REF
    # attitude
    if fl.estimator == HAN:
        v0 = (_han_angle(fl.han, lp, 0), _han_angle(fl.han, lp, 1), _han_angle(fl.han_yaw, lp, 2))
    else:
        v0 = attitude_mpc.angular(fl.attitude, angles, rates, (roll, pitch, YAW_REF))
        if fl.compensate_angles:
            v0 = (v0[0] - e[3, 2], v0[1] - e[4, 2], v0[2] - e[5, 2])
    inertia = (quad.ix_kg_m2, quad.iy_kg_m2, quad.iz_kg_m2)
    tau = attitude_mpc.torque(inertia, v0, rates)
    u, tx, ty, tz = plant.allocate(quad, lp.inputs[0, 0], tau[0], tau[1], tau[2], lp.command)
    lp.u_applied[0] = u
    # what was applied, as accelerations
    s = u / quad.mass_kg
    ix, iy, iz = inertia
    p, q, r = rates
    applied = (
        -s * ux,
        -s * uy,
        g.gravity - s * cos_true,
        (tx + (iy - iz) * q * r) / ix,
        (ty + (iz - ix) * p * r) / iy,
        (tz + (ix - iy) * p * q) / iz,
    )
    _predict(fl, lp, applied)
    error = (lp.error[0, 0], lp.error[1, 0], lp.error[2, 0])
    saturated = saturated or busy
    if g.integral:
        integral = mpc.integrate((lp.integral[0], lp.integral[1], lp.integral[2]), error, DT, saturated)
        lp.integral[0], lp.integral[1], lp.integral[2] = integral
    plant.advance(quad, lp.x, lp.motors, lp.command, wind, PLANT_DT, PLANT_STEPS, lp.work, lp.f_true)
    return saturated


@kernel
def _predict(fl, lp, applied):
    for i in range(6):
        x = (lp.est[i, 0], lp.est[i, 1], lp.est[i, 2])
        if fl.estimator == FILTER:
            x = eskf.predict(x, applied[i], DT)
        elif fl.estimator == HAN:
            x = adrc.observe(fl.han, x, lp.y[i, 0], applied[i])
        else:
            g = fl.k_position[0] if i < 3 else fl.k_angle[0]
            e = lp.y[i, 0] - x[0]
            x = eskf.predict(x, applied[i], DT)
            x = (x[0] + g[0] * e, x[1] + g[1] * e, x[2] + g[2] * e)
        lp.est[i, 0], lp.est[i, 1], lp.est[i, 2] = x


@kernel
def _han_angle(g, lp, i):
    """Nonlinear feedback of one angle, its disturbance cancelled; the tracking differentiator then steps on."""
    x = (lp.td[i, 0], lp.td[i, 1])
    v = adrc.feedback(g, x, (lp.est[3 + i, 0], lp.est[3 + i, 1], lp.est[3 + i, 2]))
    lp.td[i, 0], lp.td[i, 1] = adrc.differentiate(g, x, lp.wanted[i])
    return v


COLUMNS = 31  # t; p 3; reference 3; angles 3; wanted 3; y 6 (p, angles); f estimated 6; f true 6


@kernel
def record(lp, t, row):
    """One line of the log, before `act`; f true belongs to the interval that ends at t."""
    angles, _ = euler(lp.x)
    pr = reference(t)[0]
    row[0] = t
    for i in range(3):
        row[1 + i] = lp.x[i]
        row[4 + i] = pr[i]
        row[7 + i] = angles[i]
        row[10 + i] = lp.wanted[i]
        row[13 + i] = lp.y[i, 0]
        row[16 + i] = lp.y[3 + i, 0]
    for i in range(6):
        row[19 + i] = lp.est[i, 2]
        row[25 + i] = lp.f_true[i]


@kernel
def fly(fl, lp, noise, wind, log):
    """A whole flight: noise (steps,12), wind (steps,5), log (steps, COLUMNS). Returns the steps flown before it was lost."""
    for k in range(len(log)):
        if lost(lp.x):
            return k
        t = k * DT
        sense(fl, lp, k, noise[k])
        a = want(fl, lp, t)
        record(lp, t, log[k])
        act(fl, lp, a, False, wind[k])
    return len(log)
