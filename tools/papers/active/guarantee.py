"""Do the bounds hold the truth? The 19-state filter of the reference helicopter under noise at its bounds, in many variants.

Set-up of the design note, section 6: truth = model plus w in +-b (0.01 per tick on f_u, f_v, f_w, 0.02 on f_q, f_p, f_r), 3000
steps of 20 ms in closed loop (LQR on the estimate), noise uniform or in square waves of 50 steps at the bound.
"""

import math
from typing import NamedTuple

import numpy as np

from mavquad.compensate import helicopter
from mavquad.estimate import asmf, asmf_joint, augment, ellipsoid, interval
from mavquad.identify import models
from mavquad.jit import kernel
from mavquad.statespace import zoh

DT_S = 0.02
STEPS = 3000
SQUARE_STEPS = 50
ROWS = ("u", "q", "v", "p", "w", "r")
E = {"u": 0.05, "q": 0.01, "theta": 0.005, "v": 0.05, "p": 0.01, "phi": 0.005, "w": 0.05, "r": 0.01}
B_F = {"u": 0.01, "q": 0.02, "v": 0.01, "p": 0.02, "w": 0.01, "r": 0.02}

# form, rho on scaled outputs, R = diag(e^2) without the factor m, model error on every state
VARIANTS = {
    "printed": ("printed", False, False, False),
    "corrected": ("joint", False, False, False),
    "scaled": ("joint", True, False, False),
    "strips": ("strips", True, False, False),
    "R=diag(e2)": ("joint", True, True, False),
    "Bf=I": ("joint", True, False, True),
}
NOISES = ("uniform", "square")


class Containment(NamedTuple):
    """Shares in percent; half-widths and errors per model error, averaged over the second half."""

    inside_pct: float
    half_width: np.ndarray  # (n_f,)
    error: np.ndarray  # (n_f,) mean absolute
    empty: int
    inflations: int


