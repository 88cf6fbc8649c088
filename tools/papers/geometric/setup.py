"""The paper's experiment: its rigid body, torque, truth and samples, and the configurations of the note by name.

J = diag(8.942, 9.458, 7.787)e-3 kg m^2, M = 0.01 [sin t, sin t, 0] N m, 20 s, samples every 20 ms, ticks of 10 ms.
"""

import functools
import math

import numpy as np
import numpy.typing as npt
from scipy.integrate import solve_ivp

from mavquad.estimate import gsmo, gsmo_relay, lie, mekf, rate_baselines, rate_filters, torque
from tools.papers.geometric.runs import Config, Stimulus

Array = npt.NDArray[np.float64]
INERTIA = (8.942e-3, 9.458e-3, 7.787e-3)
GYRO = torque.gyro_ratios(INERTIA)
H, PERIOD, SPAN = 0.01, 0.02, 20.0
IDENTITY = (1.0, 0.0, 0.0, 0.0)
ZERO = (0.0, 0.0, 0.0)
NO_FADE_S = 1e9  # the note's tables keep the torque state in gaps


def paper_torque(t: Array) -> Array:
    """M/J [rad/s^2] (n,3)."""
    m = 0.01 * np.sin(t)
    return np.stack([m / INERTIA[0], m / INERTIA[1], np.zeros_like(t)], axis=-1)


class Truth:
    """Attitudes and rates at the ticks, to 12 digits; a_half (2n+1,3) the torque over inertia at every half tick."""

    def __init__(self, w0: tuple[float, float, float], span_s: float, h: float) -> None:
        n = round(span_s / h) + 1
        self.t = h * np.arange(n)
        self.h = h
        self.a_half = paper_torque(0.5 * h * np.arange(2 * n + 1))
        j = np.array(INERTIA)

        def motion(t: float, x: Array) -> Array:
            q, w = x[:4], x[4:]
            m = 0.01 * math.sin(t) * np.array([1.0, 1.0, 0.0])
            dq = 0.5 * np.array(
                [
                    -q[1] * w[0] - q[2] * w[1] - q[3] * w[2],
                    q[0] * w[0] + q[2] * w[2] - q[3] * w[1],
                    q[0] * w[1] - q[1] * w[2] + q[3] * w[0],
                    q[0] * w[2] + q[1] * w[1] - q[2] * w[0],
                ]
            )
            return np.concatenate([dq, (m - np.cross(w, j * w)) / j])

        start = np.array([1.0, 0.0, 0.0, 0.0, *w0])
        solution = solve_ivp(motion, (0.0, span_s), start, method="DOP853", rtol=1e-12, atol=1e-13, t_eval=self.t)
        self.q = np.ascontiguousarray(solution.y[:4].T)
        self.q /= np.linalg.norm(self.q, axis=1, keepdims=True)
        self.w = np.ascontiguousarray(solution.y[4:].T)


@functools.cache
def truth(w0: tuple[float, float, float] = ZERO, span_s: float = SPAN, h: float = H) -> Truth:
    """Computed once per process."""
    return Truth(w0, span_s, h)


def multiply(a: Array, b: Array) -> Array:
    """Quaternion product of rows (n,4)."""
    aw, av, bw, bv = a[:, :1], a[:, 1:], b[:, :1], b[:, 1:]
    return np.concatenate([aw * bw - (av * bv).sum(1, keepdims=True), aw * bv + bw * av + np.cross(av, bv)], axis=1)


def noisy(q: Array, sigma_deg: float, rng: np.random.Generator) -> Array:
    """q with an independent Gaussian rotation vector on the body side, sigma per axis."""
    return turned_by(q, np.radians(sigma_deg) * rng.standard_normal((len(q), 3)))


def turned_by(q: Array, phi: Array) -> Array:
    """q (n,4) turned by rotation vectors phi (n,3) [rad] on the body side."""
    angle = np.linalg.norm(phi, axis=1, keepdims=True)
    return multiply(q, np.concatenate([np.cos(0.5 * angle), 0.5 * np.sinc(0.5 * angle / np.pi) * phi], axis=1))


def stimulus(
    source: Truth,
    *,
    noise_deg: float = 0.0,
    seed: int = 0,
    torque_scale: float = 1.0,
    drop: float = 0.0,
    flips: bool = False,
    gap_s: tuple[float, float] | None = None,
    period_s: float = PERIOD,
) -> Stimulus:
    """The samples of one run. torque_scale 0: unknown, 1.2: 20 % too large. gap_s: (last sample before, seconds until the next)."""
    rng = np.random.default_rng(seed)
    n = len(source.t)
    every = round(period_s / source.h)
    has = np.arange(n) % every == 0
    samples = noisy(source.q, noise_deg, rng) if noise_deg > 0.0 else source.q.copy()
    if drop > 0.0:
        has &= (rng.random(n) >= drop) | (np.arange(n) == 0)
    if flips:
        samples = samples * np.where(rng.random(n) < 0.5, -1.0, 1.0)[:, None]
    if gap_s is not None:
        has &= ~((source.t > gap_s[0] + 1e-9) & (source.t < gap_s[0] + gap_s[1] - 1e-9))
    return Stimulus(torque_scale * source.a_half, has, samples, source.h, period_s)


