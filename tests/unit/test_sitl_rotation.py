"""The simulator's rotation matrices against scipy's rotations, an independent implementation."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sitl import rotation

angles = st.floats(-3.0, 3.0)
vectors = st.tuples(angles, angles, angles)


def random_matrix(v):
    return Rotation.from_rotvec(v).as_matrix()


@given(vectors)
def test_exp_is_the_rotation_of_its_vector(v):
    np.testing.assert_allclose(np.reshape(rotation.exp(v), (3, 3)), random_matrix(v), atol=1e-14)


@given(vectors)
def test_log_undoes_exp_up_to_half_a_turn(v):
    shortest = Rotation.from_rotvec(v).as_rotvec()
    if np.linalg.norm(shortest) < math.pi - 1e-4:  # at half a turn both signs are right
        np.testing.assert_allclose(rotation.log(tuple(random_matrix(v).ravel())), shortest, atol=1e-9)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.6, 0.8, 0.0), (-0.48, 0.6, 0.64)])
@pytest.mark.parametrize("short_of_half", [0.0, 1e-9, 1e-6, 1e-3, 0.05])
def test_log_holds_near_half_a_turn(axis, short_of_half):
    v = np.array(axis) * (math.pi - short_of_half)
    R = tuple(random_matrix(v).ravel())
    back = np.reshape(rotation.exp(rotation.log(R)), (3, 3))
    np.testing.assert_allclose(back, np.reshape(R, (3, 3)), atol=2e-8)  # the square root of rounding


@given(vectors)
def test_quaternions_there_and_back(v):
    x, y, z, w = Rotation.from_rotvec(v).as_quat()
    R = tuple(random_matrix(v).ravel())
    sign = 1.0 if w >= 0.0 else -1.0
    np.testing.assert_allclose(rotation.to_quaternion(R), np.array([w, x, y, z]) * sign, atol=1e-8)
    np.testing.assert_allclose(rotation.from_quaternion((w, x, y, z)), R, atol=1e-14)


@given(st.tuples(angles, st.floats(-1.5, 1.5), angles))
def test_euler_angles_are_yaw_pitch_roll(e):
    roll, pitch, yaw = e
    R = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    np.testing.assert_allclose(np.reshape(rotation.from_euler(*e), (3, 3)), R, atol=1e-14)
    np.testing.assert_allclose(rotation.to_euler(tuple(R.ravel())), e, atol=1e-9)


@given(vectors, vectors)
def test_products(v, u):
    A, B = random_matrix(v), random_matrix(u)
    a, b = tuple(A.ravel()), tuple(B.ravel())
    np.testing.assert_allclose(np.reshape(rotation.mul(a, b), (3, 3)), A @ B, atol=1e-14)
    np.testing.assert_allclose(np.reshape(rotation.mul_t(a, b), (3, 3)), A.T @ B, atol=1e-14)
    np.testing.assert_allclose(rotation.apply(a, u), A @ u, atol=1e-13)
    np.testing.assert_allclose(rotation.apply_t(a, u), A.T @ u, atol=1e-13)


@given(vectors, st.floats(-1e-4, 1e-4))
def test_orthonormal_mends_what_rounding_breaks(v, wrong):
    R = random_matrix(v) + wrong * np.arange(9).reshape(3, 3)
    M = np.reshape(rotation.orthonormal(tuple(R.ravel())), (3, 3))
    # one pass squares the error: (8e-4)^2, some rows meeting
    np.testing.assert_allclose(M @ M.T, np.eye(3), atol=5e-6)
    assert np.linalg.det(M) == pytest.approx(1.0, abs=5e-6)


@given(st.tuples(st.floats(-8, 8), st.floats(-8, 8), st.floats(-30, -2)), angles)
def test_towards_points_the_thrust_and_the_nose(force, yaw):
    M = np.reshape(rotation.towards(force, yaw), (3, 3))
    np.testing.assert_allclose(M @ M.T, np.eye(3), atol=1e-13)
    np.testing.assert_allclose(-M[:, 2], np.array(force) / np.linalg.norm(force), atol=1e-13)
    assert M[:2, 0] @ (-math.sin(yaw), math.cos(yaw)) == pytest.approx(0.0, abs=1e-12)  # no part of the nose off its heading
    assert M[:2, 0] @ (math.cos(yaw), math.sin(yaw)) > 0.0
