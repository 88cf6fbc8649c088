"""An autopilot that sends attitudes without rates: the observer's are flown, and what they are worth is published."""

import math

import numpy as np
import pytest

from mavquad import lifecycle, pipeline, wire
from mavquad.companion import request
from mavquad.errors import ConfigError
from mavquad.estimate import gsmo
from mavquad.paths import Path
from mavquad.settings import Companion
from tests.oracles.autopilot import EPOCH_US, Autopilot

PATH = Path(name="circle", radius_m=2.0)


class Gyroless(Autopilot):
    """Rates are NaN: its attitude comes from a camera, say."""

    def send(self, name, *fields):
        if name == "ATTITUDE_QUATERNION":
            fields = (*fields[:5], math.nan, math.nan, math.nan, fields[8])
        super().send(name, *fields)


def flown(settings, autopilot, seconds):
    """(flight, trace rows, decoded messages of ours) after `seconds`; engaged as soon as the companion observes."""
    plan = pipeline.build(settings)
    flight, trace, sent = pipeline.start(plan), [], []

    def emit(after):
        for _, out in after.outbox:
            sent.extend(m for _, m in wire.parse(out))
            autopilot.hear(out)
        trace.extend(after.trace)
        after.outbox, after.trace = [], []
        return after

    def take(raw):
        nonlocal flight
        stamp = EPOCH_US + autopilot.t_us
        for frame in wire.split(raw)[0]:
            flight = emit(pipeline.advance(plan, flight, stamp))
            flight = emit(pipeline.feed(plan, flight, stamp, frame))

    asked = False
    for _ in range(round(1e6 * seconds / autopilot.dt_us)):
        for raw in autopilot.step():
            take(raw)
        if not asked and flight.life.state == lifecycle.OBSERVING:
            asked = True
            take(request(lifecycle.CMD_ENGAGE, plan, 0).raw)
    return plan, flight, np.array(trace), sent


@pytest.mark.parametrize("controller", ["pid", "iadrc"])
def test_an_autopilot_without_a_gyro_is_flown_on_observed_rates(controller):
    settings = Companion(path=PATH, controller=controller, observers=("gsmo:variant=implicit-third-order",))
    plan, flight, trace, sent = flown(settings, Gyroless(), 16.0)
    assert flight.life.state == lifecycle.ENGAGED
    assert flight.counts["body rates observed"] > 500
    assert any("body rates by gsmo" in m.text for m in sent if type(m).__name__ == "STATUSTEXT")
    at = {name: i for i, name in enumerate(plan.trace_names)}
    engaged = trace[-500:]
    given = engaged[:, [i for name, i in at.items() if name.startswith("w_")]]
    assert np.isfinite(given).all()
    assert np.abs(given).max() > 1e-4
    assert "ATTITUDE_QUATERNION refused" not in flight.counts


def test_rates_are_the_observers_on_request_and_need_an_observer():
    settings = Companion(path=PATH, body_rates="observer", observers=("gsmo:variant=implicit-third-order",))
    plan, _, trace, _ = flown(settings, Autopilot(), 8.0)
    at = {name: i for i, name in enumerate(plan.trace_names)}
    own = [i for name, i in at.items() if name.startswith("w_")]
    theirs = [i for name, i in at.items() if name.startswith("gsmo")]
    assert len(own) == len(theirs) == 3
    np.testing.assert_array_equal(trace[-50:][:, own], trace[-50:][:, theirs])
    with pytest.raises(ConfigError, match="body_rates"):
        Companion(body_rates="observer", observers=())


def test_without_an_observer_an_attitude_without_rates_is_refused_and_counted():
    _, flight, trace, _ = flown(Companion(path=PATH, observers=()), Gyroless(), 4.0)
    assert flight.counts["ATTITUDE_QUATERNION refused"] > 100
    assert len(trace) == 0


def test_the_health_of_the_observed_rates_is_published_beside_them():
    _, _, _, sent = flown(Companion(path=PATH), Autopilot(), 6.0)
    arrays = [m for m in sent if type(m).__name__ == "DEBUG_FLOAT_ARRAY" and m.name == "rates"]
    age_s, period_s, noise_rad, member, coasting, stale, settled, *counts = arrays[-1].data[7 : 17 + 7]
    assert 0.0 <= age_s < 0.02
    assert period_s == pytest.approx(0.01)
    assert noise_rad >= 0.0
    assert member in range(29)
    assert (coasting, stale, settled) == (0.0, 0.0, 1.0)
    counted = gsmo.Counts(*counts)
    assert counted.accepted > 500
    assert sum(counted) == counted.accepted
