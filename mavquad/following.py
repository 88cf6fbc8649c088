"""Whether the vehicle does what is sent: an autopilot may ignore setpoints without a word. Pure.

The thrust axis that was sent, delayed and through the airframe's attitude response, against the one measured. What an autopilot's own
loops leave between the two is small and short, in gusts too; where they part by more for longer, nobody flies our setpoints.
"""

import math
from typing import NamedTuple

from mavquad.airframe import AttitudeResponse
from mavquad.jit import kernel
from mavquad.signals import Quat

LEAST_RAD = math.radians(1.2)  # apart is more than this,
MANY = 3.0  # more than so many times what the two part by as a rule,
SHARE = 0.15  # more than this share of the lean, and than a turn during the delay
FOR_S = 0.2  # apart by twice that for so long and the delay: not followed; by more sooner
AGAIN_S = 1.0  # together for so long: followed again
_RULE_RAD, _RULE_S = (
    math.radians(0.8),
    8.0,
)  # what they part by as a rule, before anything is known and over how long it is learnt
_KEPT_US = 400_000


class State(NamedTuple):
    sent: tuple[tuple[int, float, float], ...]  # vehicle time, thrust axis north and east
    axis: tuple[float, float]  # expected
    rate: tuple[float, float]
    t_us: int
    rule_rad: float  # root mean square of what they part by
    apart_s: float  # weighed by how far
    together_s: float
    follows: bool


START = State((), (0.0, 0.0), (0.0, 0.0), 0, _RULE_RAD, 0.0, 0.0, True)


@kernel
def axis(q: Quat) -> tuple[float, float]:
    """North and east part of the body's z axis in the world, turned up: where the thrust leans."""
    w, x, y, z = q
    return (-2.0 * (x * z + w * y), -2.0 * (y * z - w * x))


@kernel
def answer(
    wn: float, zeta: float, x: tuple[float, float], v: tuple[float, float], u: tuple[float, float], dt_s: float
) -> tuple[tuple[float, float], tuple[float, float]]:
    """A second-order response over dt, in steps it can take."""
    n = int(dt_s / 0.01) + 1
    h = dt_s / n
    x0, x1, v0, v1 = x[0], x[1], v[0], v[1]
    for _ in range(n):
        v0 += h * (wn * wn * (u[0] - x0) - 2.0 * zeta * wn * v0)
        v1 += h * (wn * wn * (u[1] - x1) - 2.0 * zeta * wn * v1)
        x0 += h * v0
        x1 += h * v1
    return (x0, x1), (v0, v1)


def step(response: AttitudeResponse, state: State, t_us: int, sent: Quat, measured: Quat, delay_s: float) -> State:
    """After a control step at t_us that sent an attitude; delay_s from here to the autopilot and back into telemetry."""
    now = axis(measured)
    dt_s = 1e-6 * (t_us - state.t_us)
    if not state.t_us or not 0.0 < dt_s < 0.5:  # the beginning, or a gap: nothing is known of what happened in it
        return START._replace(sent=((t_us, *axis(sent)),), axis=now, t_us=t_us, rule_rad=state.rule_rad, follows=state.follows)
    acts_us = t_us - round(1e6 * (response.delay_s + delay_s))
    old = 0
    while old < len(state.sent) and state.sent[old][0] <= t_us - _KEPT_US:
        old += 1
    kept = (*state.sent[old:], (t_us, *axis(sent)))
    acting = next((entry for entry in reversed(kept) if entry[0] <= acts_us), kept[0])
    x, v = answer(response.natural_frequency_rad_s, response.damping, state.axis, state.rate, acting[1:], dt_s)
    apart = math.hypot(now[0] - x[0], now[1] - x[1])
    lean = max(math.hypot(x[0], x[1]), math.hypot(now[0], now[1]))
    most = max(LEAST_RAD, MANY * state.rule_rad, SHARE * lean, delay_s * math.hypot(v[0], v[1]))
    rule = math.sqrt(state.rule_rad**2 + dt_s / _RULE_S * (min(apart, most) ** 2 - state.rule_rad**2))
    apart_s = max(0.0, state.apart_s + dt_s * (min(apart / most, 4.0) - 1.0))
    together_s = state.together_s + dt_s if apart <= most else 0.0
    follows = state.follows
    if together_s > AGAIN_S:
        follows, apart_s = True, 0.0
    elif apart_s > FOR_S + delay_s:
        follows = False
    return State(kept, x, v, t_us, rule, apart_s, together_s, follows)
