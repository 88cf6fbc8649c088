"""quat.py against rotation matrices and matrix exponentials written out here."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mavquad import quat

angles = st.floats(-3.1, 3.1)
vectors = st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3))


def _rotation(q: quat.Quat) -> Rotation:
    return Rotation.from_quat([q[1], q[2], q[3], q[0]])


@given(a=vectors, b=vectors, v=vectors)
def test_product_and_rotation_agree_with_matrices(a, b, v):
    qa, qb = quat.exp(a), quat.exp(b)
    expected = Rotation.from_rotvec(a).as_matrix() @ Rotation.from_rotvec(b).as_matrix() @ np.array(v)
    np.testing.assert_allclose(quat.rotate(quat.mul(qa, qb), v), expected, atol=1e-13)
    np.testing.assert_allclose(quat.rotate_back(qa, quat.rotate(qa, v)), v, atol=1e-13)


@given(phi=vectors)
def test_log_undoes_exp_up_to_the_shortest_way_round(phi):
    q = quat.exp(phi)
    np.testing.assert_allclose(quat.log(q), _rotation(q).as_rotvec(), atol=1e-12)
    np.testing.assert_array_equal(quat.log(q), quat.log((-q[0], -q[1], -q[2], -q[3])))


@given(xi=vectors)
def test_cayley_agrees_with_its_matrix_form(xi):
    wx, wy, wz = xi
    u = 0.5 * np.array([[0, -wx, -wy, -wz], [wx, 0, wz, -wy], [wy, -wz, 0, wx], [wz, wy, -wx, 0]])
    q0 = np.array([0.5, -0.5, 0.5, 0.5])
    expected = np.linalg.solve(np.eye(4) - u / 2, (np.eye(4) + u / 2) @ q0)
    np.testing.assert_allclose(quat.mul(tuple(q0), quat.cayley(xi)), expected, atol=1e-14)
    np.testing.assert_allclose(quat.cayley_inverse(quat.cayley(xi)), xi, atol=1e-12)


@given(roll=angles, pitch=st.floats(-1.5, 1.5), yaw=angles)
def test_euler_angles_are_zyx(roll, pitch, yaw):
    q = quat.from_euler(roll, pitch, yaw)
    expected = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    np.testing.assert_allclose(_rotation(q).as_matrix(), expected, atol=1e-14)
    np.testing.assert_allclose(quat.to_euler(q), (roll, pitch, yaw), atol=1e-7)  # asin is flat near 1.5 rad
    assert math.isclose(quat.yaw(q), yaw, abs_tol=1e-9)


@given(omega=vectors, dt=st.floats(1e-4, 0.05))
def test_integration_at_constant_rate_composes(omega, dt):
    twice = quat.integrate(quat.integrate(quat.IDENTITY, omega, dt), omega, dt)
    np.testing.assert_allclose(twice, quat.integrate(quat.IDENTITY, omega, 2 * dt), atol=1e-15 * 10)


def test_a_zero_quaternion_normalizes_to_nan():
    assert all(math.isnan(x) for x in quat.normalize((0.0, 0.0, 0.0, 0.0)))
