"""Linear extended state observer with disturbance-rate feed-forward, any number of channels at once.

Source: Xiao & Tong 2023, Eqs. (11)-(30). Each channel is xdd = a + d: `a` is known (input and model), the total
disturbance d is estimated as a third state (and its rate as a fourth, where order = 4). Estimated d follows
w0^3/(s+w0)^3, so it lags by 3/w0; the feed-forward adds the steady lag under the present rate of d, taken from the
low-passed innovation.

Deviations from the paper:
  Eqs. (12), (13)  e = y - z1 with +beta e; the printed sign is unstable.
  Eqs. (16), (17)  error matrix [-b1 1 0; -b2 0 1; -b3 0 0], poles of det(lambda I - Ae).
  Eqs. (25)-(30)   the rate of d is b3 e, low-passed by tau_f: as printed they need the disturbance they estimate.
  -                discrete: "current" uses the newest sample and has no error at constant speed; "zoh" is the exact
                   discretisation of the continuous observer under a held y (a false disturbance proportional to speed);
                   "euler" only inside its noise limit.
  -                Butterworth poles (the steady Kalman filter of a triple integrator) beside the triple pole; order 4.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import linalg as dense

from mavquad.errors import ConfigError
from mavquad.jit import kernel

FORMS = ("current", "zoh", "euler")
PATTERNS = ("binomial", "butterworth")
MAX_W0_DT = 0.6
MAX_W0_DT_EULER = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class LesoParams:
    """What a person tunes: one bandwidth and one feed-forward gain per channel."""

    w0_rad_s: tuple[float, ...]
    dt_s: float
    feedforward: tuple[float, ...] = ()  # 0 (none) .. 1 (no lag for ramps); empty: none
    tau_f_s: float = 0.03  # low-pass of the innovation before the feed-forward
    order: int = 3
    form: str = "current"
    pattern: str = "binomial"

    def __post_init__(self) -> None:
        if self.form not in FORMS:
            raise ConfigError(f'leso.form must be one of {", ".join(FORMS)}, got "{self.form}"')
        if self.pattern not in PATTERNS:
            raise ConfigError(f'leso.pattern must be one of {", ".join(PATTERNS)}, got "{self.pattern}"')
        if self.order not in (3, 4):
            raise ConfigError(f"leso.order must be 3 or 4, got {self.order}")
        if not (math.isfinite(self.dt_s) and self.dt_s > 0.0):
            raise ConfigError(f"leso.dt_s must be > 0, got {self.dt_s}")
        if not (math.isfinite(self.tau_f_s) and self.tau_f_s >= 0.0):
            raise ConfigError(f"leso.tau_f_s must be >= 0, got {self.tau_f_s}")
        if self.feedforward and len(self.feedforward) != len(self.w0_rad_s):
            raise ConfigError(f"leso.feedforward needs {len(self.w0_rad_s)} values, one per channel, got {self.feedforward}")
        if any(not 0.0 <= g <= 1.0 for g in self.feedforward):
            raise ConfigError(f"leso.feedforward must be within 0..1, got {self.feedforward}")
        if self.order == 4 and any(g > 0.0 for g in self.feedforward):
            raise ConfigError("leso.feedforward with order 4 would count the rate of d twice; set one of them to none")
        limit = MAX_W0_DT_EULER if self.form == "euler" else MAX_W0_DT
        for w0 in self.w0_rad_s:
            if not (math.isfinite(w0) and w0 > 0.0):
                raise ConfigError(f"leso.w0_rad_s must be > 0 on every channel, got {self.w0_rad_s}")
            if w0 * self.dt_s > limit * (1.0 + 1e-12):
                raise ConfigError(
                    f"leso.w0_rad_s {w0:g} at dt {self.dt_s:g} s gives w0*dt = {w0 * self.dt_s:.3g}, limit {limit:g} "
                    f'for form "{self.form}"; lower w0 to {limit / self.dt_s:.3g} rad/s or run faster'
                )


class LesoGains(NamedTuple):
    """zp = A z + B a + Y y_before;  z = zp + L (y - zp1);  compensated z + g F ef. First axis: channel."""

    A: np.ndarray  # (n,4,4)
    B: np.ndarray  # (n,4)
    Y: np.ndarray  # (n,4) zero in the current form
    L: np.ndarray  # (n,4) zero in the forms that use the sample one step late
    F: np.ndarray  # (n,4) feed-forward of the filtered innovation, times g
    alpha: float  # dt/(tau_f + dt)


class LesoState(NamedTuple):
    z: np.ndarray  # (n,4) position, velocity, disturbance, its rate (0 where order = 3)
    y: np.ndarray  # (n,) the last measurement
    ef: np.ndarray  # (n,) low-passed innovation


def continuous_gains(w0_rad_s: float, order: int = 3, pattern: str = "binomial") -> np.ndarray:
    """Observer gains (order,) of z' = A z + B a + b (y - z1): [3w, 3w^2, w^3] or [2w, 2w^2, w^3], and of order 4 alike."""
    return np.real(np.poly(poles(w0_rad_s, order, pattern)))[1:]


