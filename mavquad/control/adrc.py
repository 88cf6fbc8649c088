"""Active disturbance rejection by Han: tracking differentiator, nonlinear extended state observer, nonlinear feedback.

Source: Han 2009, "From PID to Active Disturbance Rejection Control"; the baseline of Yang, Lyu & Chai 2022, whose own
ADRC gains are not printed anywhere. One channel xdd = a + d at a time, only x measured.

Deviations from the source:
  -  discrete as in the method's note: every state is updated from the old values, after the control of the step has used them.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

from mavquad.errors import ConfigError
from mavquad.jit import kernel


@dataclass(frozen=True, slots=True, kw_only=True)
class HanParams:
    """What a person tunes; the observer gains follow from the period (Han's rule) unless given."""

    h_s: float
    r_rad_s2: float = 200.0  # largest acceleration of the tracking differentiator
    filter_steps: float = 5.0  # h0/h of fhan
    k_error: float = 100.0
    k_rate: float = 20.0
    alpha_error: float = 0.75
    alpha_rate: float = 1.0
    delta_feedback: float = 0.1
    alpha_velocity: float = 0.5  # of the observer's second and third equation
    alpha_disturbance: float = 0.25
    delta_observer: float = 0.01

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ConfigError(f"adrc.{name} must be finite and > 0, got {value}")


class HanGains(NamedTuple):
    h: float
    r: float
    h0: float
    k: tuple[float, float]
    alpha: tuple[float, float]
    delta: float
    b: tuple[float, float, float]
    alpha_eso: tuple[float, float]
    delta_eso: float


class HanState(NamedTuple):
    """Observer [position, velocity, disturbance] and the differentiator's [reference, its rate]."""

    z: tuple[float, float, float]
    x: tuple[float, float]


def gains(params: HanParams) -> HanGains:
    """Han's observer gains for the period h: 1, 1/(2 h^0.5), 2/(25 h^1.2), applied without a further factor h."""
    p = params
    return HanGains(
        p.h_s,
        p.r_rad_s2,
        p.filter_steps * p.h_s,
        (p.k_error, p.k_rate),
        (p.alpha_error, p.alpha_rate),
        p.delta_feedback,
        (1.0, 0.5 / math.sqrt(p.h_s), 2.0 / (25.0 * p.h_s**1.2)),
        (p.alpha_velocity, p.alpha_disturbance),
        p.delta_observer,
    )


@kernel
def init(position: float) -> HanState:
    """At rest at a position (or an angle), the reference there too."""
    return HanState((position, 0.0, 0.0), (position, 0.0))


@kernel
def fal(e: float, alpha: float, delta: float) -> float:
    """|e|^alpha sign(e), made linear within delta."""
    if abs(e) <= delta:
        return e / delta ** (1.0 - alpha)
    return math.copysign(abs(e) ** alpha, e)


@kernel
def _sign(x: float) -> float:
    if x > 0.0:
        return 1.0
    if x < 0.0:
        return -1.0
    return 0.0


@kernel
def fhan(x1: float, x2: float, r: float, h0: float) -> float:
    """Han's time-optimal synthesis: the acceleration, at most r, that takes (x1, x2) to rest at 0 without chatter."""
    d = r * h0 * h0
    a0 = h0 * x2
    y = x1 + a0
    a1 = math.sqrt(d * (d + 8.0 * abs(y)))
    a2 = a0 + _sign(y) * (a1 - d) / 2.0
    near = (_sign(y + d) - _sign(y - d)) / 2.0
    a = (a0 + y - a2) * near + a2
    inside = (_sign(a + d) - _sign(a - d)) / 2.0
    return -r * (a / d - _sign(a)) * inside - r * _sign(a)


@kernel
def observe(gains: HanGains, z: tuple[float, float, float], y: float, a: float) -> tuple[float, float, float]:
    """The observer's state after the sample y and the acceleration `a` applied from now on (after saturation)."""
    e = z[0] - y
    h = gains.h
    return (
        z[0] + h * z[1] - gains.b[0] * e,
        z[1] + h * (z[2] + a) - gains.b[1] * fal(e, gains.alpha_eso[0], gains.delta_eso),
        z[2] - gains.b[2] * fal(e, gains.alpha_eso[1], gains.delta_eso),
    )


@kernel
def differentiate(gains: HanGains, x: tuple[float, float], reference: float) -> tuple[float, float]:
    """The tracking differentiator's state one period on."""
    return (x[0] + gains.h * x[1], x[1] + gains.h * fhan(x[0] - reference, x[1], gains.r, gains.h0))


@kernel
def feedback(gains: HanGains, x: tuple[float, float], z: tuple[float, float, float]) -> float:
    """The acceleration wanted: nonlinear feedback of the two errors, the estimated disturbance cancelled."""
    return (
        gains.k[0] * fal(x[0] - z[0], gains.alpha[0], gains.delta)
        + gains.k[1] * fal(x[1] - z[1], gains.alpha[1], gains.delta)
        - z[2]
    )
