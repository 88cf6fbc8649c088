"""control/qp.py and constrained.py: against SLSQP, against a foreign history, and everything that OSQP must not see."""

import math

import numpy as np
import pytest
from scipy.optimize import minimize

from mavquad.control import constrained, prediction, qp

G = 9.81
MODEL = prediction.position_model(0.05)
WEIGHTS, R = np.array([4.0, 0.5, 1.0]), 0.02
DESIGN = constrained.design(MODEL, MODEL, WEIGHTS, R, 0.05)
LIMITS = constrained.Horizon(G - 14.4 / 0.74, 0.8 * G, constrained.OCTAGON * math.sin(math.radians(35.0)), 200.0, 0.01)
REST = (0.0, 0.0, 0.0)


def _error(seed):
    return np.random.default_rng(seed).normal(size=(3, 3)) * [2.5, 1.0, 0.0]


def _solve(state, error, path=None, last=REST, limits=LIMITS, design=DESIGN):
    return constrained.solve(design, state, error, np.zeros((20, 3)) if path is None else path, last, limits, G, always=True)


def _slsqp(problem, p, q, low, high):
    """min 1/2 x'Px + q'x in low <= A x <= high, to 1e-10."""
    a = problem.rows
    both = {"type": "ineq", "fun": lambda x: np.concatenate([high - a @ x, a @ x - low]), "jac": lambda x: np.vstack([-a, a])}
    found = minimize(
        lambda x: 0.5 * x @ p @ x + q @ x,
        np.zeros(len(q)),
        jac=lambda x: p @ x + q,
        constraints=[both],
        method="SLSQP",
        options={"ftol": 1e-12, "maxiter": 500},
    )
    return found.x


@pytest.mark.parametrize("seed", range(6))
def test_the_vertical_program_agrees_with_slsqp(seed):
    rng = np.random.default_rng(seed)
    stacked = prediction.stack(MODEL, 20, WEIGHTS, R, prediction.terminal(MODEL, WEIGHTS, R))
    q = stacked.f @ (rng.normal(size=3) * [2.5, 1.0, 0.0])
    low = np.concatenate([np.full(20, -9.0), np.full(20, -4.0)])
    high = np.concatenate([np.full(20, 7.8), np.full(20, 4.0)])
    expected = _slsqp(DESIGN.down.problem, stacked.g, q, low, high)
    found = qp.solve(DESIGN.down.problem, q, low, high, qp.cold(DESIGN.down.problem))
    assert found.usable
    assert found.x[0] == pytest.approx(expected[0], abs=0.02)  # m/s^2, from a cold start: what eps = 1e-4 buys
    for eps, first, whole in ((1e-5, 1e-3, 5e-3), (1e-9, 2e-6, 1e-5)):  # the last: SLSQP's own accuracy
        fine = qp.problem(stacked.g, DESIGN.down.problem.rows, rho=constrained.RHO_DOWN, eps=eps, max_iter=20000)
        close = qp.solve(fine, q, low, high, qp.cold(fine))
        assert close.x[0] == pytest.approx(expected[0], abs=first)
        np.testing.assert_allclose(close.x, expected, atol=whole)


def test_without_limits_the_program_is_the_closed_form():
    wide = constrained.Horizon(-1e4, 1e4 + G, 1e3, 1e7, 0.01)
    wide = wide._replace(down_high=G - 1e-6, down_low=-1e4)
    error = 0.01 * _error(3)
    state, move = _solve(constrained.init(DESIGN), error, limits=wide)
    k = prediction.lqr(MODEL, WEIGHTS, R)
    np.testing.assert_allclose(move.u, -error @ k, atol=0.01)  # eps = 1e-4
    assert not move.active
    _, quick = constrained.solve(DESIGN, state, error, np.zeros((20, 3)), REST, wide, G)
    np.testing.assert_allclose(quick.u, -error @ k, rtol=1e-9)  # nothing to solve


