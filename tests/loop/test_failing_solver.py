"""eskf-mpc flown on the simulated autopilot with a solver that fails: the closed form flies on, and every failure is counted."""

import numpy as np
import pytest

from mavquad.control import constrained
from tools import scenarios, score
from tools.bulk import stepwise
from tools.summary import ENGAGED_STATE


def _flown(*changes):
    options = scenarios.Options(seed=1, personality="px4", controller="eskf-mpc", observers=[])
    words = ("path.duration_s=2", "companion.settle_s=1.0", "wind.mean_m_s=5", "wind.w20_m_s=8", *changes)
    flown = stepwise.Loop(scenarios.resolve(scenarios.load("hover", list(words)), options)).fly()
    trace = flown.trace
    engaged = trace.rows[trace.column("state") == ENGAGED_STATE]
    error = score.position_error(trace, flown.truth)[trace.column("state") == ENGAGED_STATE]
    assert len(engaged) > 300
    assert not flown.grounded
    assert np.isfinite(engaged[:, [trace.names.index(f"sent_q_{i}") for i in "wxyz"]]).all()
    return flown.solver, float(np.abs(error).max())


@pytest.mark.parametrize("how", ["iterations", "infeasible"])
def test_a_solver_that_fails_costs_no_flight(how, monkeypatch):
    changes = ["eskf-mpc.constrained=always"]
    if how == "iterations":
        changes.append("eskf-mpc.max_iter=1")
    else:
        sound = constrained._assemble_level

        def crossed(*data):
            q, low, high, free, inside = sound(*data)
            return q, high + 1.0, low, free, inside  # no command at all keeps these

        monkeypatch.setattr(constrained, "_assemble_level", crossed)
    solver, worst_m = _flown(*changes)
    assert solver["qp_fallbacks"] == solver["steps"] > 300
    assert worst_m < 0.3
    sound_solver, sound_m = _flown("eskf-mpc.constrained=off")
    assert sound_solver["qp_fallbacks"] == 0
    assert worst_m == pytest.approx(sound_m, abs=1e-9)  # it is the closed form that flew
