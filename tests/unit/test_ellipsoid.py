import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavquad.estimate import ellipsoid
from tests.oracles import ellipsoid as oracle

ONE_STEP = {"rtol": 1e-9, "atol": 1e-9}  # acceptance 1 of the design note


def random_system(seed, n=7, m=4):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n))
    p = root @ root.T + 0.1 * np.eye(n)
    c = rng.normal(size=(m, n))
    x = rng.normal(size=n)
    e = rng.uniform(0.05, 2.0, m)
    z = x + np.linalg.cholesky(p) @ (lambda v: v / np.linalg.norm(v) * rng.uniform(0, 1))(rng.normal(size=n))
    y = c @ z + rng.uniform(-1, 1, m) * e
    return rng, x, p, c, y, e, z


@pytest.mark.parametrize("printed", [False, True])
@pytest.mark.parametrize("scaled", [False, True])
@given(seed=st.integers(0, 10_000))
def test_joint_update_agrees_with_the_dense_form(seed, scaled, printed):
    _, x, p, c, y, e, _ = random_system(seed)
    r = c.shape[0] * e**2
    expected_x, expected_p, expected_delta = oracle.joint(x, p, c, y, r, scaled, printed)
    delta = ellipsoid.joint(x, p, c, y, r, scaled, printed)
    np.testing.assert_allclose(delta, expected_delta, **ONE_STEP)
    np.testing.assert_allclose(x, expected_x, **ONE_STEP)
    np.testing.assert_allclose(p, expected_p, **ONE_STEP)


@given(seed=st.integers(0, 10_000))
def test_strip_agrees_with_the_dense_form(seed):
    rng, x, p, c, y, e, _ = random_system(seed)
    s = rng.uniform(0.2, 5.0, x.size)
    expected = oracle.strip(x, p, c[0], y[0], e[0], s)
    delta = ellipsoid.strip(x, p, c[0], y[0], e[0], 1 / s**2)
    assert expected is not None
    np.testing.assert_allclose(delta, expected[2], **ONE_STEP)
    np.testing.assert_allclose(x, expected[0], **ONE_STEP)
    np.testing.assert_allclose(p, expected[1], **ONE_STEP)


@given(seed=st.integers(0, 10_000), zeros=st.integers(0, 7))
def test_propagation_agrees_with_the_dense_form(seed, zeros):
    rng, x, p, _, _, _, _ = random_system(seed)
    f, drive, q, s = rng.normal(size=(7, 7)), rng.normal(size=7), rng.uniform(0.01, 1.0, 7), rng.uniform(0.2, 5.0, 7)
    q[:zeros] = 0.0
    expected_x, expected_p = oracle.propagate(x, p, f, drive, q, s)
    ellipsoid.propagate(x, p, f, drive, q, 1 / s**2)
    np.testing.assert_allclose(x, expected_x, **ONE_STEP)
    np.testing.assert_allclose(p, expected_p, **ONE_STEP)


@given(seed=st.integers(0, 10_000))
def test_every_form_keeps_a_truth_that_keeps_its_bounds(seed):
    rng, x0, p0, c, y, e, z = random_system(seed)
    inv_s2 = np.ones(7)
    for scaled in (False, True):
        for printed in (False, True):
            x, p = x0.copy(), p0.copy()
            assert ellipsoid.joint(x, p, c, y, c.shape[0] * e**2, scaled, printed) > 0.0
            assert ellipsoid.form(x, p, z) <= 1.0 + 1e-9
    x, p = x0.copy(), p0.copy()
    for k in range(4):
        assert ellipsoid.strip(x, p, c[k], y[k], e[k], inv_s2) > 0.0
        assert ellipsoid.form(x, p, z) <= 1.0 + 1e-9
    f, b = rng.normal(size=(7, 7)), rng.uniform(0.0, 0.3, 7)
    ellipsoid.propagate(x, p, f, np.zeros(7), 7 * b**2, inv_s2)
    assert ellipsoid.form(x, p, f @ z + rng.choice([-1.0, 1.0], 7) * b) <= 1.0 + 1e-9


@given(seed=st.integers(0, 10_000), outside=st.booleans(), sign=st.sampled_from([-1.0, 1.0]))
def test_a_strip_is_empty_exactly_where_no_point_of_the_ellipsoid_lies_in_it(seed, outside, sign):
    _, x, p, c, _, e, _ = random_system(seed)
    reach = math.sqrt(c[0] @ p @ c[0])
    farthest = x + sign * p @ c[0] / reach  # the point of the ellipsoid farthest along c
    y = c[0] @ farthest + sign * e[0] * (1.0 + (1e-6 if outside else -1e-6))
    before = p.copy()
    delta = ellipsoid.strip(x, p, c[0], y, e[0], np.ones(7))
    assert (delta < 0.0) == outside
    if outside:
        np.testing.assert_array_equal(p, before)


def test_the_joint_form_misses_an_empty_set_that_strips_see():
    p, c, x = np.eye(2), np.eye(2), np.zeros(2)
    e, y = np.array([0.2, 0.2]), np.array([1.25, 0.0])  # the nearest point of the box is 0.05 outside the unit disc
    assert ellipsoid.joint(x.copy(), p.copy(), c, y, 2 * e**2, True, False) > 0.0
    assert ellipsoid.strip(x, p, c[0], y[0], e[0], np.ones(2)) < 0.0


@given(seed=st.integers(0, 10_000), n=st.integers(1, 8))
def test_largest_eigenvalue_agrees_with_lapack(seed, n):
    root = np.random.default_rng(seed).normal(size=(n, n)) * 10.0 ** np.random.default_rng(seed).uniform(-4, 4, n)
    symmetric = root + root.T
    expected = np.linalg.eigvalsh(symmetric)
    np.testing.assert_allclose(ellipsoid.largest_eigenvalue(symmetric), expected[-1], atol=1e-12 * np.abs(expected).max())


def test_keep_positive_repairs_a_matrix_that_is_not_and_leaves_others_alone():
    good = np.diag([1.0, 1e-9])
    assert not ellipsoid.keep_positive(good, np.ones(2))
    np.testing.assert_array_equal(good, np.diag([1.0, 1e-9]))
    bad = np.array([[1.0, 1.0], [1.0, 1.0 - 1e-6]])
    before = bad.copy()
    assert ellipsoid.keep_positive(bad, np.ones(2))
    assert np.linalg.eigvalsh(bad)[0] >= 1e-12
    assert np.all(np.linalg.eigvalsh(bad - before) >= 0.0)  # enlarged, never cut


def test_nan_in_the_covariance_is_never_inside():
    p = np.full((2, 2), math.nan)
    assert ellipsoid.form(np.zeros(2), p, np.zeros(2)) == math.inf
