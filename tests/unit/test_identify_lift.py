"""Thrust as it follows its command: a lag and a delay told apart, and what cannot be told."""

import numpy as np
import pytest

from mavquad.errors import LogError
from mavquad.identify import lift, timebase
from mavquad.identify.excitation import Sweep, value
from mavquad.identify.timebase import Held, Sampled

HOVER, GAIN, LAG_S, DELAY_S = 0.57, 17.1, 0.03, 0.012


def flown(amplitude=0.05, noise_m_s2=0.05):
    """A thrust sweep sent at 125 Hz and its answer by the lag's own recursion at 1 ms, sampled at 100 Hz with noise."""
    plan = Sweep(amplitude=amplitude, f_start_hz=0.1, f_end_hz=5.0, duration_s=60.0)
    t_sent = np.arange(0.0, 72.0, 0.008)
    sent = Held(t_sent, HOVER + np.array([value(plan, x) for x in t_sent]))
    t = np.arange(0.0, 72.0, 0.001)
    acting, y = timebase.held_at(sent, t - DELAY_S), np.empty(t.size)
    y[0] = acting[0]
    for k in range(1, t.size):
        y[k] = acting[k] + (y[k - 1] - acting[k]) * np.exp(-0.001 / LAG_S)
    rng = np.random.default_rng(5)
    return sent, Sampled(t[::10], GAIN * y[::10] + noise_m_s2 * rng.standard_normal(t[::10].size))


def test_lag_delay_and_gain_come_back_within_their_bars():
    found = lift.lift(*flown(), [(1.0, 71.0)])
    for got, bar, wanted in zip(found[:3], found.sd, (GAIN, LAG_S, DELAY_S), strict=True):
        assert abs(got - wanted) < 4.0 * bar
    assert found.lag_s == pytest.approx(LAG_S, abs=0.002)
    assert found.delay_s == pytest.approx(DELAY_S, abs=0.002)
    assert found.gain_m_s2 == pytest.approx(GAIN, rel=0.02)


def test_a_hover_and_a_deaf_accelerometer_are_refused():
    with pytest.raises(LogError, match="record a sweep"):
        lift.lift(*flown(amplitude=0.002), [(1.0, 71.0)])
    with pytest.raises(LogError, match="--axis thrust"):
        lift.lift(*flown(noise_m_s2=20.0), [(1.0, 71.0)])
