"""Faults on request: what is sent, what is flown and what is said about it."""

import math

import pytest

from mavquad.errors import ConfigError
from sitl import config
from tests.oracles.client import HOVER, Client


def with_fault(text, *changes, attitude="ahrs"):
    return Client(f"faults=[{{{text}}}]", f"attitude_source={attitude}", *changes)


@pytest.mark.parametrize(
    ("sensor", "message", "fields"),
    [
        ("gyro", "HIGHRES_IMU", ("xgyro", "ygyro", "zgyro")),
        ("accel", "HIGHRES_IMU", ("xacc", "yacc", "zacc")),
        ("attitude", "ATTITUDE_QUATERNION", ("q1", "q2", "q3", "q4", "rollspeed")),
        ("attitude", "ATTITUDE", ("roll", "pitch", "yaw")),
        ("position", "LOCAL_POSITION_NED", ("x", "y", "z", "vx", "vy", "vz")),
    ],
)
def test_nan_freeze_and_dropout_are_what_is_sent(sensor, message, fields):
    def values(c):
        return [getattr(c.last[message], field) for field in fields]

    c = with_fault(f'kind="nan", sensor="{sensor}", t_s=1.0, duration_s=0.5')
    c.run(1.2)
    assert all(map(math.isnan, values(c)))
    assert c.sim.vehicle.state["gyro_rad_s"] == pytest.approx((0, 0, 0), abs=0.03)  # the autopilot has another
    c.run(0.5)
    assert not any(map(math.isnan, values(c)))

    c = with_fault(f'kind="freeze", sensor="{sensor}", t_s=1.0, duration_s=0.5')
    c.run(1.1)
    held, stamp = values(c), c.last[message][0]
    c.run(0.2)
    assert values(c) == held
    assert c.last[message][0] > stamp
    c.run(0.5)
    assert values(c) != held

    c = with_fault(f'kind="dropout", sensor="{sensor}", t_s=1.0, duration_s=0.5')
    c.run(1.1)
    before = c.counts[message]
    c.run(0.3)
    assert c.counts[message] == before
    c.run(0.5)
    assert c.counts[message] > before


def test_spikes_are_in_some_of_the_velocities_sent_and_in_nothing_that_is_flown():
    c = with_fault('kind="spikes", sensor="position", t_s=1.0, value=[2.5, 2.5, 2.5]')
    c.run(1.5)
    seen = []
    for _ in range(500):
        c.run(0.02)
        m = c.last["LOCAL_POSITION_NED"]
        assert abs(m.x) < 0.2  # positions have none
        seen.append(max(abs(m.vx), abs(m.vy), abs(m.vz)))
    spikes = sum(v > 2.0 for v in seen)
    assert 2 <= spikes <= 30
    assert all(v < 0.3 or 2.0 < v < 3.0 for v in seen)
    assert max(abs(v) for v in c.sim.vehicle.state["nav_v_ned_m_s"]) < 0.3


def test_a_sick_sensor_shows_in_the_health_bits():
    c = with_fault('kind="nan", sensor="imu", t_s=1.0')
    c.run(0.9)
    c.run(1.3)
    m = c.last["SYS_STATUS"]
    assert m.onboard_control_sensors_present & 3 == 3
    assert m.onboard_control_sensors_health & 3 == 0


def test_a_gyro_bias_jumps_and_the_ahrs_learns_it():
    c = with_fault('kind="bias", sensor="gyro", t_s=1.0, value=[0.05, 0.0, 0.0]', "noise.gyro_rad_s=0")
    c.run(1.1)
    assert c.last["HIGHRES_IMU"].xgyro == pytest.approx(0.05, abs=1e-6)
    worst = 0.0
    for _ in range(20):
        c.run(1.0)
        worst = max(worst, abs(c.last["ATTITUDE"].roll))
    assert math.radians(1.0) < worst < math.radians(6.0)
    c.run(20.0)
    assert abs(c.last["ATTITUDE"].rollspeed) < 0.01  # learnt


