"""What a client asks for and the simulated autopilot does not have gets an answer that says so, on both personalities."""

import math

import pytest

from tests.oracles.client import Client

PERSONALITIES = ("px4", "ardupilot")
NAN = math.nan


@pytest.fixture(params=PERSONALITIES)
def client(request):
    c = Client(f"personality={request.param}")
    c.run(0.1)
    return c


def answer(c, name, request, *fields):
    """The next `name` after a request."""
    before = c.counts[name]
    c.send(request, *fields)
    c.run(0.1)
    assert c.counts[name] == before + 1
    return c.last[name]


@pytest.mark.parametrize("number", [30, 34, 183, 192, 193, 209, 241, 500, 2500, 42424])
def test_a_command_that_is_not_known_is_unsupported(client, number):
    assert client.command(number, 1.0) == 3


def test_a_command_with_positions_is_answered_the_same(client):
    ack = answer(client, "COMMAND_ACK", "COMMAND_INT", 1, 1, 6, 192, 0, 0, NAN, NAN, NAN, NAN, 0, 0, NAN)
    assert (ack.command, ack.result) == (192, 3)


def test_a_message_that_is_not_there_is_refused(client):
    assert client.command(512, 132) == 3  # DISTANCE_SENSOR
    assert client.command(511, 132, 20_000) != 0


@pytest.mark.parametrize("name", ["MISSION_REQUEST", "MISSION_REQUEST_INT"])
def test_there_is_no_item_of_a_mission(client, name):
    assert answer(client, "MISSION_ACK", name, 1, 1, 0, 0).type == 13


def test_a_mission_cannot_be_uploaded_and_an_empty_one_can(client):
    assert answer(client, "MISSION_ACK", "MISSION_COUNT", 1, 1, 5, 0, 0).type == 3
    assert answer(client, "MISSION_ACK", "MISSION_COUNT", 1, 1, 0, 0, 0).type == 0
    assert answer(client, "MISSION_ACK", "MISSION_CLEAR_ALL", 1, 1, 1).mission_type == 1
    assert answer(client, "MISSION_ACK", "MISSION_SET_CURRENT", 1, 1, 2).type == 13
    assert answer(client, "MISSION_COUNT", "MISSION_REQUEST_LIST", 1, 1, 2).count == 0
    item = (1, 1, 0, 3, 16, 2, 1, NAN, NAN, NAN, NAN, 0, 0, 10.0, 0)
    assert answer(client, "MISSION_ACK", "MISSION_ITEM_INT", *item).type == 3


def test_files_are_refused_and_sessions_that_were_never_open_end(client):
    request = (7, 1, 9, 3) + (0,) * 247  # sequence 263, session 9, list a directory
    payload = answer(client, "FILE_TRANSFER_PROTOCOL", "FILE_TRANSFER_PROTOCOL", 0, 1, 1, request).payload
    assert tuple(payload[:6]) == (8, 1, 9, 129, 1, 3)
    assert payload[12] == 7  # unknown command
    request = (255, 255, 0, 2) + (0,) * 247
    payload = answer(client, "FILE_TRANSFER_PROTOCOL", "FILE_TRANSFER_PROTOCOL", 0, 1, 1, request).payload
    assert tuple(payload[:6]) == (0, 0, 0, 128, 0, 2)


def test_no_log_is_kept_aboard(client):
    assert answer(client, "LOG_ENTRY", "LOG_REQUEST_LIST", 1, 1, 0, 0xFFFF).num_logs == 0
    assert answer(client, "LOG_DATA", "LOG_REQUEST_DATA", 1, 1, 3, 0, 90).count == 0


def test_an_unknown_parameter_is_said_to_be_unknown(client):
    refused = answer(client, "PARAM_ERROR", "PARAM_REQUEST_READ", 1, 1, "NO_SUCH", -1)
    assert (refused.param_id, refused.error, refused.target_component) == ("NO_SUCH", 1, 191)
    assert answer(client, "PARAM_ERROR", "PARAM_REQUEST_READ", 1, 1, "", 999).param_index == 999
    answer(client, "PARAM_ERROR", "PARAM_SET", 1, 1, "NO_SUCH", 1.0, 9)
    assert "PARAM_VALUE" not in client.counts


def test_a_setpoint_that_is_not_flown_is_said_once(client):
    for _ in range(5):
        client.send("SET_POSITION_TARGET_GLOBAL_INT", 0, 1, 1, 6, 0, 0, 0, 10.0, *(0.0,) * 8)
        client.run(0.1)
    assert sum("SET_POSITION_TARGET_GLOBAL_INT" in text for text in client.texts) == 1


def test_the_origin_is_told_and_not_moved(client):
    said = answer(client, "GPS_GLOBAL_ORIGIN", "SET_GPS_GLOBAL_ORIGIN", 1, 10, 20, 30, 0)
    assert (said.latitude, said.longitude, said.altitude) == (473977420, 85455940, 488000)


def test_health_says_ready_to_arm_when_it_is():
    for personality, ready_s in zip(PERSONALITIES, (2.0, 21.0), strict=True):
        c = Client(f"personality={personality}")
        c.run(0.2)
        assert c.command(512, 1) == 0
        assert not c.last["SYS_STATUS"].onboard_control_sensors_health & 1 << 28
        c.run(ready_s)
        assert c.command(512, 1) == 0
        assert c.last["SYS_STATUS"].onboard_control_sensors_health & 1 << 28
        assert c.command(512, 242) == 0  # and home is known before it is armed
        assert c.last["HOME_POSITION"].latitude == pytest.approx(473977420, abs=20)
