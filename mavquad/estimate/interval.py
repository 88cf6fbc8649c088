"""Interval observer of a scalar that changes slowly and is measured within a bound; and intervals cut with an ellipsoid's.

Source: design note of the ASMF, beyond paper 004: f in [max(lo - b, y - e), min(hi + b, y + e)]. Where the model error itself is
measured (accelerometers) the interval is several times narrower than the ellipsoid's, and as guaranteed: while |y - f| <= e and
|f(k+1) - f(k)| <= b hold.
"""

import math
from typing import NamedTuple

from mavquad.jit import kernel

OUTLIERS = 2  # as in asmf: contradictions in a row that are dropped; the next one opens the interval again


class State(NamedTuple):
    low: float
    high: float
    n_bad: int  # contradictions in a row
    empty: int  # contradictions, ever


class Cut(NamedTuple):
    """The part two intervals share; `consistent` is false where they share none (then it is their hull)."""

    low: float
    high: float
    consistent: bool


def init() -> State:
    """Nothing known: the whole line."""
    return State(-math.inf, math.inf, 0, 0)


@kernel
def predict(state: State, b: float) -> State:
    """One tick: the scalar moved by at most b."""
    return State(state.low - b, state.high + b, state.n_bad, state.empty)


@kernel
def update(state: State, y: float, e: float) -> State:
    """Cut with [y - e, y + e]; a y that is not finite changes nothing."""
    if not math.isfinite(y):
        return state
    low, high = max(state.low, y - e), min(state.high, y + e)
    if low <= high:
        return State(low, high, 0, state.empty)
    if state.n_bad < OUTLIERS:
        return State(state.low, state.high, state.n_bad + 1, state.empty + 1)
    return State(min(state.low, y - e), max(state.high, y + e), 0, state.empty + 1)


@kernel
def cut(a_low: float, a_high: float, b_low: float, b_high: float) -> Cut:
    """What is shown to people: the intersection, or the hull and `consistent` false where it is empty."""
    low, high = max(a_low, b_low), min(a_high, b_high)
    if low <= high:
        return Cut(low, high, True)
    return Cut(min(a_low, b_low), max(a_high, b_high), False)
