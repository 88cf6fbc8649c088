"""Personality `ardupilot`: each thing about ArduCopter that surprises a companion, as it was observed."""

import math

import numpy as np
import pytest

from mavquad import wire
from sitl import config, response
from tests.oracles.client import HOVER, Client

THRUST = "params={ GUID_OPTIONS = 8 }"


def guided(*changes, height=10.0):
    client = Client("personality=ardupilot", *changes)
    client.take_off_guided(height)
    return client


@pytest.fixture(scope="module")
def hovering():
    """One flight for tests that leave it hovering as they found it; thrust is a climb rate."""
    return guided()


def test_nothing_is_sent_unasked():
    c = Client("personality=ardupilot")
    c.run(10.0)
    assert set(c.counts) <= {"HEARTBEAT", "STATUSTEXT", "TIMESYNC"}
    assert c.counts["HEARTBEAT"] in (9, 10)
    assert c.counts["TIMESYNC"] in (1, 2)
    assert c.last["HEARTBEAT"].autopilot == 3


def test_rates_are_granted_exactly_or_refused_and_then_stay():
    c = Client("personality=ardupilot")
    assert c.command(511, 30, 5_000) == 0
    c.run(0.1)
    before = c.counts["ATTITUDE"]
    assert c.command(511, 30, 2_500) == 2
    assert any("400 Hz" in text for text in c.texts)
    start_us, before = c.sim.t_us, c.counts["ATTITUDE"]
    c.run(1.0)
    assert c.counts["ATTITUDE"] - before == pytest.approx((c.sim.t_us - start_us) / 5000, abs=2)
    for denied in (111, 331, 375, 60_000):  # TIMESYNC, ODOMETRY, ACTUATOR_OUTPUT_STATUS, nothing at all
        assert c.command(511, denied, 20_000) == 2
    assert c.command(511, 30, 0) == 0  # the default is off
    c.run(0.1)
    before = c.counts["ATTITUDE"]
    c.run(0.5)
    assert c.counts["ATTITUDE"] == before


def test_the_old_stream_request_turns_on_many():
    c = Client("personality=ardupilot")
    c.send("REQUEST_DATA_STREAM", 1, 1, 0, 4, 1)
    c.run(25.0)
    assert len(c.counts) >= 15
    assert c.counts["ATTITUDE"] == pytest.approx(100, abs=2)


def test_it_arms_and_knows_its_place_after_20_seconds():
    c = Client("personality=ardupilot")
    assert c.command(511, 32, 20_000) == 0
    assert c.command(176, 1, 4) == 4
    assert any("requires position" in text for text in c.texts)
    assert c.command(400, 1) == 4
    assert any("Need Position Estimate" in text for text in c.texts)
    c.run(18.0)
    assert "LOCAL_POSITION_NED" not in c.counts
    c.run(2.5)
    assert c.counts["LOCAL_POSITION_NED"] > 0
    assert c.command(176, 1, 4) == 0
    assert c.command(400, 1) == 0


def test_a_bad_mode_fails_with_a_text_and_an_unknown_command_is_unsupported(hovering):
    assert hovering.command(176, 1, 77) == 4
    assert any("No such mode 77" in text for text in hovering.texts)
    assert hovering.command(31999) == 3
    assert hovering.last["HEARTBEAT"].custom_mode == 4


def test_take_off_is_above_home(hovering):
    assert hovering.where == pytest.approx((0.0, 0.0, -10.0), abs=0.25)


def test_thrust_is_a_climb_rate_by_default(hovering):
    c = hovering
    height = -c.where[2]
    c.run(2.0, lambda: c.attitude(thrust=0.5))
    assert -c.where[2] == pytest.approx(height, abs=0.2)
    c.run(3.0, lambda: c.attitude(thrust=0.75))  # half of WPNAV_SPEED_UP, 2.5 m/s
    rise = -c.where[2]
    c.run(2.0, lambda: c.attitude(thrust=0.75))
    assert -c.where[2] - rise == pytest.approx(2.5, abs=0.3)
    c.run(3.0, lambda: c.attitude(thrust=0.25))
    sink = -c.where[2]
    c.run(1.0, lambda: c.attitude(thrust=0.25))
    assert sink + c.where[2] == pytest.approx(0.75, abs=0.2)


