"""The quadrotor of the design note of the ASMF, section 8: PD, PI, INDI-like, a Kalman active model and the ASMF, same air.

Truth: mass +20 %, attitude answer of second order (12 rad/s, 0.8, gain 0.95, bias 1.5 deg, 20 ms late), thrust lag 0.05 s, rotor
drag, wind. Plant at 200 Hz (midpoint), loop at 50 Hz, noise uniform at the bounds, velocity at 25 Hz, position known.
"""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from mavquad import linalg, quat
from mavquad.airframe import ModelBounds
from mavquad.compensate import active_model
from mavquad.estimate import command_line, quad_error
from mavquad.jit import kernel
from tools.papers.active import kalman, surroundings

Vec3 = tuple[float, float, float]

DT_S, SUBSTEPS = 0.02, 4
G_M_S2 = 9.80665
PD, PI, INDI, KF, ASMF = range(5)
CONFIGS = {"PD": PD, "PI": PI, "INDI": INDI, "KF": KF, "ASMF": ASMF}
KP, KV, KI = 1.6, 2.2, 0.5
TILT_MAX_RAD, THRUST_MAX_M_S2 = math.radians(40.0), 2.0 * G_M_S2
SCORED_FROM_S = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One scenario: path, air, vehicle, faults. Everything random comes from the seed."""

    path: surroundings.Path
    gust_m_s: float = 1.5
    mass_factor: float = 1.2
    delay_s: float = 0.02
    lead_s: float = 0.0  # how far ahead the path's acceleration is read
    spikes: float = 0.0  # share of velocity samples that are off by +-2.5 m/s
    dropout_s: tuple[float, float] = (math.inf, math.inf)  # no velocity between these times
    imu: bool = True
    bounds: ModelBounds = field(default_factory=ModelBounds)
    mode: str = "centre"
    model_delay_s: float = 0.0


class Flown(NamedTuple):
    error_m: np.ndarray  # (N, 3) NED, path minus truth
    f: np.ndarray  # (N, 3) estimate of the model error
    f_true: np.ndarray  # (N, 3)
    low: np.ndarray  # (N, 3) published interval
    high: np.ndarray  # (N, 3)
    half_width: np.ndarray  # (N, 3) of the ellipsoid alone
    p_m: np.ndarray  # (N, 3) truth
    guarantee: np.ndarray  # (N,)
    empty: int
    inflations: int


class Truth(NamedTuple):
    p: Vec3
    v: Vec3
    roll: float
    pitch: float
    roll_rate: float
    pitch_rate: float
    thrust: float  # specific, as it acts


def fly(config: str, case: Case, seed: int) -> Flown:
    """One flight."""
    n = case.path.p_m.shape[0]
    rng = np.random.default_rng(seed)
    air = surroundings.wind(rng, SUBSTEPS * n + 1, DT_S / SUBSTEPS, gust_m_s=case.gust_m_s)
    e = ModelBounds()
    size = np.array([e.e_attitude_rad] * 3 + [e.e_velocity_m_s] * 3 + [e.e_acceleration_m_s2] * 3)
    noise = rng.uniform(-1.0, 1.0, (n, 9)) * size
    hit = rng.uniform(size=n) < case.spikes
    noise[:, 3:6] += np.where(hit[:, None], rng.choice([-2.5, 2.5], (n, 3)), 0.0)
    corner = rng.choice([-1.0, 1.0], (n, 3))
    gains = quad_error.gains(quad_error.Params(bounds=case.bounds))
    b, out = case.bounds, np.zeros((n, 22))
    q = np.array([b.b_velocity_m_s] * 3 + [b.b_f_m_s2] * 3 + [b.b_attitude_rad] * 2 + [b.b_f_attitude_rad_s] * 2) ** 2 / 3.0
    state = quad_error.init(gains, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), G_M_S2)
    ahead = np.minimum(np.arange(n) + round(case.lead_s / DT_S), n - 1)
    state = _fly(
        CONFIGS[config],
        active_model.MODES.index(case.mode),
        gains,
        active_model.gains(active_model.Params(mode=case.mode), in_flight=False),
        state,
        command_line.init(np.array([0.0, 0.0, G_M_S2])),
        (case.path.p_m, case.path.v_m_s, case.path.a_m_s2[ahead]),
        air,
        noise,
        corner,
        q,
        (case.mass_factor, case.delay_s, case.model_delay_s),
        case.dropout_s,
        case.imu,
        out,
    )
    return Flown(
        out[:, 0:3],
        out[:, 3:6],
        out[:, 6:9],
        out[:, 9:12],
        out[:, 12:15],
        out[:, 15:18],
        out[:, 18:21],
        out[:, 21] > 0.5,
        state.filter.empty,
        state.filter.inflations,
    )


def metrics(flown: Flown) -> dict[str, tuple[float, str]]:
    """name -> (value, unit), scored from 3 s."""
    first = round(SCORED_FROM_S / DT_S)
    distance = np.linalg.norm(flown.error_m[first:], axis=1)
    f, truth = flown.f[first:], flown.f_true[first:]
    inside = np.all(np.abs(f - truth) <= flown.half_width[first:], axis=1)
    published = np.all((truth >= flown.low[first:]) & (truth <= flown.high[first:]), axis=1)
    return {
        "rms_m": (float(np.sqrt(np.mean(distance**2))), "m"),
        "max_m": (float(distance.max()), "m"),
        "vert_rms": (float(np.sqrt(np.mean(flown.error_m[first:, 2] ** 2))), "m"),
        "inside_pct": (100.0 * float(inside.mean()), "%"),
        "half_width": (float(flown.half_width[first:].mean()), "m/s^2"),
        "published_inside_pct": (100.0 * float(published.mean()), "%"),
        "published_half_width": (float(0.5 * (flown.high[first:] - flown.low[first:]).mean()), "m/s^2"),
        "f_error": (float(np.abs(f - truth).mean()), "m/s^2"),
        "empty": (float(flown.empty), "1"),
        "inflations": (float(flown.inflations), "1"),
    }


@kernel
def _fly(
    config: int,
    mode: int,
    gains: quad_error.Gains,
    correction: active_model.Gains,
    state: quad_error.State,
    sent: command_line.Line,
    path: tuple[np.ndarray, np.ndarray, np.ndarray],
    air: np.ndarray,
    noise: np.ndarray,
    corner: np.ndarray,
    q: np.ndarray,
    vehicle: tuple[float, float, float],
    dropout_s: tuple[float, float],
    imu: bool,
    out: np.ndarray,
) -> quad_error.State:
    mass_factor, delay_s, model_delay_s = vehicle
    p_ref, v_ref, a_ref = path
    truth = Truth((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0, 0.0, 0.0, 0.0, G_M_S2)
    v_measured = (0.0, 0.0, 0.0)
    integral = (0.0, 0.0, 0.0)
    smooth = (0.0, 0.0, 0.0)  # INDI
    x, p, r = state.filter.x.copy(), state.filter.p.copy(), gains.filter.e**2 / 3.0  # Kalman filter
    keep = math.exp(-2.0 * math.pi * 2.0 * DT_S)
    for k in range(p_ref.shape[0]):
        t_s = k * DT_S
        # what is measured now
        w = noise[k]
        attitude = (truth.roll + w[0], truth.pitch + w[1], w[2])
        velocity = (math.nan, math.nan, math.nan)
        if k % 2 == 0 and not dropout_s[0] <= t_s < dropout_s[1]:
            velocity = (truth.v[0] + w[3], truth.v[1] + w[4], truth.v[2] + w[5])
            v_measured = velocity
        body = _specific_force(truth, _at(air, SUBSTEPS * k))
        accel = (math.nan, math.nan, math.nan)
        if imu:
            accel = (body[0] + w[6], body[1] + w[7], body[2] + w[8])
        measured = quad_error.Measured(attitude, velocity, accel, 0.0, 0.0, 0.0)
        # model error
        before = state
        acting = _at(sent.value, command_line.index_at(sent, k * 20_000 - 10_000 - round(1e6 * model_delay_s)))
        state = quad_error.step(gains, state, acting, measured, DT_S, k * 20_000)
        a_before = quad_error.nominal_acceleration(before.attitude_rad, before.thrust_m_s2)
        a_after = quad_error.nominal_acceleration(state.attitude_rad, state.thrust_m_s2)
        a_nominal = linalg.scale(0.5, linalg.add(a_before, a_after))
        y = quad_error.outputs(measured, attitude, state.thrust_m_s2)
        x, p = kalman.predict(
            x, p, quad_error.transition(gains.tau_s, DT_S), quad_error.drive(gains.tau_s, DT_S, a_nominal, acting), q
        )
        kalman.update(x, p, gains.filter.c, y, r)
        if imu:
            smooth = (
                keep * smooth[0] + (1.0 - keep) * y[5],
                keep * smooth[1] + (1.0 - keep) * y[6],
                keep * smooth[2] + (1.0 - keep) * y[7],
            )
        # nominal law and correction
        e_p = linalg.sub(_at(p_ref, k), truth.p)
        v, f, f_att = v_measured, (0.0, 0.0, 0.0), (0.0, 0.0)
        if config == INDI:
            f = smooth
        elif config == KF:
            v, f, f_att = (x[0], x[1], x[2]), (x[3], x[4], x[5]), (x[8], x[9])
        elif config == ASMF:
            z = state.filter.x
            v, f, f_att = (z[0], z[1], z[2]), (z[3], z[4], z[5]), (z[8], z[9])
            if mode > 0:
                f = _other_point(state, mode, corner[k])
        integral = linalg.axpy(DT_S, e_p, integral)
        wanted = linalg.axpy(KV, linalg.sub(_at(v_ref, k), v), linalg.axpy(KP, e_p, _at(a_ref, k)))
        if config == PI:
            wanted = linalg.axpy(KI, integral, wanted)
        a = active_model.correct(correction, wanted, 0.0, f, f_att, 1.0)
        command = _within_tilt(active_model.attitude_for(a, 0.0))
        _record(out[k], truth, state, e_p, _true_error(truth, body, state.thrust_m_s2))
        if config != ASMF:
            for i in range(3):
                out[k, 3 + i] = f[i]
        # the vehicle
        sent = command_line.push(sent, k * 20_000, np.array(command))
        for s in range(SUBSTEPS):
            t_us = k * 20_000 + (2 * s + 1) * 10_000 // SUBSTEPS  # the middle of the substep
            acting = _at(sent.value, command_line.index_at(sent, t_us - round(1e6 * delay_s)))
            truth = _advance(truth, acting, _at(air, SUBSTEPS * k + s), mass_factor, DT_S / SUBSTEPS)
    return state


@kernel
def _at(rows: np.ndarray, k: int) -> Vec3:
    return (rows[k, 0], rows[k, 1], rows[k, 2])


@kernel
def _specific_force(truth: Truth, wind: Vec3) -> Vec3:
    """Body: thrust and drag, per mass."""
    q = quat.from_euler(truth.roll, truth.pitch, 0.0)
    u = quat.rotate_back(q, linalg.sub(truth.v, wind))
    speed = linalg.norm(u)
    return (
        -(0.22 + 0.012 * speed) * u[0],
        -(0.22 + 0.012 * speed) * u[1],
        -(0.12 + 0.012 * speed) * u[2] - truth.thrust,
    )


@kernel
def _true_error(truth: Truth, body: Vec3, thrust_model: float) -> Vec3:
    """v' - (g e3 - R e3 T_m) of the truth, NED."""
    q = quat.from_euler(truth.roll, truth.pitch, 0.0)
    return quat.rotate(q, (body[0], body[1], body[2] + thrust_model))