def test_bits_do_not_depend_on_what_was_solved_before():
    def flight(foreign):
        state, out, rng = constrained.init(DESIGN), [], np.random.default_rng(5)
        for k in range(60):
            if foreign:  # another vehicle's problems, good and bad, through the same solver
                _solve(constrained.init(DESIGN), _error(1000 + k), last=(3.0, -2.0, 1.0))
                qp.solve(DESIGN.level.problem, np.full(40, 1e9), -np.ones(120), np.ones(120), qp.cold(DESIGN.level.problem))
            state, move = _solve(state, _error(7) * (1.0 - k / 60) + 0.02 * rng.normal(size=(3, 3)))
            out += [*move.u, float(state.iterations)]
        return np.array(out).tobytes()

    assert flight(False) == flight(True)


def test_the_move_keeps_every_limit():
    state, last = constrained.init(DESIGN), REST
    for k in range(40):  # from 3 m off, with gusts
        state, move = _solve(state, (1.0 - k / 40) * _error(0) + 0.15 * _error(k), last=last)
        assert move.usable
        n, e, d = move.u
        reach = (G - d) * LIMITS.tilt  # the cone goes before the slew: a last command outside it is drawn in
        size = math.hypot(last[0], last[1])
        last = tuple(x * min(1.0, reach / size) if size else x for x in last)
        assert LIMITS.down_low - 1e-9 <= d <= LIMITS.down_high + 1e-9
        most = (G - d) * math.sin(math.radians(35.0))
        assert math.hypot(n, e) <= most * (1.0 + 2e-3)  # OSQP's own accuracy
        step = LIMITS.slew * LIMITS.first_s
        assert max(abs(n - last[0]), abs(e - last[1])) <= step + 0.02  # OSQP's own accuracy
        last = move.u
    assert state.fallbacks == 0


def test_a_last_command_outside_the_bounds_is_clipped_into_them():
    _, move = _solve(constrained.init(DESIGN), _error(2), last=(30.0, -20.0, 60.0))
    assert move.usable


@pytest.mark.parametrize("what", ["nan", "crossed", "cone", "thrust", "iterations"])
def test_a_failure_is_flagged_and_the_next_solve_is_good(what):
    design = constrained.design(MODEL, MODEL, WEIGHTS, R, 0.05, max_iter=1) if what == "iterations" else DESIGN
    error, limits, path = _error(4), LIMITS, np.zeros((20, 3))
    if what == "nan":
        error = np.full((3, 3), math.nan)
    elif what == "crossed":  # l > u in one row only: OSQP itself would keep the old bounds and say "solved"
        limits = LIMITS._replace(slew=-1.0)
    elif what == "cone":
        limits = LIMITS._replace(tilt=-0.1)
    elif what == "thrust":
        limits = LIMITS._replace(down_low=5.0, down_high=4.0)
    state, move = _solve(constrained.init(design), error, path, limits=limits, design=design)
    assert not move.usable
    assert state.fallbacks == 1
    fresh, expected = _solve(constrained.init(DESIGN), _error(4))
    if what != "iterations":
        state, good = _solve(state, _error(4))
        assert good.usable
        assert good.u == expected.u
        assert state.fallbacks == 1
    assert fresh.fallbacks == 0


def test_infeasible_data_is_not_taken_for_a_solution():
    p = qp.problem(np.eye(2), np.array([[1.0, 0.0], [1.0, 0.0]]), rho=0.1)
    found = qp.solve(p, np.zeros(2), np.array([1.0, -3.0]), np.array([2.0, -2.0]), qp.cold(p))
    assert not found.usable
    np.testing.assert_array_equal(found.x, 0.0)
    again = qp.solve(p, np.array([1.0, 0.0]), np.array([-5.0, -5.0]), np.array([5.0, 5.0]), qp.Start(found.x, found.y))
    np.testing.assert_allclose(again.x, [-1.0, 0.0], atol=1e-3)


def test_a_held_constraint_says_so():
    _, held = _solve(constrained.init(DESIGN), np.diag([3.0, 3.0, 0.0]))
    assert held.active