def test_a_weak_rotor_is_carried_and_shows_as_disturbance():
    c = with_fault('kind="motor", motor=2, effectiveness=0.7, t_s=12.0')
    c.take_off()
    c.run(16.0 - 1e-6 * c.sim.t_us)
    assert c.where == pytest.approx((0, 0, -5), abs=0.6)
    servo = c.last["SERVO_OUTPUT_RAW"]
    assert servo.servo2_raw > servo.servo1_raw + 80


def test_a_push_moves_it_and_ends():
    c = with_fault('kind="push", force_n=[0.0, 6.0, 0.0], t_s=12.0, duration_s=0.5')
    c.take_off()
    c.run(12.6 - 1e-6 * c.sim.t_us)
    assert c.last["LOCAL_POSITION_NED"].vy > 0.6  # 3 m/s^2 for half a second, less what the loop does
    c.run(8.0)
    assert c.where == pytest.approx((0, 0, -5), abs=0.2)


def test_an_estimator_reset_jumps_what_is_sent_but_not_the_vehicle():
    c = with_fault('kind="ekf_reset", value=[3.0, 0.0, 0.0], t_s=12.0')
    c.take_off()
    c.run(11.9 - 1e-6 * c.sim.t_us)
    assert c.where[0] == pytest.approx(0.0, abs=0.15)
    c.run(0.2)
    assert c.where[0] == pytest.approx(3.0, abs=0.15)
    c.run(4.0)
    assert c.where[0] == pytest.approx(3.0, abs=0.2)
    assert c.sim.vehicle.state["p_ned_m"][0] == pytest.approx(0.0, abs=0.2)


@pytest.mark.parametrize("personality", ["px4", "ardupilot"])
def test_a_restart_stops_the_rotors_and_starts_the_boot_clock_again(personality):
    c = with_fault('kind="restart", t_s=31.0', f"personality={personality}")
    if personality == "px4":
        c.run(20.0)
        c.take_off(3.0)
    else:
        c.take_off_guided(3.0)
    c.run(30.9 - 1e-6 * c.sim.t_us)
    assert c.last["ATTITUDE"].time_boot_ms > 30_000
    assert -c.where[2] > 2.0
    c.run(0.2)
    before = c.counts["HEARTBEAT"]
    c.run(1.0)
    assert c.counts["HEARTBEAT"] == before  # booting
    c.run(4.0)
    assert c.counts["HEARTBEAT"] > before
    assert not c.last["HEARTBEAT"].base_mode & 128
    assert c.sim.autopilot.crashed
    assert c.sim.vehicle.state["grounded"]
    if personality == "px4":
        assert c.last["ATTITUDE"].time_boot_ms < 6_000


def test_a_reboot_command_is_obeyed_on_the_ground_and_refused_in_the_air():
    c = Client()
    c.run(5.0)
    assert c.command(246, 1) == 0
    c.run(3.0)
    assert c.last["ATTITUDE"].time_boot_ms < 4000
    c.take_off(3.0)
    assert c.command(246, 1) == 2


def test_a_flight_goes_on_through_a_gust_and_a_dropout_together():
    c = with_fault('kind="dropout", sensor="position", t_s=14.0, duration_s=1.0', "wind.mean_m_s=4", "wind.w20_m_s=6")
    c.take_off()
    c.run(1.2, lambda: c.attitude(thrust=HOVER))
    assert c.command(176, 1, 6, 0) == 0
    c.run(3.0, lambda: c.position((0.0, 0.0, -5.0)))
    assert math.dist(c.sim.vehicle.state["p_ned_m"], (0, 0, -5)) < 2.5


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('kind="motor", motor=5, t_s=1.0', "motor = 5"),
        ('kind="bias", sensor="attitude", t_s=1.0', "bias of 'attitude' is not modelled"),
        ('kind="spikes", sensor="attitude", t_s=1.0', "spikes of 'attitude' is not modelled"),
        ('kind="explode", t_s=1.0', "kind = 'explode'"),
    ],
)
def test_an_impossible_fault_is_refused(text, said):
    with pytest.raises(ConfigError, match=said):
        config.load(None, [f"faults=[{{{text}}}]"])