@kernel
def _rate(truth: Truth, command: Vec3, wind: Vec3, mass_factor: float) -> Truth:
    q = quat.from_euler(truth.roll, truth.pitch, 0.0)
    a = quat.rotate(q, _specific_force(truth, wind))
    wn, zeta, gain, bias = 12.0, 0.8, 0.95, math.radians(1.5)
    return Truth(
        truth.v,
        (a[0], a[1], a[2] + G_M_S2),
        truth.roll_rate,
        truth.pitch_rate,
        wn * wn * (gain * command[0] + bias - truth.roll) - 2.0 * zeta * wn * truth.roll_rate,
        wn * wn * (gain * command[1] + bias - truth.pitch) - 2.0 * zeta * wn * truth.pitch_rate,
        (command[2] / mass_factor - truth.thrust) / 0.05,
    )


@kernel
def _moved(truth: Truth, rate: Truth, dt_s: float) -> Truth:
    return Truth(
        linalg.axpy(dt_s, rate.p, truth.p),
        linalg.axpy(dt_s, rate.v, truth.v),
        truth.roll + dt_s * rate.roll,
        truth.pitch + dt_s * rate.pitch,
        truth.roll_rate + dt_s * rate.roll_rate,
        truth.pitch_rate + dt_s * rate.pitch_rate,
        truth.thrust + dt_s * rate.thrust,
    )


