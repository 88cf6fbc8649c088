"""Sweeps to fly: an exponential frequency sweep with quiet ends on one input, small known noise on the others.

Source: Song et al. 2011 (paper 004), section 4.2; frequency law of Tischler & Remple.

Deviations from the paper:
  section 4.2  0.05-8 Hz in 90 s instead of 1-20 Hz in 30 s: the speed derivatives live below 1 rad/s, and 20 Hz is 0.8 of the
               Nyquist frequency at 50 Hz. No 10 Hz band-stop: it would turn the phase inside the band.
  section 4.2  the other inputs carry small known noise, without which a closed loop leaves the input matrix singular.
"""

import math
from dataclasses import dataclass

import numpy as np

from mavquad.errors import ConfigError

GROWTH = 4.0  # w(t) = w0 + SHAPE (e^(4 t/T) - 1)(w1 - w0)
SHAPE = 0.0187


@dataclass(frozen=True, slots=True, kw_only=True)
class Sweep:
    """One sweep: amplitude in the unit of the input it goes to (stick, rad, thrust)."""

    amplitude: float
    f_start_hz: float = 0.05
    f_end_hz: float = 8.0
    duration_s: float = 90.0
    quiet_s: float = 5.0  # before and after
    fade_s: float = 3.0

    def __post_init__(self) -> None:
        if not 0.0 < self.f_start_hz < self.f_end_hz:
            raise ConfigError(f"sweep: need 0 < f_start_hz < f_end_hz, got {self.f_start_hz:g} and {self.f_end_hz:g}")
        if not (self.amplitude > 0.0 and math.isfinite(self.amplitude)):
            raise ConfigError(f"sweep.amplitude must be > 0, got {self.amplitude:g}")
        if not self.duration_s > 2.0 * self.fade_s >= 0.0:
            raise ConfigError(f"sweep.duration_s must exceed twice fade_s, got {self.duration_s:g} and {self.fade_s:g}")
        if self.duration_s * self.f_start_hz < 1.0:
            raise ConfigError(
                f"sweep: {self.duration_s:g} s hold less than one period of {self.f_start_hz:g} Hz; lengthen it or start higher"
            )

    @property
    def total_s(self) -> float:
        return self.duration_s + 2.0 * self.quiet_s


def check_rate(sweep: Sweep, dt_s: float) -> None:
    """Refuse a sweep above 0.35 of the sample rate. Raises ConfigError."""
    if sweep.f_end_hz > 0.35 / dt_s:
        raise ConfigError(
            f"sweep.f_end_hz {sweep.f_end_hz:g} is above {0.35 / dt_s:.3g} Hz (0.35 of the {1 / dt_s:.3g} Hz commands)"
        )


def value(sweep: Sweep, t_s: float) -> float:
    """The sweep at `t_s` after its start (quiet head included); zero outside."""
    t = t_s - sweep.quiet_s
    if not 0.0 <= t <= sweep.duration_s:
        return 0.0
    w0, w1 = 2.0 * math.pi * sweep.f_start_hz, 2.0 * math.pi * sweep.f_end_hz
    grow = sweep.duration_s / GROWTH * math.expm1(GROWTH * t / sweep.duration_s)  # integral of e^(4 t/T)
    phase = w0 * t + SHAPE * (w1 - w0) * (grow - t)
    return sweep.amplitude * _fade(sweep, t) * math.sin(phase)


def frequency_hz(sweep: Sweep, t_s: float) -> float:
    """The momentary frequency at `t_s` after the start, held at its ends."""
    t = min(max(t_s - sweep.quiet_s, 0.0), sweep.duration_s)
    return sweep.f_start_hz + SHAPE * math.expm1(GROWTH * t / sweep.duration_s) * (sweep.f_end_hz - sweep.f_start_hz)


def record(sweep: Sweep, dt_s: float, axis: int, axes: int, rng: np.random.Generator) -> np.ndarray:
    """The excitation of all inputs, (N, axes): the sweep on `axis`, small low-passed noise on the others (seeded by `rng`)."""
    check_rate(sweep, dt_s)
    count = round(sweep.total_s / dt_s)
    r = np.empty((count, axes))
    for j in range(axes):
        r[:, j] = (
            [value(sweep, k * dt_s) for k in range(count)]
            if j == axis
            else off_axis(count, dt_s, 0.15 * sweep.amplitude, rng) * _window(sweep, count, dt_s)
        )
    return r


def linear_record(
    amplitude: float,
    f_start_hz: float,
    f_end_hz: float,
    duration_s: float,
    dt_s: float,
    axis: int,
    axes: int,
    rng: np.random.Generator,
) -> np.ndarray:
    """The paper's own sweep (section 4.2): linear in frequency, no quiet ends; for comparison only. Shape (N, axes)."""
    t = np.arange(round(duration_s / dt_s)) * dt_s
    r = np.empty((t.size, axes))
    for j in range(axes):
        if j == axis:
            r[:, j] = amplitude * np.sin(2.0 * np.pi * (f_start_hz * t + (f_end_hz - f_start_hz) * t**2 / (2.0 * duration_s)))
        else:
            r[:, j] = off_axis(t.size, dt_s, 0.15 * amplitude, rng)
    return r


def off_axis(count: int, dt_s: float, sigma: float, rng: np.random.Generator, tau_s: float = 0.15) -> np.ndarray:
    """Low-passed noise (N,) of standard deviation `sigma`: AR(1) with time constant `tau_s`."""
    return ar1(count, dt_s, sigma, tau_s, rng)


def ar1(count: int, dt_s: float, sigma: float, tau_s: float, rng: np.random.Generator) -> np.ndarray:
    """Stationary AR(1) noise (N,) with standard deviation `sigma` and time constant `tau_s`."""
    keep = math.exp(-dt_s / tau_s)
    white = rng.standard_normal(count)
    out = np.empty(count)
    last = out[0] = sigma * white[0]
    drive = sigma * math.sqrt(1.0 - keep * keep)
    for k in range(1, count):
        last = out[k] = keep * last + drive * white[k]
    return out


def _fade(sweep: Sweep, t: float) -> float:
    if sweep.fade_s <= 0.0:
        return 1.0
    edge = min(t, sweep.duration_s - t) / sweep.fade_s
    return 1.0 if edge >= 1.0 else 0.5 - 0.5 * math.cos(math.pi * edge)


def _window(sweep: Sweep, count: int, dt_s: float) -> np.ndarray:
    inside = [k * dt_s - sweep.quiet_s for k in range(count)]
    return np.array([_fade(sweep, t) if 0.0 <= t <= sweep.duration_s else 0.0 for t in inside])
