"""Positions that stand still while the vehicle moves, and a delay that nobody can fly with: held, or landed with the reason."""

import math

import pytest

from mavquad import control_step, lifecycle
from mavquad.paths import Path
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
