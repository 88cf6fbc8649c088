"""Replay equals live: on flights of the pipeline with a scripted autopilot, and only as long as nothing was changed."""

import json
import math

import numpy as np
import pytest

from mavquad import plan as plans
from mavquad import plan_file, wire
from mavquad.errors import ConfigError, LogError
from mavquad.paths import Path
from mavquad.settings import Companion
from tests.loop.test_companion_loop import Loop
from tools import playback
from tools.trace import Trace, read_trace

OWN = (1, 191)
SETTINGS = Companion(path=Path(name="circle", radius_m=1.0, turns=1.0))


@pytest.fixture(scope="module")
def flight():
    """A flight: its records as (t_us, frame), and the trace as it was written in flight."""
    loop = Loop(SETTINGS)
    loop.engage()
    loop.run(5.0)
    records = [(t, frame) for t, raw in loop.records for frame in wire.split(raw)[0]]
    assert sum((f.system, f.component) == OWN for _, f in records) > 500
    return loop.plan, records, Trace(tuple(loop.plan.trace_names), np.array(loop.trace))


def test_every_sent_frame_and_trace_value_comes_again_bit_for_bit(flight):
    plan, records, then = flight
    verdict = playback.verify(plan, records, own=OWN, then=then)
    assert verdict.parting is None
    assert (verdict.received + verdict.sent, verdict.unsent, verdict.largest) == (len(records), 0, 0.0)
    assert verdict.rows == len(then.rows) > 500