def explicit(
    name: str, variant: str, order: int, k1: float, k2: float, group_map: int = lie.CAYLEY, layer: float = 0.2
) -> Config:
    gains = gsmo_relay.Gains(gsmo.EXPLICIT[variant], order, group_map, False, k1, k2, 0.5, 2.5, layer, GYRO)
    return Config(name, "relay", gains)


def implicit(name: str, variant: str, k1: float = 0.0, k2: float = 0.0, L: float = 5.0) -> Config:
    if variant == "implicit-relay":
        params = gsmo.Params(variant=variant, k1_rad_s=k1, k2_rad_s2=k2, forget_s=NO_FADE_S)
    else:
        params = gsmo.Params(variant=variant, L=L, forget_s=NO_FADE_S)
    return Config(name, "implicit", gsmo.fixed_gains(params, GYRO).implicit)


def kalman(name: str, accel_noise: float, bias_walk: float, attitude_noise_deg: float = 0.1) -> Config:
    start_bias = 1.0 if bias_walk > 0.0 else 0.0
    gains = mekf.Gains(accel_noise, bias_walk, math.radians(attitude_noise_deg), 3.0, 3.0, start_bias, GYRO)
    return Config(name, "kalman", gains)


def traditional(name: str, scheme: int, hold: bool) -> Config:
    return Config(name, "traditional", rate_baselines.Gains(scheme, hold, 4.0, 8.0, GYRO))


def configurations() -> dict[str, Config]:
    """G1 ... B3 as in the note; the bank without and with the inertia."""
    listed = [
        explicit("G1", "relay", 1, 4.0, 8.0),
        explicit("G2", "relay", 2, 4.0, 8.0),
        explicit("G3", "relay", 2, 1.0, 5.0),
        explicit("G4", "scheduled", 2, 6.0, 30.0),
        explicit("G5", "sat", 2, 4.0, 20.0),
        explicit("G6", "super-twisting", 2, 1.5 * math.sqrt(2.0), 1.1 * 2.0),
        implicit("G7", "implicit-relay", 6.0, 120.0),
        implicit("G7b", "implicit-relay", 6.0, 30.0),
        implicit("G8", "implicit-super-twisting", L=5.0),
        implicit("G9", "implicit-third-order", L=5.0),
        traditional("B1a", rate_baselines.EULER, True),
        traditional("B1b", rate_baselines.EULER, False),
        traditional("B1c", rate_baselines.RK4, False),
        traditional("B1d", rate_baselines.ADDITIVE, True),
        kalman("B2a", 0.3, 0.0),
        kalman("B2b", 0.0, 0.3),
        Config("B3", "difference", 5.0),
        Config("online", "online", ZERO),
        Config("online-J", "online", GYRO),
    ]
    return {c.name: c for c in listed}


# ---- figures of merit ------------------------------------------------------------------------------------------------------
def attitude_error_deg(source: Truth, q_hat: Array) -> Array:
    """Angle between the true and the observed attitude at every tick [deg]."""
    relative = multiply(source.q * np.array([1.0, -1.0, -1.0, -1.0]), q_hat)
    return np.degrees(2.0 * np.arctan2(np.linalg.norm(relative[:, 1:], axis=1), np.abs(relative[:, 0])))


def rms(x: Array) -> float:
    """Over everything given."""
    return float(np.sqrt(np.mean(np.square(x))))


def after(source: Truth, t_s: float) -> npt.NDArray[np.bool_]:
    """Which ticks are at t_s or later."""
    return source.t >= t_s - 1e-9


def settling_s(source: Truth, w_hat: Array, q_hat: Array) -> float:
    """Time after which the 5 Hz-filtered rate error stays below 0.2 rad/s and the attitude error below 10 deg; inf: never."""
    rate_error = np.linalg.norm(rate_filters.low_pass(w_hat - source.w, 5.0, source.h), axis=1)
    bad = ~(rate_error < 0.2)
    if np.isfinite(q_hat).all():
        bad |= ~(attitude_error_deg(source, q_hat) < 10.0)
    if bad[-1]:
        return math.inf
    return float(source.t[np.flatnonzero(bad)[-1] + 1]) if bad.any() else 0.0
