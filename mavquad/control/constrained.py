"""The constrained MPC: thrust, tilt and slew over the horizon, as two quadratic programs; the vertical one first.

Source: Yang, Lyu, Chai 2022 has no constraints; section 5.3 of the design note. Variables are u~ = u - u_path per stage, u_path
previewed, so G = H'QH + R never changes and only vectors are updated. The tilt cone is an octagon whose size follows the thrust of
the vertical program's first stage.

Where the unconstrained optimum breaks no row it is the solution (the problem is strictly convex) and nothing is solved.
"""

import math
from typing import NamedTuple

import numpy as np

from mavquad.control import prediction, qp
from mavquad.control.prediction import Model
from mavquad.jit import kernel

ACTIVE = 1e-2  # a multiplier above this holds its constraint
OCTAGON = math.cos(math.radians(22.5))  # inner over outer circle
_ROOM = 1e-9  # of a row broken by rounding
# by iterations in S3 and from far off, warm and cold: both programs of a step take 105 at the 99th percentile, 145 without the weight
RHO_DOWN, RHO_LEVEL = 0.07, 0.15
SLEW_LEVEL, ALPHA_LEVEL = 0.6, 1.8  # weight of the slew rows, over-relaxation


class Axis(NamedTuple):
    """One program: the law -K e, its condensed cost, and the rows."""

    law: np.ndarray  # (N, n): u~ = -law e without constraints, every stage
    f: np.ndarray  # (N, n): q = f e
    problem: qp.Problem


class Design(NamedTuple):
    horizon: int
    stage_s: float
    down: Axis
    level: Axis  # both horizontal axes at once: north's stages, then east's


class Horizon(NamedTuple):
    """The limits of this instant. Accelerations along the axes, NED."""

    down_low: float
    down_high: float
    tilt: float  # distance of the octagon's sides per g - a_D; times OCTAGON it lies inside the circle, else around it
    slew: float  # m/s^3, per axis
    first_s: float  # time since the last applied command: a control period, not a stage


class State(NamedTuple):
    down: qp.Start
    level: qp.Start
    solves: int
    fallbacks: int
    iterations: int  # of the last solve
    seconds: tuple[float, ...]  # of the last solves, for statistics only


class Move(NamedTuple):
    u: tuple[float, float, float]  # NED
    usable: bool
    active: bool  # a constraint holds: integrals must not go on


UNUSABLE = Move((math.nan, math.nan, math.nan), False, False)


def design(
    model: Model, model_down: Model, q: np.ndarray, r: float, stage_s: float, horizon: int = 20, max_iter: int = qp.MAX_ITER
) -> Design:
    """Both programs for states of `model` (horizontal) and `model_down`, discretised at stage_s; terminal weight by DARE."""
    level = prediction.stack(model, horizon, q, r, prediction.terminal(model, q, r))
    down = prediction.stack(model_down, horizon, q, r, prediction.terminal(model_down, q, r))
    eye = np.eye(horizon)
    step = eye - np.eye(horizon, k=-1)
    zero = np.zeros((horizon, horizon))
    c = math.sqrt(0.5)
    cone = np.vstack(
        [np.hstack([eye, zero]), np.hstack([zero, eye]), np.hstack([c * eye, c * eye]), np.hstack([c * eye, -c * eye])]
    )
    both = np.vstack([np.hstack([level.g, zero]), np.hstack([zero, level.g])])
    return Design(
        horizon,
        stage_s,
        Axis(
            np.linalg.solve(down.g, down.f), down.f, qp.problem(down.g, np.vstack([eye, step]), rho=RHO_DOWN, max_iter=max_iter)
        ),
        Axis(
            np.linalg.solve(level.g, level.f),
            level.f,
            qp.problem(
                both,
                np.vstack([cone, np.kron(np.eye(2), step)]),
                rho=RHO_LEVEL,
                weights=np.repeat([1.0, SLEW_LEVEL], [4 * horizon, 2 * horizon]),
                alpha=ALPHA_LEVEL,
                max_iter=max_iter,
            ),
        ),
    )


def init(d: Design) -> State:
    return State(qp.cold(d.down.problem), qp.cold(d.level.problem), 0, 0, 0, ())


@kernel
def _slew_bounds(path, last, limit, first, low, high, at):
    """Rows u_j - u_(j-1) as bounds on u~: limit per stage, `first` for the step from the last applied value."""
    low[at], high[at] = last - first - path[0], last + first - path[0]
    for j in range(1, len(path)):
        jump = path[j] - path[j - 1]
        low[at + j], high[at + j] = -limit - jump, limit - jump


@kernel
def _times(matrix, vector, out, at):
    for j in range(matrix.shape[0]):
        total = 0.0
        for i in range(matrix.shape[1]):
            total += matrix[j, i] * vector[i]
        out[at + j] = total