@pytest.mark.parametrize("cut", [1, 2, 3, 500, 1777])
def test_a_log_cut_at_any_frame_verifies(flight, cut):
    plan, records, then = flight
    short = Trace(then.names, then.rows[: cut // 20])  # behind its log, as a killed companion leaves it
    assert playback.verify(plan, records[:cut], own=OWN, then=short).parting is None


def _changed(records, name, component, number, field, change):
    """The records with one field of one frame changed, CRC mended; and when that was."""
    numbers = [i for i, (_, f) in enumerate(records) if f.msgid == wire.ID[name] and f.component == component]
    t_us, frame = records[numbers[number]]
    message = wire.decode(frame)
    fields = list(message)
    spot = message._fields.index(field)
    fields[spot] = change(fields[spot])
    raw = wire.encode(name, tuple(fields), seq=frame.seq, system=frame.system, component=frame.component)
    return [*records[: numbers[number]], (t_us, frame._replace(raw=raw)), *records[numbers[number] + 1 :]], t_us


def _next(x):
    return float(np.nextafter(np.float32(x), np.float32(2.0)))


@pytest.mark.parametrize(
    ("name", "field", "change"),
    [
        ("ATTITUDE_QUATERNION", "q2", _next),
        ("LOCAL_POSITION_NED", "vx", _next),
        ("EXTENDED_SYS_STATE", "vtol_state", lambda x: x ^ 1),  # a field that nothing uses
    ],
)
def test_one_changed_bit_received_is_found_with_time_and_message(flight, name, field, change):
    plan, records, then = flight
    changed, t_us = _changed(records, name, 1, -20, field, change)
    parting = playback.verify(plan, changed, own=OWN, then=then).parting
    assert parting is not None
    assert 0 <= parting.t_us - t_us < 50_000
    assert parting.message in ("SET_ATTITUDE_TARGET", "trace, at ATTITUDE_QUATERNION")
    assert " in the replay" in parting.why


def test_on_another_machine_the_last_bit_may_differ_and_nothing_more(flight):
    plan, records, _ = flight
    changed, t_us = _changed(records, "SET_ATTITUDE_TARGET", 191, 200, "thrust", _next)
    parting = playback.verify(plan, changed, own=OWN).parting
    assert parting is not None
    assert (parting.t_us, parting.message) == (t_us, "SET_ATTITUDE_TARGET")
    assert parting.why.startswith("thrust is ")
    verdict = playback.verify(plan, changed, own=OWN, exact=False)
    assert verdict.parting is None
    assert 0.0 < verdict.largest <= playback.WIRE_CLOSE
    changed, _ = _changed(records, "SET_ATTITUDE_TARGET", 191, 200, "thrust", lambda x: x + 1e-6)
    assert playback.verify(plan, changed, own=OWN, exact=False).parting is not None


def test_a_frame_too_many_or_too_few_is_found(flight):
    plan, records, _ = flight
    sent = [i for i, (_, f) in enumerate(records) if f.component == OWN[1]]
    at = sent[400]
    missing = playback.verify(plan, records[:at] + records[at + 1 :], own=OWN).parting
    assert missing is not None
    assert missing.t_us <= records[at + 60][0]
    t_us, frame = records[at]
    extra = playback.verify(plan, [*records[: at + 1], (t_us, frame), *records[at + 1 :]], own=OWN).parting
    assert extra is not None
    dropped = [i for i, (_, f) in enumerate(records) if f.msgid == wire.ID["ATTITUDE_QUATERNION"]][700]
    assert playback.verify(plan, records[:dropped] + records[dropped + 1 :], own=OWN).parting is not None


def test_playing_a_log_with_or_without_its_sent_frames_gives_the_trace_of_the_flight(flight):
    plan, records, then = flight
    received = [(t, f) for t, f in records if (f.system, f.component) != OWN]
    for given in (records, received):
        played = playback.play(plan, given, own=OWN)
        np.testing.assert_array_equal(played.trace.rows.view(np.int64), then.rows.view(np.int64))
        assert played.received == len(received)


def test_a_trace_of_another_value_length_or_version_is_found(flight):
    plan, records, then = flight
    rows = then.rows.copy()
    rows[300, 5] = np.nextafter(rows[300, 5], 99.0)
    parting = playback.verify(plan, records, own=OWN, then=Trace(then.names, rows)).parting
    assert parting is not None
    assert f"{then.names[5]} is " in parting.why
    assert "(row 300, vehicle time" in parting.why
    assert playback.verify(plan, records, own=OWN, then=Trace(then.names, rows), exact=False).parting is None
    longer = Trace(then.names, np.vstack([then.rows, then.rows[-1:]]))
    assert "rows in flight" in playback.verify(plan, records, own=OWN, then=longer).parting.why
    older = Trace((*then.names[:-1], "z"), then.rows)
    assert "other columns" in playback.verify(plan, records, own=OWN, then=older).parting.why


def test_a_trace_file_cut_in_a_row_gives_its_whole_rows(tmp_path):
    path = tmp_path / "flight.trace"
    rows = np.array([[1.0, math.nan], [2.0, -0.0]])
    path.write_bytes(json.dumps(["t_us", "x"]).encode() + b"\n" + rows.tobytes() + b"\x01\x02")
    trace = read_trace(path)
    assert trace.names == ("t_us", "x")
    np.testing.assert_array_equal(trace.rows.view(np.int64), rows.view(np.int64))
    for bad in (b"", b"no json\n", b"[]\n"):
        path.write_bytes(bad)
        with pytest.raises(LogError, match="not a trace"):
            read_trace(path)
    with pytest.raises(LogError, match="cannot be read"):
        read_trace(tmp_path / "none")


def test_a_plan_file_gives_the_plan_again_and_tells_another_machine(tmp_path, monkeypatch):
    plan = plans.build(SETTINGS)
    path = plan_file.beside(tmp_path / "flight-2.tlog")
    assert path.name == "plan-2.toml"
    plan_file.write(path, plan.settings, plan.airframe)
    again = plan_file.read(path)
    assert again.here == ()
    assert plans.build(again.companion, again.airframe) == plan
    path.write_text(path.read_text().replace('numpy = "', 'numpy = "0.'))
    assert len(plan_file.read(path).here) == 1
    assert plan_file.read(path).here[0].startswith("numpy: 0.")
    path.write_text("[companion]\n")
    with pytest.raises(ConfigError, match=r"there is no \[made_by\]"):
        plan_file.read(path)
    with pytest.raises(ConfigError, match="no such file"):
        plan_file.read(tmp_path / "none.toml")
