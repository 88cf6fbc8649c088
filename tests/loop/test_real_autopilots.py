"""What a real ArduCopter does to a companion, met without a change of code: the pipeline against one that is scripted."""

import itertools
import math

import pytest

from mavquad import lifecycle
from mavquad.companion import request
from tests.loop.test_companion_loop import Loop
from tests.oracles.arducopter import (
    ARM,
    DENIED,
    FAILED,
    GUIDED,
    IN_PROGRESS,
    LAND,
    LOITER,
    RTL,
    SET_INTERVAL,
    SET_MODE,
    STABILIZE,
    TAKEOFF,
    TEMPORARY,
    ArduCopter,
)
from tests.oracles.autopilot import OFFBOARD, Autopilot


def asked_to_engage(autopilot):
    loop = Loop(autopilot=autopilot)
    loop.until(lifecycle.OBSERVING)
    loop.take(request(lifecycle.CMD_ENGAGE, loop.plan, 0).raw)
    return loop


def engaged(autopilot):
    loop = asked_to_engage(autopilot)
    loop.until(lifecycle.ENGAGED)
    return loop


def times(autopilot, command):
    return [t_us for t_us, number in autopilot.commands if number == command]


def not_fought(loop, seconds=6.0):
    """Released, and from then on neither a command nor a setpoint."""
    assert loop.flight.life.state == lifecycle.RELEASED, loop.texts
    a = loop.autopilot
    before = len(a.commands), len(a.setpoints)
    loop.run(seconds)
    assert (len(a.commands), len(a.setpoints)) == before
    return loop.flight.life.reason


def test_a_whole_flight_of_one_that_sends_nothing_unasked_and_denies_more_than_200_hz():
    a = ArduCopter()
    loop = engaged(a)
    granted = {rate.name: rate.granted_hz for rate in loop.flight.life.rates}
    assert (granted["ATTITUDE_QUATERNION"], granted["ATTITUDE"], granted["HIGHRES_IMU"]) == (200.0, 100.0, 200.0)
    assert len(times(a, SET_INTERVAL)) == len(granted) + 3  # three were stepped down once
    assert a.mode == GUIDED
    loop.until(lifecycle.RELEASED)
    assert a.mode == LAND
    loop.run(12.0)
    assert not a.armed


def test_a_position_that_is_not_there_yet_is_waited_for_and_said_once():
    loop = asked_to_engage(ArduCopter(origin_s=20.0))
    loop.run(15.0)
    assert loop.texts.count("mavquad: waiting for local position") == 1
    assert not loop.autopilot.armed
    loop.until(lifecycle.ENGAGED)


@pytest.mark.parametrize("result", [FAILED, TEMPORARY])
@pytest.mark.parametrize("first", [True, False])
def test_arming_that_is_refused_is_shown_with_its_reason_and_tried_again(first, result):
    a = ArduCopter()
    a.answers_to[ARM] = [(result, "Arm: Need Position Estimate", first)] * 3
    loop = asked_to_engage(a)
    loop.run(4.0)
    assert loop.texts.count("mavquad: arm refused: Need Position Estimate") == 1
    loop.until(lifecycle.ENGAGED)
    tried = times(a, ARM)
    assert len(tried) == 4
    assert min(b - a for a, b in itertools.pairwise(tried)) >= 2_000_000
    assert sum(text.startswith("mavquad: arm refused") for text in loop.texts) == (1 if first else 2)


def test_a_reason_that_comes_in_parts_is_put_together():
    a = ArduCopter()
    words = "Arm: Compass not calibrated, gyros inconsistent and battery below minimum arming voltage"
    a.answers_to[ARM] = [(FAILED, words, False)]
    loop = asked_to_engage(a)
    loop.run(1.0)
    assert loop.flight.life.heard.text == words
    assert "Compass not calibrated" in loop.flight.life.said


def test_a_command_that_will_always_be_refused_is_not_repeated():
    a = ArduCopter()
    a.answers_to[ARM] = [(DENIED, "Arm: Rudder arming disabled", True)] * 9
    loop = asked_to_engage(a)
    loop.run(1.0)
    assert "Rudder arming disabled" in not_fought(loop)
    assert len(times(a, ARM)) == 1


def test_a_command_in_progress_is_given_time():
    a = ArduCopter()
    a.answers_to[ARM] = [(IN_PROGRESS, "", False)]
    loop = asked_to_engage(a)
    loop.run(2.5)
    assert len(times(a, ARM)) == 1
    loop.until(lifecycle.ENGAGED)


def test_a_mode_that_needs_a_position_is_asked_for_again():
    a = ArduCopter()
    a.answers_to[SET_MODE] = [(FAILED, "Mode change to GUIDED failed: requires position", False)] * 2
    loop = asked_to_engage(a)
    loop.until(lifecycle.ENGAGED)
    assert any("mode refused: Mode change to GUIDED" in text for text in loop.texts)


def test_an_ack_for_somebody_else_is_not_taken_for_ours():
    a = ArduCopter()
    a.answers_to[ARM] = [(IN_PROGRESS, "", False)] * 5
    loop = asked_to_engage(a)
    loop.run(2.0)
    pending = loop.flight.life.pending
    assert pending.purpose == "arm"
    a.send("COMMAND_ACK", ARM, DENIED, 0, 0, 255, 190)
    loop.run(0.1)
    assert loop.flight.life.pending == pending


