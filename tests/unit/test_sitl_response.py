"""The attitude response that the airframe's file claims is the one that the simulated autopilot has."""

import numpy as np
import pytest

from mavquad import airframe
from sitl import config, response


def test_the_file_holds_the_measured_response():
    found, said = response.measure(config.Sitl()), airframe.load("x500").attitude
    assert said.natural_frequency_rad_s == pytest.approx(found.natural_frequency_rad_s, rel=0.03)
    assert said.damping == pytest.approx(found.damping, rel=0.03)
    assert said.delay_s == pytest.approx(found.delay_s, abs=0.002)
    assert 0.09 < said.lag_s + said.delay_s < 0.12  # "about 0.1 s"
    assert found.overshoot < 0.05
    assert found.residual < 0.02  # of the step: a second order with a delay is a fair description


@pytest.mark.parametrize(("wn", "zeta"), [(19.2, 0.77), (10.0, 1.0), (12.0, 1.8)])
def test_the_step_answer_is_the_second_order_one(wn, zeta):
    t = np.linspace(0.0, 1.0, 2001)
    x = v = 0.0
    euler = []
    for _ in t:
        euler.append(x)
        a = wn * wn * (1.0 - x) - 2.0 * zeta * wn * v
        x, v = x + 5e-4 * v, v + 5e-4 * a
    np.testing.assert_allclose(response.second_order(t, wn, zeta, 0.0), euler, atol=0.01)  # Euler's own error at 0.5 ms
