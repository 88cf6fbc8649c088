"""How late a companion may be for which design, and that a later design is a slower one."""

import math

import pytest

from mavquad import pipeline, slowing, tunables, wire
from mavquad.control import pid
from mavquad.settings import Companion

LATE = slowing.LATE_S
EPOCH_US = 1_700_000_000_000_000


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


def test_a_thrust_is_later_with_the_companion_too():
    plan = pipeline.build(Companion(controller="eskf-mpc", observers=()))
    assert [g.delay_down_s for g in plan.slowed] == pytest.approx([0.5 * late_s for late_s in LATE])


def _attitude(stamp_ms, seq):
    fields = (stamp_ms, 1.0, *(0.0,) * 6, (0.0,) * 4)
    return wire.split(wire.encode("ATTITUDE_QUATERNION", fields, seq=seq, system=1, component=1))[0][0]


def test_a_sample_older_than_usual_is_known_to_be():
    """Attitudes 40 ms old on the mean, some 10 ms more or less: the mean is the link's delay, the rest the sample's age."""
    plan = pipeline.build(Companion(controller="eskf-mpc", observers=()))
    f = pipeline.start(plan)
    f.life = f.life._replace(target=(1, 1))
    for i in range(1000):
        jitter_ms = (0, 10, -10)[i % 3]
        f = pipeline.feed(plan, f, EPOCH_US + 1000 * (5040 + 24 * i + jitter_ms), _attitude(5000 + 24 * i, i & 255))
        if i > 900:
            assert f.age_s == pytest.approx(1e-3 * jitter_ms, abs=1e-3)
    f = pipeline.feed(plan, f, f.arrival_us + 900_000, _attitude(5000 + 24 * 1000, 0))
    assert f.age_s == 0.06  # what is later than any jitter is not the link's
