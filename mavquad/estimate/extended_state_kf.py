"""Extended-state Kalman filter: position, velocity and the unknown acceleration f of one axis (or angle, rate and f).

Source: Yang, Lyu, Chai 2022, Eqs. (4)-(9). "ESKF" is extended-state here, not error-state. Each axis is a double integrator
driven by a known acceleration a and by f, which walks at random: X+ = A X + B a, y = D X + n. Both position and velocity are
measured: with position alone every flight of the paper's scenario is lost.

Deviations from the paper:
  Eq. (6)   A and B by zero-order hold: the printed Euler step drops dt^2/2.
  Eq. (7)   the estimate, not the true state, stands on both sides.
  Eq. (8)   one inverse: P+ = (1 + delta) A (P - K D P) A^T + (1 + 1/delta) Q, where -L = A K; equal to the printed form.
  Eq. (9)   delta > 0 bounds how f's change correlates with the error (Young's inequality); kept constant it is a fading memory
            that puts every pole inside 1/(1 + delta) whatever the noise. "none" (the default, a Kalman filter) drops delta and
            the factor 1 + 1/delta with it; "constant" is the printed filter; "per-step" takes delta from the P of each step.
  Table 1   D, never printed, is [I 0].
The control acts on the posterior (`correct`), not on the prediction of Eq. (7); `predict` after `correct` is Eq. (7).
With delta > 0 P and Q scale per sample: another dt is another filter. q is per step: for another dt take q dt/0.01.
"""

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from mavquad.errors import ConfigError
from mavquad.jit import kernel

Axis = tuple[float, float, float]  # p [m], v [m/s], f [m/s^2]; or angle [rad], rate [rad/s], f [rad/s^2]
Cov = tuple[float, float, float, float, float, float]  # upper triangle of P: 11, 12, 13, 22, 23, 33
Gain = tuple[float, float, float, float, float, float]  # K (3,2) row by row: p1 p2 v1 v2 f1 f2
R_MIN, R_MAX = 1e-7, 1.0  # bounds of the adapted variance


