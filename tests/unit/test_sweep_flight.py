"""The sweep on top of a position hold: where it leans, what ends it, what goes on the log."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavquad import airframe, quat, sweep_flight, wire
from mavquad.errors import ConfigError
from mavquad.setpoint import attitude
from mavquad.signals import NAN3, ZERO3, Demand, Estimate
from mavquad.sweep_flight import Params

X500 = airframe.load("x500")
GAINS = sweep_flight.gains(Params(), X500)
DT_S = 0.008


def still(**changes):
    values = {"t_us": 0, "p_ned_m": (0.0, 0.0, -20.0), "v_ned_m_s": ZERO3, "q_wxyz": (1.0, 0.0, 0.0, 0.0), "omega_rad_s": NAN3,
              "f_ned_m_s2": NAN3, "tau_rad_s2": NAN3}  # fmt: skip
    return Estimate(**{**values, **changes})


def wanted(yaw_rad=0.0):
    return Demand(0, (0.0, 0.0, -20.0), ZERO3, ZERO3, ZERO3, yaw_rad, 0.0)


def at(gains, t_s, estimate=None, yaw_rad=0.0, dt_s=DT_S):
    state = sweep_flight.init(gains)._replace(t_s=t_s)
    return sweep_flight.step(gains, state, estimate or still(), wanted(yaw_rad), None, dt_s)


@given(st.floats(8.0, 80.0), st.sampled_from(["roll", "pitch"]), st.floats(-3.0, 3.0))
def test_in_hover_the_setpoint_leans_by_just_the_excitation(t_s, axis, yaw):
    gains = sweep_flight.gains(Params(axes=(axis,)), X500)
    state, command = at(gains, t_s, yaw_rad=yaw)
    vector = attitude.thrust_vector(command.a_ned_m_s2, 0.7, 2.0, 20.0)
    q, _ = attitude.attitude(vector, command.yaw_rad)
    roll, pitch, heading = quat.to_euler(q)
    assert roll == pytest.approx(state.excited[0], abs=1e-9)
    assert pitch == pytest.approx(state.excited[1], abs=1e-9)
    assert math.cos(heading - yaw) == pytest.approx(1.0)


def test_thrust_and_yaw_are_swept_where_asked():
    gains = sweep_flight.gains(Params(axes=("thrust", "yaw"), thrust_amplitude=0.05), X500)
    state, command = at(gains, 15.3)
    collective = X500.hover_thrust * (9.80665 - command.a_ned_m_s2[2]) / 9.80665
    assert collective - X500.hover_thrust == pytest.approx(state.excited[3], abs=1e-12)
    assert abs(state.excited[3]) > 0.01
    state, command = at(gains, 100.0, yaw_rad=0.5)
    assert command.yaw_rad == pytest.approx(0.5 + state.excited[2])
    assert state.excited[2] != 0.0


def test_the_axes_follow_one_another_and_doublets_come_last():
    def moving(t_from, t_to):
        seen = [sweep_flight.excitation_at(GAINS, 0.1 * k) for k in range(round(10 * t_from), round(10 * t_to))]
        return [any(x[i] for x in seen) for i in range(4)]

    assert moving(0.0, 8.0) == [False] * 4
    assert moving(8.1, 78.0) == [True, False, False, False]
    assert moving(84.1, 154.0) == [False, True, False, False]
    assert moving(157.0, 182.0) == [True, True, False, False]
    end = sweep_flight.duration_s(Params())
    assert moving(end + 0.1, end + 5.0) == [False] * 4


@pytest.mark.parametrize(
    ("estimate", "dt_s", "why"),
    [
        (still(q_wxyz=quat.from_euler(math.radians(26.0), 0.0, 0.0)), DT_S, "tilt"),
        (still(q_wxyz=(math.nan, 0.0, 0.0, 0.0)), DT_S, "tilt"),
        (still(v_ned_m_s=(4.0, 3.1, 0.0)), DT_S, "speed"),
        (still(p_ned_m=(0.0, 0.0, -16.9)), DT_S, "height lost"),
        (still(), 0.31, "link age"),
    ],
)
def test_an_abort_ends_the_excitation_in_its_own_sample_and_for_good(estimate, dt_s, why):
    state, _ = at(GAINS, 30.0, estimate, dt_s=dt_s)
    assert state.excited == (0.0, 0.0, 0.0, 0.0)
    before = sweep_flight.init(GAINS)
    assert any(
        why in fields[1] for name, fields in sweep_flight.messages(GAINS, before, state, 1, (1, 1)) if name == "STATUSTEXT"
    )
    later, command = sweep_flight.step(GAINS, state, still(), wanted(), None, DT_S)
    assert later.excited == (0.0, 0.0, 0.0, 0.0)
    assert command.a_ned_m_s2[0] == pytest.approx(0.0)
    assert len(sweep_flight.messages(GAINS, state, later, 2, (1, 1))) == 1  # said once


def test_the_excitation_goes_on_the_log_with_the_vehicles_stamp():
    state, _ = at(GAINS, 30.0)
    ((name, fields),) = sweep_flight.messages(GAINS, sweep_flight.init(GAINS), state, 123_456, (1, 1))
    raw = wire.encode(name, fields, seq=0, system=1, component=191)
    message = wire.decode(wire.split(raw)[0][0])
    assert (message.name, message.time_usec) == ("EXCITE", 123_456)
    assert message.x == pytest.approx(state.excited[0], abs=1e-7)


@pytest.mark.parametrize(
    "change",
    [{"axes": ("rol",)}, {"axes": ()}, {"amplitude_rad": 0.5}, {"hold_rad_s": 5.0}, {"speed_max_m_s": 0.0}, {"f_end_hz": 0.01}],
)
def test_a_sweep_that_cannot_be_flown_is_refused(change):
    with pytest.raises(ConfigError, match=r"sweep"):
        Params(**change)