def test_thrust_is_thrust_with_bit_3_and_is_divided_by_the_cosine_of_the_tilt():
    c = guided(THRUST)
    c.run(1.0, lambda: c.attitude(roll=math.radians(30), thrust=HOVER))
    height = -c.where[2]
    c.run(2.0, lambda: c.attitude(roll=math.radians(30), thrust=HOVER))
    assert -c.where[2] == pytest.approx(height, abs=0.6)  # undivided it would fall 2.6 m
    assert c.last["ATTITUDE_TARGET"].thrust == pytest.approx(HOVER, abs=1e-6)
    c.run(1.0, lambda: c.attitude(roll=math.radians(60), thrust=HOVER))
    assert c.last["ATTITUDE"].roll > math.radians(55)  # nobody clamps: ANGLE_MAX is 30 deg


@pytest.mark.parametrize("wrong", ["some rates", "no throttle", "zero quaternion", "long quaternion"])
def test_what_it_does_not_understand_restarts_guided_mode(wrong):
    c = guided(THRUST)
    c.run(2.0, lambda: c.attitude(roll=0.2, thrust=HOVER))
    assert c.last["LOCAL_POSITION_NED"].vy > 1.5
    said = len(c.texts)
    if wrong == "some rates":
        c.run(4.0, lambda: c.attitude(roll=0.2, thrust=HOVER, mask=3))
    elif wrong == "no throttle":
        c.run(4.0, lambda: c.attitude(roll=0.2, thrust=HOVER, mask=7 | 64))
    else:
        q = (0.0, 0.0, 0.0, 0.0) if wrong == "zero quaternion" else (1.01, 0.0, 0.0, 0.0)
        c.run(4.0, lambda: c.send("SET_ATTITUDE_TARGET", 0, 1, 1, 7, q, 0.0, 0.0, 0.0, HOVER))
    assert abs(c.last["LOCAL_POSITION_NED"].vy) < 1.0  # it has braked
    assert c.last["HEARTBEAT"].custom_mode == 4
    assert len(c.texts) == said  # in silence


def test_the_last_setpoint_is_held_for_3_seconds_then_it_levels():
    c = guided(THRUST)
    c.run(1.0, lambda: c.attitude(roll=0.15, thrust=HOVER))
    said = len(c.texts)
    c.run(2.8)
    assert c.last["ATTITUDE"].roll == pytest.approx(0.15, abs=0.03)
    c.run(1.2)
    assert c.last["ATTITUDE"].roll == pytest.approx(0.0, abs=0.03)
    height = -c.where[2]
    c.run(2.0)
    assert -c.where[2] == pytest.approx(height, abs=0.3)  # no climb
    assert c.last["LOCAL_POSITION_NED"].vy > 1.0  # and drifting
    assert c.last["HEARTBEAT"].custom_mode == 4
    assert len(c.texts) == said


def test_the_step_response_is_the_one_observed():
    found = response.measure(config.Sitl(personality="ardupilot"))
    observed = {"t10_s": 0.060, "t50_s": 0.157, "t63_s": 0.200, "t90_s": 0.365}
    assert {name: getattr(found, name) for name in observed} == pytest.approx(observed, abs=0.015)
    assert found.overshoot < 0.01


def test_rates_beside_an_attitude_are_rotated_by_it():
    c = guided(THRUST)
    c.run(2.0, lambda: c.attitude(yaw=math.pi / 2, thrust=HOVER))
    c.run(1.0, lambda: c.attitude(yaw=math.pi / 2, thrust=HOVER, mask=0, rates=(0.3, 0.0, 0.0)))
    w, x, y, z = c.last["ATTITUDE_TARGET"].q
    roll, pitch = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)), math.asin(2 * (w * y - z * x))
    # at a heading of 90 deg a roll rate is taken for a pitch rate: the target leads by rate times ATC_INPUT_TC there
    assert (roll, pitch) == pytest.approx((0.0, 0.3 * 0.165), abs=0.005)