def test_thrust_options_are_said_with_the_value_to_set():
    loop = asked_to_engage(ArduCopter(GUID_OPTIONS=1.0))
    loop.run(1.0)
    assert not_fought(loop) == "set GUID_OPTIONS to 9"
    loop.autopilot.params["GUID_OPTIONS"] = 9.0  # set by a ground station, told to everybody
    loop.autopilot.send("PARAM_VALUE", "GUID_OPTIONS", 9.0, 9, 1, 0)
    loop.run(0.2)
    loop.take(request(lifecycle.CMD_ENGAGE, loop.plan, 1).raw)
    loop.until(lifecycle.ENGAGED)


def test_thrust_options_that_were_not_read_are_asked_for_again_before_the_flight():
    a = ArduCopter()
    a.deaf_to = {"GUID_OPTIONS"}
    loop = Loop(autopilot=a)
    loop.until(lifecycle.OBSERVING)
    a.deaf_to = set()
    loop.take(request(lifecycle.CMD_ENGAGE, loop.plan, 0).raw)
    assert math.isnan(lifecycle.param(loop.flight.life, "GUID_OPTIONS"))
    loop.until(lifecycle.ENGAGED)
    assert lifecycle.param(loop.flight.life, "GUID_OPTIONS") == 8.0


def test_thrust_options_that_nobody_tells_are_no_reason_to_fly():
    a = ArduCopter()
    a.deaf_to = {"GUID_OPTIONS"}
    loop = asked_to_engage(a)
    loop.until(lifecycle.RELEASED)
    assert loop.flight.life.reason == "GUID_OPTIONS cannot be read"
    assert not a.armed


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan])
def test_thrust_options_that_are_no_number_are_as_good_as_none(value):
    loop = asked_to_engage(ArduCopter(GUID_OPTIONS=value))
    loop.until(lifecycle.RELEASED)
    assert loop.flight.life.reason == "GUID_OPTIONS cannot be read"
    assert loop.flight.counts["PARAM_VALUE refused"] > 0


def test_a_failsafe_that_takes_the_vehicle_home_is_named_and_not_fought():
    loop = engaged(ArduCopter())
    loop.autopilot.say("GCS Failsafe")
    loop.autopilot.mode = RTL
    loop.run(1.1)
    assert not_fought(loop) == "mode RTL set by another: GCS Failsafe"


def test_a_failsafe_on_the_way_up_is_not_fought():
    loop = asked_to_engage(ArduCopter())
    for _ in range(200):
        loop.run(0.1)
        if loop.flight.life.phase == "climb" and loop.autopilot.p[2] < -1.0:
            break
    loop.autopilot.mode = RTL
    loop.run(1.1)
    assert not_fought(loop) == "mode RTL set by another"


def test_a_failsafe_before_our_setpoints_are_flown_is_not_fought():
    loop = asked_to_engage(ArduCopter())
    loop.until(lifecycle.STREAMING)
    loop.autopilot.mode = LOITER
    loop.run(1.1)
    assert not_fought(loop) == "mode LOITER set by another"


def test_a_pilot_who_takes_another_mode_on_the_ground_has_it():
    a = ArduCopter()
    a.answers_to[ARM] = [(FAILED, "Arm: Throttle too high", True)] * 99
    loop = asked_to_engage(a)
    loop.run(5.0)
    a.mode = STABILIZE
    loop.run(1.1)
    assert not_fought(loop) == "mode STABILIZE set by another"


def test_px4_modes_of_its_own_on_the_way_up_are_no_reason_to_let_go_and_others_are():
    loop = Loop(autopilot=Autopilot())
    loop.until(lifecycle.OBSERVING)
    loop.take(request(lifecycle.CMD_ENGAGE, loop.plan, 0).raw)
    loop.until(lifecycle.STREAMING)
    loop.autopilot.mode = 3 << 16
    loop.run(1.1)
    assert loop.flight.life.reason == "mode POSCTL set by another"
    loop.run(5.0)
    assert loop.autopilot.mode != OFFBOARD


def test_a_vehicle_that_is_disarmed_on_the_way_up_is_not_armed_again():
    loop = asked_to_engage(ArduCopter())
    for _ in range(200):
        loop.run(0.1)
        if loop.autopilot.p[2] < -0.5:
            break
    loop.autopilot.armed = False
    loop.run(1.1)
    assert not_fought(loop) == "disarmed"


def test_a_landing_that_is_refused_is_asked_for_again():
    a = ArduCopter()
    loop = engaged(a)
    a.answers_to[SET_MODE] = [(FAILED, "", False)] * 2
    loop.until(lifecycle.RELEASED)
    assert a.mode == LAND
    assert any("land refused: failed" in text for text in loop.texts)
    assert loop.texts.count("mavquad: path over, landing") == 1


def test_a_take_off_that_is_refused_is_tried_again():
    a = ArduCopter()
    a.answers_to[TAKEOFF] = [(FAILED, "", False)] * 2
    loop = engaged(a)
    assert any("takeoff refused: failed" in text for text in loop.texts)


def test_a_text_with_no_end_in_sight_leaves_no_trace_in_the_next():
    loop = asked_to_engage(ArduCopter())
    a = loop.autopilot
    a.send("STATUSTEXT", 6, "x" * 50, 5, 0)  # its second part gets lost
    a.say("EKF3 IMU0 is using GPS", 6)
    loop.run(0.1)
    assert loop.flight.life.heard.text == "EKF3 IMU0 is using GPS"
