"""Correct a helicopter by its model error: the paper's structure on separate loops, and a full-state target.

Source: Song et al. 2011 (paper 004), section 3.2; design note of the ASMF, sections 5 (static gains), 7.1 (paper structure) and 7.3
(full-state target). States u q theta a c | v p phi b d | w r r_fb, inputs (lon, lat, ped, col), f on u q v p w r.

Deviations from the paper:
  Eq. (27)  one-step matching would over-drive the servos about twelve times: B acts on measured states through flapping only. What
            the sticks match (q, p, r, w) is balanced statically; what they cannot (u, v) tilts the attitude set-point.
  7.3       beyond the paper: each tick solves for the trim of path, model error and coupling; state feedback holds it there.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mavquad import linalg, quat
from mavquad.errors import ConfigError
from mavquad.jit import kernel
from mavquad.statespace import dlqr, zoh

G_M_S2 = 9.80665
STATES = ("u", "q", "theta", "a", "c", "v", "p", "phi", "b", "d", "w", "r", "r_fb")
U, Q, THETA, A, C, V, P, PHI, B, D, W, R, R_FB = range(13)
F_U, F_Q, F_V, F_P, F_W, F_R = range(6)
ROTOR = ("a", "c", "b", "d")
MATCHED = ("q", "p", "r", "w")
SOLVED = ("theta", "a", "c", "phi", "b", "d", "r_fb")  # and the four sticks
EQUATIONS = ("u", "q", "a", "c", "v", "p", "b", "d", "w", "r", "r_fb")
ATTITUDE_WEIGHTS = {"theta": 4.0, "phi": 4.0, "p": 0.02, "q": 0.02, "u": 1e-4, "v": 1e-4, "w": 0.01, "r": 0.01}
TARGET_WEIGHTS = {"u": 0.02, "v": 0.02, "q": 0.02, "p": 0.02, "theta": 1.0, "phi": 1.0, "w": 0.05, "r": 0.02}
PLACE_WEIGHTS = (0.3, 0.3, 1.0, 1.0)  # x, y, z, psi


@dataclass(frozen=True, slots=True, kw_only=True)
class Params:
    """Both structures. Rates in rad/s, gains of the design note."""

    tick_s: float = 0.02
    low_pass_rad_s: float = 3.0  # of the paper's correction
    correction_max: float = 0.6  # of full stick; 0.3 on a real vehicle
    tilt_max_rad: float = 0.25  # of the correction
    target_low_pass_rad_s: float = 20.0  # of f in the full-state target
    error_max_m: float = 4.0
    integral_1_s: float = 0.2
    integral_max_m: float = 1.5

    def __post_init__(self) -> None:
        if not (self.tick_s > 0.0 and self.low_pass_rad_s > 0.0 and self.target_low_pass_rad_s > 0.0):
            raise ConfigError("helicopter: tick_s and both low-pass frequencies must be > 0")


class Gains(NamedTuple):
    k_attitude: np.ndarray  # (4, 13)
    matched: np.ndarray  # (4, 4) sticks from (q, p, r, w) accelerations
    z_col: float
    pedal_s: float  # static pedal per rad/s of turn
    keep: float  # low-pass of the paper's correction
    correction_max: float
    tilt_max_rad: float
    a: np.ndarray  # (13, 13)
    solve: np.ndarray  # (11, 11) inverse of the target's equations
    k_target: np.ndarray  # (4, 17)
    target_keep: float
    error_max_m: float
    integral_1_s: float
    integral_max_m: float
    tick_s: float


class Target(NamedTuple):
    """Memory of the full-state target."""

    f: np.ndarray  # (6,) low-passed
    integral_m: tuple[float, float, float]


def gains(params: Params, a: np.ndarray, b: np.ndarray, states: tuple[str, ...]) -> Gains:
    """a (13, 13), b (13, 4) of the hover model. Raises ConfigError for another order of states."""
    if tuple(states) != STATES:
        raise ConfigError(f"helicopter: the model's states are {', '.join(states)}; expected {', '.join(STATES)}")
    dt_s, at = params.tick_s, STATES.index
    a_d, b_d = zoh(a, b, dt_s)
    weights = np.array([ATTITUDE_WEIGHTS.get(state, 0.0) for state in STATES])
    place = np.zeros((4, 13))
    for row, name in enumerate(("u", "v", "w", "r")):
        place[row, at(name)] = 1.0
    a_17 = np.block([[a, np.zeros((13, 4))], [place, np.zeros((4, 4))]])
    a_17d, b_17d = zoh(a_17, np.vstack([b, np.zeros((4, 4))]), dt_s)
    weights_17 = np.array([TARGET_WEIGHTS.get(state, 0.0) for state in STATES] + list(PLACE_WEIGHTS))
    rows, columns = [at(name) for name in EQUATIONS], [at(name) for name in SOLVED]
    return Gains(
        dlqr(a_d, b_d, np.diag(weights), np.eye(4)),
        np.linalg.inv(static_gain(a, b)),
        float(b[W, 3]),
        -(a[R, R] + a[R, R_FB] * -a[R_FB, R] / a[R_FB, R_FB]) / float(b[R, 2]),
        1.0 - math.exp(-params.low_pass_rad_s * dt_s),
        params.correction_max,
        params.tilt_max_rad,
        np.ascontiguousarray(a),
        np.linalg.inv(np.hstack([a[np.ix_(rows, columns)], b[rows]])),
        dlqr(a_17d, b_17d, np.diag(weights_17), np.eye(4)),
        1.0 - math.exp(-params.target_low_pass_rad_s * dt_s),
        params.error_max_m,
        params.integral_1_s,
        params.integral_max_m,
        dt_s,
    )


def static_gain(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(4, 4) accelerations of (q, p, r, w) per stick with the rotor states settled: the B of the residualised model."""
    rotor = [STATES.index(name) for name in ROTOR]
    rows = [STATES.index(name) for name in MATCHED]
    settled = -np.linalg.solve(a[np.ix_(rotor, rotor)], b[rotor])
    return np.asarray(a[np.ix_(rows, rotor)] @ settled + b[rows])


