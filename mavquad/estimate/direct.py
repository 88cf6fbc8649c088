"""No estimator: the autopilot's own position, velocity, attitude and rates, carried forward to now. What `pd` and `pid` fly on."""

from dataclasses import dataclass
from typing import NamedTuple

from mavquad.airframe import Airframe
from mavquad.signals import NAN3, ZERO3, Applied, Attitude, Estimate, Position, Quat, Vec3


@dataclass(frozen=True, slots=True, kw_only=True)
class Params:
    """Nothing to tune but how far a sample may be carried forward."""

    carry_s: float = 0.2


class Gains(NamedTuple):
    carry_s: float


class State(NamedTuple):
    position: Position | None
    q_wxyz: Quat
    omega_rad_s: Vec3


def gains(params: Params, airframe: Airframe) -> Gains:
    return Gains(params.carry_s)


def init(gains: Gains) -> State:
    return State(None, (1.0, 0.0, 0.0, 0.0), ZERO3)


def observe(gains: Gains, state: State, sample: object) -> State:
    """Keep the newest attitude and position."""
    if isinstance(sample, Attitude):
        return State(state.position, sample.q_wxyz, sample.omega_rad_s)
    if isinstance(sample, Position):
        return State(sample, state.q_wxyz, state.omega_rad_s)
    return state


def step(gains: Gains, state: State, applied: Applied, t_us: int) -> tuple[State, Estimate]:
    """The last position carried forward by its velocity."""
    if state.position is None:
        return state, Estimate(t_us, NAN3, NAN3, state.q_wxyz, state.omega_rad_s, NAN3, NAN3)
    _, p, v = state.position
    age_s = min(gains.carry_s, max(0.0, 1e-6 * (t_us - state.position.t_us)))
    now = (p[0] + age_s * v[0], p[1] + age_s * v[1], p[2] + age_s * v[2])
    return state, Estimate(t_us, now, v, state.q_wxyz, state.omega_rad_s, NAN3, NAN3)


def uses(gains: Gains) -> tuple[str, ...]:
    """The kinds of samples that `observe` keeps."""
    return ("Attitude", "Position")
