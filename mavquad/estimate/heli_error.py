"""Model error of a helicopter with bounds: the 13-state hover model and six accelerations in the ASMF.

x' = A x + B U + k(y) + B_f f + w: k(y) holds what is known beyond the linear model, rigid-body coupling, gravity and the
kinematics of roll and pitch, from the estimate itself. f acts on u', q', v', p', w', r': what eight outputs can tell apart.

Source: Song et al. 2011 (paper 004), Eqs. (6), (25); design note of the ASMF, sections 2, 6 and 7.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mavquad.errors import ConfigError
from mavquad.estimate import asmf, augment
from mavquad.jit import kernel

G_M_S2 = 9.80665
STATES = ("u", "q", "theta", "a", "c", "v", "p", "phi", "b", "d", "w", "r", "r_fb")
U, Q, THETA, A, C, V, P, PHI, B, D, W, R, R_FB = range(13)
ROWS = ("u", "q", "v", "p", "w", "r")  # where f acts
OUTPUTS = ("theta", "phi", "q", "p", "r", "u", "v", "w")  # in the order in which strips are taken
N = len(STATES)


@dataclass(frozen=True, slots=True, kw_only=True)
class Params:
    e: tuple[float, ...] = (0.005, 0.005, 0.01, 0.01, 0.01, 0.05, 0.05, 0.05)  # of OUTPUTS
    b_model: float = 0.0  # per tick, on every state of the model
    b_f: tuple[float, ...] = (0.03, 0.2, 0.03, 0.3, 0.06, 0.06)  # of ROWS, per tick
    p0: float = 19.0
    tick_s: float = 0.02

    def __post_init__(self) -> None:
        if len(self.e) != len(OUTPUTS) or len(self.b_f) != len(ROWS):
            raise ConfigError(f"heli_error: e needs {len(OUTPUTS)} values ({', '.join(OUTPUTS)}), b_f {len(ROWS)}")


class Gains(NamedTuple):
    filter: asmf.Gains
    f: np.ndarray  # (19, 19)
    g: np.ndarray  # (19, 4)
    known: np.ndarray  # (19, 13)


def gains(params: Params, a: np.ndarray, b: np.ndarray, states: tuple[str, ...]) -> Gains:
    """a (13, 13), b (13, 4) of the hover model, its states named in the order of STATES. Raises ConfigError."""
    if tuple(states) != STATES:
        raise ConfigError(f"heli_error: the model's states are {', '.join(states)}; expected {', '.join(STATES)}")
    c = np.array([[1.0 if state == output else 0.0 for state in STATES] for output in OUTPUTS])
    model = augment.with_model_error(a, b, c, STATES, ROWS, params.tick_s)
    n = N + len(ROWS)
    filter_params = asmf.Params(
        e=params.e, b=(params.b_model,) * N + params.b_f, p0=(params.p0,) * n, model_error=tuple(range(N, n))
    )
    return Gains(asmf.gains(filter_params, model.c), model.f, model.g, model.known)


def init(gains: Gains) -> asmf.State:
    """Around hover."""
    return asmf.init(gains.filter, np.zeros(gains.f.shape[0]))


@kernel
def known_terms(x: np.ndarray) -> np.ndarray:
    """k (13,): coupling, gravity beyond its linear part, attitude kinematics beyond theta' = q, phi' = p."""
    k = np.zeros(13)
    u, v, w, p, q, r, theta, phi = x[U], x[V], x[W], x[P], x[Q], x[R], x[THETA], x[PHI]
    k[U] = r * v - q * w - G_M_S2 * (math.sin(theta) - theta)
    k[V] = p * w - r * u + G_M_S2 * (math.cos(theta) * math.sin(phi) - phi)
    k[W] = q * u - p * v + G_M_S2 * (math.cos(theta) * math.cos(phi) - 1.0)
    k[THETA] = q * math.cos(phi) - r * math.sin(phi) - q
    k[PHI] = (q * math.sin(phi) + r * math.cos(phi)) * math.tan(theta)
    return k


@kernel
def drive(gains: Gains, x: np.ndarray, stick: np.ndarray) -> np.ndarray:
    """(19,) the known part of one tick: held sticks (4,) as applied, and k(x)."""
    k = known_terms(x)
    n = gains.f.shape[0]
    out = np.zeros(n)
    for i in range(n):
        for j in range(4):
            out[i] += gains.g[i, j] * stick[j]
        for j in range(13):
            out[i] += gains.known[i, j] * k[j]
    return out


@kernel
def step(gains: Gains, state: asmf.State, stick: np.ndarray, y: np.ndarray, t_us: int) -> asmf.State:
    """One tick: predict with the sticks (4,) that acted since the last one, then the outputs (8,) that arrived (NaN: none)."""
    state = asmf.predict(gains.filter, state, gains.f, drive(gains, state.x, stick), 1.0, t_us)
    return asmf.update(gains.filter, state, y, np.zeros(y.shape[0]), t_us)


@kernel
def ahead(gains: Gains, x: np.ndarray, sticks: np.ndarray) -> np.ndarray:
    """The centre (19,) some ticks later, with the sticks (ticks, 4) that are on their way, oldest first."""
    x = x.copy()
    for k in range(sticks.shape[0]):
        moved = drive(gains, x, sticks[k])
        for i in range(x.shape[0]):
            for j in range(x.shape[0]):
                moved[i] += gains.f[i, j] * x[j]
        x = moved
    return x