def init_target() -> Target:
    """Level, nothing known of f."""
    return Target(np.zeros(6), (0.0, 0.0, 0.0))


@kernel
def attitude_sticks(
    gains: Gains, x: np.ndarray, theta_ref: float, phi_ref: float, r_ref: float, heave_m_s2: float
) -> np.ndarray:
    """(4,) the shared inner loop of 7.1: LQR about the set-points (0.4 rad, 1 rad/s at most), static pedal, collective from heave."""
    error = x.copy()
    error[U] = error[V] = error[W] = 0.0
    error[THETA] -= linalg.clip(theta_ref, -0.4, 0.4)
    error[PHI] -= linalg.clip(phi_ref, -0.4, 0.4)
    error[R] -= linalg.clip(r_ref, -1.0, 1.0)
    out = np.zeros(4)
    for i in range(4):
        for j in range(13):
            out[i] -= gains.k_attitude[i, j] * error[j]
    out[2] += gains.pedal_s * linalg.clip(r_ref, -1.0, 1.0)
    out[3] += heave_m_s2 / gains.z_col
    return out


@kernel
def paper_correction(gains: Gains, filtered: np.ndarray, x: np.ndarray, f: np.ndarray, k: np.ndarray) -> np.ndarray:
    """(6,) the paper's structure: (d theta_ref, d phi_ref, d lon, d lat, d ped, d col), low-passed from the last `filtered`.

    x (13,), f (6,), k (13,) the known terms. Surge and sway tilt the set-point; the rest is matched by the sticks; heave in the
    inertial vertical.
    """
    wanted = np.empty(6)
    wanted[0] = linalg.clip(f[F_U] / G_M_S2, -gains.tilt_max_rad, gains.tilt_max_rad)
    turn = x[R] * x[U] / G_M_S2
    wanted[1] = linalg.clip(-f[F_V] / G_M_S2, -gains.tilt_max_rad, gains.tilt_max_rad) + turn
    sin, cos = math.sin(x[THETA]), math.cos(x[THETA]) * math.cos(x[PHI])
    push = (f[F_Q] + k[Q], f[F_P] + k[P], f[F_R] + k[R], f[F_W] - f[F_U] * sin + G_M_S2 * (1.0 - cos))
    for i in range(4):
        total = 0.0
        for j in range(4):
            total -= gains.matched[i, j] * push[j]
        wanted[2 + i] = linalg.clip(total, -gains.correction_max, gains.correction_max)
    out = filtered.copy()
    for i in range(6):
        out[i] += gains.keep * (wanted[i] - out[i])
    return out


