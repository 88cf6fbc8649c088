"""Adaptive set-membership filter (ASMF): an ellipsoid that holds state and model error while the stated bounds hold.

Source: Song et al. 2011 (paper 004), section 3.1, Eqs. (25), (26), after Zhou & Han 2008. The state of the model is joined by its
error f, f' = w_f; noise is unknown but bounded. The set is guaranteed to hold the truth **while the stated noise and rate bounds
hold**; `State.guarantee` says when the data contradict them. The algebra is in `ellipsoid.py`.

One `predict` per tick with the true time step, then one `update` with the outputs that arrived (NaN: not there).

Deviations from the paper:
  Eq. (25)  B_f is the discretised one, f an acceleration, and f acts on as many states as outputs can tell apart.
  Eq. (26)  corrected (see ellipsoid.py) and taken one output at a time; all at once, as printed, is in asmf_joint.py.
  Q, R      shape matrices of bounds, not covariances: a box of n sides needs n diag(b^2).
  no text   says what to do when a set is empty: here an output that contradicts the set is dropped twice as an outlier, the
            third time running the set is enlarged until it fits. Many enlargements raise Q_f and take authority away.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mavquad.errors import ConfigError
from mavquad.estimate import ellipsoid
from mavquad.jit import kernel

OUTLIERS = 2  # contradictions in a row taken for outliers; the next one enlarges the set
CLEAN_UPDATES = 50  # that bring the guarantee back
INFLATED_MARGIN = 1.2
WINDOW_US = 10_000_000
HALF_ABOVE, OFF_ABOVE = 5, 20  # enlargements within the window
_NEVER_US = -(1 << 62)


@dataclass(frozen=True, slots=True, kw_only=True)
class Params:
    """Bounds of one model with n states (model error included) and m outputs, each in the unit of its state or output."""

    e: tuple[float, ...]  # (m,) largest error of each output
    b: tuple[float, ...]  # (n,) largest unmodelled change of each state per tick
    p0: tuple[float, ...]  # (n,) squared half-axes of the first ellipsoid
    model_error: tuple[int, ...]  # which states are f
    scale: tuple[float, ...] | None = None  # (n,) S: what one unit of each state is worth; SI where None

    def __post_init__(self) -> None:
        n = len(self.b)
        for name, values, floor in (("e", self.e, 0.0), ("p0", self.p0, 0.0), ("scale", self.scale or (1.0,), 0.0)):
            if not all(math.isfinite(v) and v > floor for v in values):
                raise ConfigError(f"asmf.{name} = {values}: every value must be finite and > {floor:g}")
        if not all(math.isfinite(v) and v >= 0.0 for v in self.b):
            raise ConfigError(f"asmf.b = {self.b}: every value must be finite and >= 0")
        if len(self.p0) != n or (self.scale is not None and len(self.scale) != n):
            raise ConfigError(f"asmf.p0 and asmf.scale need one value for each of the {n} states of asmf.b")
        if not all(0 <= i < n for i in self.model_error):
            raise ConfigError(f"asmf.model_error = {self.model_error}: expected indices 0 to {n - 1}")


class Gains(NamedTuple):
    c: np.ndarray  # (m, n)
    e: np.ndarray  # (m,)
    q: np.ndarray  # (n,)
    p0: np.ndarray  # (n,)
    inv_s2: np.ndarray  # (n,)
    is_f: np.ndarray  # (n,) bool


class State(NamedTuple):
    x: np.ndarray  # (n,) centre
    p: np.ndarray  # (n, n)
    guarantee: bool  # false from a contradiction until 50 clean updates
    clean: int  # updates since the last contradiction
    empty: int  # outputs (joint: updates) that contradicted the set, ever
    inflations: int  # times the set was enlarged, ever
    delta: float  # smallest of the last update; NaN before the first
    n_bad: np.ndarray  # (m,) contradictions in a row
    inflated_us: np.ndarray  # (OFF_ABOVE + 1,) times of the last enlargements


def gains(params: Params, c: np.ndarray) -> Gains:
    """c (m, n) with y = C z + v. Raises ConfigError where its shape does not fit the bounds."""
    m, n = len(params.e), len(params.b)
    if c.shape != (m, n):
        raise ConfigError(f"asmf: C is {c.shape[0]} x {c.shape[1]}, but e has {m} and b has {n} values")
    b = np.array(params.b, dtype=float)
    scale = np.ones(n) if params.scale is None else np.array(params.scale, dtype=float)
    is_f = np.zeros(n, dtype=np.bool_)
    is_f[list(params.model_error)] = True
    return Gains(
        np.ascontiguousarray(c, dtype=float),
        np.array(params.e, dtype=float),
        float(np.count_nonzero(b)) * b**2,
        np.array(params.p0, dtype=float),
        1.0 / scale**2,
        is_f,
    )


@kernel
def init(gains: Gains, x: np.ndarray) -> State:
    """A first set around x (n,): half-axes sqrt(p0)."""
    n = x.shape[0]
    p = np.zeros((n, n))
    for i in range(n):
        p[i, i] = gains.p0[i]
    n_bad, inflated_us = np.zeros(gains.e.shape[0], dtype=np.int64), np.full(OFF_ABOVE + 1, _NEVER_US, dtype=np.int64)
    return State(x.copy(), p, True, CLEAN_UPDATES, 0, 0, math.nan, n_bad, inflated_us)


@kernel
def recent_inflations(state: State, t_us: int) -> int:
    """Enlargements in the last 10 s, counted up to 21."""
    count = 0
    for stamp in state.inflated_us:
        if 0 <= t_us - stamp <= WINDOW_US:
            count += 1
    return count


@kernel
def authority(state: State, t_us: int) -> float:
    """What the correction may use: 1, 0.5 above 5 enlargements in 10 s, 0 above 20."""
    count = recent_inflations(state, t_us)
    return 0.0 if count > OFF_ABOVE else (0.5 if count > HALF_ABOVE else 1.0)


@kernel
def predict(gains: Gains, state: State, f: np.ndarray, drive: np.ndarray, ticks: float, t_us: int) -> State:
    """z = F z + drive + w, |w_i| <= ticks b_i: one tick, or the shorter or longer step that was. f (n, n), drive (n,).

    drive holds the inputs as applied (saturated: else saturation is taken for model error) and other known terms.
    """
    x, p = state.x.copy(), state.p.copy()
    q = gains.q * ticks**2
    if recent_inflations(state, t_us) > HALF_ABOVE:
        for i in range(q.shape[0]):
            if gains.is_f[i]:
                q[i] *= 2.0
    ellipsoid.propagate(x, p, f, drive, q, gains.inv_s2)
    return State(
        x,
        p,
        state.guarantee,
        state.clean,
        state.empty,
        state.inflations,
        state.delta,
        state.n_bad,
        state.inflated_us,
    )


@kernel
def update(gains: Gains, state: State, y: np.ndarray, late: np.ndarray, t_us: int) -> State:
    """Intersect with what arrived. y (m,), NaN or inf where nothing (usable) did; late (m,) >= 0 widens e: |rate| x age."""
    if not np.isfinite(y).any():
        return state
    x, p, n_bad = state.x.copy(), state.p.copy(), state.n_bad.copy()
    empty, inflations, delta = _strips(gains, x, p, y, late, n_bad)
    return judged(gains, state, x, p, n_bad, empty, inflations, delta, t_us)


@kernel
def judged(
    gains: Gains,
    state: State,
    x: np.ndarray,
    p: np.ndarray,
    n_bad: np.ndarray,
    empty: int,
    inflations: int,
    delta: float,
    t_us: int,
) -> State:
    """The state after an update that met `empty` contradictions and enlarged the set `inflations` times."""
    ellipsoid.keep_positive(p, gains.inv_s2)
    inflated_us = state.inflated_us
    if inflations > 0:
        inflated_us = inflated_us.copy()
        for k in range(inflations):
            inflated_us[(state.inflations + k) % inflated_us.shape[0]] = t_us
    clean = 0 if empty > 0 else min(state.clean + 1, CLEAN_UPDATES)
    return State(
        x,
        p,
        clean >= CLEAN_UPDATES,
        clean,
        state.empty + empty,
        state.inflations + inflations,
        delta,
        n_bad,
        inflated_us,
    )


@kernel
def half_widths(state: State) -> np.ndarray:
    """(n,) the interval of component i is x_i +- sqrt(P_ii)."""
    n = state.x.shape[0]
    out = np.empty(n)
    for i in range(n):
        out[i] = math.sqrt(max(state.p[i, i], 0.0))
    return out


@kernel
def _strips(
    gains: Gains, x: np.ndarray, p: np.ndarray, y: np.ndarray, late: np.ndarray, n_bad: np.ndarray
) -> tuple[int, int, float]:
    empty, inflations, smallest = 0, 0, math.inf
    n = x.shape[0]
    for i in range(y.shape[0]):
        if not math.isfinite(y[i]):
            continue
        e = gains.e[i] + late[i]
        delta = ellipsoid.strip(x, p, gains.c[i], y[i], e, gains.inv_s2)
        smallest = min(smallest, delta)
        if delta >= 0.0:
            n_bad[i] = 0
            continue
        empty += 1
        n_bad[i] += 1
        if n_bad[i] <= OUTLIERS:
            continue
        nu, g = y[i], 0.0
        for j in range(n):
            nu -= gains.c[i, j] * x[j]
            for k in range(n):
                g += gains.c[i, j] * p[j, k] * gains.c[i, k]
        p *= (INFLATED_MARGIN * (abs(nu) - e)) ** 2 / g
        ellipsoid.strip(x, p, gains.c[i], y[i], e, gains.inv_s2)
        inflations += 1
        n_bad[i] = 0
    return empty, inflations, smallest
