"""The helicopter of paper 004, section 4.3: PI on separate loops, the paper's correction (7.1), the full-state target (7.3).

Truth: the reference model with body-axis kinematics, whose derivatives change with air speed, in wind and gusts (design note of the
ASMF, section 7.1). Plant at 200 Hz (midpoint), loop at 50 Hz, noise uniform at the bounds; position and heading are known.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.spatial

from mavquad import linalg, quat
from mavquad.compensate import helicopter as structure
from mavquad.estimate import asmf, command_line, heli_error
from mavquad.identify import models
from mavquad.jit import kernel
from tools.papers.active import kalman, surroundings

Vec3 = tuple[float, float, float]

DT_S, SUBSTEPS = 0.02, 4
TICK_US = 20_000
G_M_S2 = 9.80665
U, Q, THETA, A, C, V, P, PHI, B, D, W, R, R_FB, NORTH, EAST, DOWN, PSI = range(17)


class Config(NamedTuple):
    """What flies. `paper` is the structure of 7.1, else the full-state target of 7.3."""

    paper: bool
    f: bool = True  # the model error is used
    f_target: bool = True
    kalman: bool = False
    integral: bool = True  # 7.3: of the position error; 7.1: horizontal
    accel: bool = True  # 7.3: the path's acceleration


CONFIGS = {
    "PI": Config(paper=True, f=False),
    "active-7.1": Config(paper=True, integral=False),
    "active": Config(paper=False),
    "target without f": Config(paper=False, f=False),
    "target without integral": Config(paper=False, integral=False),
    "target without acceleration": Config(paper=False, accel=False),
    "target with Kalman f": Config(paper=False, kalman=True),
}
PHASES = {"heli-hover": (5.0, 50.0), "heli-leg1": (50.0, 150.0), "heli-leg2": (160.0, 250.0)}


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One flight. Everything random comes from the seed."""

    path: surroundings.Path
    gust_m_s: float = 1.5
    delay_s: float = 0.0  # of the sticks
    model_delay_s: float = 0.0  # what filter and controller reckon with
    scale_b: float = 1.0  # of the truth's B, M_a, L_b: how wrong the model is beyond its air speed
    scale_m_a: float = 1.0
    scale_l_b: float = 1.0


class Flown(NamedTuple):
    p_m: np.ndarray  # (N, 3)
    v_m_s: np.ndarray  # (N, 3) NED
    f: np.ndarray  # (N, 6)
    half_width: np.ndarray  # (N, 6)
    f_true: np.ndarray  # (N, 6) what the model lacks at that moment
    stick: np.ndarray  # (N, 4)
    correction: np.ndarray  # (N, 6) of the paper's structure
    empty: int
    inflations: int


class Plant(NamedTuple):
    """REF as arrays, changed by the case."""

    a: np.ndarray  # (13, 13)
    b: np.ndarray  # (13, 4)


def fly(config: str, case: Case, seed: int) -> Flown:
    """One flight."""
    chosen, n = CONFIGS[config], case.path.p_m.shape[0]
    model = models.ref_13()
    rng = np.random.default_rng(seed)
    air = surroundings.wind(rng, SUBSTEPS * n + 1, DT_S / SUBSTEPS, gust_m_s=case.gust_m_s)
    params = heli_error.Params()
    noise = rng.uniform(-1.0, 1.0, (n, 8)) * np.array(params.e)
    model_error = heli_error.gains(params, model.a, model.b, model.states)
    heading = structure.Params(integral_1_s=0.2 if chosen.integral else 0.0)
    correction = structure.gains(heading, model.a, model.b, model.states)
    a, b = model.a.copy(), model.b * case.scale_b
    a[Q, A] *= case.scale_m_a
    a[P, B] *= case.scale_l_b
    out = np.zeros((n, 34))
    truth = np.zeros(17)
    truth[PSI] = case.path.yaw_rad[0]
    state = _fly(
        chosen,
        model_error,
        correction,
        heli_error.init(model_error),
        structure.init_target(),
        command_line.init(np.zeros(4)),
        Plant(np.ascontiguousarray(a), np.ascontiguousarray(b)),
        truth,
        (case.path.p_m, case.path.v_m_s, case.path.a_m_s2, case.path.yaw_rad, np.gradient(case.path.yaw_rad, DT_S)),
        air,
        noise,
        (round(1e6 * case.delay_s), round(1e6 * case.model_delay_s)),
        out,
    )
    return Flown(
        out[:, 0:3], out[:, 3:6], out[:, 6:12], out[:, 12:18], out[:, 18:24], out[:, 24:28], out[:, 28:34],
        state.empty, state.inflations,
    )  # fmt: skip


