"""The companion's pipeline led through whole flights on a virtual clock, against a scripted autopilot."""

import math

import numpy as np
import pytest

from mavquad import lifecycle, pipeline, wire
from mavquad.companion import request
from mavquad.paths import Path
from mavquad.settings import Companion
from tests.oracles.autopilot import EPOCH_US, OFFBOARD, Autopilot, level

QUICK = Companion(path=Path(name="hover", duration_s=3.0), observers=())


class Loop:
    """Autopilot and pipeline, frame by frame, as the shell does it."""

    def __init__(self, settings=QUICK, autopilot=None):
        self.autopilot = autopilot or Autopilot()
        self.plan = pipeline.build(settings)
        self.flight = pipeline.start(self.plan)
        self.records = []
        self.trace = []
        self.texts = []

    def take(self, raw):
        stamp = EPOCH_US + self.autopilot.t_us
        for frame in wire.split(raw)[0]:
            if pipeline.accepts(self.plan, self.flight, frame):
                continue
            self._emit(pipeline.advance(self.plan, self.flight, stamp))
            self.records.append((stamp, frame.raw))
            self._emit(pipeline.feed(self.plan, self.flight, stamp, frame))

    def _emit(self, flight):
        self.flight = flight
        for stamp, raw in flight.outbox:
            self.records.append((stamp, raw))
            self.autopilot.hear(raw)
            self.texts += [m.text for _, m in wire.parse(raw) if type(m).__name__ == "STATUSTEXT"]
        self.trace += flight.trace
        flight.outbox, flight.trace = [], []

    def run(self, seconds):
        for _ in range(round(1e6 * seconds / self.autopilot.dt_us)):
            for raw in self.autopilot.step():
                self.take(raw)

    def until(self, state, seconds=60.0):
        for _ in range(round(seconds / 0.1)):
            if self.flight.life.state == state:
                return
            self.run(0.1)
        life = self.flight.life
        raise AssertionError(f"{state} was not reached in {seconds} s: {life.state} {life.phase} {self.texts}")

    def engage(self):
        self.until(lifecycle.OBSERVING)
        self.take(request(lifecycle.CMD_ENGAGE, self.plan, 0).raw)
        self.until(lifecycle.ENGAGED)


def test_a_whole_flight_from_the_ground_to_the_ground():
    loop = Loop()
    loop.engage()
    assert loop.autopilot.mode == OFFBOARD
    loop.until(lifecycle.RELEASED)
    loop.run(12.0)
    assert not loop.autopilot.armed
    assert "landing" in loop.flight.life.reason
    words = " ".join(loop.texts)
    for state in ("configuring", "observing", "streaming", "engaged", "released"):
        assert f"mavquad {state}" in words


def test_nothing_is_flown_before_it_is_asked_for():
    loop = Loop()
    loop.run(20.0)
    assert loop.flight.life.state == lifecycle.OBSERVING
    assert not loop.autopilot.setpoints
    assert not loop.autopilot.armed


def test_engaging_does_not_bump():
    loop = Loop()
    loop.engage()
    assert loop.autopilot.setpoints[0][1].thrust == pytest.approx(0.5735, abs=0.02)
    assert max(level(m.q) for _, m in loop.autopilot.setpoints) < math.radians(3.0)


def test_the_distance_from_the_path_is_published_while_it_is_flown():
    loop = Loop(Companion(path=Path(name="circle"), observers=()))
    loop.engage()
    loop.run(4.0)
    sent = [m for _, raw in loop.records for _, m in wire.parse(raw) if type(m).__name__ == "NAMED_VALUE_FLOAT"]
    errors = {m.time_boot_ms: m.value for m in sent if m.name == "path_err"}
    names, compared = loop.plan.trace_names, 0
    at, p, ref = (names.index(name) for name in ("t_us", "p_n", "ref_p_n"))
    for row in loop.trace:
        if round(row[at] / 1000) in errors and row[names.index("state")] == lifecycle.STATES.index(lifecycle.ENGAGED):
            expected = math.dist(row[p : p + 3], row[ref : ref + 3])
            assert errors[round(row[at] / 1000)] == pytest.approx(expected, abs=1e-6)
            compared += 1
    assert compared > 5
    assert 15 <= len(errors) <= 22  # five a second, none before it was engaged


def test_denied_rates_are_stepped_down():
    loop = Loop()
    loop.autopilot.denied_above_hz = 120.0
    loop.until(lifecycle.OBSERVING)
    assert loop.autopilot.rates[wire.ID["ATTITUDE_QUATERNION"]] == pytest.approx(100.0)
    granted = {r.name: r.granted_hz for r in loop.flight.life.rates}
    assert granted["HIGHRES_IMU"] == 100.0
    assert granted["LOCAL_POSITION_NED"] == 50.0


