"""The plant against scipy's integrator on quaternions, and what the ground, the rotors and a wrong file do."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from mavquad import airframe
from mavquad.errors import ConfigError
from sitl import config as sitl_config
from sitl import rotors, vehicle
from sitl.plant import GRAVITY_M_S2
from sitl.state import OFF, RATES

QUIET = ["noise.position_m=0", "noise.velocity_m_s=0", "noise.attitude_deg=0", "noise.gyro_rad_s=0", "noise.accel_m_s2=0"]


def airborne(*changes):
    v = vehicle.Vehicle(sitl_config.load(None, [*QUIET, *changes]))
    v.state["p_ned_m"], v.state["grounded"] = (0.0, 0.0, -100.0), 0
    return v


@pytest.mark.parametrize(("hz", "tolerance"), [(500, 3e-4), (1000, 0.8e-4)])  # second order: half the step, a quarter of it
def test_free_rotation_and_drag_agree_with_a_quaternion_integration(hz, tolerance):
    inertia = 'overrides=["body.inertia_kg_m2=[0.02, 0.028, 0.04]"]'
    v = airborne("wind.mean_m_s=6", "wind.from_deg=230", inertia, f"loop_hz={hz}")
    v.state["omega_rad_s"], v.state["v_ned_m_s"] = (3.0, -2.0, 5.0), (4.0, 1.0, -2.0)
    v.state["thrust_n"] = 0.0
    v.setpoint["kind"] = OFF
    frame = airframe.load("x500")
    J, m = np.array([0.02, 0.028, 0.04]), frame.body.mass_kg
    wind = -6.0 * np.array([math.cos(math.radians(230)), math.sin(math.radians(230)), 0.0])

    def slope(t, x):
        velocity, q, w = x[3:6], x[6:10], x[10:13]
        R = Rotation.from_quat([*q[1:], q[0]]).as_matrix()
        air = R.T @ (wind - velocity)
        drag = (np.array(frame.drag.linear_n_s_m) + np.array(frame.drag.quadratic_n_s2_m2) * np.linalg.norm(air)) * air
        a = np.array([0, 0, GRAVITY_M_S2]) + R @ drag / m
        W = np.array([[0, -w[0], -w[1], -w[2]], [w[0], 0, w[2], -w[1]], [w[1], -w[2], 0, w[0]], [w[2], w[1], -w[0], 0]])
        return np.concatenate([velocity, a, 0.5 * W @ q, -np.cross(w, J * w) / J])

    start = [0, 0, -100, 4, 1, -2, 1, 0, 0, 0, 3, -2, 5]
    truth = solve_ivp(slope, (0, 2.0), start, rtol=1e-10, atol=1e-12).y[:, -1]
    v.run(2 * hz)
    np.testing.assert_allclose(v.state["p_ned_m"], truth[:3], atol=tolerance)
    np.testing.assert_allclose(v.state["v_ned_m_s"], truth[3:6], atol=tolerance)
    np.testing.assert_allclose(v.state["omega_rad_s"], truth[10:], atol=tolerance)
    assert abs(np.dot(v.quaternion(), truth[6:10])) == pytest.approx(1.0, abs=tolerance**2)


def test_hover_thrust_carries_the_weight_and_rotors_lag():
    v = airborne()
    hover = v.constants["mass_kg"] * GRAVITY_M_S2 / (4 * v.constants["thrust_max_n"])
    v.state["thrust_n"] = 0.25 * v.constants["mass_kg"] * GRAVITY_M_S2
    v.setpoint["kind"], v.setpoint["thrust"] = RATES, hover
    v.run(500)
    assert v.state["v_ned_m_s"] == pytest.approx((0, 0, 0), abs=1e-9)
    v.setpoint["thrust"] = 1.1 * hover
    v.run(15)  # one lag of 30 ms
    share = (v.state["thrust_n"].sum() / (v.constants["mass_kg"] * GRAVITY_M_S2) - 1.0) / 0.1
    assert share == pytest.approx(1.0 - math.exp(-1.0), abs=1e-9)


@pytest.mark.parametrize("layout", ["x", "plus"])
def test_allocation_gives_the_wanted_wrench(layout):
    frame = airframe.load("x500", (f'rotors.layout="{layout}"',))
    g = rotors.geometry(frame)
    wanted = (20.0, 0.3, -0.2, 0.02)
    T = rotors.allocate(rotors.allocation(frame), wanted[0], wanted[1:], 0.4, 0.05, 8.5)
    np.testing.assert_allclose(rotors.wrench(g.x_m, g.y_m, g.spin, g.c_m, T), wanted, atol=1e-12)


@pytest.mark.parametrize("layout", ["x", "plus"])
def test_what_each_rotor_does(layout):
    g = rotors.geometry(airframe.load("x500", (f'rotors.layout="{layout}"',)))
    signs = [np.sign(np.round(rotors.wrench(g.x_m, g.y_m, g.spin, g.c_m, T)[1:], 12)) for T in np.eye(4)]
    # more thrust at the front pitches up (+), on the left rolls right (+); a rotor that turns CCW from above yaws right (+)
    x = [(-1, 1, 1), (1, -1, 1), (1, 1, -1), (-1, -1, -1)]
    plus = [(0, 1, -1), (-1, 0, 1), (0, -1, -1), (1, 0, 1)]
    assert [tuple(s) for s in signs] == (x if layout == "x" else plus)


def test_saturation_gives_up_yaw_first_then_height_and_keeps_roll():
    frame = airframe.load("x500")
    g, A = rotors.geometry(frame), rotors.allocation(frame)
    T = rotors.allocate(A, 33.0, (0.8, 0.0, 0.5), 0.4, 0.05, 8.5)
    U, tx, _, tz = rotors.wrench(g.x_m, g.y_m, g.spin, g.c_m, T)
    assert max(T) <= 8.5
    assert tx == pytest.approx(0.8, abs=0.35)
    assert U < 33.0
    assert tz < 0.5
    low = rotors.allocate(A, 0.2, (0.5, 0.0, 0.0), 0.4, 0.05, 8.5)
    assert rotors.wrench(g.x_m, g.y_m, g.spin, g.c_m, low)[1] == pytest.approx(0.5, abs=1e-12)


def test_the_ground_holds_and_a_fall_ends_there():
    v = vehicle.Vehicle(sitl_config.load(None, [*QUIET, "wind.mean_m_s=15"]))
    v.run(500)
    assert v.state["p_ned_m"] == pytest.approx((0, 0, 0), abs=0.0)
    assert v.state["accel_m_s2"] == pytest.approx((0, 0, -GRAVITY_M_S2), abs=1e-9)
    v = airborne()
    v.state["p_ned_m"] = (0.0, 0.0, -1.0)
    v.run(400)
    assert v.state["p_ned_m"][2] == 0.0
    assert v.state["v_ned_m_s"] == pytest.approx((0, 0, 0), abs=0.0)
    assert v.state["impact_m_s"] == pytest.approx(math.sqrt(2 * GRAVITY_M_S2), rel=0.03)  # drag takes 2 %


def test_the_disturbance_is_what_the_still_air_vehicle_would_not_feel():
    v = airborne("wind.mean_m_s=5", "wind.from_deg=180")
    v.state["thrust_n"] = 0.25 * v.constants["mass_kg"] * GRAVITY_M_S2
    v.setpoint["kind"], v.setpoint["thrust"] = RATES, v.constants["hover_thrust"]
    v.run(1)
    n = v.state["summed"]
    expected = (0.5 + 0.03 * 5.0) * 5.0 / 2.0  # drag towards north over mass, at rest
    assert v.state["disturbance_m_s2"] / n == pytest.approx((expected, 0, 0), rel=2e-3, abs=1e-4)
    v.constants["push_nm"] = (0.02167, 0.0, 0.0)
    v.constants["effectiveness"] = (0.5, 1.0, 1.0, 1.0)
    v.state["disturbance_rad_s2"], v.state["summed"] = 0.0, 0
    v.run(1)
    lost = 0.5 * v.state["thrust_n"][0]
    arm = v.constants["y_m"][0]
    assert v.state["disturbance_rad_s2"][0] == pytest.approx(1.0 + lost * arm / 0.02167, rel=1e-2)


def test_gyro_and_accelerometer_read_the_body():
    v = vehicle.Vehicle(sitl_config.load(None, ["seed=5", "noise.gyro_bias_rad_s=[0.01, 0, 0]"]))
    rows = []
    for _ in range(2000):
        v.run(1)
        rows.append((*v.state["gyro_rad_s"], *v.state["accel_m_s2"]))
    mean, std = np.mean(rows, axis=0), np.std(rows, axis=0)
    assert mean == pytest.approx((0.01, 0, 0, 0, 0, -GRAVITY_M_S2), abs=0.006)
    assert std == pytest.approx((0.005,) * 3 + (0.05,) * 3, rel=0.06)  # 1/sqrt(2 * 2000) = 1.6 %


def test_a_helicopter_is_refused_by_name(tmp_path):
    text = 'name = "heli"\nkind = "helicopter"\nhover_thrust = 0.5\n[body]\nmass_kg = 8.0\ninertia_kg_m2 = [0.2, 0.3, 0.4]\n'
    text += "[attitude]\nnatural_frequency_rad_s = 8.0\ndamping = 0.8\n"
    path = tmp_path / "heli.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match="airframe 'heli' is a helicopter: the simulator flies a quadrotor"):
        vehicle.Vehicle(sitl_config.load(None, [f"airframe={path}"]))
