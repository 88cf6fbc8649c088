"""Extended Kalman filter of a multirotor: position, velocity, attitude, body rates, with every measurement optional.

Source: Xiao & Tong 2023, Eqs. (3)-(7), (2). Twelve error states [p v eta w], Euler angles eta = (roll, pitch, yaw) as in the
paper; the attitude itself is kept as a unit quaternion, so that passing the singular pitch costs accuracy and never a NaN.
The noise of the rows is independent: they are absorbed one after the other, which equals the matrix form and lets any of them
be missing. Covariance update in Joseph's form.

Deviations from the paper:
  Eqs. (3), (4)  twelve states instead of six pose states without dynamics; position, attitude, rate and velocity rows.
  Eq. (2)        gravity outside the bracket; gyroscopic terms on body rates; force and torque drag have constants of their own.
  Eq. (5)        RK4 for the state, I + A dt + (A dt)^2/2 for the covariance, A at the state before the step.
  -              the disturbance estimated by the observer behind the filter enters the prediction (joint observer, form J2).
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mavquad import quat
from mavquad.errors import ConfigError
from mavquad.jit import kernel

COS_PITCH_MIN = 0.1  # |pitch| > 84 deg: the Euler channels mean nothing there

Vec3 = tuple[float, float, float]
Quat = tuple[float, float, float, float]
Row12 = tuple[float, float, float, float, float, float, float, float, float, float, float, float]

NOTHING: Row12 = (math.nan,) * 12  # type: ignore[assignment]


@dataclass(frozen=True, slots=True, kw_only=True)
class EkfParams:
    """What a person tunes: q is a process noise density (variance per second), sigma a standard deviation per sample."""

    q_position: float = 1e-6  # m^2/s
    q_velocity: float = 0.003  # (m/s)^2/s
    q_angle: float = 1e-6  # rad^2/s
    q_rate: float = 0.003  # (rad/s)^2/s
    sigma_position_m: float = 0.01
    sigma_velocity_m_s: float = 0.03
    sigma_angle_rad: float = 0.0035
    sigma_rate_rad_s: float = 0.01
    p0_position: float = 1e-2
    p0_velocity: float = 1e-2
    p0_angle: float = 1e-3
    p0_rate: float = 1e-2

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ConfigError(f"ekf.{name} must be finite and > 0, got {value}")


class EkfModel(NamedTuple):
    """The vehicle as the filter knows it."""

    gravity_m_s2: float
    drag_1_s: float  # kf/m
    inertia_kg_m2: Vec3
    rate_drag_nm_s: float  # kr


class EkfGains(NamedTuple):
    """The model, and variances by row in the order p v eta w. Flat, one array: a nested tuple costs 1 us to pass, an array half."""

    gravity_m_s2: float
    drag_1_s: float
    inertia_kg_m2: Vec3
    rate_drag_nm_s: float
    noise: np.ndarray  # (3,12): rows Q (per second), R (per sample), P0


Vehicle = EkfModel | EkfGains
Q, R, P0 = 0, 1, 2


class EkfState(NamedTuple):
    """Mean and covariance; P is in the coordinates [p v eta w]."""

    p_ned_m: Vec3
    v_ned_m_s: Vec3
    q_wxyz: Quat
    omega_rad_s: Vec3
    P: np.ndarray  # (12,12)
    singular: bool  # pitch within 6 deg of +-90 deg: attitude rows were not absorbed as angles


# What drove the vehicle over a step: applied thrust over mass [m/s^2], > 0 along -z body; applied torque [N m]; and the
# disturbance estimated before (plain z3): force over mass [m/s^2, NED], torque over inertia [rad/s^2, body]. A plain tuple.
Input = tuple[float, Vec3, Vec3, Vec3]


def gains(params: EkfParams, model: EkfModel) -> EkfGains:
    """Variances laid out by row. Params are already valid."""
    p = params
    q = np.repeat([p.q_position, p.q_velocity, p.q_angle, p.q_rate], 3)
    sigma = np.repeat([p.sigma_position_m, p.sigma_velocity_m_s, p.sigma_angle_rad, p.sigma_rate_rad_s], 3)
    p0 = np.repeat([p.p0_position, p.p0_velocity, p.p0_angle, p.p0_rate], 3)
    return EkfGains(*model, np.stack([q, sigma**2, p0]))


@kernel
def init(gains: EkfGains, z: Row12) -> EkfState:
    """The state after the first measurement z = (p, v, eta, w), NaN where unmeasured: zero is taken there."""
    x = np.empty(12)
    covariance = np.zeros((12, 12))
    for i in range(12):
        x[i] = z[i] if math.isfinite(z[i]) else 0.0
        covariance[i, i] = gains.noise[P0, i]
    q = quat.from_euler(x[6], x[7], x[8])
    return EkfState((x[0], x[1], x[2]), (x[3], x[4], x[5]), q, (x[9], x[10], x[11]), covariance, False)


@kernel
def angular_acceleration(model: Vehicle, torque_nm: Vec3, w: Vec3) -> Vec3:
    """Euler's equations with rotational drag (Eq. (2), corrected), without the rotors' own gyroscopic term."""
    jx, jy, jz = model.inertia_kg_m2
    kr = model.rate_drag_nm_s
    return (
        ((jy - jz) * w[1] * w[2] + torque_nm[0] - kr * w[0]) / jx,
        ((jz - jx) * w[2] * w[0] + torque_nm[1] - kr * w[1]) / jy,
        ((jx - jy) * w[0] * w[1] + torque_nm[2] - kr * w[2]) / jz,
    )


@kernel
def _acceleration(model: Vehicle, u: Input, v: Vec3, q: Quat) -> Vec3:
    n = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    thrust, _, f, _ = u
    k = thrust / (n * n)  # an RK4 stage is a unit quaternion to O(dt^2) only
    d = model.drag_1_s
    return (
        -k * 2.0 * (q[1] * q[3] + q[0] * q[2]) - d * v[0] + f[0],
        -k * 2.0 * (q[2] * q[3] - q[0] * q[1]) - d * v[1] + f[1],
        -k * (q[0] * q[0] - q[1] * q[1] - q[2] * q[2] + q[3] * q[3]) + model.gravity_m_s2 - d * v[2] + f[2],
    )


@kernel
def _turning(q: Quat, w: Vec3) -> Quat:
    return (
        0.5 * (-q[1] * w[0] - q[2] * w[1] - q[3] * w[2]),
        0.5 * (q[0] * w[0] + q[2] * w[2] - q[3] * w[1]),
        0.5 * (q[0] * w[1] - q[1] * w[2] + q[3] * w[0]),
        0.5 * (q[0] * w[2] + q[1] * w[1] - q[2] * w[0]),
    )


@kernel
def _spin(model: Vehicle, u: Input, w: Vec3) -> Vec3:
    _, torque, _, tau = u
    a = angular_acceleration(model, torque, w)
    return (a[0] + tau[0], a[1] + tau[1], a[2] + tau[2])


@kernel
def _axpy3(s: float, a: Vec3, b: Vec3) -> Vec3:
    return (s * a[0] + b[0], s * a[1] + b[1], s * a[2] + b[2])


@kernel
def _axpy4(s: float, a: Quat, b: Quat) -> Quat:
    return (s * a[0] + b[0], s * a[1] + b[1], s * a[2] + b[2], s * a[3] + b[3])


@kernel
def _simpson3(s: float, a: Vec3, b: Vec3, c: Vec3, d: Vec3, x: Vec3) -> Vec3:
    return (
        x[0] + s * (a[0] + 2.0 * (b[0] + c[0]) + d[0]),
        x[1] + s * (a[1] + 2.0 * (b[1] + c[1]) + d[1]),
        x[2] + s * (a[2] + 2.0 * (b[2] + c[2]) + d[2]),
    )


@kernel
def motion(model: Vehicle, u: Input, p: Vec3, v: Vec3, q: Quat, w: Vec3, dt_s: float) -> tuple[Vec3, Vec3, Quat, Vec3]:
    """One RK4 step of Eq. (2): (p, v, q, w) after dt under a constant input. The quaternion is normalised at the end."""
    h = 0.5 * dt_s
    v1, a1, q1, w1 = v, _acceleration(model, u, v, q), _turning(q, w), _spin(model, u, w)
    v2, qb, wb = _axpy3(h, a1, v), _axpy4(h, q1, q), _axpy3(h, w1, w)
    a2, q2, w2 = _acceleration(model, u, v2, qb), _turning(qb, wb), _spin(model, u, wb)
    v3, qc, wc = _axpy3(h, a2, v), _axpy4(h, q2, q), _axpy3(h, w2, w)
    a3, q3, w3 = _acceleration(model, u, v3, qc), _turning(qc, wc), _spin(model, u, wc)
    v4, qd, wd = _axpy3(dt_s, a3, v), _axpy4(dt_s, q3, q), _axpy3(dt_s, w3, w)
    a4, q4, w4 = _acceleration(model, u, v4, qd), _turning(qd, wd), _spin(model, u, wd)
    s = dt_s / 6.0
    q_next = (
        q[0] + s * (q1[0] + 2.0 * (q2[0] + q3[0]) + q4[0]),
        q[1] + s * (q1[1] + 2.0 * (q2[1] + q3[1]) + q4[1]),
        q[2] + s * (q1[2] + 2.0 * (q2[2] + q3[2]) + q4[2]),
        q[3] + s * (q1[3] + 2.0 * (q2[3] + q3[3]) + q4[3]),
    )
    return (
        _simpson3(s, v1, v2, v3, v4, p),
        _simpson3(s, a1, a2, a3, a4, v),
        quat.normalize(q_next),
        _simpson3(s, w1, w2, w3, w4, w),
    )


@kernel
def jacobian(model: Vehicle, thrust_m_s2: float, eta: Vec3, w: Vec3, A: np.ndarray) -> bool:
    """Fill A (n,n), n >= 12 and zero elsewhere, with d(xdot)/dx of Eq. (2) at [eta w]; True where the pitch is singular."""
    sf, cf = math.sin(eta[0]), math.cos(eta[0])
    st, ct = math.sin(eta[1]), math.cos(eta[1])
    sp, cp = math.sin(eta[2]), math.cos(eta[2])
    singular = abs(ct) < COS_PITCH_MIN
    safe = math.copysign(COS_PITCH_MIN, ct) if singular else ct
    k = -thrust_m_s2
    for i in range(3):
        A[i, 3 + i] = 1.0
        A[3 + i, 3 + i] = -model.drag_1_s
    A[3, 6] = k * (sp * cf - cp * st * sf)
    A[3, 7] = k * cp * ct * cf
    A[3, 8] = k * (cp * sf - sp * st * cf)
    A[4, 6] = k * (-cp * cf - sp * st * sf)
    A[4, 7] = k * sp * ct * cf
    A[4, 8] = k * (cp * st * cf + sp * sf)
    A[5, 6] = -k * sf * ct
    A[5, 7] = -k * cf * st
    across = w[1] * sf + w[2] * cf
    along = w[1] * cf - w[2] * sf
    A[6, 6] = along * st / safe
    A[6, 7] = across / (safe * safe)
    A[6, 9] = 1.0
    A[6, 10] = sf * st / safe
    A[6, 11] = cf * st / safe
    A[7, 6] = -across
    A[7, 10] = cf
    A[7, 11] = -sf
    A[8, 6] = along / safe
    A[8, 7] = across * st / (safe * safe)
    A[8, 10] = sf / safe
    A[8, 11] = cf / safe
    jx, jy, jz = model.inertia_kg_m2
    kr = model.rate_drag_nm_s
    A[9, 9], A[9, 10], A[9, 11] = -kr / jx, (jy - jz) * w[2] / jx, (jy - jz) * w[1] / jx
    A[10, 9], A[10, 10], A[10, 11] = (jz - jx) * w[2] / jy, -kr / jy, (jz - jx) * w[0] / jy
    A[11, 9], A[11, 10], A[11, 11] = (jx - jy) * w[1] / jz, (jx - jy) * w[0] / jz, -kr / jz
    return singular


@kernel
def transition(A: np.ndarray, dt_s: float) -> np.ndarray:
    """F = I + A dt + (A dt)^2/2; zeros of A are skipped."""
    n = A.shape[0]
    half = 0.5 * dt_s * dt_s
    F = np.zeros((n, n))
    for i in range(n):
        for k in range(n):
            aik = A[i, k]
            if aik != 0.0:
                F[i, k] += dt_s * aik
                for j in range(n):
                    F[i, j] += half * aik * A[k, j]
        F[i, i] += 1.0
    return F


@kernel
def spread(F: np.ndarray, P: np.ndarray) -> np.ndarray:
    """F P F^T for a sparse F and a symmetric P, exactly symmetric."""
    n = F.shape[0]
    half = np.zeros((n, n))  # F P, transposed
    out = np.empty((n, n))
    for i in range(n):
        for k in range(n):
            f = F[i, k]
            if f != 0.0:
                for j in range(n):
                    half[i, j] += f * P[k, j]
    for i in range(n):
        for j in range(i + 1):
            out[i, j] = 0.0
    for j in range(n):
        for k in range(n):
            f = F[j, k]
            if f != 0.0:
                for i in range(j, n):
                    out[i, j] += f * half[i, k]
    for i in range(n):
        for j in range(i):
            out[j, i] = out[i, j]
    return out


@kernel
def absorb(P: np.ndarray, dx: np.ndarray, row: int, residual: float, r: float, scratch: np.ndarray) -> None:
    """One scalar measurement of state `row`, in place: dx gains K e, P in Joseph's form.

    `residual` is against the prior mean; scratch (2,n).
    """
    n = P.shape[0]
    s = P[row, row] + r
    for j in range(n):
        scratch[0, j] = P[row, j]
        scratch[1, j] = P[row, j] / s
    e = residual - dx[row]
    for i in range(n):
        c, k = scratch[0, i], scratch[1, i]
        dx[i] += k * e
        left = s * k - c
        for j in range(n):
            P[i, j] += left * scratch[1, j] - k * scratch[0, j]


@kernel
def wrap(angle_rad: float) -> float:
    """The same angle in [-pi, pi); what is not finite stays as it is."""
    if -math.pi <= angle_rad < math.pi or not math.isfinite(angle_rad):
        return angle_rad
    return angle_rad - 2.0 * math.pi * math.floor((angle_rad + math.pi) / (2.0 * math.pi))


@kernel
def predict(gains: EkfGains, state: EkfState, u: Input, dt_s: float) -> EkfState:
    """The state after dt_s [s] under the applied input u: RK4 mean, F P F^T + Q dt."""
    A = np.zeros((12, 12))
    singular = jacobian(gains, u[0], quat.to_euler(state.q_wxyz), state.omega_rad_s, A)
    p, v, q, w = motion(gains, u, state.p_ned_m, state.v_ned_m_s, state.q_wxyz, state.omega_rad_s, dt_s)
    P = spread(transition(A, dt_s), state.P)
    for i in range(12):
        P[i, i] += gains.noise[Q, i] * dt_s
    return EkfState(p, v, q, w, P, singular)


@kernel
def update(gains: EkfGains, state: EkfState, z: Row12) -> EkfState:
    """The state after the measurement z = (p, v, eta, w); any row may be NaN or infinite and is then left out.

    Close to the singular pitch angles cannot be compared: a whole measured attitude is then taken as it is, and `singular` set.
    """
    eta = quat.to_euler(state.q_wxyz)
    whole = math.isfinite(z[6]) and math.isfinite(z[7]) and math.isfinite(z[8])
    singular = abs(math.cos(eta[1])) < COS_PITCH_MIN or (math.isfinite(z[7]) and abs(math.cos(z[7])) < COS_PITCH_MIN)
    prior = state.p_ned_m + state.v_ned_m_s + eta + state.omega_rad_s
    P = state.P.copy()
    dx = np.zeros(12)
    scratch = np.empty((2, 12))
    for i in range(12):
        residual = z[i] - prior[i]
        if 6 <= i < 9:
            if singular:
                continue
            residual = wrap(residual)
        if math.isfinite(residual):
            absorb(P, dx, i, residual, gains.noise[R, i], scratch)
    p, v, w = state.p_ned_m, state.v_ned_m_s, state.omega_rad_s
    if not singular:
        q = quat.from_euler(eta[0] + dx[6], eta[1] + dx[7], eta[2] + dx[8])
    elif whole:
        q = quat.from_euler(z[6], z[7], z[8])
    else:
        q = state.q_wxyz
    return EkfState(
        (p[0] + dx[0], p[1] + dx[1], p[2] + dx[2]),
        (v[0] + dx[3], v[1] + dx[4], v[2] + dx[5]),
        q,
        (w[0] + dx[9], w[1] + dx[10], w[2] + dx[11]),
        P,
        singular,
    )


@kernel
def step(gains: EkfGains, state: EkfState, u: Input, z: Row12, dt_s: float) -> EkfState:
    """Predict over dt_s under u, then absorb z: one sample of a filter that runs at the rate of its measurements."""
    return update(gains, predict(gains, state, u, dt_s), z)