def test_replay_of_the_received_frames_gives_every_sent_frame_again():
    loop = Loop(Companion(path=Path(name="circle"), observers=("gsmo",)))
    loop.engage()
    loop.run(5.0)
    plan = pipeline.build(loop.plan.settings)
    flight = pipeline.start(plan)
    sent, trace = [], []

    def keep(state):
        sent.extend(state.outbox)
        trace.extend(state.trace)
        state.outbox, state.trace = [], []
        return state

    for stamp, raw in loop.records:
        frame = wire.split(raw)[0][0]
        if (frame.system, frame.component) == (1, 191):
            if not sent:
                flight = keep(pipeline.advance(plan, flight, stamp))
            assert sent.pop(0) == (stamp, raw)
        else:
            flight = keep(pipeline.advance(plan, flight, stamp))
            flight = keep(pipeline.feed(plan, flight, stamp, frame))
    assert np.array(trace).tobytes() == np.array(loop.trace).tobytes()
    assert len(trace) > 500


def test_stale_telemetry_is_held_then_levelled_then_released():
    loop = Loop()
    loop.engage()
    loop.run(1.0)
    loop.autopilot.muted = {"ATTITUDE_QUATERNION"}
    n = len(loop.autopilot.setpoints)
    loop.run(0.6)
    held = loop.autopilot.setpoints[n:]
    assert held
    assert held[-1][1].q == pytest.approx(loop.autopilot.setpoints[n - 1][1].q, abs=1e-6)
    loop.run(0.7)
    assert level(loop.autopilot.setpoints[-1][1].q) < 1e-3
    loop.run(0.5)
    assert loop.flight.life.state == lifecycle.RELEASED
    assert "no telemetry" in loop.flight.life.reason
    n = len(loop.autopilot.setpoints)
    loop.run(1.0)
    assert len(loop.autopilot.setpoints) == n


def test_a_mode_taken_away_releases_at_once_and_is_not_fought():
    loop = Loop()
    loop.engage()
    loop.autopilot.mode = 3 << 16
    loop.run(1.1)
    assert loop.flight.life.state == lifecycle.RELEASED
    n, commands = len(loop.autopilot.setpoints), loop.autopilot.heard.count("COMMAND_LONG")
    loop.run(3.0)
    assert (len(loop.autopilot.setpoints), loop.autopilot.heard.count("COMMAND_LONG")) == (n, commands)


def test_a_position_reset_moves_no_setpoint():
    loop = Loop(Companion(path=Path(name="hover", duration_s=10.0), observers=()))
    loop.engage()
    loop.run(2.0)
    before = loop.autopilot.setpoints[-1][1]
    loop.autopilot.jump = (3.0, 0.0, 0.0)
    loop.run(0.2)
    np.testing.assert_allclose(loop.autopilot.setpoints[-1][1].q, before.q, atol=0.005)
    assert loop.flight.offset_m[0] == pytest.approx(3.0, abs=0.05)
    assert any("position reset of 3.0" in t for t in loop.texts)


def test_an_autopilot_that_restarts_is_a_new_epoch_and_is_not_flown_unasked():
    loop = Loop()
    loop.engage()
    loop.run(0.5)
    fresh = Autopilot()
    fresh.t_us, fresh.boot_us = loop.autopilot.t_us, loop.autopilot.t_us
    loop.autopilot = fresh
    loop.run(8.0)
    assert loop.flight.epoch == 1
    assert not fresh.setpoints
    assert not fresh.armed
    assert loop.flight.life.state == lifecycle.OBSERVING


def test_a_state_handed_in_is_never_changed():
    loop = Loop(Companion(observers=("gsmo",)))
    loop.until(lifecycle.OBSERVING)
    before = loop.flight
    shown = {name: repr(value) for name, value in vars(before).items()}
    for raw in loop.autopilot.step():
        for frame in wire.split(raw)[0]:
            pipeline.feed(loop.plan, before, EPOCH_US + loop.autopilot.t_us, frame)
    assert {name: repr(value) for name, value in vars(before).items()} == shown


@pytest.mark.parametrize("name", ["ATTITUDE_QUATERNION", "LOCAL_POSITION_NED"])
def test_samples_that_are_nan_or_zero_are_refused_and_counted(name):
    loop = Loop()
    loop.until(lifecycle.OBSERVING)
    t = (loop.autopilot.t_us + 5000) // 1000
    zero = (t, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, (0.0,) * 4)
    bad = zero if name.startswith("ATT") else (t, math.nan, 0.0, 0.0, 0.0, 0.0, 0.0)
    loop.take(wire.encode(name, bad, seq=0, system=1, component=1))
    assert loop.flight.counts[f"{name} refused"] == 1