@kernel
def _inside(rows, x, low, high):
    """Whether x keeps every row."""
    for i in range(rows.shape[0]):
        total = 0.0
        for j in range(rows.shape[1]):
            total += rows[i, j] * x[j]
        if not (low[i] - _ROOM <= total <= high[i] + _ROOM):
            return False
    return True


@kernel
def _assemble_down(law, f, rows, error, path, last, down_low, down_high, slew, first):
    """(q, low, high, unconstrained optimum, whether it keeps the rows) of the vertical program."""
    n = law.shape[0]
    q, free, low, high = np.empty(n), np.empty(n), np.empty(2 * n), np.empty(2 * n)
    _times(f, error[2], q, 0)
    _times(law, error[2], free, 0)
    for j in range(n):
        free[j] = -free[j]
        low[j], high[j] = down_low - path[j, 2], down_high - path[j, 2]
    _slew_bounds(path[:, 2], min(down_high, max(down_low, last[2])), slew, first, low, high, n)
    return q, low, high, free, _inside(rows, free, low, high)


@kernel
def _assemble_level(law, f, rows, error, path, last, reach, slew, first):
    """The same of the horizontal program: north's stages, then east's."""
    n = law.shape[0]
    q, free, low, high = np.empty(2 * n), np.empty(2 * n), np.empty(6 * n), np.empty(6 * n)
    for i in range(2):
        _times(f, error[i], q, i * n)
        _times(law, error[i], free, i * n)
    c = math.sqrt(0.5)
    for j in range(n):
        free[j], free[n + j] = -free[j], -free[n + j]
        north, east = path[j, 0], path[j, 1]
        low[j], high[j] = -reach - north, reach - north
        low[n + j], high[n + j] = -reach - east, reach - east
        low[2 * n + j], high[2 * n + j] = -reach - c * (north + east), reach - c * (north + east)
        low[3 * n + j], high[3 * n + j] = -reach - c * (north - east), reach - c * (north - east)
    size = math.sqrt(last[0] * last[0] + last[1] * last[1])
    shrink = min(1.0, reach / size) if size > 0.0 else 1.0  # a set with the last command outside would be empty
    _slew_bounds(path[:, 0], shrink * last[0], slew, first, low, high, 4 * n)
    _slew_bounds(path[:, 1], shrink * last[1], slew, first, low, high, 5 * n)
    return q, low, high, free, _inside(rows, free, low, high)


def _program(axis: Axis, data: tuple[np.ndarray, ...], start: qp.Start, always: bool) -> qp.QpResult:
    q, low, high, free, inside = data
    if inside and not always:
        return qp.QpResult(free, np.zeros(len(low)), qp.SOLVED, 0, 0.0)
    return qp.solve(axis.problem, q, low, high, start)


def solve(
    d: Design,
    state: State,
    error: np.ndarray,
    path: np.ndarray,
    last: tuple[float, float, float],
    limits: Horizon,
    gravity: float,
    always: bool = False,
) -> tuple[State, Move]:
    """The first move. error (3, n) NED, path (N, 3) the previewed part of the command, last the command applied before.

    A failed program gives a Move that is not usable: the caller flies its closed form; the next start is cold.
    """
    if not (limits.tilt >= 0.0 and limits.down_low <= limits.down_high):  # an empty cone, an empty set of thrusts
        return _fallback(d, state), UNUSABLE
    slew, first = limits.slew * d.stage_s, limits.slew * limits.first_s
    axis = d.down
    data = _assemble_down(
        axis.law, axis.f, axis.problem.rows, error, path, last, limits.down_low, limits.down_high, slew, first
    )
    found = _program(axis, data, state.down, always)
    if not found.usable:
        return _fallback(d, state, found), UNUSABLE
    down = min(limits.down_high, max(limits.down_low, float(found.x[0] + path[0, 2])))
    axis = d.level
    reach = max(0.0, gravity - down) * limits.tilt
    data = _assemble_level(axis.law, axis.f, axis.problem.rows, error, path, last, reach, slew, first)
    level = _program(axis, data, state.level, always)
    if not level.usable:
        return _fallback(d, state, found, level), UNUSABLE
    u = (float(level.x[0] + path[0, 0]), float(level.x[d.horizon] + path[0, 1]), down)
    active = bool(np.abs(found.y).max() > ACTIVE or np.abs(level.y).max() > ACTIVE)
    state = _count(state, found, level)
    return state._replace(down=qp.Start(found.x, found.y), level=qp.Start(level.x, level.y)), Move(u, True, active)


def _count(state: State, *found: qp.QpResult) -> State:
    solved = [r for r in found if r.iterations]
    seconds = sum(r.seconds for r in solved)
    return state._replace(
        solves=state.solves + (1 if solved else 0),
        iterations=sum(r.iterations for r in solved),
        seconds=(*state.seconds[-999:], seconds) if solved else state.seconds,
    )


def _fallback(d: Design, state: State, *found: qp.QpResult) -> State:
    state = _count(state, *found)
    return state._replace(down=qp.cold(d.down.problem), level=qp.cold(d.level.problem), fallbacks=state.fallbacks + 1)
