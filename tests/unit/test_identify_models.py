"""The hover models against the eigenvalues, zeros and matrices of the identification note, and against each other."""

import numpy as np
import pytest
import scipy.linalg

from mavquad.errors import ConfigError
from mavquad.identify import models


def assert_spectrum(model, expected, atol=6e-3):
    """Same eigenvalues as printed with three decimals (two for the fast ones)."""
    found = np.linalg.eigvals(model.a)
    for wanted in expected:
        assert np.min(np.abs(found - wanted)) < atol, (wanted, found)
    assert len(found) == len(expected)


def pair(real, imag):
    return [complex(real, imag), complex(real, -imag)]


@pytest.mark.parametrize(
    ("build", "expected"),
    [
        (models.ref_lon, [-20.87, *pair(-1.897, 7.968), 0.263, -0.312]),
        (models.ref_lat, [-20.69, *pair(-1.988, 11.979), -0.394, 0.243]),
        (models.ref_yaw_heave, [-0.612, *pair(-6.196, 8.199)]),
        (models.table1_lon, [*pair(-0.890, 6.785), 0.870, -0.521, -2.304]),
        (models.table1_lat, [*pair(-2.448, 11.609), 3.139, *pair(-1.129, 0.318)]),
    ],
)
def test_eigenvalues_are_those_of_the_note(build, expected):
    assert_spectrum(build(), expected)


def test_no_repair_of_signs_makes_table_1_stable():
    assert_spectrum(models.lon({**models.TABLE1_LON, "X_u": -0.2446}), [*pair(-0.894, 6.781), 0.609, -0.744, -2.302])
    assert_spectrum(models.lat({**models.TABLE1_LAT, "L_v": -15.84}), [*pair(-2.735, 11.195), *pair(1.045, 2.474), -0.635])


@pytest.mark.parametrize(("build", "zero"), [(models.table1_lon, 4.55), (models.table1_lat, 37.0)])
def test_table_1_rates_have_the_right_half_plane_zero_of_the_note(build, zero):
    model = build()
    # q and p from the input that Table 1 calls "lon": the big entries on both axes
    rosenbrock = np.block([[model.a, model.b[:, [0]]], [model.c[[1]], np.zeros((1, 1))]])
    mass = np.diag([1.0] * 5 + [0.0])
    zeros = scipy.linalg.eigvals(rosenbrock, mass)
    zeros = zeros[np.isfinite(zeros)]
    assert np.min(np.abs(zeros - zero)) < 0.02 * zero


def test_the_printed_longitudinal_matrix():
    g = 9.80665
    expected = [
        [-0.0505, 0, -g, -g, 0], [-0.184, 0, 0, 82.6, 0], [0, 1, 0, 0, 0], [0, -1, 0, -21.7391, 14.0], [0, -1, 0, 0, -2.92398],
    ]  # fmt: skip
    np.testing.assert_allclose(models.ref_lon().a, expected, atol=5e-5)
    np.testing.assert_allclose(models.ref_lat().a[3], [0, -1, 0, -21.7391, 15.43478], atol=5e-5)


def test_thirteen_states_are_the_three_axes_side_by_side():
    whole = models.ref_13()
    assert whole.a.shape == (13, 13)
    assert whole.b.shape == (13, 4)
    assert whole.inputs == ("lon", "lat", "ped", "col")
    found = np.sort_complex(np.linalg.eigvals(whole.a))
    axes = np.concatenate([np.linalg.eigvals(m().a) for m in (models.ref_lon, models.ref_lat, models.ref_yaw_heave)])
    np.testing.assert_allclose(found, np.sort_complex(axes), atol=1e-9)


def test_reordering_to_eq_1_keeps_the_response():
    whole = models.ref_13()
    other = models.reordered(whole)
    assert other.states[8:10] == ("w", "r")
    s = 2.3j
    ours = whole.c @ np.linalg.solve(s * np.eye(13) - whole.a, whole.b)
    theirs = other.c @ np.linalg.solve(s * np.eye(13) - other.a, other.b)
    np.testing.assert_allclose(ours[:, [1, 0, 2, 3]], theirs, atol=1e-10)
    with pytest.raises(ConfigError, match="reorder"):
        models.reordered(whole, states=("u",))


def test_an_accelerometer_feels_the_thrust_vector_and_not_gravity():
    """u' + g theta leaves drag and flapping only: no row of Eq. (2) may see the attitude of a body in hover."""
    whole = models.reordered(models.ref_13())
    c, d = models.measurement_eq2(whole)
    tilted = np.zeros(13)
    tilted[whole.states.index("theta")] = 0.1
    tilted[whole.states.index("phi")] = 0.2
    np.testing.assert_allclose((c @ tilted)[8:], 0.0, atol=1e-12)
    falling = np.zeros(13)
    falling[whole.states.index("w")] = 1.0
    assert (c @ falling)[10] == pytest.approx(-0.614)
    assert d[10, whole.inputs.index("col")] == pytest.approx(-13.96)


def test_a_missing_parameter_is_named():
    with pytest.raises(ConfigError, match="tau_s"):
        models.lon({k: v for k, v in models.REF_LON.items() if k != "tau_s"})
    with pytest.raises(ConfigError, match="time constants"):
        models.lon({**models.REF_LON, "tau_f": 0.0})