def test_another_vehicle_changes_nothing():
    loop = Loop()
    loop.engage()
    fields = (10**6, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, (0.0,) * 4)
    stranger = wire.encode("ATTITUDE_QUATERNION", fields, seq=0, system=2, component=1)
    (frame,) = wire.split(stranger)[0]
    assert pipeline.accepts(loop.plan, loop.flight, frame) == "not from our autopilot"


def _params(loop, *raw):
    seen = {}
    for r in raw:
        loop.take(r)
    for _, sent in loop.records:
        for frame, m in wire.parse(sent):
            if type(m).__name__ == "PARAM_VALUE" and frame.component == 191:
                seen[m.param_id] = m.param_value
    return seen


def test_gains_are_listed_read_and_changed_in_flight():
    loop = Loop(Companion(path=Path(name="hover", duration_s=20.0), observers=()))
    loop.engage()
    ask = wire.encode("PARAM_REQUEST_LIST", (1, 191), seq=0, system=255, component=190)
    assert {"PID_WC", "PID_DAMPING", "PID_INTEGRAL"} <= set(_params(loop, ask))
    change = wire.encode("PARAM_SET", (1, 191, "PID_DAMPING", 1.5, 9), seq=1, system=255, component=190)
    assert _params(loop, change)["PID_DAMPING"] == 1.5
    assert loop.flight.tuned.controller.gains.kd == pytest.approx(1.5 * loop.plan.controller.gains.kd)
    absurd = wire.encode("PARAM_SET", (1, 191, "PID_DAMPING", -4.0, 9), seq=2, system=255, component=190)
    assert _params(loop, absurd)["PID_DAMPING"] == 1.5
    assert any("PID_DAMPING = -4 refused" in t for t in loop.texts)


@pytest.mark.parametrize("name", ["COMMAND_LONG", "COMMAND_INT"])
def test_a_command_to_us_is_answered_known_or_not(name):
    loop = Loop()
    loop.until(lifecycle.OBSERVING)
    for number, result in ((31_000, 3), (lifecycle.CMD_ENGAGE, 0)):
        fields = (
            (1, 191, number, 0, *(0.0,) * 7) if name == "COMMAND_LONG" else (1, 191, 0, number, 0, 0, *(0.0,) * 4, 0, 0, 0.0)
        )
        loop.take(wire.encode(name, fields, seq=0, system=255, component=190))
        answers = [m for _, raw in loop.records[-3:] for _, m in wire.parse(raw) if type(m).__name__ == "COMMAND_ACK"]
        assert (answers[-1].command, answers[-1].result, answers[-1].target_system) == (number, result, 255)
    assert loop.flight.life.engage


def test_a_parameter_that_we_do_not_have_is_refused_by_name_and_not_to_everybody():
    loop = Loop()
    loop.until(lifecycle.OBSERVING)

    def errors(name, *fields):
        count = len(loop.records)
        loop.take(wire.encode(name, fields, seq=0, system=255, component=190))
        said = [m for _, raw in loop.records[count:] for _, m in wire.parse(raw) if type(m).__name__ == "PARAM_ERROR"]
        return [(m.target_system, m.param_id, m.param_index, m.error) for m in said]

    assert errors("PARAM_REQUEST_READ", 1, 191, "NO_SUCH", -1) == [(255, "NO_SUCH", -1, 1)]
    assert errors("PARAM_REQUEST_READ", 1, 191, "", 999) == [(255, "", 999, 1)]
    assert errors("PARAM_SET", 1, 191, "NO_SUCH", 1.0, 9) == [(255, "NO_SUCH", -1, 1)]
    assert errors("PARAM_REQUEST_READ", 1, 0, "NO_SUCH", -1) == []  # the autopilot may have it
    assert errors("PARAM_REQUEST_READ", 1, 191, "", 0) == []


def test_an_autopilot_that_answers_nothing_is_said():
    """Telemetry that comes and requests that get nowhere: a link of one direction, a wrong target, a key."""
    a = Autopilot()
    a.muted = {"COMMAND_ACK"}
    loop = Loop(autopilot=a)
    loop.run(6.0)
    assert loop.texts.count("mavquad: no answer to rate requests") == 1


def test_an_ardupilot_that_takes_thrust_for_a_climb_rate_is_refused_with_the_parameter_to_set():
    loop = Loop()
    loop.until(lifecycle.OBSERVING)
    life = loop.flight.life._replace(autopilot=lifecycle.ARDUPILOT, params=(("GUID_OPTIONS", 0.0),))
    loop.flight = loop.flight.clone()
    loop.flight.life = life
    loop.take(request(lifecycle.CMD_ENGAGE, loop.plan, 0).raw)
    loop.run(1.0)
    assert loop.flight.life.state == lifecycle.RELEASED
    assert loop.flight.life.reason == "set GUID_OPTIONS to 8"
    assert not loop.autopilot.armed
