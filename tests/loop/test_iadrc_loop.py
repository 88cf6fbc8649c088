"""IADRC flown by the whole companion on the simulated autopilot, in one process on vehicle time."""

import functools

import numpy as np
import pytest

from mavquad import pipeline
from mavquad.errors import ConfigError
from mavquad.settings import Companion
from tests.oracles.closed_loop import Flown


@functools.cache
def circle(controller):
    return Flown(controller)


def test_in_wind_iadrc_follows_at_most_0_8_of_adrc_and_0_7_of_pid():
    assert circle("iadrc").rmse() <= 0.8 * circle("adrc").rmse()
    assert circle("iadrc").rmse() <= 0.7 * circle("pid").rmse()
    assert circle("iadrc").rmse() < 0.03


def test_the_estimated_disturbance_is_the_true_one():
    flown = circle("iadrc")
    miss = np.array(flown.f)[200:] - np.array(flown.f_true)[200:]
    assert np.sqrt(np.mean(np.square(miss))) < 0.25  # of about 1.2 m/s^2, 0.05 of it by the tilt the AHRS is off
    for axis in (0, 1):
        assert np.corrcoef(np.array(flown.f)[200:, axis], np.array(flown.f_true)[200:, axis])[0, 1] > 0.8


@pytest.mark.parametrize(
    ("delay_ms", "mask", "said"), [(2, 128, "attitude loop closed here"), (20, 7, "autopilot's attitude loop")]
)
def test_rates_are_sent_on_request_while_the_link_is_quick_and_it_is_said(delay_ms, mask, said):
    flown = Flown("iadrc", "hover", 2.0, (f"link.delay_ms={delay_ms}",), loop="rates")
    assert flown.masks == {mask}
    assert any(said in text for text in flown.texts)
    assert flown.rmse() < 0.05


def test_a_controller_without_an_attitude_loop_cannot_be_asked_for_rates():
    with pytest.raises(ConfigError, match="pid closes no attitude loop"):
        pipeline.build(Companion(controller="pid", loop="rates"))


def test_the_disturbance_is_published():
    flown = circle("iadrc")
    assert len(flown.published) > 40
    told, estimated = zip(*flown.published, strict=True)
    np.testing.assert_allclose(told, estimated, atol=1e-5)  # float32 on the wire
