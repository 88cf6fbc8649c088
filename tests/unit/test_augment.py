import numpy as np
import pytest
import scipy.integrate

from mavquad.errors import ConfigError
from mavquad.estimate import augment
from mavquad.identify import models

ACCELERATIONS = ("u", "q", "v", "p", "w", "r")


@pytest.mark.parametrize(
    ("rows", "rank"),
    [
        (models.ref_13().states, 21),
        (ACCELERATIONS, 19),
        (("u", "q", "theta", "v", "p", "phi", "w", "r"), 21),
        (("u", "q", "theta", "v", "p", "phi", "w", "r", "a"), 21),
    ],
)
def test_what_eight_outputs_can_tell_apart_is_the_note_s_table(rows, rank):
    model = models.ref_13()
    b_f = np.array([[1.0 if state == row else 0.0 for row in rows] for state in model.states])
    assert augment.rank_with_constant_error(model.a, b_f, model.c) == rank


def test_errors_that_cannot_be_told_apart_are_refused():
    model = models.ref_13()
    with pytest.raises(ConfigError, match="26 unknowns, but the 8 outputs tell only 21 apart"):
        augment.with_model_error(model.a, model.b, model.c, model.states, model.states, 0.02)
    with pytest.raises(ConfigError, match="no such state"):
        augment.with_model_error(model.a, model.b, model.c, model.states, ("speed",), 0.02)


def test_one_tick_is_the_integral_of_the_continuous_model():
    model, dt_s, rng = models.ref_13(), 0.02, np.random.default_rng(1)
    plant = augment.with_model_error(model.a, model.b, model.c, model.states, ACCELERATIONS, dt_s)
    x, f, u, k = rng.normal(size=13), rng.normal(size=6), rng.normal(size=4), rng.normal(size=13)
    push = np.zeros(13)
    push[[model.states.index(name) for name in ACCELERATIONS]] = f
    rate = scipy.integrate.solve_ivp(lambda _, z: model.a @ z + model.b @ u + push + k, (0.0, dt_s), x, rtol=1e-11, atol=1e-12)
    z = plant.f @ np.concatenate([x, f]) + plant.g @ u + plant.known @ k
    np.testing.assert_allclose(z[:13], rate.y[:, -1], rtol=1e-8, atol=1e-9)
    np.testing.assert_array_equal(z[13:], f)
    np.testing.assert_array_equal(plant.c @ np.concatenate([x, f]), model.c @ x)
