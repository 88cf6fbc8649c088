"""One closed-loop run of the IADRC paper's cascade, fused: plant, sensors, joint observer, law, mixer, applied-input model."""

import math
from typing import NamedTuple

import numpy as np

from mavquad import quat
from mavquad.control import iadrc
from mavquad.estimate import ekf, joint
from mavquad.jit import kernel
from tools.papers.joint_observer import augmented
from tools.papers.joint_observer.plant import Plant, Truth, advance

ESO, AUGMENTED = 0, 1


class Law(NamedTuple):
    """The cascade's settings, and which of the note's variants it is."""

    body: iadrc.Body
    wc_position: tuple[float, float, float]
    wc_attitude: tuple[float, float, float]
    command_filter_rad_s: float
    tilt_max_rad: float
    estimator: int  # ESO or AUGMENTED
    states_from_ekf: bool
    cancel: bool  # False: PD
    feed_applied: bool  # False: the observers are told the unlimited wish (negative control)
    motor_model: bool
    indi_rad_s: float  # > 0: torque disturbance from the gyro's slope, filtered with this bandwidth
    latency: int  # samples between a measurement and the law
    delayed_input: bool  # the observers' input is delayed likewise


class Run(NamedTuple):
    """What a run leaves, one row per control period."""

    truth: np.ndarray  # (n,12) p v eta w
    used: np.ndarray  # (n,12) the state the law used
    f: np.ndarray  # (n,6) the disturbance the law used
    rotors: np.ndarray  # (n,4) commands after limits
    reference: np.ndarray  # (n,3) filtered attitude reference


@kernel
def _butterworth(w: float, dt_s: float, x: tuple[float, float], u: float) -> tuple[float, float]:
    """Second-order Butterworth low-pass, semi-implicit: (output, its rate) after dt."""
    rate = (x[1] + dt_s * w * w * (u - x[0])) / (1.0 + math.sqrt(2.0) * w * dt_s + w * w * dt_s * dt_s)
    return (x[0] + dt_s * rate, rate)


@kernel
def _row(z: np.ndarray) -> ekf.Row12:
    return (z[0], z[1], z[2], z[3], z[4], z[5], z[6], z[7], z[8], z[9], z[10], z[11])


@kernel
def fly(
    plant: Plant,
    law: Law,
    gains: joint.JointGains,
    aug: augmented.AugmentedGains,
    reference: np.ndarray,  # (n,6) position and velocity
    disturbance: np.ndarray,  # (n,6) force over mass, torque over inertia, held over the period
    noise: np.ndarray,  # (n,12) p v eta w; NaN where there is no such sensor
    dt_s: float,
) -> Run:
    """Fly the whole scenario from rest at the origin."""
    n = noise.shape[0]
    body, model = law.body, gains.ekf
    run = Run(np.empty((n, 12)), np.empty((n, 12)), np.empty((n, 6)), np.empty((n, 4)), np.empty((n, 3)))
    hover = 0.25 * plant.body.mass_kg * plant.body.gravity_m_s2
    x = Truth((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), quat.IDENTITY, (0.0, 0.0, 0.0), (hover, hover, hover, hover))
    measured = np.empty((n, 12))
    inputs = np.zeros((n, 4))  # applied T/m and torque
    known = np.zeros((n, 6))
    still = iadrc.CommandFilter(0.0, 0.0, 0.0)
    roll, pitch = still, still
    base = 0.25 * body.mass_kg * body.gravity_m_s2
    motors = (base, base, base, base)
    zero3 = (0.0, 0.0, 0.0)
    state = joint.init(gains, _row(np.zeros(12)))
    wide = augmented.init(aug, _row(np.zeros(12)))
    turned, indi = np.zeros(3), np.zeros((3, 2))  # the gyro before, and the filtered difference of its slope and the input
    for k in range(n):
        eta_true = quat.to_euler(x.q_wxyz)
        true = x.p_ned_m + x.v_ned_m_s + eta_true + x.omega_rad_s
        for i in range(12):
            run.truth[k, i] = true[i]
            measured[k, i] = true[i] + noise[k, i]
        z = _row(measured[max(k - law.latency, 0)])
        j = k - 1 - (law.latency if law.delayed_input else 0)
        if k == 0:
            state = joint.init(gains, z)
            wide = augmented.init(aug, z)
        else:
            thrust, torque, a = body.gravity_m_s2, zero3, np.zeros(6)
            if j >= 0:
                thrust, torque, a = inputs[j, 0], (inputs[j, 1], inputs[j, 2], inputs[j, 3]), known[j]
            if law.estimator == AUGMENTED:
                wide = augmented.step(aug, wide, thrust, torque, z, dt_s)
            else:
                state = joint.step(gains, state, thrust, torque, a, z, dt_s)
        if law.estimator == AUGMENTED:
            est = augmented.read(wide)
        else:
            est = joint.read(gains, state, law.states_from_ekf)
        f, tau = est.f_ned_m_s2, est.tau_rad_s2
        if law.indi_rad_s > 0.0:
            for i in range(3):
                slope = (z[9 + i] - turned[i]) / dt_s if k > 0 else 0.0
                acted = known[k - 1, 3 + i] if k > 0 else 0.0
                indi[i, 0], indi[i, 1] = _butterworth(law.indi_rad_s, dt_s, (indi[i, 0], indi[i, 1]), slope - acted)
                turned[i] = z[9 + i]
            tau = (indi[0, 0], indi[1, 0], indi[2, 0])
        if not law.cancel:
            f, tau = zero3, zero3
        used = est.p_ned_m + est.v_ned_m_s + est.eta_rad + est.omega_rad_s
        for i in range(12):
            run.used[k, i] = used[i]
        for i in range(3):
            run.f[k, i], run.f[k, 3 + i] = f[i], tau[i]
        wished = 8.0 / body.mass_kg
        if not plant.fixed:
            r = reference[k]
            want = iadrc.position_law(
                law.wc_position, est.p_ned_m, est.v_ned_m_s, f, (r[0], r[1], r[2]), (r[3], r[4], r[5]), zero3
            )
            force = iadrc.limit_force(body, want, est.v_ned_m_s, law.tilt_max_rad)
            wished, phi, theta = iadrc.thrust_and_angles(force, est.eta_rad[2])
            roll = iadrc.filter_command(roll, phi, law.command_filter_rad_s, dt_s)
            pitch = iadrc.filter_command(pitch, theta, law.command_filter_rad_s, dt_s)
        run.reference[k, 0], run.reference[k, 1], run.reference[k, 2] = roll.angle, pitch.angle, 0.0
        torque = iadrc.attitude_law(body, law.wc_attitude, est.eta_rad, est.omega_rad_s, tau, (roll, pitch, still))
        command = iadrc.mix(body, body.mass_kg * wished, torque)
        for i in range(4):
            run.rotors[k, i] = command[i]
        mean = command
        if law.motor_model:
            motors, mean = iadrc.lag(motors, command, body.motor_lag_s, dt_s)
        total, applied = iadrc.unmix(body, mean)
        inputs[k, 0], inputs[k, 1], inputs[k, 2], inputs[k, 3] = total / body.mass_kg, applied[0], applied[1], applied[2]
        known[k] = joint.known_acceleration(model, est.eta_rad, est.v_ned_m_s, est.omega_rad_s, inputs[k, 0], applied)
        if not law.feed_applied and not plant.fixed:
            for i in range(3):  # what the law wished for, before any limit
                known[k, i] = want[i]
        d = disturbance[k]
        x = advance(plant, x, command, (d[0], d[1], d[2]), (d[3], d[4], d[5]), dt_s)
    return run