@dataclass(frozen=True, slots=True, kw_only=True)
class KfParams:
    """One kind of axis. Variances per sample, growth per step; the defaults are those of a position axis."""

    dt_s: float = 0.01
    q_per_step: float = 0.3  # growth of f's variance in one step, (m/s^2)^2 or (rad/s^2)^2
    r_first: float = 0.01  # variance of the measured position (angle)
    r_second: float = 0.01  # variance of the measured velocity (rate)
    p0: float = 1.0  # initial variance, on the diagonal
    fading: Literal["none", "constant", "per-step"] = "none"

    def __post_init__(self) -> None:
        for name in ("dt_s", "q_per_step", "r_first", "r_second", "p0"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ConfigError(f"eskf.{name} must be a finite number > 0, got {value}")
        if self.fading not in ("none", "constant", "per-step"):
            raise ConfigError(f'eskf.fading must be "none", "constant" or "per-step", got "{self.fading}"')


class KfGains(NamedTuple):
    dt_s: float
    q: float
    r_first: float
    r_second: float
    p0: float
    delta: float  # 0: Kalman filter; < 0: from P at each step


class KfState(NamedTuple):
    """One axis with its covariance, and the variances it believes in."""

    x: Axis
    p: Cov
    r: tuple[float, float]
    delta: float  # of this step


def gains(params: KfParams) -> KfGains:
    """Params to numbers; delta = sqrt(tr Q / tr P(0)) of Eq. (9) where it is constant."""
    delta = {"none": 0.0, "constant": math.sqrt(params.q_per_step / (3.0 * params.p0)), "per-step": -1.0}[params.fading]
    return KfGains(params.dt_s, params.q_per_step, params.r_first, params.r_second, params.p0, delta)


def init(g: KfGains, first: float, second: float) -> KfState:
    """At a measured position and velocity, f unknown."""
    p = (g.p0, 0.0, 0.0, g.p0, 0.0, g.p0)
    return KfState((first, second, 0.0), p, (g.r_first, g.r_second), delta_of(g.delta, g.q, p))


@kernel
def delta_of(delta, q, p):
    """The delta of this step: given, or sqrt(tr Q / tr P)."""
    if delta < 0.0:
        return math.sqrt(q / (p[0] + p[3] + p[5]))
    return delta


@kernel
def gain(p, r_first, r_second, delta):
    """K = P D^T (D P D^T + R/(1 + delta))^-1, the posterior gain; L of Eq. (8) is -A K."""
    p11, p12, p13, p22, p23, _ = p
    s11 = p11 + r_first / (1.0 + delta)
    s22 = p22 + r_second / (1.0 + delta)
    det = s11 * s22 - p12 * p12
    return (
        (p11 * s22 - p12 * p12) / det,
        p12 * (s11 - p11) / det,
        p12 * (s22 - p22) / det,
        (p22 * s11 - p12 * p12) / det,
        (p13 * s22 - p23 * p12) / det,
        (p23 * s11 - p13 * p12) / det,
    )


@kernel
def shrink(p, k):
    """(I - K D) P: the covariance after the measurement."""
    p11, p12, p13, p22, p23, p33 = p
    return (
        p11 - k[0] * p11 - k[1] * p12,
        p12 - k[0] * p12 - k[1] * p22,
        p13 - k[0] * p13 - k[1] * p23,
        p22 - k[2] * p12 - k[3] * p22,
        p23 - k[2] * p13 - k[3] * p23,
        p33 - k[4] * p13 - k[5] * p23,
    )


@kernel
def grow(p, q, dt, delta):
    """(1 + delta) A P A^T + (1 + 1/delta) Q; delta = 0 is the Kalman filter, without the factors."""
    p11, p12, p13, p22, p23, p33 = p
    h = 0.5 * dt * dt
    a11 = p11 + dt * p12 + h * p13  # first row of A P
    a12 = p12 + dt * p22 + h * p23
    a13 = p13 + dt * p23 + h * p33
    a22 = p22 + dt * p23  # second row
    a23 = p23 + dt * p33
    s = 1.0 + delta
    growth = q * (1.0 + 1.0 / delta) if delta > 0.0 else q
    return (
        s * (a11 + dt * a12 + h * a13),
        s * (a12 + dt * a13),
        s * a13,
        s * (a22 + dt * a23),
        s * a23,
        s * p33 + growth,
    )


@kernel
def correct(k, x, y_first, y_second):
    """The posterior estimate: X + K (y - D X)."""
    e1 = y_first - x[0]
    e2 = y_second - x[1]
    return (x[0] + k[0] * e1 + k[1] * e2, x[1] + k[2] * e1 + k[3] * e2, x[2] + k[4] * e1 + k[5] * e2)


@kernel
def predict(x, a, dt):
    """A X + B a: what was really applied, after saturation, as an acceleration."""
    return (x[0] + dt * x[1] + 0.5 * dt * dt * (x[2] + a), x[1] + dt * (x[2] + a), x[2])


@kernel
def update(g, state, y_first, y_second):
    """Measurement of one axis with its covariance: the posterior of this step."""
    delta = delta_of(g.delta, g.q, state.p)
    k = gain(state.p, state.r[0], state.r[1], delta)
    return KfState(correct(k, state.x, y_first, y_second), shrink(state.p, k), state.r, delta)


@kernel
def advance(g, state, a, dt_s):
    """Time update of one axis over dt_s (g.dt_s long, or what passed: q grows in proportion)."""
    p = grow(state.p, g.q * dt_s / g.dt_s, dt_s, state.delta)
    return KfState(predict(state.x, a, dt_s), p, state.r, state.delta)


@kernel
def adapt(state, y_first, y_second, forget):
    """R from the residuals of the posterior: R := (1-w) R + w (r r^T + D P+ D^T), clipped. Call it after `update`.

    The residual form stays positive; the innovation form (r r^T - D P D^T) does not and is only a monitor.
    """
    e1 = y_first - state.x[0]
    e2 = y_second - state.x[1]
    r1 = (1.0 - forget) * state.r[0] + forget * (e1 * e1 + state.p[0])
    r2 = (1.0 - forget) * state.r[1] + forget * (e2 * e2 + state.p[3])
    return KfState(state.x, state.p, (min(R_MAX, max(R_MIN, r1)), min(R_MAX, max(R_MIN, r2))), state.delta)


@kernel
def _schedule(g, steps, out):
    p = (g.p0, 0.0, 0.0, g.p0, 0.0, g.p0)
    for i in range(steps):
        delta = delta_of(g.delta, g.q, p)
        k = gain(p, g.r_first, g.r_second, delta)
        for j in range(6):
            out[i, j] = k[j]
        p = grow(shrink(p, k), g.q, g.dt_s, delta)
    return p


def schedule(g: KfGains, steps: int = 400) -> tuple[np.ndarray, Cov]:
    """The posterior gains of the first `steps` steps, (steps, 6) as `Gain`, and the P that follows. They need no data."""
    out = np.empty((steps, 6))
    return out, _schedule(g, steps, out)


def limit(g: KfGains) -> tuple[Gain, np.ndarray]:
    """Where the recursion ends: (posterior gain, P (3,3)), by the DARE of (sqrt(1+delta) A, D, (1+1/delta) Q, R/(1+delta)).

    A "per-step" delta has no such equation: ConfigError. Run `schedule` instead.
    """
    from scipy.linalg import solve_discrete_are

    if g.delta < 0.0:
        raise ConfigError(
            'eskf.fading = "per-step" has no limit by a Riccati equation; use "none" or "constant", or schedule()'
        )
    s = 1.0 + g.delta
    growth = g.q * (1.0 + 1.0 / g.delta) if g.delta > 0.0 else g.q
    a = np.array([[1.0, g.dt_s, 0.5 * g.dt_s**2], [0.0, 1.0, g.dt_s], [0.0, 0.0, 1.0]])
    d = np.eye(2, 3)
    p = solve_discrete_are(math.sqrt(s) * a.T, d.T, np.diag([0.0, 0.0, growth]), np.diag([g.r_first, g.r_second]) / s)
    packed = (p[0, 0], p[0, 1], p[0, 2], p[1, 1], p[1, 2], p[2, 2])
    return gain(packed, g.r_first, g.r_second, g.delta), p


@kernel
def step_bank(k, x, y, a, dt):
    """Six axes with steady gains: posterior of y (6,2), then prediction over a (6,). k (6,6), x (6,3). Returns both, (2,6,3)."""
    out = np.empty((2, 6, 3))
    for i in range(6):
        e1 = y[i, 0] - x[i, 0]
        e2 = y[i, 1] - x[i, 1]
        p = x[i, 0] + k[i, 0] * e1 + k[i, 1] * e2
        v = x[i, 1] + k[i, 2] * e1 + k[i, 3] * e2
        f = x[i, 2] + k[i, 4] * e1 + k[i, 5] * e2
        out[0, i, 0], out[0, i, 1], out[0, i, 2] = p, v, f
        out[1, i, 0] = p + dt * v + 0.5 * dt * dt * (f + a[i])
        out[1, i, 1] = v + dt * (f + a[i])
        out[1, i, 2] = f
    return out
