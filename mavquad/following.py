"""Whether the vehicle does what is sent: an autopilot may ignore setpoints without a word. Pure.

The thrust axis that was sent, delayed and through the airframe's attitude response, against the one measured. What an autopilot's own
loops leave between the two is small and short, in gusts too; where they part by more for longer, nobody flies our setpoints.
"""

import math
from typing import NamedTuple

import numpy as np

from mavquad import flat
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
_RING = 512  # setpoints kept: 400 ms at 1 kHz

RECORD = flat.record(
    [
        ("sent_us", "i8", _RING),  # a ring of what was sent: vehicle time,
        ("sent", "f8", (_RING, 2)),  # thrust axis north and east
        ("sent_count", "i8"),  # ever
        ("axis", "f8", 2),  # expected
        ("rate", "f8", 2),
        ("t_us", "i8"),
        ("rule_rad", "f8"),  # root mean square of what they part by
        ("apart_s", "f8"),  # weighed by how far
        ("together_s", "f8"),
    ]
)


class State(NamedTuple):
    follows: bool
    record: np.ndarray  # its bytes

    @property
    def apart_s(self) -> float:
        """For how long they have been apart, weighed by how far."""
        return float(self.record.view(RECORD)["apart_s"][0])


def _start() -> State:
    record = np.zeros(1, RECORD)
    record["rule_rad"] = _RULE_RAD
    return State(True, record.view(np.uint8))


START = _start()


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
    own = (response.natural_frequency_rad_s, response.damping, response.delay_s)
    return State(*_step(state.record, state.follows, own, t_us, sent, measured, delay_s))


@kernel
def _step(state, follows, response, t_us, sent, measured, delay_s):
    out = state.copy()
    return step_in(out.view(RECORD)[0], follows, response, t_us, sent, measured, delay_s), out


@kernel
def step_in(s, follows, response, t_us, sent, measured, delay_s):
    """`step` on a record's item, in place, response as (natural frequency, damping, delay): whether setpoints are followed."""
    now, wanted = axis(measured), axis(sent)
    dt_s = 1e-6 * (t_us - s.t_us)
    if s.t_us == 0 or not 0.0 < dt_s < 0.5:  # the beginning, or a gap: nothing is known of what happened in it
        s.sent_count, s.apart_s, s.together_s = 0, 0.0, 0.0
        _send(s, t_us, wanted)
        s.axis[0], s.axis[1], s.rate[0], s.rate[1], s.t_us = now[0], now[1], 0.0, 0.0, t_us
        return follows
    _send(s, t_us, wanted)
    natural_rad_s, damping, own_delay_s = response
    x, v = answer(
        natural_rad_s, damping, (s.axis[0], s.axis[1]), (s.rate[0], s.rate[1]), _acting(s, t_us, own_delay_s + delay_s), dt_s
    )
    apart = math.hypot(now[0] - x[0], now[1] - x[1])
    lean = max(math.hypot(x[0], x[1]), math.hypot(now[0], now[1]))
    most = max(LEAST_RAD, MANY * s.rule_rad, SHARE * lean, delay_s * math.hypot(v[0], v[1]))
    s.rule_rad = math.sqrt(s.rule_rad**2 + dt_s / _RULE_S * (min(apart, most) ** 2 - s.rule_rad**2))
    s.apart_s = max(0.0, s.apart_s + dt_s * (min(apart / most, 4.0) - 1.0))
    s.together_s = s.together_s + dt_s if apart <= most else 0.0
    if s.together_s > AGAIN_S:
        follows, s.apart_s = True, 0.0
    elif s.apart_s > FOR_S + delay_s:
        follows = False
    s.axis[0], s.axis[1], s.rate[0], s.rate[1], s.t_us = x[0], x[1], v[0], v[1], t_us
    return follows


@kernel
def reset_in(s):
    """A record's item as at the start."""
    s.sent_count, s.t_us, s.rule_rad, s.apart_s, s.together_s = 0, 0, _RULE_RAD, 0.0, 0.0
    s.axis[0], s.axis[1], s.rate[0], s.rate[1] = 0.0, 0.0, 0.0, 0.0


@kernel
def _send(s, t_us, wanted):
    i = s.sent_count % _RING
    s.sent_us[i], s.sent[i, 0], s.sent[i, 1] = t_us, wanted[0], wanted[1]
    s.sent_count += 1


@kernel
def _acting(s, t_us, delay_s):
    """The thrust axis sent that acts now, of those of the last moments: the newest old enough, else the oldest."""
    acts_us = t_us - round(1e6 * delay_s)
    newest = s.sent_count - 1
    oldest = newest
    for k in range(min(s.sent_count, _RING)):
        i = (newest - k) % _RING
        if k > 0 and s.sent_us[i] <= t_us - _KEPT_US:
            break
        oldest = i
        if s.sent_us[i] <= acts_us:
            return (s.sent[i, 0], s.sent[i, 1])
    return (s.sent[oldest % _RING, 0], s.sent[oldest % _RING, 1])