@kernel
def _advance(truth: Truth, command: Vec3, wind: Vec3, mass_factor: float, dt_s: float) -> Truth:
    middle = _moved(truth, _rate(truth, command, wind, mass_factor), 0.5 * dt_s)
    return _moved(truth, _rate(middle, command, wind, mass_factor), dt_s)


@kernel
def _within_tilt(attitude: Vec3) -> Vec3:
    roll, pitch, thrust = attitude
    return (
        linalg.clip(roll, -TILT_MAX_RAD, TILT_MAX_RAD),
        linalg.clip(pitch, -TILT_MAX_RAD, TILT_MAX_RAD),
        linalg.clip(thrust, 0.0, THRUST_MAX_M_S2),
    )


@kernel
def _other_point(state: quad_error.State, mode: int, corner: np.ndarray) -> Vec3:
    """minmax: the middle of the published interval; vertex: a corner of the ellipsoid's box."""
    out = np.empty(3)
    for i in range(3):
        if mode == 1:
            both = quad_error.bounds_f(state, i)
            out[i] = 0.5 * (both.low + both.high)
        else:
            out[i] = state.filter.x[3 + i] + corner[i] * math.sqrt(state.filter.p[3 + i, 3 + i])
    return (out[0], out[1], out[2])


@kernel
def _record(row: np.ndarray, truth: Truth, state: quad_error.State, e_p: Vec3, f_true: Vec3) -> None:
    for i in range(3):
        both = quad_error.bounds_f(state, i)
        row[i] = e_p[i]
        row[3 + i] = state.filter.x[3 + i]
        row[6 + i] = f_true[i]
        row[9 + i] = both.low
        row[12 + i] = both.high
        row[15 + i] = math.sqrt(max(state.filter.p[3 + i, 3 + i], 0.0))
        row[18 + i] = truth.p[i]
    row[21] = 1.0 if state.filter.guarantee else 0.0
