"""What a late companion flies with: the same controllers, designed for an attitude response that much later. Pure.

Lateness is the age of a sample when it is acted on, beyond the best age seen: a stalled process, a starved processor and a link
that has become slow all show in it. The largest of late is kept and fades, so a loop that runs in bursts counts as late as its gaps.
A setpoint held for a gap is late by half of it on the mean: bandwidths fall as 1/(lag + delay + half the lateness), which gives
back the phase that it costs.
"""

import dataclasses
import math
from typing import Any

import msgspec

from mavquad.airframe import Airframe

LATE_S = (0.06, 0.12, 0.25)  # designs for a companion that late and later
_MEAN = 0.5  # share of a gap that a setpoint held over it is late by
_FADE_S = 3.0
_MARGIN_S = 0.03  # beside lag and delay, as in the controllers' own rules


def fade(held_s: float, late_s: float, dt_s: float) -> float:
    """The largest lateness of late: at once up, slowly down."""
    return max(late_s, held_s * math.exp(-dt_s / _FADE_S))


def level(now: int, held_s: float) -> int:
    """Which design to fly with (0 the quick one): up at LATE_S, down again below two thirds of it."""
    if not now and held_s < LATE_S[0]:
        return 0
    up = sum(held_s >= limit for limit in LATE_S)
    down = sum(held_s >= limit * 2.0 / 3.0 for limit in LATE_S)
    return min(max(now, up), down)


def designs(module: Any, params: Any, airframe: Airframe) -> tuple[Any, ...]:
    """A controller's gains for each of LATE_S."""
    return tuple(_design(module, params, airframe, late_s) for late_s in LATE_S)


def own_s(airframe: Airframe) -> float:
    """What the vehicle's own attitude response takes, with the margin of the controllers' rules."""
    return airframe.attitude.lag_s + airframe.attitude.delay_s + _MARGIN_S


def _design(module: Any, params: Any, airframe: Airframe, late_s: float) -> Any:
    response, own, more_s = airframe.attitude, own_s(airframe), _MEAN * late_s
    slower = own / (own + more_s)
    changed: dict[str, float] = {}
    for field in dataclasses.fields(params):
        value = getattr(params, field.name)
        if field.name.startswith("wc") and value > 0.0:
            changed[field.name] = slower * value
        elif field.name == "delay_down_s":
            changed[field.name] = value + more_s
        elif field.name == "r_input":  # a bandwidth goes with the fourth root of the weights
            changed[field.name] = value / slower**4
    later = msgspec.structs.replace(response, delay_s=response.delay_s + more_s)
    return module.gains(dataclasses.replace(params, **changed), msgspec.structs.replace(airframe, attitude=later))
