"""The simulated helicopter against the identification model of REF, which it shares no number with, and its inner loop in the air."""

import math

import numpy as np
import pytest

from mavquad.errors import ConfigError
from mavquad.identify import fit, models
from sitl import config, helicopter, rotation
from sitl.state import ATTITUDE, STICKS


def vehicle(**changes):
    quiet = config.Noise(position_m=0.0, velocity_m_s=0.0, attitude_deg=0.0, gyro_rad_s=0.0, accel_m_s2=0.0)
    flying = helicopter.Helicopter(config.Sitl(airframe="helicopter", noise=quiet, **changes))
    flying.state["p_ned_m"], flying.state["grounded"] = (0.0, 0.0, -20.0), 0
    flying.state["past"][:, :3] = (0.0, 0.0, -20.0)
    flying.constants["idle"] = 0.0
    level(flying)
    return flying


def level(flying, roll=0.0, pitch=0.0, yaw=0.0):
    flying.setpoint["kind"], flying.setpoint["thrust"] = ATTITUDE, 0.5
    flying.setpoint["R"] = rotation.from_euler(roll, pitch, yaw)


def derivative(x, sticks):
    """(13,) of ref_13's state at small angles, from the simulator's own functions, derivatives of hover."""
    u, q, theta, a, c, v, p, phi, b, d, w, r, r_fb = x
    R = rotation.from_euler(phi, theta, 0.0)
    force, turn = helicopter.forces((u, v, w), (p, q, r), (a, b, c, d, r_fb), sticks, 0)
    gravity = rotation.apply_t(R, (0.0, 0.0, 9.80665))
    rotor = helicopter.rotor_change((p, q, r), (a, b, c, d, r_fb), sticks)
    return np.array(
        [
            force[0] + gravity[0], turn[1], q, rotor[0], rotor[2],
            force[1] + gravity[1], turn[0], p, rotor[1], rotor[3],
            force[2] + gravity[2], turn[2], rotor[4],
        ]
    )  # fmt: skip


def test_at_hover_the_plant_is_the_reference_model():
    reference = models.ref_13()
    h, zero, none = 1e-6, np.zeros(13), (0.0,) * 4
    a = np.column_stack([(derivative(zero + h * e, none) - derivative(zero - h * e, none)) / (2 * h) for e in np.eye(13)])
    b = np.column_stack([derivative(zero, tuple(e)) - derivative(zero, none) for e in np.eye(4)])
    np.testing.assert_allclose(a, reference.a, atol=1e-6)
    np.testing.assert_allclose(b, reference.b, atol=1e-12)
    np.testing.assert_allclose(derivative(zero, none), 0.0, atol=1e-12)


def test_airspeed_changes_the_derivatives_as_scheduled():
    """At 10 m/s ahead s = 1: M_u has changed its sign, the nose is lifted, lift is gained and lost as printed."""
    still = helicopter.forces((10.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0,) * 5, (0.0,) * 4, 0)
    fast = helicopter.forces((10.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0,) * 5, (0.0,) * 4, 1)
    assert still[1][1] == pytest.approx(-1.84)
    assert fast[1][1] == pytest.approx(0.3 * 1.84 + 1.0)
    assert fast[0][0] == pytest.approx(-0.505 * 1.8 - 1.2)
    assert fast[0][2] == pytest.approx(-9.80665 - 1.1)
    assert fast[1][0] == pytest.approx(-1.2)


def test_the_inner_loop_holds_level_and_follows_an_attitude():
    flying = vehicle()
    flying.run(2500)
    assert abs(flying.state["ahrs_euler_rad"][:2]).max() < 1e-6
    level(flying, roll=0.1)
    flying.run(1000)
    roll, pitch, _ = flying.state["ahrs_euler_rad"]
    assert roll == pytest.approx(0.1, abs=0.01)
    assert abs(pitch) < 0.02


def test_the_inner_loop_knows_the_rotor_without_measuring_it():
    flying = vehicle()
    level(flying, roll=0.1, pitch=-0.08)
    flying.run(300)
    truth, known = flying.heli["rotor"], flying.heli["known"]
    assert np.abs(truth).max() > 1e-3
    np.testing.assert_allclose(known[:4], truth[:4], atol=0.1 * np.abs(truth[:4]).max())  # the gyro's filter is 4 ms late


def test_heading_turns_at_its_limit_and_stops():
    flying = vehicle()
    level(flying, yaw=1.5)
    flying.run(1000)
    assert flying.state["omega_rad_s"][2] == pytest.approx(0.4, abs=0.03)
    flying.run(4000)
    assert flying.state["ahrs_euler_rad"][2] == pytest.approx(1.5, abs=0.03)


def test_collective_carries_what_thrust_says():
    flying = vehicle()
    flying.setpoint["thrust"] = 0.55
    flying.run(100)
    assert flying.state["accel_ned_m_s2"][2] == pytest.approx(-0.1 * 9.80665, rel=0.15)
    assert flying.sticks()[3] == pytest.approx(0.1 * 9.80665 / 13.96)


def test_sticks_on_top_are_added_and_forgotten():
    flying = vehicle()
    flying.run(50)
    flying.add_sticks(0.05, -0.1, 0.02, 0.0)
    flying.run(1)
    assert flying.sticks() == pytest.approx((0.05, -0.1, 0.02, 0.0), abs=1e-3)
    flying.run(600)
    level(flying)
    flying.run(2500)
    assert max(abs(x) for x in flying.sticks()) < 0.02


def test_sticks_in_place_of_the_inner_loop_fly_the_bare_unstable_model():
    flying = vehicle()
    flying.setpoint["kind"] = STICKS
    flying.give_sticks(0.02, 0.0, 0.0, 0.0)
    flying.run(500)
    model = models.ref_13()
    _, bd = fit.discretized(model.a, model.b, 1.0)
    expected = bd @ [0.0, 0.02, 0.0, 0.0]
    assert flying.state["ahrs_euler_rad"][0] == pytest.approx(expected[model.states.index("phi")], rel=0.05)
    assert flying.state["omega_rad_s"][1] == pytest.approx(expected[model.states.index("q")], abs=0.003)


def test_the_same_seed_flies_the_same():
    def flown():
        flying = helicopter.Helicopter(config.Sitl(airframe="helicopter", seed=5, wind=config.Wind(mean_m_s=4.0, w20_m_s=5.0)))
        flying.state["p_ned_m"], flying.state["grounded"] = (0.0, 0.0, -20.0), 0
        level(flying)
        flying.run(700)
        return flying.state["p_ned_m"].tolist()

    assert flown() == flown()


def test_an_ardupilot_helicopter_is_refused():
    with pytest.raises(ConfigError, match="another firmware"):
        helicopter.Helicopter(config.Sitl(airframe="helicopter", personality="ardupilot"))


def test_a_gust_is_a_disturbance_and_a_calm_hover_is_none():
    flying = vehicle()
    flying.run(250)
    assert np.abs(flying.state["disturbance_m_s2"]).max() / flying.state["summed"] < 1e-3
    windy = vehicle(wind=config.Wind(mean_m_s=5.0, from_deg=90.0))
    windy.run(250)
    mean = windy.state["disturbance_m_s2"] / windy.state["summed"]
    assert mean[1] < -0.3  # the air pushes west
    assert math.isfinite(float(mean.sum()))
