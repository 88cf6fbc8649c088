"""MAVSDK flies the simulated autopilot, both personalities, from connecting to disarming."""

import json
import subprocess

import pytest

from tests.clients.conftest import PROGRAMS, Sitl

pytestmark = pytest.mark.slow

AUTOPILOT = {"px4": "1", "ardupilot": "2"}  # MAVSDK's own numbers
READY_TO_HOLD = "3"
OFFBOARD = "7"


@pytest.fixture(scope="module", params=AUTOPILOT)
def personality(request):
    return request.param


@pytest.fixture(scope="module")
def seen(personality, client_python, tmp_path_factory):
    """One flight for all tests of a personality."""
    vehicle = Sitl(personality, tmp_path_factory.mktemp(personality))
    try:
        done = subprocess.run(
            [client_python, PROGRAMS / "fly_mavsdk.py", f"udpout://127.0.0.1:{vehicle.port}", personality],
            capture_output=True,
            text=True,
            timeout=200,
            check=False,
        )
    finally:
        report = vehicle.stop()
    found = json.loads(done.stdout.strip().splitlines()[-1])
    assert found["done"], found
    return {**found, "report": report}


def test_it_connects_and_all_is_healthy(seen, personality):
    assert (seen["system"], seen["autopilot"]) == (1, AUTOPILOT[personality])
    assert seen["all_ok"] is True
    assert seen["armable"] is True


def test_telemetry_comes_at_the_rates_that_were_set(seen):
    assert seen["attitude_euler_hz"] == pytest.approx(50.0, rel=0.2)
    assert seen["imu_hz"] == pytest.approx(50.0, rel=0.2)
    assert seen["attitude_quaternion_hz"] == pytest.approx(20.0, rel=0.2)
    assert seen["position_velocity_ned_hz"] == pytest.approx(20.0, rel=0.2)
    assert seen["down_accel_m_s2"] == pytest.approx(-9.81, abs=0.3)
    assert seen["latitude_deg"] == pytest.approx(47.397742, abs=1e-4)


def test_parameters_of_both_kinds_are_read_and_set(seen, personality):
    floats = {"px4": (1.5, 2.0), "ardupilot": (3.0, 2.0)}
    integers = {"px4": (1, 2), "ardupilot": (0, 8)}
    assert (seen["float_was"], seen["float_is"]) == floats[personality]
    assert (seen["int_was"], seen["int_is"]) == integers[personality]
    assert seen["params"] >= 25


def test_what_is_not_there_is_refused_and_not_waited_for(seen):
    assert "UNSUPPORTED" in seen["orbit"]
    assert seen["set_rate_odometry"]
    assert seen["no_such_param"]


def test_it_flies_by_attitude_and_by_rates_and_hands_back(seen):
    assert seen["armed"] is seen["in_air"] is seen["active"] is True
    assert seen["flight_mode"] == OFFBOARD
    assert seen["roll_deg"] == pytest.approx(10.0, abs=1.5)
    assert seen["turned_deg"] == pytest.approx(60.0, abs=12.0)
    assert seen["active_after"] is False
    assert seen["mode_after"] == READY_TO_HOLD
    assert seen["disarmed"] is True
    assert seen["report"]["landed"]
    assert not seen["report"]["crashed"]