def metrics_line(flown: Flown, path: surroundings.Path, course_rad: float, phase: str) -> dict[str, tuple[float, str]]:
    """name -> (value, unit) of one phase; lateral is across the course."""
    first, last = (round(t_s / DT_S) for t_s in PHASES[phase])
    error = (flown.p_m - path.p_m)[first:last]
    speed = np.linalg.norm((flown.v_m_s - path.v_m_s)[first:last], axis=1)
    along = error @ np.array([math.cos(course_rad), math.sin(course_rad), 0.0])
    lateral = error @ np.array([-math.sin(course_rad), math.cos(course_rad), 0.0])
    return {
        "lat_rms": (_rms(lateral), "m"),
        "max_m": (float(np.abs(lateral).max()), "m"),
        "vert_rms": (_rms(error[:, 2]), "m"),
        "vert_max": (float(np.abs(error[:, 2]).max()), "m"),
        "along_rms": (_rms(along), "m"),
        "rms_m": (_rms(np.linalg.norm(error, axis=1)), "m"),
        "vel_rms": (_rms(speed), "m/s"),
        **_of_filter(flown, first, last),
    }


def metrics_ellipse(flown: Flown, path: surroundings.Path) -> dict[str, tuple[float, str]]:
    """name -> (value, unit) from 5 s on; cross-track is the distance to the nearest point of the ellipse."""
    first = round(5.0 / DT_S)
    error = (flown.p_m - path.p_m)[first:]
    angle = np.linspace(0.0, 2.0 * math.pi, 20_001)
    track = np.column_stack([20.0 * (np.cos(angle) - 1.0), 17.5 * np.sin(angle)])
    cross, _ = scipy.spatial.cKDTree(track).query(flown.p_m[first:, :2])
    return {
        "lat_rms": (_rms(cross), "m"),
        "max_m": (float(cross.max()), "m"),
        "vert_rms": (_rms(error[:, 2]), "m"),
        "vert_max": (float(np.abs(error[:, 2]).max()), "m"),
        "horizontal_rms": (_rms(np.hypot(error[:, 0], error[:, 1])), "m"),
        "along_rms": (math.sqrt(max(0.0, _rms(np.hypot(error[:, 0], error[:, 1])) ** 2 - _rms(cross) ** 2)), "m"),
        "rms_m": (_rms(np.linalg.norm(error, axis=1)), "m"),
        "vel_rms": (_rms(np.linalg.norm((flown.v_m_s - path.v_m_s)[first:], axis=1)), "m/s"),
        **_of_filter(flown, first, flown.p_m.shape[0]),
    }


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _of_filter(flown: Flown, first: int, last: int) -> dict[str, tuple[float, str]]:
    inside = np.all(np.abs(flown.f - flown.f_true)[first:last] <= flown.half_width[first:last], axis=1)
    return {
        "inside_pct": (100.0 * float(inside.mean()), "%"),
        "half_width": (float(flown.half_width[first:last].mean()), "mixed"),
        "empty": (float(flown.empty), "1"),
        "inflations": (float(flown.inflations), "1"),
    }


