"""Setpoints that an autopilot ignores without a word are noticed, because the vehicle does not follow, and said within a second."""

import math

import pytest

from mavquad import following, lifecycle, wire
from mavquad.airframe import AttitudeResponse
from mavquad.paths import Path
from mavquad.settings import Companion
from tests.oracles.late import Late

SETPOINT = wire.ID["SET_ATTITUDE_TARGET"]
RESPONSE = AttitudeResponse(natural_frequency_rad_s=15.0, damping=0.8, delay_s=0.02)
LEVEL = (1.0, 0.0, 0.0, 0.0)
GUSTS = ("wind.mean_m_s=5", "wind.w20_m_s=6")


def lean(angle_rad):
    return (math.cos(0.5 * angle_rad), math.sin(0.5 * angle_rad), 0.0, 0.0)


def follow(seconds, sent, measured, state=following.START, delay_s=0.01, from_s=1.0):
    """(state, when it said so first)."""
    said = math.nan
    for k in range(round(seconds / 0.008)):
        t_s = from_s + 0.008 * k
        state = following.step(RESPONSE, state, round(1e6 * t_s), sent(t_s), measured(t_s), delay_s)
        if not state.follows and math.isnan(said):
            said = t_s
    return state, said


def test_a_vehicle_that_answers_as_its_airframe_says_follows():
    x = v = 0.0
    queue = [0.0] * 4

    def command(t_s):
        return 0.3 * math.sin(2.0 * t_s)

    def measured(t_s):
        nonlocal x, v
        queue.append(command(t_s))
        u = queue.pop(0)  # 32 ms
        for _ in range(8):
            v += 0.001 * (225.0 * (u - x) - 24.0 * v)
            x += 0.001 * v
        return lean(x)

    state, said = follow(10.0, lambda t: lean(command(t)), measured)
    assert math.isnan(said)
    assert state.apart_s == 0.0


@pytest.mark.parametrize("angle_deg", [6.0, -12.0, 30.0])
def test_one_that_stays_level_does_not(angle_deg):
    _, said = follow(3.0, lambda t: LEVEL if t < 2.0 else lean(math.radians(angle_deg)), lambda t: LEVEL)
    assert 2.1 < said < 2.6


def test_less_than_it_would_take_to_be_sure_is_not_said_and_following_again_is():
    _, said = follow(5.0, lambda t: lean(math.radians(1.0)), lambda t: LEVEL)
    assert math.isnan(said)
    state, said = follow(2.0, lambda t: lean(0.2), lambda t: LEVEL)
    assert not state.follows
    state, _ = follow(2.0, lambda t: lean(0.2), lambda t: lean(0.2), state, from_s=3.0)
    assert state.follows


def test_a_gap_of_telemetry_says_nothing():
    state, _ = follow(1.0, lambda t: lean(0.3), lambda t: LEVEL if t < 1.2 else lean(0.3))
    after = following.step(RESPONSE, state, 5_000_000, lean(0.3), LEVEL, 0.01)
    assert after.apart_s == 0.0


def test_the_axis_leans_where_the_thrust_pushes():
    roll, pitch = lean(0.2), (math.cos(0.1), 0.0, math.sin(0.1), 0.0)
    assert following.axis(roll) == pytest.approx((0.0, math.sin(0.2)))  # roll + goes east
    assert following.axis(pitch) == pytest.approx((-math.sin(0.2), 0.0))  # nose up goes back


def flight(personality, *changes):
    settings = Companion(path=Path(name="circle", turns=20.0), observers=(), settle_s=0.5, takeoff_m=2.0)
    params = ("params.GUID_OPTIONS=8",) if personality == "ardupilot" else ()
    late = Late(settings, f"personality={personality}", *params, *changes).engage()
    assert late.life.state == lifecycle.ENGAGED, late.texts
    return late


@pytest.mark.parametrize("personality", ["px4", "ardupilot"])
def test_ignored_setpoints_are_said_within_a_second(personality):
    late = flight(personality, *GUSTS).run(5.0)
    assert not any("followed" in text for text in late.texts), late.texts
    take = late.sim.receive
    late.sim.receive = lambda link, raw: int.from_bytes(raw[7:10], "little") == SETPOINT or take(link, raw)
    late.run(1.0)
    assert "mavquad: setpoints are not followed" in late.texts
    assert late.flight.counts["not followed"] == 1