@kernel
def target(
    gains: Gains,
    memory: Target,
    x_now: np.ndarray,
    f: np.ndarray,
    v_ref: tuple[float, float, float],
    a_ref: tuple[float, float, float],
    turn_rad_s: float,
) -> tuple[Target, np.ndarray, np.ndarray]:
    """(memory, x_s (13,), U_s (4,)): states and sticks that fly the path with this model error.

    v_ref, a_ref: the path's velocity and inertial acceleration in heading axes (forward, right, down); turn: the heading's rate.
    Eleven rows of A x + B U + f + k = x', all but those of theta and phi, solved for theta, a, c, phi, b, d, r_fb and U. The path is
    turned into body axes by the present attitude (x_now): the error of body velocities is then that of the velocity over ground.
    """
    smooth = memory.f.copy()
    for i in range(6):
        smooth[i] += gains.target_keep * (f[i] - smooth[i])
    theta, phi = x_now[THETA], x_now[PHI]
    attitude = quat.from_euler(phi, theta, 0.0)
    x = np.zeros(13)
    x[U], x[V], x[W] = quat.rotate_back(attitude, v_ref)
    push = quat.rotate_back(attitude, a_ref)  # u' + q w - r v, ... along the path
    x[P] = -turn_rad_s * math.sin(theta)
    x[Q] = turn_rad_s * math.sin(phi) * math.cos(theta)
    x[R] = turn_rad_s * math.cos(phi) * math.cos(theta)
    known = np.zeros(13)
    known[U] = smooth[F_U] - push[0] - G_M_S2 * (math.sin(theta) - theta)
    known[V] = smooth[F_V] - push[1] + G_M_S2 * (math.cos(theta) * math.sin(phi) - phi)
    known[W] = smooth[F_W] - push[2] + G_M_S2 * (math.cos(theta) * math.cos(phi) - 1.0)
    known[Q], known[P], known[R] = smooth[F_Q], smooth[F_P], smooth[F_R]
    given = (U, Q, V, P, W, R)
    rows = (U, Q, A, C, V, P, B, D, W, R, R_FB)
    right = np.zeros(11)
    for i in range(11):
        right[i] = -known[rows[i]]
        for j in given:
            right[i] -= gains.a[rows[i], j] * x[j]
    found = np.zeros(11)
    for i in range(11):
        for j in range(11):
            found[i] += gains.solve[i, j] * right[j]
    x[THETA], x[A], x[C], x[PHI], x[B], x[D], x[R_FB] = found[0], found[1], found[2], found[3], found[4], found[5], found[6]
    return Target(smooth, memory.integral_m), x, found[7:11].copy()


@kernel
def target_sticks(
    gains: Gains,
    memory: Target,
    x: np.ndarray,
    x_s: np.ndarray,
    u_s: np.ndarray,
    place_error: tuple[float, float, float],
    heading_error: float,
) -> tuple[Target, np.ndarray]:
    """(memory, sticks (4,)): U_s - K (x - x_s, -(e + integral), -e_psi); place_error (forward, right, down) path minus vehicle."""
    e_max, i_max = gains.error_max_m, gains.integral_max_m
    size = math.hypot(place_error[0], place_error[1])
    shrink = 1.0 if size <= e_max else e_max / size
    e = (shrink * place_error[0], shrink * place_error[1], linalg.clip(place_error[2], -e_max, e_max))
    grown = linalg.axpy(gains.integral_1_s * gains.tick_s, e, memory.integral_m)
    integral = (
        linalg.clip(grown[0], -i_max, i_max),
        linalg.clip(grown[1], -i_max, i_max),
        linalg.clip(grown[2], -i_max, i_max),
    )
    out = u_s.copy()
    for i in range(4):
        for j in range(13):
            out[i] -= gains.k_target[i, j] * (x[j] - x_s[j])
        for j in range(3):
            out[i] += gains.k_target[i, 13 + j] * (e[j] + integral[j])
        out[i] += gains.k_target[i, 16] * heading_error
        out[i] = linalg.clip(out[i], -1.0, 1.0)
    return Target(memory.f, integral), out