@kernel
def _fly(
    config: Config,
    model: heli_error.Gains,
    gains: structure.Gains,
    state: asmf.State,
    memory: structure.Target,
    sent: command_line.Line,
    plant: Plant,
    truth: np.ndarray,
    path: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    air: np.ndarray,
    noise: np.ndarray,
    delays_us: tuple[int, int],
    out: np.ndarray,
) -> asmf.State:
    p_ref, v_ref, a_ref, yaw_ref, turn_ref = path
    delay_us, model_delay_us = delays_us
    ticks_ahead = (model_delay_us + TICK_US // 2) // TICK_US
    n = p_ref.shape[0]
    x_kf, p_kf, r_kf = np.zeros(19), state.p / 3.0, model.filter.e**2 / 3.0
    q_kf = model.filter.q / 18.0  # b^2/3
    filtered = np.zeros(6)
    integral = (0.0, 0.0, 0.0)
    for k in range(n):
        t_us = k * TICK_US
        y = np.empty(8)
        for i in range(8):
            y[i] = truth[_output(i)] + noise[k, i]
        acting = sent.value[command_line.index_at(sent, t_us - TICK_US // 2 - model_delay_us)]
        state = heli_error.step(model, state, acting, y, t_us)
        if config.kalman:
            x_kf, p_kf = kalman.predict(x_kf, p_kf, model.f, heli_error.drive(model, x_kf, acting), q_kf)
            kalman.update(x_kf, p_kf, model.filter.c, y, r_kf)
        x = x_kf if config.kalman else state.x
        f = x[13:19] if config.f else np.zeros(6)
        # the state when this tick's sticks will act
        later = x
        if ticks_ahead > 0:
            waiting = np.empty((ticks_ahead, 4))
            for i in range(ticks_ahead):
                at_us = t_us + i * TICK_US + TICK_US // 2 - model_delay_us
                waiting[i] = sent.value[command_line.index_at(sent, at_us)]
            later = heli_error.ahead(model, x, waiting)
        k_ref = min(k + ticks_ahead, n - 1)
        psi = truth[PSI] + 0.5 * ticks_ahead * DT_S * (x[R] + later[R])
        v_now, v_later = _level(x, truth[PSI]), _level(later, psi)
        place = (truth[NORTH], truth[EAST], truth[DOWN])
        place = linalg.axpy(0.5 * ticks_ahead * DT_S, linalg.add(v_now, v_later), place)
        e_p = _turned(linalg.sub((p_ref[k_ref, 0], p_ref[k_ref, 1], p_ref[k_ref, 2]), place), psi)
        v_r = _turned((v_ref[k_ref, 0], v_ref[k_ref, 1], v_ref[k_ref, 2]), psi)
        a_r = _turned((a_ref[k_ref, 0], a_ref[k_ref, 1], a_ref[k_ref, 2]), psi)
        turn = turn_ref[k_ref]
        e_psi = _wrapped(yaw_ref[k_ref] - psi)
        if config.paper:
            v_level = _turned(v_later, psi)
            e_v = (
                v_r[0] + linalg.clip(0.5 * e_p[0], -2.0, 2.0) - v_level[0],
                v_r[1] + linalg.clip(0.5 * e_p[1], -2.0, 2.0) - v_level[1],
                v_r[2] + linalg.clip(0.5 * e_p[2], -2.0, 2.0) - v_level[2],
            )
            horizontal = 1.0 if config.integral else 0.0
            integral = (
                integral[0] + 0.2 * DT_S * e_v[0] * horizontal,
                integral[1] + 0.2 * DT_S * e_v[1] * horizontal,
                integral[2] + 0.2 * DT_S * e_v[2],
            )
            theta = -(0.9 * e_v[0] + integral[0]) / G_M_S2
            phi = (0.9 * e_v[1] + integral[1]) / G_M_S2
            if config.f:
                filtered = structure.paper_correction(gains, filtered, later[:13], f, heli_error.known_terms(later))
                theta, phi = theta + filtered[0], phi + filtered[1]
            heave = 1.2 * e_v[2] + integral[2]
            stick = structure.attitude_sticks(gains, later[:13], theta, phi, 1.2 * e_psi + turn, heave)
            for i in range(4):
                stick[i] += filtered[2 + i]
        else:
            a_path = a_r
            if not config.accel:  # the speed's change is left out, the turn is not
                a_path = (-turn * v_r[1], turn * v_r[0], 0.0)
            memory, x_s, u_s = structure.target(gains, memory, later, f, v_r, a_path, turn)
            memory, stick = structure.target_sticks(gains, memory, later[:13], x_s, u_s, e_p, e_psi)
        for i in range(4):
            stick[i] = linalg.clip(stick[i], -1.0, 1.0)
        _record(out[k], truth, state, f, stick, filtered, plant, model, air[SUBSTEPS * k])
        sent = command_line.push(sent, t_us, stick)
        for s in range(SUBSTEPS):
            at_us = t_us + (2 * s + 1) * TICK_US // (2 * SUBSTEPS)
            now = sent.value[command_line.index_at(sent, at_us - delay_us)]
            _advance(truth, plant, now, air[SUBSTEPS * k + s], DT_S / SUBSTEPS)
    return state


@kernel
def _output(i: int) -> int:
    """Index in the state of heli_error.OUTPUTS[i]."""
    return (THETA, PHI, Q, P, R, U, V, W)[i]


@kernel
def _turned(v: Vec3, psi: float) -> Vec3:
    """NED to heading axes."""
    c, s = math.cos(psi), math.sin(psi)
    return (c * v[0] + s * v[1], -s * v[0] + c * v[1], v[2])


@kernel
def _level(x: np.ndarray, psi: float) -> Vec3:
    """Velocity NED of the body velocities in x."""
    return quat.rotate(quat.from_euler(x[PHI], x[THETA], psi), (x[U], x[V], x[W]))


@kernel
def _wrapped(angle: float) -> float:
    return math.atan2(math.sin(angle), math.cos(angle))


@kernel
def _rate(z: np.ndarray, plant: Plant, stick: np.ndarray, wind: np.ndarray) -> np.ndarray:
    """z' (17,) of the truth: derivatives that change with air speed, wind, full kinematics."""
    a, b = plant
    theta, phi = z[THETA], z[PHI]
    attitude = quat.from_euler(phi, theta, z[PSI])
    body_wind = quat.rotate_back(attitude, (wind[0], wind[1], wind[2]))
    u, v, w = z[U] - body_wind[0], z[V] - body_wind[1], z[W] - body_wind[2]
    speed = math.sqrt(u * u + v * v + w * w)
    s = min(speed / 10.0, 1.5)
    p, q, r = z[P], z[Q], z[R]
    k = heli_error.known_terms(z)
    out = np.zeros(17)
    for i in range(13):
        for j in range(4):
            out[i] += b[i, j] * stick[j]
    for i in (A, C, B, D, R_FB):
        for j in range(13):
            out[i] += a[i, j] * z[j]
    out[W] += 0.15 * s * b[W, 3] * stick[3]
    out[U] += a[U, U] * (1.0 + 0.8 * s) * u + a[U, THETA] * theta + a[U, A] * z[A] - 0.012 * speed * u + k[U]
    out[V] += a[V, V] * (1.0 + 1.2 * s) * v + a[V, PHI] * phi + a[V, B] * z[B] - 0.03 * speed * v + 0.9 * s + k[V]
    out[W] += a[W, W] * (1.0 + s) * w + a[W, R] * r - 2.2 * s * s / (1.0 + s * s) + k[W]
    out[Q] += a[Q, U] * (1.0 - 1.3 * s) * u + a[Q, A] * (1.0 - 0.12 * s) * z[A] + s * s
    out[P] += (a[P, V] * (1.0 + 0.6 * s) - 0.1 * s) * v + a[P, B] * (1.0 - 0.1 * s) * z[B] - 1.2 * s
    out[R] += a[R, W] * w + a[R, R] * (1.0 + 0.5 * s) * r + a[R, R_FB] * z[R_FB] + 0.25 * s * v
    out[THETA] = q + k[THETA]
    out[PHI] = p + k[PHI]
    moved = quat.rotate(attitude, (z[U], z[V], z[W]))
    out[NORTH], out[EAST], out[DOWN] = moved[0], moved[1], moved[2]
    out[PSI] = (q * math.sin(phi) + r * math.cos(phi)) / math.cos(theta)
    return out


@kernel
def _advance(z: np.ndarray, plant: Plant, stick: np.ndarray, wind: np.ndarray, dt_s: float) -> None:
    middle = z + 0.5 * dt_s * _rate(z, plant, stick, wind)
    z += dt_s * _rate(middle, plant, stick, wind)


@kernel
def _record(
    row: np.ndarray,
    truth: np.ndarray,
    state: asmf.State,
    f: np.ndarray,
    stick: np.ndarray,
    filtered: np.ndarray,
    plant: Plant,
    model: heli_error.Gains,
    wind: np.ndarray,
) -> None:
    velocity = _level(truth, truth[PSI])
    rate = _rate(truth, plant, stick, wind)
    known = heli_error.known_terms(truth)
    for i in range(3):
        row[i] = truth[NORTH + i]
        row[3 + i] = velocity[i]
    acted = (U, Q, V, P, W, R)
    for i in range(6):
        row[6 + i] = state.x[13 + i]
        row[12 + i] = math.sqrt(max(state.p[13 + i, 13 + i], 0.0))
        j = acted[i]
        expected = known[j]
        for l in range(13):
            expected += plant.a[j, l] * truth[l]
        for l in range(4):
            expected += plant.b[j, l] * stick[l]
        row[18 + i] = rate[j] - expected
        row[28 + i] = filtered[i]
    for i in range(4):
        row[24 + i] = stick[i]
