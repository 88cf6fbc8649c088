"""How late a companion may be for which design, and that a later design is a slower one."""

import math

import pytest

from mavquad import pipeline, slowing, tunables
from mavquad.control import pid
from mavquad.settings import Companion

LATE = slowing.LATE_S


def test_the_largest_lateness_is_kept_and_fades():
    held = slowing.fade(0.0, 0.3, 0.008)
    assert held == 0.3
    for _ in range(375):  # 3 s
        held = slowing.fade(held, 0.0, 0.008)
    assert held == pytest.approx(0.3 / math.e, rel=1e-6)


def test_slower_at_once_quicker_only_well_below():
    assert [slowing.level(0, s) for s in (0.0, 0.059, 0.06, 0.119, 0.12, 0.25, 9.0)] == [0, 0, 1, 1, 2, 3, 3]
    assert [slowing.level(3, s) for s in (0.24, 0.17, 0.16, 0.09, 0.07, 0.05, 0.041, 0.039)] == [3, 3, 2, 2, 1, 1, 1, 0]


@pytest.mark.parametrize("tune", [{}, {"pid": {"wc_rad_s": 2.0}}])
def test_a_design_leaves_the_lateness_its_phase(tune):
    plan = pipeline.build(Companion(observers=(), tune=tune))
    bandwidths = [math.sqrt(g.kp) for g in (plan.controller.gains, *plan.slowed)]
    own = 0.3 / pid.bandwidth(plan.airframe)
    scale = bandwidths[0] * own / 0.3
    for late_s, wc in zip(LATE, bandwidths[1:], strict=True):
        assert 0.3 * scale / wc - own == pytest.approx(0.5 * late_s)


@pytest.mark.parametrize(("controller", "tune"), [("iadrc", {}), ("adrc", {"wc_rad_s": 2.0}), ("eskf-mpc", {})])
def test_every_later_design_is_slower(controller, tune):
    plan = pipeline.build(Companion(controller=controller, observers=(), tune={controller: tune} if tune else {}))
    gains = (plan.controller.gains, *plan.slowed)
    quick = [g.law.k[0] if controller == "eskf-mpc" else g.wc[0] for g in gains]
    down = [g.law.k_down[0] if controller == "eskf-mpc" else g.wc[2] for g in gains]
    assert quick == sorted(quick, reverse=True)
    assert down == sorted(down, reverse=True)
    assert quick[-1] < 0.7 * quick[0]


def test_gains_changed_in_flight_are_slowed_as_well():
    plan = pipeline.build(Companion(observers=()))
    changed = tunables.change(plan, "PID_DAMPING", 2.0)
    assert changed.slowed[1].kd == pytest.approx(2.0 * plan.slowed[1].kd)
