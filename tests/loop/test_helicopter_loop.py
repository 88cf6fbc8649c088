"""The helicopter flown by its sticks: the compensator `asmf` over MAVLink, in one process on vehicle time."""

import numpy as np

from mavquad import active_helicopter, pipeline, warm
from mavquad.paths import Path
from mavquad.settings import Companion
from tests.oracles.closed_loop import Flown

WIND = ('airframe="helicopter"', "wind.mean_m_s=4", "wind.from_deg=225")
SHORT = Path(name="line", length_m=25.0, speed_m_s=5.0)


def test_a_line_in_wind_is_flown_by_sticks_from_the_model_error():
    active = Flown("pid", SHORT, 13.0, WIND, airframe="helicopter", compensator="asmf")
    assert active.sticks > 1000
    assert active.sim.misses == 0  # between two ticks of the filter the sticks are sent again
    assert active.rmse() < 0.3  # pid through the autopilot's inner loop: metres
    state = active.flight.compensator
    shown = dict(zip(active.plan.compensator.module.PUBLISHED, active.plan.compensator.module.published(state), strict=True))
    assert shown["guarantee"] == 1.0
    assert shown["empty"] == 0.0
    assert np.abs(active.errors).max() < 1.0


def test_everything_a_helicopter_s_flight_needs_is_compiled_before_it(monkeypatch):
    plan = pipeline.build(Companion(airframe="helicopter", compensator="asmf", observers=()))
    flown = []
    fly = active_helicopter._fly
    monkeypatch.setattr(active_helicopter, "_fly", lambda *args: flown.append(0) or fly(*args))
    warm.run(plan)
    assert flown
