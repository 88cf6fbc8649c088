"""Killed and started again at random moments: the companion takes over, an autopilot that restarts is never flown unasked."""

import random

import pytest

from mavquad import lifecycle, pipeline
from mavquad.companion import request
from mavquad.paths import Path
from mavquad.settings import Companion
from tests.loop.test_companion_loop import Loop
from tests.oracles.autopilot import Autopilot, level

SETTINGS = Companion(path=Path(name="circle", radius_m=2.0, speed_m_s=1.5, turns=0.5), observers=(), settle_s=0.5)
MOMENTS = [random.Random(20).uniform(0.3, 16.0) for _ in range(1)] + [
    round(random.Random(k).uniform(0.3, 16.0), 2) for k in range(19)
]


def flown(moment_s):
    """A flight led up to a moment of its life, wherever that is."""
    loop = Loop(SETTINGS, Autopilot(hz=50.0))
    asked = False
    for _ in range(round(moment_s / 0.1)):
        if not asked and loop.flight.life.state == lifecycle.OBSERVING:
            loop.take(request(lifecycle.CMD_ENGAGE, loop.plan, 0).raw)
            asked = True
        loop.run(0.1)
    return loop


@pytest.mark.parametrize("moment_s", MOMENTS)
def test_a_killed_companion_takes_over_again_without_a_bump(moment_s):
    loop = flown(moment_s)
    aloft = loop.autopilot.p[2] < -1.0
    tilt = max([level(m.q) for _, m in loop.autopilot.setpoints] or [0.0])
    loop.flight = pipeline.start(loop.plan)  # a new process: it knows nothing
    n = len(loop.autopilot.setpoints)
    loop.until(lifecycle.OBSERVING, 20.0)
    assert len(loop.autopilot.setpoints) == n, "nothing is flown before it is asked for"
    loop.take(request(lifecycle.CMD_ENGAGE, loop.plan, 0).raw)
    loop.until(lifecycle.ENGAGED, 60.0)
    after = loop.autopilot.setpoints[n:]
    assert all(0.3 < m.thrust < 0.9 for _, m in after)
    assert max(level(m.q) for _, m in after[:50]) < max(tilt, 0.1) + 0.1
    if aloft:
        assert loop.autopilot.p[2] < -0.5, "it went on where it was, not from the ground"
    loop.until(lifecycle.RELEASED, 60.0)


@pytest.mark.parametrize("moment_s", MOMENTS)
def test_an_autopilot_that_restarts_is_flown_again_only_on_request(moment_s):
    loop = flown(moment_s)
    was_known = loop.flight.now_us > 3_000_000
    fresh = Autopilot(hz=50.0)
    fresh.t_us = fresh.boot_us = loop.autopilot.t_us
    loop.autopilot = fresh
    loop.run(12.0)
    if was_known:
        assert loop.flight.epoch == 1
    if not loop.flight.life.engage:
        assert not fresh.setpoints
        assert not fresh.armed
    loop.take(request(lifecycle.CMD_ENGAGE, loop.plan, 0).raw)
    loop.until(lifecycle.ENGAGED, 60.0)
    assert all(0.3 < m.thrust < 0.9 and level(m.q) < 0.6 for _, m in fresh.setpoints)