def box_noise(rng: np.random.Generator, kind: str, steps: int, size: np.ndarray) -> np.ndarray:
    """(steps, n) uniform within +-size, or square waves at +-size with a random phase."""
    if kind == "uniform":
        return rng.uniform(-1.0, 1.0, (steps, size.size)) * size
    phase = rng.integers(0, 2 * SQUARE_STEPS, size.size)
    return np.where((np.arange(steps)[:, None] + phase) // SQUARE_STEPS % 2 == 0, 1.0, -1.0) * size


def contain(variant: str, noise: str, seed: int, *, steps: int = STEPS, b_model: float = 0.0) -> Containment:
    """One run of a variant. `b_model` is what the filter allows on the model states (the truth moves them by nothing)."""
    form, scaled, without_m, on_all = VARIANTS[variant]
    model = models.ref_13()
    rng = np.random.default_rng(seed)
    e = np.array([E[name] for name in model.outputs])
    b = np.array([B_F[name] for name in ROWS])
    truth = augment.with_model_error(model.a, model.b, model.c, model.states, ROWS, DT_S)
    if on_all:
        f, g, c, b_all = _error_on_every_state(model, b)
    else:
        f, g, c, b_all = truth.f, truth.g, truth.c, np.concatenate([np.full(13, b_model), b])
    n = f.shape[0]
    params = asmf.Params(e=tuple(e), b=tuple(b_all), p0=(float(n),) * n, model_error=tuple(range(13, n)))
    filter_gains = asmf.gains(params, c)
    r = e**2 if without_m else e.size * e**2
    z0 = rng.uniform(-1.0, 1.0, 19)
    w = np.zeros((steps, 19))
    w[:, 13:] = box_noise(rng, noise, steps, b)
    picks = np.array([13 + model.states.index(name) for name in ROWS] if on_all else range(13, 19))
    k = helicopter.gains(helicopter.Params(), model.a, model.b, model.states).k_attitude
    inside, width, error, state = _contain(
        (form != "strips", scaled, form == "printed"),
        filter_gains,
        asmf.init(filter_gains, np.zeros(n)),
        r,
        (truth.f, truth.g, truth.c),
        (f, g),
        k,
        z0,
        w,
        box_noise(rng, noise, steps, e),
        picks,
    )
    return Containment(100.0 * inside / steps, width, error, state.empty, state.inflations)


def decoupled(b_f: float, seed: int, *, steps: int = STEPS) -> dict[str, tuple[float, float]]:
    """Per axis (v, f) with e_v 0.06 at 25 Hz and e_a 0.35: {"decoupled", "interval"} -> (inside %, mean half-width)."""
    rng = np.random.default_rng(seed)
    params = asmf.Params(e=(0.06, 0.35), b=(0.004, b_f), p0=(2.0, 50.0), model_error=(1,), scale=(1.0, 1.0))
    filter_gains = asmf.gains(params, np.eye(2))
    noise = rng.uniform(-1.0, 1.0, (steps, 4)) * np.array([0.004, b_f, 0.06, 0.35])
    in_set, set_width, in_interval, interval_width = _decoupled(
        filter_gains, asmf.init(filter_gains, np.zeros(2)), interval.init(), noise, b_f
    )
    return {
        "decoupled": (100.0 * in_set / steps, set_width),
        "interval": (100.0 * in_interval / steps, interval_width),
    }


def _error_on_every_state(model: models.Model, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """B_f = I_13, which `augment` refuses: 26 unknowns for eight outputs. The five hidden errors may move as f_u does."""
    n = model.a.shape[0]
    a_d, b_d = zoh(model.a, np.hstack([model.b, np.eye(n)]), DT_S)
    f = np.block([[a_d, b_d[:, 4:]], [np.zeros((n, n)), np.eye(n)]])
    g = np.vstack([b_d[:, :4], np.zeros((n, 4))])
    b_all = np.concatenate([np.zeros(n), np.full(n, 0.01)])
    for name, value in zip(ROWS, b, strict=True):
        b_all[n + model.states.index(name)] = value
    return f, g, np.hstack([model.c, np.zeros_like(model.c)]), b_all


@kernel
def _contain(
    form: tuple[bool, bool, bool],
    gains: asmf.Gains,
    state: asmf.State,
    r: np.ndarray,
    truth: tuple[np.ndarray, np.ndarray, np.ndarray],
    model: tuple[np.ndarray, np.ndarray],
    k: np.ndarray,
    z0: np.ndarray,
    w: np.ndarray,
    v: np.ndarray,
    picks: np.ndarray,
) -> tuple[int, np.ndarray, np.ndarray, asmf.State]:
    steps, n, n_f = w.shape[0], state.x.shape[0], picks.shape[0]
    joint, scaled, printed = form
    f_true, g_true, c_true = truth
    f, g = model
    z, on_time = z0.copy(), np.zeros(v.shape[1])
    width, error = np.zeros(n_f), np.zeros(n_f)
    inside, counted = 0, 0
    padded = np.zeros(n)
    for step in range(steps):
        t_us = step * 20_000
        y = v[step] + _times(c_true, z)
        if joint:
            state = asmf_joint.update(gains, state, y, r, scaled, printed, t_us)
        else:
            state = asmf.update(gains, state, y, on_time, t_us)
        for i in range(13):
            padded[i] = z[i]
        for i in range(n_f):
            padded[picks[i]] = z[13 + i]
        if ellipsoid.form(state.x, state.p, padded) <= 1.0:
            inside += 1
        if step >= steps // 2:
            counted += 1
            for i in range(n_f):
                width[i] += math.sqrt(state.p[picks[i], picks[i]])
                error[i] += abs(state.x[picks[i]] - z[13 + i])
        u = -_times(k, state.x[:13])
        z = _times(f_true, z) + _times(g_true, u) + w[step]
        state = asmf.predict(gains, state, f, _times(g, u), 1.0, t_us)
    return inside, width / counted, error / counted, state


@kernel
def _times(a: np.ndarray, x: np.ndarray) -> np.ndarray:
    out = np.zeros(a.shape[0])
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            out[i] += a[i, j] * x[j]
    return out


@kernel
def _decoupled(
    gains: asmf.Gains, state: asmf.State, scalar: interval.State, noise: np.ndarray, b_f: float
) -> tuple[int, float, int, float]:
    steps = noise.shape[0]
    f = np.array([[1.0, DT_S], [0.0, 1.0]])
    nothing = np.zeros(2)
    v, error = 0.0, 0.0
    in_set, in_interval, counted = 0, 0, 0
    set_width, interval_width = 0.0, 0.0
    for step in range(steps):
        v += DT_S * error + noise[step, 0]
        error += noise[step, 1]
        state = asmf.predict(gains, state, f, nothing, 1.0, step * 20_000)
        y = np.array([v + noise[step, 2] if step % 2 == 0 else math.nan, error + noise[step, 3]])
        state = asmf.update(gains, state, y, nothing, step * 20_000)
        scalar = interval.update(interval.predict(scalar, b_f), error + noise[step, 3], gains.e[1])
        half = math.sqrt(state.p[1, 1])
        if abs(error - state.x[1]) <= half:
            in_set += 1
        if scalar.low <= error <= scalar.high:
            in_interval += 1
        if step >= steps // 2:
            counted += 1
            set_width += half
            interval_width += 0.5 * (scalar.high - scalar.low)
    return in_set, set_width / counted, in_interval, interval_width / counted
