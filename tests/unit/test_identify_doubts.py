"""What two signs are compared by: a rate against the change of what it is the rate of."""

import numpy as np
import pytest

from mavquad.identify import doubts


@pytest.mark.parametrize("n", [0, 1, 2, doubts.ENOUGH - 1])
def test_too_few_samples_say_nothing(n):
    value = np.sin(np.arange(n))
    assert doubts.against(-np.cos(np.arange(n)), value, 1.0) is False


def test_a_rate_of_the_other_sign_runs_against_its_value():
    t = 0.02 * np.arange(4 * doubts.ENOUGH)
    assert doubts.against(-2.0 * np.cos(2.0 * t), np.sin(2.0 * t), 0.02)
    assert not doubts.against(2.0 * np.cos(2.0 * t), np.sin(2.0 * t), 0.02)