def test_body_rates_alone_are_flown():
    c = guided(THRUST)
    c.run(1.5, lambda: c.attitude(mask=128, rates=(0.0, 0.0, 0.5), thrust=HOVER))
    assert c.last["ATTITUDE"].yawspeed == pytest.approx(0.5, abs=0.05)


def test_it_follows_position_velocity_and_acceleration_within_its_angle_limit(hovering):
    c = hovering
    here = c.where
    goal = (here[0] + 5.0, here[1] - 3.0, -12.0)
    tilts = []

    def fly():
        c.position(goal, mask=56 | 448)
        tilts.append(math.acos(c.sim.vehicle.state["R"][8]))

    c.run(12.0, fly)
    assert c.where == pytest.approx(goal, abs=0.2)
    assert max(tilts) < math.radians(31)
    c.position((0.0, 0.0, 0.0), mask=1)  # not all of an axis group: guided mode begins anew
    c.run(2.0)
    assert c.where == pytest.approx(goal, abs=0.3)


def test_setpoints_outside_guided_mode_are_ignored(hovering):
    c = hovering
    assert c.command(176, 1, 5) == 0
    c.run(1.0, lambda: c.attitude(roll=0.3, thrust=0.5))
    assert abs(c.last["ATTITUDE"].roll) < 0.05
    assert c.command(176, 1, 4) == 0


def test_parameters_are_plain_floats():
    c = Client("personality=ardupilot")
    seen = []
    c.on = lambda m: seen.append(m) if type(m).__name__ == "PARAM_VALUE" else None
    c.send("PARAM_SET", 1, 1, "GUID_OPTIONS", 8.0, 9)
    c.send("PARAM_REQUEST_READ", 1, 1, "GUID_OPTIONS", -1)
    c.run(0.2)
    assert [m.param_value for m in seen] == [8.0, 8.0]
    assert c.command(512, 148) == 0
    assert not c.last["AUTOPILOT_VERSION"].capabilities & 16


def test_a_silent_ground_station_brings_it_home_when_that_is_enabled():
    c = guided("params={ FS_GCS_ENABLE = 1 }")
    c.sim.receive(c.link, wire.encode("HEARTBEAT", (6, 8, 0, 0, 4, 3), seq=0, system=255, component=190))
    c.run(5.0, lambda: c.attitude(thrust=0.5))
    assert c.last["HEARTBEAT"].custom_mode == 4
    c.run(3.0, lambda: c.attitude(thrust=0.5))
    assert c.last["HEARTBEAT"].custom_mode == 6
    assert "GCS Failsafe" in c.texts


def test_its_rates_lag_behind_a_20_hz_filter():
    c = guided(THRUST)
    rows = []

    def swing():
        roll = 0.15 * math.sin(2.0 * math.pi * 1e-6 * c.sim.t_us)
        c.attitude(roll=roll, thrust=HOVER)
        state = c.sim.vehicle.state
        rows.append((state["omega_rad_s"][0], state["rates_rad_s"][0]))

    c.run(6.0, swing)
    true, told = np.array(rows[200:]).T
    angle = np.angle(np.vdot(np.exp(2j * np.pi * 0.01 * np.arange(len(true))), told)) - np.angle(
        np.vdot(np.exp(2j * np.pi * 0.01 * np.arange(len(true))), true)
    )
    assert -angle / (2.0 * math.pi) == pytest.approx(0.011, abs=0.002)  # seconds, at 1 Hz


def test_it_lands_and_disarms():
    c = guided(height=3.0)
    assert c.command(21) == 0
    assert c.last["HEARTBEAT"] is not None
    c.run(14.0)
    assert c.last["HEARTBEAT"].custom_mode == 9
    assert c.last["EXTENDED_SYS_STATE"].landed_state == 1
    assert not c.last["HEARTBEAT"].base_mode & 128
