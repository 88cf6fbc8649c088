"""control/iadrc: law, limits, mixer and motors, each undone by an independent calculation."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mavquad.control import iadrc

BODY = iadrc.Body(0.4, 9.8, 0.125, (0.005, 0.005, 0.0095), 0.002, 0.2575, 0.016, 0.05, 2.2, 0.03)
number = st.floats(-20.0, 20.0)
torques = st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), st.floats(-0.3, 0.3))


@given(thrust=st.floats(-5.0, 15.0), torque=torques)
def test_every_rotor_stays_inside_its_limits_whatever_is_asked(thrust, torque):
    f = iadrc.mix(BODY, thrust, torque)
    assert min(f) >= BODY.f_min_n - 1e-12
    assert max(f) <= BODY.f_max_n + 1e-12


@given(thrust=st.floats(2.0, 6.0), torque=st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-0.005, 0.005)))
def test_inside_the_limits_the_mixer_gives_what_was_asked(thrust, torque):
    total, got = iadrc.unmix(BODY, iadrc.mix(BODY, thrust, torque))
    assert total == pytest.approx(thrust, abs=1e-12)
    np.testing.assert_allclose(got, torque, atol=1e-12)


@given(thrust=st.floats(0.0, 9.0), torque=torques)
def test_roll_and_pitch_come_before_thrust_and_thrust_before_yaw(thrust, torque):
    total, got = iadrc.unmix(BODY, iadrc.mix(BODY, thrust, torque))
    half = 0.5 * (BODY.f_max_n - BODY.f_min_n)
    share = max(abs(torque[0]), abs(torque[1])) / (2 * BODY.arm_m)
    kept = min(1.0, half / share) if share > 0.0 else 1.0
    np.testing.assert_allclose(got[:2], (kept * torque[0], kept * torque[1]), atol=1e-12)
    most = min(share, half)
    assert total == pytest.approx(4 * min(max(thrust / 4, BODY.f_min_n + most), BODY.f_max_n - most), abs=1e-12)
    assert abs(got[2]) <= abs(torque[2]) + 1e-12
    assert got[2] * torque[2] >= -1e-15


@given(x=number, y=number, up=st.floats(1.0, 20.0), yaw=st.floats(-3.0, 3.0))
def test_roll_and_pitch_point_the_thrust_where_the_force_is(x, y, up, yaw):
    force = np.array([x, y, -up])
    t, roll, pitch = iadrc.thrust_and_angles(tuple(force), yaw)
    down = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()[:, 2]
    np.testing.assert_allclose(-t * down, force, atol=1e-9)


@given(x=number, y=number, z=number, v=st.tuples(number, number, number))
def test_the_force_is_cut_to_thrust_then_to_tilt_and_keeps_its_direction(x, y, z, v):
    force = iadrc.limit_force(BODY, (x, y, z), v, math.radians(35.0))
    assert 0.25 * 9.8 - 1e-9 <= -force[2] <= 0.85 * 4 * 2.2 / 0.4 + 1e-9
    assert math.hypot(force[0], force[1]) <= -force[2] * math.tan(math.radians(35.0)) + 1e-9
    wanted = np.array([x + 0.125 * v[0], y + 0.125 * v[1]])
    assume(np.linalg.norm(wanted) > 1e-3)
    assert abs(force[0] * wanted[1] - force[1] * wanted[0]) < 1e-6
    assert force[0] * wanted[0] + force[1] * wanted[1] >= 0.0


def test_the_position_law_puts_both_poles_at_wc():
    # x'' of the closed loop, as a matrix: the derivative of the law by position and by velocity
    wc = (1.0, 2.0, 3.0)
    zero = (0.0, 0.0, 0.0)
    for i in range(3):
        unit = tuple(1.0 if j == i else 0.0 for j in range(3))
        kp = iadrc.position_law(wc, unit, zero, zero, zero, zero, zero)[i]
        kd = iadrc.position_law(wc, zero, unit, zero, zero, zero, zero)[i]
        np.testing.assert_allclose(np.roots([1.0, -kd, -kp]), -wc[i], atol=1e-6)
        assert iadrc.position_law(wc, zero, zero, unit, zero, zero, zero)[i] == -1.0  # the disturbance is cancelled


@given(w=st.tuples(*[st.floats(-3, 3)] * 3), tau=st.tuples(*[st.floats(-3, 3)] * 3), eta=st.tuples(*[st.floats(-1, 1)] * 3))
def test_the_attitude_law_leaves_the_wanted_acceleration_after_gyroscopics_drag_and_disturbance(w, tau, eta):
    wc, ref = (8.0, 8.0, 3.0), tuple(iadrc.CommandFilter(0.1 * i, 0.2, 0.3) for i in range(3))
    torque = np.array(iadrc.attitude_law(BODY, wc, eta, w, tau, ref))
    J, spin = np.diag(BODY.inertia_kg_m2), np.array(w)
    got = np.linalg.solve(J, torque - np.cross(spin, J @ spin) - BODY.rate_drag_nm_s * spin) + tau
    expected = [0.3 + 2 * wc[i] * (0.2 - w[i]) + wc[i] ** 2 * (0.1 * i - eta[i]) for i in range(3)]
    np.testing.assert_allclose(got, expected, atol=1e-9)


def test_the_attitude_law_turns_the_short_way_round():
    still = iadrc.CommandFilter(0.0, 0.0, 0.0)
    ref = (still, still, iadrc.CommandFilter(-3.1, 0.0, 0.0))
    assert iadrc.attitude_law(BODY, (8.0, 8.0, 3.0), (0.0, 0.0, 3.1), (0.0,) * 3, (0.0,) * 3, ref)[2] > 0.0


def test_motors_follow_their_command_exactly_and_so_does_the_mean():
    f, target, tau, dt = (1.0, 0.5, 2.0, 0.1), (2.0, 2.0, 0.1, 0.1), 0.03, 0.005
    end, mean = iadrc.lag(f, target, tau, dt)
    t = (np.arange(20000) + 0.5) / 20000 * dt
    for i in range(4):
        path = target[i] + (f[i] - target[i]) * np.exp(-t / tau)
        assert mean[i] == pytest.approx(path.mean(), abs=1e-9)
        assert end[i] == pytest.approx(target[i] + (f[i] - target[i]) * math.exp(-dt / tau), abs=1e-12)


def test_the_command_filter_settles_without_overshoot():
    s, path = iadrc.CommandFilter(0.0, 0.0, 0.0), []
    for _ in range(200):
        s = iadrc.filter_command(s, 1.0, 20.0, 0.005)
        path.append(s.angle)
    assert max(path) <= 1.0
    assert path[-1] == pytest.approx(1.0, abs=1e-3)
