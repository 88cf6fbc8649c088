"""Every observer of the gsmo experiment over a grid of ticks, at the same samples: one compiled loop per family.

All loops take: start (q0, w0); a_half (2n+1,3) torque over inertia at every half tick; has (n,) whether a sample arrives at a
tick; samples (n,4); h the tick [s]; period the nominal sample period [s]. They give rates (n,3) and attitudes (n,4) as
published at each tick: before the step of the explicit observers, after the correction of the others.
"""

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from mavquad.estimate import gsmo_implicit, gsmo_online, gsmo_relay, mekf, rate_baselines, rate_filters
from mavquad.jit import kernel

Array = npt.NDArray[np.float64]


class Stimulus(NamedTuple):
    """What all observers are given."""

    a_half: Array
    has: npt.NDArray[np.bool_]
    samples: Array
    h: float
    period: float


@kernel
def _vec(a: np.ndarray, k: int) -> tuple[float, float, float]:
    return (a[k, 0], a[k, 1], a[k, 2])


@kernel
def _quat(a: np.ndarray, k: int) -> tuple[float, float, float, float]:
    return (a[k, 0], a[k, 1], a[k, 2], a[k, 3])


@kernel
def _store(w_out: np.ndarray, q_out: np.ndarray, k: int, w: tuple, q: tuple) -> None:
    for i in range(3):
        w_out[k, i] = w[i]
    for i in range(4):
        q_out[k, i] = q[i]


@kernel
def relay(gains, stimulus, q0, w0):
    a_half, has, samples, h, period = stimulus
    n = len(has)
    w_out, q_out = np.empty((n, 3)), np.empty((n, 4))
    s = gsmo_relay.State(q0, w0, _quat(samples, 0), 0)
    age = 0.0
    for k in range(n):
        if has[k]:
            s = gsmo_relay.State(s.q, s.w, _quat(samples, k), s.calm)
            age = 0.0
        _store(w_out, q_out, k, s.w, s.q)
        coast = age > 5.0 * period
        s = gsmo_relay.tick(gains, s, coast, _vec(a_half, 2 * k), _vec(a_half, 2 * k + 1), _vec(a_half, 2 * k + 2), h)
        age += h
    return w_out, q_out


@kernel
def implicit(gains, stimulus, q0, w0):
    a_half, has, samples, h, period = stimulus
    n = len(has)
    w_out, q_out = np.empty((n, 3)), np.empty((n, 4))
    s = gsmo_implicit.State(q0, w0, (0.0, 0.0, 0.0))
    since = period
    for k in range(n):
        if has[k]:
            s = gsmo_implicit.correct(gains, s, _quat(samples, k), since)
            since = 0.0
        _store(w_out, q_out, k, s.w, s.q)
        s = gsmo_implicit.predict(gains, s, since > 2.5 * period, _vec(a_half, 2 * k), _vec(a_half, 2 * k + 1), h)
        since += h
    return w_out, q_out


@kernel
def traditional(gains, stimulus, q0, w0):
    a_half, has, samples, h, _ = stimulus
    n = len(has)
    w_out, q_out = np.empty((n, 3)), np.empty((n, 4))
    s = rate_baselines.State(q0, w0, _quat(samples, 0))
    for k in range(n):
        if has[k]:
            s = rate_baselines.State(s.q, s.w, _quat(samples, k))
        _store(w_out, q_out, k, s.w, s.q)
        s = rate_baselines.tick(gains, s, _vec(a_half, 2 * k), _vec(a_half, 2 * k + 1), _vec(a_half, 2 * k + 2), h)
    return w_out, q_out


@kernel
def kalman(gains, stimulus, q0, w0):
    a_half, has, samples, h, _ = stimulus
    n = len(has)
    w_out, q_out = np.empty((n, 3)), np.empty((n, 4))
    s = mekf.init(gains, q0, w0)
    for k in range(n):
        if has[k]:
            s = mekf.update(gains, s, _quat(samples, k))
        _store(w_out, q_out, k, s.w, s.q)
        s = mekf.predict(gains, s, _vec(a_half, 2 * k), _vec(a_half, 2 * k + 1), h)
    return w_out, q_out


@kernel
def online(gyro, stimulus, q0, w0):
    """The bank: started by its first sample, whatever q0 and w0 are, as it is in flight."""
    a_half, has, samples, h, _ = stimulus
    n = len(has)
    w_out, q_out = np.empty((n, 3)), np.empty((n, 4))
    bank = gsmo_online.of(gsmo_online.new(_quat(samples, 0)))
    fresh, since, period = 0, 0.0, 0.0
    for k in range(n):
        if has[k]:
            if fresh == 0:
                gsmo_online.start(bank, _quat(samples, k))
            else:
                if fresh == 1:
                    period = since
                elif since < 2.5 * period:
                    period += (since - period) / min(fresh, 50)
                gsmo_online.correct(bank, _quat(samples, k), since, period, fresh)
            fresh += 1
            since = 0.0
        q, w = gsmo_online.mixed(bank)
        _store(w_out, q_out, k, w, q)
        gap_s = -1.0 if period > 0.0 and since > 2.5 * period else math.inf
        gsmo_online.advance(bank, gyro, _vec(a_half, 2 * k + 1), h, h, gap_s)
        since += h
    return w_out, q_out


@kernel
def difference(cutoff_hz, stimulus):
    """The plain difference of the last two samples, held between samples, through a Butterworth at tick rate."""
    _, has, samples, h, _ = stimulus
    n = len(has)
    d = np.zeros((n, 3))
    rate = (0.0, 0.0, 0.0)
    last = -1
    for k in range(n):
        if has[k]:
            if last >= 0:
                rate = rate_baselines.difference(_quat(samples, last), _quat(samples, k), (k - last) * h)
            last = k
        for i in range(3):
            d[k, i] = rate[i]
    return rate_filters.butterworth_run(rate_filters.butterworth(cutoff_hz, h), d)


LOOPS = {"relay": relay, "implicit": implicit, "traditional": traditional, "kalman": kalman, "online": online}


class Config(NamedTuple):
    name: str
    family: str  # one of LOOPS, or difference
    gains: Any


def run(config: Config, stimulus: Stimulus, q0: tuple, w0: tuple) -> tuple[Array, Array]:
    """One configuration over the grid: rates (n,3), attitudes (n,4), NaN where it has none."""
    if config.family == "difference":
        w = difference(config.gains, stimulus)
        return w, np.full((len(w), 4), math.nan)
    loop = LOOPS[config.family]
    result: tuple[Array, Array] = loop(config.gains, stimulus, q0, w0)
    return result
