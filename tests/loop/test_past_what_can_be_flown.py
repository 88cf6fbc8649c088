"""Positions that stand still while the vehicle moves, and a delay that nobody can fly with: held, or landed with the reason."""

import math

import pytest

from mavquad import control_step, delayed, lifecycle, tunables
from mavquad.paths import Path
from mavquad.plan import build
from mavquad.settings import Companion
from tests.oracles.late import Late


def flight(*changes, controller="pid"):
    return Late(Companion(path=Path(name="circle"), controller=controller, observers=()), "link.delay_ms=5", *changes)


def test_a_position_that_froze_for_half_a_second_is_no_reset_of_the_autopilots():
    late = flight('faults=[{kind="freeze", sensor="position", t_s=12.0, duration_s=0.5}]').engage().run(7.0)
    assert late.sim.t_us > 14_000_000
    assert late.life.state == lifecycle.ENGAGED
    assert late.flight.counts["position frozen"] >= 20
    assert not any("position reset" in text for text in late.texts)
    assert late.flight.offset_m == (0.0, 0.0, 0.0)
    wanted = control_step.demand_at(late.plan, late.flight, late.sim.t_us).p_ned_m
    assert math.dist(wanted, late.sim.vehicle.state["p_ned_m"].tolist()) < 0.3


@pytest.mark.parametrize(("delay_ms", "lands"), [(200, False), (300, True)])
def test_a_delay_that_cannot_be_flown_is_said_and_landed(delay_ms, lands):
    late = flight(f"link.delay_ms={delay_ms}").engage().run(6.0)
    said = any("ms cannot be flown, landing" in text for text in late.texts)
    assert said == lands
    assert (late.life.state != lifecycle.ENGAGED) == lands


def test_a_long_delay_without_prediction_is_flown_slower_and_not_in_circles():
    """As designed `pid` flies circles of up to four metres around its path with this delay; who predicts flies on as designed."""
    late = flight("link.delay_ms=220").engage().run(22.0)
    assert late.life.state == lifecycle.ENGAGED
    assert [text for text in late.texts if "slower" in text or "in time" in text] == [
        f"mavquad: delay of {1e3 * late.flight.delay_s:.0f} ms, flying slower"
    ]
    errors = [
        math.dist(control_step.demand_at(late.plan, late.flight, round(1e6 * t_s)).p_ned_m, p)
        for t_s, *p in late.truth
        if 1e6 * t_s > late.flight.path_t0_us
    ]
    assert len(errors) > 8000
    assert max(errors) < 1.0


def test_the_slowest_design_is_for_those_who_do_not_predict_and_goes_with_the_delay():
    pid = build(Companion(controller="pid", observers=()))
    assert delayed.adapt(pid, 0.2) is pid
    slow = delayed.adapt(pid, 0.3)
    assert slow.controller.gains == pid.slowed[-1]
    assert slow.slowed == (pid.slowed[-1],) * 3
    assert delayed.adapt(slow, 0.2) is slow  # between the two limits nothing changes
    quick = delayed.adapt(slow, 0.1)
    assert (quick.controller, quick.slowed) == (pid.controller, pid.slowed)
    changed = tunables.change(slow, "PID_DAMPING", 1.2)  # in flight: as it says, and slow again at the next tick
    assert delayed.adapt(changed, 0.3).controller.gains == changed.slowed[-1]
    for name in ("iadrc", "eskf-mpc", "autopilot"):
        other = build(Companion(controller=name, observers=()))
        assert delayed.adapt(other, 0.45) is other