def poles(w0_rad_s: float, order: int = 3, pattern: str = "binomial") -> np.ndarray:
    """Continuous observer poles (order,): all at -w0, or on the circle of a Butterworth filter."""
    if pattern == "binomial":
        return np.full(order, -w0_rad_s, dtype=complex)
    k = np.arange(order)
    return w0_rad_s * np.exp(1j * np.pi * (2.0 * k + order + 1.0) / (2.0 * order))


def chain(order: int, dt_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Exact discretisation of `order` integrators in a row: Phi (n,n), and Gam (n,) of an input held into the second."""
    phi = np.zeros((order, order))
    for i in range(order):
        for j in range(i, order):
            phi[i, j] = dt_s ** (j - i) / math.factorial(j - i)
    gam = np.zeros(order)
    gam[:2] = dt_s * dt_s / 2.0, dt_s
    return phi, gam


def current_gains(w0_rad_s: float, dt_s: float, order: int = 3, pattern: str = "binomial") -> np.ndarray:
    """Lc (order,) that places the poles of (I - Lc C) Phi at exp(s_i dt). Ackermann in units of dt, where it is well posed."""
    phi, _ = chain(order, 1.0)
    wanted = np.eye(order, dtype=complex)
    for s in poles(w0_rad_s, order, pattern):
        wanted = wanted @ (phi - np.exp(s * dt_s) * np.eye(order))
    seen = np.array([np.linalg.matrix_power(phi, k + 1)[0] for k in range(order)])  # observability of (Phi, C Phi)
    last = np.zeros(order)
    last[-1] = 1.0
    scaled = np.real(wanted) @ np.linalg.solve(seen, last)
    return scaled / dt_s ** np.arange(order)


@kernel
def closed_form(w0_rad_s: float, dt_s: float, butterworth: bool) -> tuple[float, float, float]:
    """Lc of the current form of order 3, for a period that changes from sample to sample."""
    b = math.exp(-w0_rad_s * dt_s)
    if butterworth:  # poles exp(-w dt) and exp(-w dt/2 (1 +- i sqrt 3))
        m = math.exp(-0.5 * w0_rad_s * dt_s)
        c = 2.0 * m * math.cos(0.5 * math.sqrt(3.0) * w0_rad_s * dt_s)
        a2, a1, a0 = -b - c, m * m + b * c, -b * m * m
    else:
        a2, a1, a0 = -3.0 * b, 3.0 * b * b, -b * b * b
    return (1.0 + a0, (3.0 + a2 - a1 - 3.0 * a0) / (2.0 * dt_s), (1.0 + a2 + a1 + a0) / (dt_s * dt_s))


@kernel
def ramp_gains(Lc: tuple[float, float, float], dt_s: float) -> tuple[float, float, float]:
    """Lff = eps/e of the current form of order 3: steady error per innovation while d grows at a constant rate.

    In that state e = dt/L3, so eps3 = (L2/L3 - dt/2) per unit rate: the lag that is to be made up, 3/w0 for small dt.
    """
    f3 = (Lc[1] - 0.5 * dt_s * Lc[2]) / dt_s
    return (1.0 - Lc[0], (Lc[0] - dt_s * dt_s * (Lc[2] / 6.0 + 0.5 * f3)) / dt_s, f3)


def _channel(p: LesoParams, w0: float, g: float) -> tuple[np.ndarray, ...]:
    n = p.order
    phi, gam = chain(n, p.dt_s)
    A, B, Y, L, F = np.eye(4), np.zeros(4), np.zeros(4), np.zeros(4), np.zeros(4)
    b = continuous_gains(w0, n, p.pattern)
    if p.form == "current":
        L[:n] = current_gains(w0, p.dt_s, n, p.pattern)
        A[:n, :n], B[:n] = phi, gam
        if n == 3:
            F[:3] = ramp_gains((float(L[0]), float(L[1]), float(L[2])), p.dt_s)
    else:
        flow = np.zeros((n + 2, n + 2))
        flow[np.arange(n - 1), np.arange(1, n)] = 1.0
        flow[:n, 0] -= b
        flow[1, n] = 1.0
        flow[:n, n + 1] = b
        held = dense.expm(flow * p.dt_s) if p.form == "zoh" else np.eye(n + 2) + flow * p.dt_s
        A[:n, :n], B[:n], Y[:n] = held[:n, :n], held[:n, n], held[:n, n + 1]
        F[:3] = 1.0, b[0], b[1]
    return A, B, Y, L, g * F


def gains(params: LesoParams) -> LesoGains:
    """Discrete gains of all channels."""
    g = params.feedforward or (0.0,) * len(params.w0_rad_s)
    rows = [_channel(params, w0, gi) for w0, gi in zip(params.w0_rad_s, g, strict=True)]
    A, B, Y, L, F = (np.ascontiguousarray(np.stack(column)) for column in zip(*rows, strict=True))
    return LesoGains(A, B, Y, L, F, params.dt_s / (params.tau_f_s + params.dt_s))


@kernel
def init(y: np.ndarray) -> LesoState:
    """At rest at the first measurement y (n,); a channel that is not finite starts at zero."""
    n = y.shape[0]
    z, first = np.zeros((n, 4)), np.zeros(n)
    for c in range(n):
        if math.isfinite(y[c]):
            z[c, 0] = first[c] = y[c]
    return LesoState(z, first, np.zeros(n))


@kernel
def step(gains: LesoGains, state: LesoState, y: np.ndarray, a: np.ndarray) -> LesoState:
    """The state at the sample y (n,), after `a` (n,), the known acceleration applied since the last one.

    A channel whose sample is not finite is predicted only.
    """
    A, B, Y, L = gains.A, gains.B, gains.Y, gains.L
    n = y.shape[0]
    z, held, ef = np.empty((n, 4)), np.empty(n), np.empty(n)
    for c in range(n):
        zc = state.z[c]
        for i in range(4):
            z[c, i] = (
                A[c, i, 0] * zc[0]
                + A[c, i, 1] * zc[1]
                + A[c, i, 2] * zc[2]
                + A[c, i, 3] * zc[3]
                + B[c, i] * a[c]
                + Y[c, i] * state.y[c]
            )
        e = y[c] - z[c, 0]
        if math.isfinite(e):
            held[c] = y[c]
        else:
            e = 0.0
            held[c] = z[c, 0]
        for i in range(4):
            z[c, i] += L[c, i] * e
        ef[c] = state.ef[c] + gains.alpha * (e - state.ef[c])
    return LesoState(z, held, ef)


@kernel
def compensated(gains: LesoGains, state: LesoState) -> np.ndarray:
    """Position, velocity and disturbance (n,3) with the feed-forward added: z' of Eqs. (28)-(30), made causal."""
    n = state.ef.shape[0]
    out = np.empty((n, 3))
    for c in range(n):
        for i in range(3):
            out[c, i] = state.z[c, i] + gains.F[c, i] * state.ef[c]
    return out
