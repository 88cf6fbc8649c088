"""lie.py against 4x4 matrices: the generator, the Cayley map and dcay^-1 as the paper writes them."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from mavquad import quat
from mavquad.estimate import lie, torque

vectors = st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3))
INERTIA = (8.942e-3, 9.458e-3, 7.787e-3)
GYRO = torque.gyro_ratios(INERTIA)
ZERO = (0.0, 0.0, 0.0)


def generator(w):
    """A(w) of Eq. (26), corrected: A(w) q = q (x) [0, w/2]."""
    x, y, z = w
    return 0.5 * np.array([[0, -x, -y, -z], [x, 0, z, -y], [y, -z, 0, x], [z, y, -x, 0]])


def left_generator(w):
    """B(w) q = [0, w/2] (x) q: world rates."""
    x, y, z = w
    return 0.5 * np.array([[0, -x, -y, -z], [x, 0, -z, y], [y, z, 0, -x], [z, -y, x, 0]])


def vector_of(matrix):
    """w of A(w) or B(w): the first column holds it."""
    return 2.0 * matrix[1:, 0]


@given(xi=vectors, w=vectors)
def test_dcay_inverse_is_eq_22_in_vectors_on_either_side(xi, w):
    for vector_form, matrix_form in ((lie.dcay_inv_body, generator), (lie.dcay_inv_world, left_generator)):
        u, v = matrix_form(xi), matrix_form(w)
        expected = vector_of(v - 0.5 * (u @ v - v @ u) - 0.25 * u @ v @ u)
        np.testing.assert_allclose(vector_form(xi, w), expected, atol=1e-14 * (1.0 + np.dot(xi, xi)))


@given(xi=vectors, w=vectors)
def test_moving_along_dcay_inverse_turns_the_attitude_at_that_rate(xi, w):
    eps = 1e-6  # central difference: error eps^2
    rate = np.array(lie.dcay_inv_body(xi, w))
    ahead, behind = (quat.cayley(tuple(np.array(xi) + s * eps * rate)) for s in (1.0, -1.0))
    moved = np.array(quat.mul(quat.conj(quat.cayley(xi)), tuple((np.array(ahead) - np.array(behind)) / (2.0 * eps))))
    np.testing.assert_allclose(moved, [0.0, *(0.5 * np.array(w))], atol=1e-7)
    rate = np.array(lie.dcay_inv_world(xi, w))
    ahead, behind = (quat.cayley(tuple(np.array(xi) + s * eps * rate)) for s in (1.0, -1.0))
    moved = np.array(quat.mul(tuple((np.array(ahead) - np.array(behind)) / (2.0 * eps)), quat.conj(quat.cayley(xi))))
    np.testing.assert_allclose(moved, [0.0, *(0.5 * np.array(w))], atol=1e-7)


@given(xi=vectors, start=vectors)
def test_the_cayley_matrix_is_a_product_on_the_right(xi, start):
    q = np.array(quat.exp(start))
    u = generator(xi)
    expected = np.linalg.solve(np.eye(4) - u / 2, (np.eye(4) + u / 2) @ q)
    np.testing.assert_allclose(quat.mul(tuple(q), quat.cayley(xi)), expected, atol=1e-14)


@given(xi=vectors)
def test_every_map_gives_a_unit_quaternion_with_its_own_angle(xi):
    size = math.hypot(*xi)
    angles = {lie.CAYLEY: 4 * math.atan(size / 4), lie.EXP: size, lie.EULER: 2 * math.atan(size / 2)}
    for group_map, angle in angles.items():
        q = lie.increment(group_map, xi)
        assert quat.norm(q) == pytest.approx(1.0, abs=4e-16)
        assert q[0] == pytest.approx(math.cos(0.5 * angle), abs=1e-14)
        assert np.dot(q[1:], xi) >= 0.0


@given(a=vectors, b=vectors, c=vectors)
def test_unit_quaternions_are_a_group_under_the_product(a, b, c):
    qa, qb, qc = quat.cayley(a), quat.exp(b), quat.cayley(c)
    np.testing.assert_allclose(quat.mul(quat.mul(qa, qb), qc), quat.mul(qa, quat.mul(qb, qc)), atol=1e-15)
    np.testing.assert_allclose(quat.mul(qa, quat.conj(qa)), quat.IDENTITY, atol=1e-15)
    np.testing.assert_allclose(quat.mul(qa, quat.IDENTITY), qa, atol=0)
    np.testing.assert_allclose(quat.cayley_inverse(qa), a, atol=1e-14)
    np.testing.assert_allclose(quat.mul(quat.cayley(a), quat.cayley(tuple(-x for x in a))), quat.IDENTITY, atol=1e-15)


def motion(t, x, a):
    """q' = A(w) q and Euler's equation, independently of lie.py."""
    w = x[4:]
    j = np.array(INERTIA)
    return np.concatenate([generator(w) @ x[:4], np.array(a(t)) - np.cross(w, j * w) / j])


@pytest.mark.parametrize(("order", "rate"), [(1, 1), (2, 2), (4, 4)])
def test_steps_converge_to_the_rigid_body_with_their_order(order, rate):
    def accel(t):
        return (math.sin(t), math.cos(2.0 * t), -0.5)

    end = solve_ivp(
        motion, (0.0, 1.0), [1.0, 0, 0, 0, 3.0, -2.0, 1.0], args=(accel,), method="DOP853", rtol=1e-12, atol=1e-13
    ).y[:, -1]
    errors = []
    for steps in (40, 80):
        h = 1.0 / steps
        q, w = (1.0, 0.0, 0.0, 0.0), (3.0, -2.0, 1.0)
        for k in range(steps):
            a0, a1, a2 = accel(k * h), accel((k + 0.5) * h), accel((k + 1) * h)
            if order == 1:
                q, w = lie.step_1(lie.CAYLEY, GYRO, q, w, a0, ZERO, ZERO, h)
            elif order == 2:
                q, w = lie.step_2(lie.CAYLEY, GYRO, q, w, a0, a1, ZERO, ZERO, h)
            else:
                q, w = lie.step_4(GYRO, q, w, a0, a1, a2, ZERO, ZERO, h)
        errors.append(np.linalg.norm(np.array([*q, *w]) - end))
    assert math.log2(errors[0] / errors[1]) == pytest.approx(rate, abs=0.15)


@given(w=vectors, i1=vectors, i2=vectors)
def test_an_injection_is_a_change_of_rate_and_of_acceleration(w, i1, i2):
    h, q = 1e-3, (1.0, 0.0, 0.0, 0.0)
    turned, changed = lie.step_2(lie.CAYLEY, ZERO, q, w, ZERO, ZERO, i1, i2, h)
    np.testing.assert_allclose(quat.log(turned), h * (np.array(w) - i1 - 0.5 * h * np.array(i2)), atol=1e-7)
    np.testing.assert_allclose(changed, np.array(w) - h * np.array(i2), atol=1e-15)
    for other, _ in (lie.step_1(lie.CAYLEY, ZERO, q, w, ZERO, i1, i2, h), lie.step_4(ZERO, q, w, ZERO, ZERO, ZERO, i1, i2, h)):
        np.testing.assert_allclose(other, turned, atol=1e-5)


@given(a=vectors, b=vectors)
def test_the_attitude_error_is_that_of_the_estimate_seen_from_the_body_and_blind_to_the_sign(a, b):
    meas, hat = quat.exp(a), quat.exp(b)
    e = lie.attitude_error(meas, hat)
    back = quat.mul(meas, quat.exp(e))
    assert abs(np.dot(back, hat)) == pytest.approx(1.0, abs=1e-12)
    minus = tuple(-x for x in meas)
    np.testing.assert_array_equal(lie.attitude_error(minus, hat), e)
    np.testing.assert_array_equal(lie.vector_error(minus, hat), lie.vector_error(meas, hat))
    angle = math.hypot(*e)
    np.testing.assert_allclose(
        lie.vector_error(meas, hat), 2.0 * math.sin(0.5 * angle) / max(angle, 1e-300) * np.array(e), atol=1e-12
    )
