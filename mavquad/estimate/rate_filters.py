"""Filters for a published rate: Butterworth, model-following, and zero-phase for replay.

A low-pass lags: second order at f Hz delays slow motion by sqrt(2)/(2 pi f), 45 ms at 5 Hz. The model-following filter does not
lag as long as the torque is known. Zero-phase filters look into the future and serve recordings only.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from mavquad import linalg
from mavquad.estimate import lie
from mavquad.jit import kernel
from mavquad.quat import Vec3


class Butterworth(NamedTuple):
    """Second-order low-pass by the bilinear transform, prewarped."""

    b0: float
    b1: float
    b2: float
    a1: float
    a2: float


@kernel
def butterworth(cutoff_hz: float, dt_s: float) -> Butterworth:
    """Coefficients for samples dt_s apart; cutoff below half the sample rate."""
    k = math.tan(math.pi * cutoff_hz * dt_s)
    n = 1.0 / (1.0 + math.sqrt(2.0) * k + k * k)
    return Butterworth(k * k * n, 2.0 * k * k * n, k * k * n, 2.0 * (k * k - 1.0) * n, (1.0 - math.sqrt(2.0) * k + k * k) * n)


@kernel
def butterworth_delay_s(cutoff_hz: float, dt_s: float) -> float:
    """Group delay at low frequency: sqrt(2)/(2 pi f), less what the prewarping takes away."""
    return math.sqrt(0.5) * dt_s / math.tan(math.pi * cutoff_hz * dt_s)


@kernel
def butterworth_run(c: Butterworth, x: np.ndarray) -> np.ndarray:
    """Every column of x (n,m) filtered forwards, started at rest on its first value."""
    n, m = x.shape
    y = np.empty((n, m))
    for j in range(m):
        s1 = (1.0 - c.b0) * x[0, j]
        s2 = (c.b2 - c.a2) * x[0, j]
        for i in range(n):
            y[i, j] = c.b0 * x[i, j] + s1
            s1 = c.b1 * x[i, j] - c.a1 * y[i, j] + s2
            s2 = c.b2 * x[i, j] - c.a2 * y[i, j]
    return y


def low_pass(x: npt.NDArray[np.float64], cutoff_hz: float, dt_s: float) -> npt.NDArray[np.float64]:
    """x (n,m) through the Butterworth, as it would be live."""
    return butterworth_run(butterworth(cutoff_hz, dt_s), x)


def zero_phase(x: npt.NDArray[np.float64], cutoff_hz: float, dt_s: float) -> npt.NDArray[np.float64]:
    """x (n,m) forwards and backwards through the Butterworth: no lag, attenuation squared. For recordings only.

    The ends are prolonged by three time constants of odd reflection, so that they do not ring.
    """
    from scipy import signal  # slow to load

    pad = min(len(x) - 1, math.ceil(3.0 / (2.0 * math.pi * cutoff_hz * dt_s)))
    c = butterworth(cutoff_hz, dt_s)
    return np.ascontiguousarray(signal.filtfilt((c.b0, c.b1, c.b2), (1.0, c.a1, c.a2), x, axis=0, padlen=pad))


@kernel
def follow_model_predict(gyro: Vec3, y: Vec3, a0: Vec3, a1: Vec3, h: float) -> Vec3:
    """The filtered rate moved to the next tick under the known torque over inertia a0 (now), a1 (h/2 later)."""
    y_mid = linalg.axpy(0.5 * h, lie.rate_derivative(gyro, y, a0), y)
    return linalg.axpy(h, lie.rate_derivative(gyro, y_mid, a1), y)


@kernel
def follow_model_run(gyro: Vec3, w_hat: np.ndarray, a_half: np.ndarray, cutoff_hz: float, h: float) -> np.ndarray:
    """w_hat (n,3) at ticks of h seconds; a_half (2n,3) torque over inertia at every half tick. Started on the first value."""
    out = np.empty_like(w_hat)
    gain = 1.0 - math.exp(-2.0 * math.pi * cutoff_hz * h)
    y = (w_hat[0, 0], w_hat[0, 1], w_hat[0, 2])
    for k in range(len(w_hat)):
        y = linalg.axpy(gain, linalg.sub((w_hat[k, 0], w_hat[k, 1], w_hat[k, 2]), y), y)
        out[k, 0], out[k, 1], out[k, 2] = y
        a0 = (a_half[2 * k, 0], a_half[2 * k, 1], a_half[2 * k, 2])
        a1 = (a_half[2 * k + 1, 0], a_half[2 * k + 1, 1], a_half[2 * k + 1, 2])
        y = follow_model_predict(gyro, y, a0, a1, h)
    return out
