"""The fast lane against the pipeline: the same log, setpoints, trace and flight, to the last bit, or untouched."""

import io
import math
import random
import struct
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavquad import config, control_step, lane, lane_record, lane_wire, lifecycle, pipeline, wire
from mavquad import flight as flights
from mavquad import plan as plans
from mavquad.jit import COMPILED
from mavquad.link import clock, health, tlog
from mavquad.settings import Companion

DT_US = 8000


def plan_of(**chosen):
    return plans.build(config.convert({"observers": [], "controller": "pid", **chosen}, Companion, "test"))


def encode(name, fields, seq):
    return wire.encode(name, fields, seq=seq & 0xFF, system=1, component=1)


def telemetry(k, rng, seq):
    """The frames of period k of a vehicle on its way, as an autopilot would send them, in its sequence."""
    t_us = 1_000_000 + k * DT_US
    ms, phase = t_us // 1000, 0.01 * k
    roll, pitch = 0.05 * math.sin(phase) + rng.gauss(0, 0.002), 0.04 * math.cos(phase)
    q = (math.sqrt(1.0 - 0.25 * (roll**2 + pitch**2)), 0.5 * roll, 0.5 * pitch, 0.0)
    v = (0.3 * math.sin(phase), 0.2 * math.cos(phase), 0.01)
    p = (-0.24 * math.cos(phase), 0.16 * math.sin(phase), -5.0 + 0.01 * phase)
    found = []
    if k % 3 == 0:
        found.append(("LOCAL_POSITION_NED", (ms, *p, *v)))
    found.append(("HIGHRES_IMU", (t_us, *(rng.gauss(0, 0.1) for _ in range(2)), -9.8, 0.01, 0.02, 0.0, *(0.0,) * 7, 0, 0)))
    if k % 4 == 0:
        found.append(("SERVO_OUTPUT_RAW", (t_us & 0xFFFFFFFF, 0, *(1500,) * 16)))
    if k % 5 == 0:
        found.append(("ATTITUDE_TARGET", (ms, 0, q, 0.0, math.nan, 0.0, 0.55)))
    if k % 11 == 0:
        found.append(("TIMESYNC", (0, 1000 * t_us, 0, 0)))
    if k % 13 == 0:
        found.append(("TIMESYNC", ((t_us - 9000) * 1000, (1000 * (t_us - 20_000)), 1, 191)))
    if k % 25 == 0:
        found.append(("EXTENDED_SYS_STATE", (0, 2)))
    if k % 60 == 0:
        found.append(("SYS_STATUS", (0, 0, 0, 250, 16000, 100, 80, 0, 0, 0, 0, 0, 0, 0, 0, 0)))
    found.append(("ATTITUDE", (ms, roll, pitch, 0.0, 0.1, 0.2, 0.0)))
    found.append(("ATTITUDE_QUATERNION", (ms, *q, 0.1, rng.gauss(0, 0.1), 0.0, (0.0,) * 4)))
    return [encode(name, fields, seq + i) for i, (name, fields) in enumerate(found)]


def engaged(plan, autopilot=lifecycle.PX4, state=lifecycle.ENGAGED):
    """A flight that has been heard for a third of a second and is led."""
    rng, f, seq = random.Random(1), flights.start(plan), 0
    f = pipeline.feed(plan, f, arrival(-45), wire.split(encode("HEARTBEAT", (2, autopilot, 0, 0, 4, 3), 250))[0][0])
    for k in range(-44, 0):
        frames = telemetry(k, rng, seq)
        seq += len(frames)
        f = pipeline.feed_all(plan, f, arrival(k), wire.split(b"".join(frames))[0])
    f = f.clone()
    f.life = f.life._replace(state=state, phase="path", armed=True, mode=6 << 16, landed=2, pending=None)
    f.life = f.life._replace(pending=None, wants=(), phase="path")
    if state in (lifecycle.STREAMING, lifecycle.ENGAGED):
        control_step.anchor(plan, f)
    if state == lifecycle.ENGAGED:
        f.path_t0_us = f.now_us + 100_000
    f.due_us = f.heartbeat_us = f.tick_us = f.timesync_us = f.publish_us = 1 << 62  # timers are the shell's
    return f, rng, seq


def arrival(k):
    return clock.EPOCH_US + 1_004_000 + k * DT_US


def same(a, b, name=""):
    """Equal to the last bit, NaN like NaN."""
    if isinstance(a, float):
        assert struct.pack("d", a) == struct.pack("d", b), (name, a, b)
    elif isinstance(a, tuple) and type(a) is type(b):
        assert len(a) == len(b), name
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            same(x, y, f"{name}[{i}]")
    elif isinstance(a, np.ndarray):
        assert a.tobytes() == b.tobytes(), name
    else:
        assert a == b, (name, a, b)


def same_flight(a, b):
    for name in flights.Flight.__annotations__:
        if name not in ("outbox", "trace", "life", "following"):
            same(getattr(a, name), getattr(b, name), name)
    assert a.life == b.life
    assert type(a.observers) is type(b.observers)
    assert a.following.follows == b.following.follows
    for name in ("axis", "rate", "t_us", "rule_rad", "apart_s", "together_s", "sent_count"):
        same(*(np.asarray(f.following.record.view(flights.following.RECORD)[name]) for f in (a, b)), name)


def records(entries):
    return b"".join(t.to_bytes(8, "big") + raw for t, raw in entries)


def shown(log):
    """A log as stamps and messages: what differs is seen."""
    return [(t_us, frame.seq, repr(wire.decode(frame))) for t_us, frame in tlog.read(io.BytesIO(log))]


def both(plan, fast, f, source, data, arrival_us):
    """The datagram through the lane and through the pipeline; (verdict, the pipeline's flight, its counter of frames)."""
    frames, junk = wire.datagram(data)
    assert not junk
    verdict = fast.feed(data, arrival_us, f.due_us)
    after = pipeline.feed_all(plan, f, arrival_us, frames)
    for frame in frames:
        source = health.on_frame(source, frame.seq)
    if verdict == lane.DONE:
        heard = records([(arrival_us, frame.raw) for frame in frames])
        assert shown(fast.log) == shown(heard + records(after.outbox))
        assert fast.log == heard + records(after.outbox)
        assert fast.sent == b"".join(raw for _, raw in after.outbox)
        assert fast.trace == b"".join(struct.pack(f"<{len(row)}d", *row) for row in after.trace)
        assert fast.setpoints == sum(raw[7] == 82 for _, raw in after.outbox)
        assert (fast.frames, fast.stamp_us) == (len(frames), arrival_us)
    return verdict, after, source


@pytest.mark.parametrize("autopilot", [lifecycle.PX4, lifecycle.ARDUPILOT])
@pytest.mark.parametrize("state", [lifecycle.ENGAGED, lifecycle.STREAMING, lifecycle.OBSERVING, lifecycle.RELEASED])
@pytest.mark.parametrize(
    ("controller", "observers"), [("pid", []), ("pd", []), ("pid", ["gsmo"]), ("pid", ["gsmo", "gsmo:variant=relay"])]
)
def test_a_flight_is_the_same_to_the_last_bit(controller, observers, state, autopilot):
    plan = plan_of(controller=controller, observers=observers, path={"name": "circle"})
    f, rng, seq = engaged(plan, autopilot, state)
    source, fast, plain = health.Source((seq - 1) & 0xFF, 5, 1), lane.Lane(plan, False), 0
    taken = f
    assert fast.enter(taken, source)
    for k in range(300):
        lost = k == 200
        frames = telemetry(k, rng, seq + lost)
        seq += len(frames) + lost
        verdict, after, counted = both(plan, fast, f, source, b"".join(frames), arrival(k) + rng.randrange(4000))
        if verdict == lane.OTHER or k % 50 == 49:  # out and in again
            left, source_left = fast.leave(taken)
            same_flight(left, after if verdict == lane.DONE else f)
            assert source_left == (counted if verdict == lane.DONE else source)
            taken = left if verdict == lane.DONE else after
            assert fast.enter(taken, counted)
        f, source = after, counted
        plain += verdict == lane.DONE
    assert plain > 290


@given(st.binary(max_size=80), st.integers(0, 0xFFFFFFFF), st.integers(0, 20))
def test_its_crc_is_zlibs(data, crc, start):
    array = np.frombuffer(data + b"\0", np.uint8)
    start = min(start, len(data))
    assert lane_wire.crc32(array, start, len(data), crc) == zlib.crc32(data[start:], crc)


def state_of(fast):
    """The record's bytes but for the ring, of which only the slots in use count."""
    words = fast._memory[lane_record.STATE_AT : lane_record.STATE_AT + lane_record.STATE_BYTES].view(np.int64)
    return words[: lane_record.RING_AT].tobytes() + words[lane_record.RING_END :].tobytes()


def ready(**chosen):
    plan = plan_of(path={"name": "circle"}, **chosen)
    f, rng, seq = engaged(plan)
    source = health.Source((seq - 1) & 0xFF, 5, 1)
    fast = lane.Lane(plan, False)
    for k in range(2):
        frames = telemetry(k, rng, seq)
        seq += len(frames)
        heard = wire.split(b"".join(frames))[0]
        f = pipeline.feed_all(plan, f, arrival(k), heard)
        for frame in heard:
            source = health.on_frame(source, frame.seq)
    assert fast.enter(f, source)
    return plan, fast, f, source, rng, seq


MS, Q = 1_000_000 // 1000 + 2 * DT_US // 1000, (1.0, 0.0, 0.0, 0.0)
AT = (*Q, 0.0, 0.0, 0.0, (0.0,) * 4)


@pytest.mark.parametrize(
    ("what", "name", "fields"),
    [
        ("a text", "STATUSTEXT", (4, "hello", 0, 0)),
        ("a heartbeat", "HEARTBEAT", (2, 12, 0, 0, 4, 3)),
        ("an answer", "COMMAND_ACK", (400, 0, 0, 0, 1, 191)),
        ("a parameter", "PARAM_VALUE", ("MPC_THR_HOVER", 0.5, 9, 1, 0)),
        ("a key", "SETUP_SIGNING", (1, 191, (0,) * 32, 0)),
        ("on the ground", "EXTENDED_SYS_STATE", (0, 1)),
        ("an emptier battery", "SYS_STATUS", (0, 0, 0, 250, 16000, 100, 79, 0, 0, 0, 0, 0, 0, 0, 0, 0)),
        ("twice", "ATTITUDE_QUATERNION", (MS - 8, *AT)),
        ("late", "ATTITUDE_QUATERNION", (MS - 700, *AT)),
        ("a restart", "ATTITUDE_QUATERNION", (1, *AT)),
        ("no unit quaternion", "ATTITUDE_QUATERNION", (MS, 0.5, *AT[1:])),
        ("not a number", "ATTITUDE_QUATERNION", (MS, math.nan, *AT[1:])),
        ("no rates", "ATTITUDE_QUATERNION", (MS, *Q, math.nan, math.nan, math.nan, (0.0,) * 4)),
        ("a jump", "LOCAL_POSITION_NED", (MS, 2.0, 1.0, -5.0, 0.1, 0.1, 0.0)),
        ("not a position", "LOCAL_POSITION_NED", (MS, math.inf, 1.0, -5.0, 0.1, 0.1, 0.0)),
        ("no thrust", "ATTITUDE_TARGET", (MS, 0, Q, 0.0, 0.0, 0.0, math.nan)),
        ("no accelerometer", "HIGHRES_IMU", (1000 * MS, math.nan, *(0.0,) * 12, 0, 0)),
        ("a stamp that no clock shows", "HIGHRES_IMU", (1 << 63, *(0.0,) * 13, 0, 0)),
    ],
)
def test_what_is_out_of_the_ordinary_is_given_back_untouched(what, name, fields):
    _, fast, f, source, _, seq = ready()
    before, plain = state_of(fast), encode("SERVO_OUTPUT_RAW", (1, 0, *(1500,) * 16), seq)
    at_us = arrival(2) + (20_000 if name == "HIGHRES_IMU" else 0)
    assert fast.feed(plain + encode(name, fields, seq + 1), at_us, f.due_us) == lane.OTHER, what
    assert state_of(fast) == before, what
    left, counted = fast.leave(f)
    same_flight(left, f)
    assert counted == source


@pytest.mark.parametrize("spoil", ["junk", "cut", "crc", "other vehicle", "v1", "signed", "unknown", "empty"])
def test_a_datagram_that_is_not_all_plain_frames_of_our_autopilot_is_the_pipelines(spoil):
    _, fast, f, _, rng, seq = ready()
    data, raw = b"".join(telemetry(2, rng, seq)), encode("SERVO_OUTPUT_RAW", (1, 0, *(1500,) * 16), seq)
    data = {
        "junk": data + b"\0",
        "cut": data[:-1],
        "crc": data[:-1] + bytes([data[-1] ^ 1]),
        "other vehicle": data + wire.encode("SERVO_OUTPUT_RAW", (1, 0, *(1500,) * 16), seq=1, system=2, component=1),
        "v1": data + b"\xfe" + raw[1:],
        "signed": data + wire.sign(raw, bytes(32), 0, 1),
        "unknown": data + raw[:7] + b"\xff\xff\x7f" + raw[10:],
        "empty": b"",
    }[spoil]
    before = state_of(fast)
    assert fast.feed(data, arrival(2), f.due_us) == lane.OTHER
    assert state_of(fast) == before


def test_timers_come_first():
    _, fast, _, _, rng, seq = ready()
    before, data = state_of(fast), b"".join(telemetry(2, rng, seq))
    assert fast.feed(data, arrival(2), arrival(2)) == lane.TIMERS
    assert fast.stamp_us == arrival(2)
    assert state_of(fast) == before
    assert fast.feed(data, arrival(2), arrival(2) + 1) == lane.DONE


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_spoiled_datagrams_are_as_the_pipeline_takes_them_or_not_taken(data):
    plan, fast, f, source, rng, seq = ready()
    for k in range(2, 5):
        frames = telemetry(k, rng, seq)
        seq += len(frames)
        kept = [raw for raw in frames if data.draw(st.integers(0, 5))]
        kept = kept + kept[:1] * (data.draw(st.integers(0, 5)) == 0)
        raw = bytearray(b"".join(kept))
        if raw and data.draw(st.integers(0, 3)) == 0:
            raw[data.draw(st.integers(0, len(raw) - 1))] ^= data.draw(st.integers(0, 255))
        if wire.datagram(bytes(raw))[1]:
            assert fast.feed(bytes(raw), arrival(k), f.due_us) == lane.OTHER
            continue
        before = state_of(fast)
        verdict, after, counted = both(plan, fast, f, source, bytes(raw), arrival(k))
        if verdict == lane.DONE:
            f, source = after, counted
        else:
            assert state_of(fast) == before
    taken = ready()[2]
    same_flight(fast.leave(taken)[0], f)


def test_a_lockstep_period_is_logged_with_its_barrier_before_the_answer():
    plan, _, f, source, rng, seq = ready()
    fast = lane.Lane(plan, True)
    assert fast.enter(f, source)
    frames = telemetry(2, rng, seq)
    sent_ns = 1000 * (arrival(2) - clock.EPOCH_US)
    barrier = encode("TIMESYNC", (0, sent_ns, 0, 0), seq + len(frames))
    assert fast.feed(b"".join(frames), arrival(1), f.due_us) == lane.OTHER  # a period without its end
    assert fast.feed(b"".join([*frames, barrier]), arrival(3), f.due_us) == lane.OTHER  # time does not go back
    assert fast.feed(b"".join([*frames, barrier]), arrival(1), f.due_us) == lane.DONE
    f = pipeline.feed_all(plan, f, arrival(2), wire.split(b"".join(frames))[0])
    first = records([(arrival(2), raw) for raw in frames]) + records(f.outbox)
    g = pipeline.feed_all(plan, f, arrival(2), wire.split(barrier)[0])
    assert fast.log == first + records([(arrival(2), barrier)]) + records(g.outbox)
    assert fast.sent == b"".join(raw for _, raw in [*f.outbox, *g.outbox])
    assert fast.stamp_us == arrival(2)


def test_the_end_of_a_path_and_of_following_are_said_by_the_pipeline():
    plan, fast, f, source, rng, seq = ready()
    late = f.clone()
    late.path_t0_us = f.now_us - round(1e6 * plan.path.duration_s) - 2_000_000
    fast.leave(f)
    assert fast.enter(late, source)
    assert fast.feed(b"".join(telemetry(2, rng, seq)), arrival(2), f.due_us) == lane.OTHER
    over = late.clone()
    over.life = over.life._replace(ended=True)  # said already
    fast.leave(late)
    assert fast.enter(over, source)
    verdict, after, _ = both(plan, fast, over, source, b"".join(telemetry(2, rng, seq)), arrival(2))
    assert verdict == lane.DONE
    assert after.life.ended


def test_gains_changed_in_flight_are_flown():
    from mavquad import tunables

    plan, fast, f, source, rng, seq = ready()
    names = [t.name for t in tunables.tunables(plan)]
    fast.leave(f)
    f = f.clone()
    f.tuned = tunables.change(plan, names[0], 1.5 * tunables.tunables(plan)[0].value + 0.1)
    assert fast.enter(f, source)
    assert both(plan, fast, f, source, b"".join(telemetry(2, rng, seq)), arrival(2))[0] == lane.DONE


@pytest.mark.parametrize(
    "chosen",
    [
        {"controller": "iadrc"},
        {"controller": "eskf-mpc"},
        {"controller": "autopilot"},
        {"compensator": "asmf"},
        {"observers": ["gsmo", "gsmo:source=mocap"]},
        {"observers": ["gsmo"], "body_rates": "observer"},
        {"estimator": "joint"},
    ],
)
def test_other_stages_are_the_pipelines(chosen):
    assert not lane.serves(plan_of(**chosen))
    assert lane.serves(plan_of()) == COMPILED
    assert len(plan_of().trace_names) == lane_record.COLUMNS


@pytest.mark.parametrize(
    "changed",
    [
        {"position": None},
        {"slow": 1},
        {"catching_up": True},
        {"sticks": (0.0, 0.0, 0.0, 0.5)},
        {"heartbeat_us": 0},
        {"sent": None},
        {"anchor": 0},
    ],
)
def test_a_flight_that_is_out_of_the_ordinary_is_not_taken(changed):
    _, fast, f, source, *_ = ready()
    fast.leave(f)
    f = f.clone()
    for name, value in changed.items():
        setattr(f, name, value)
    assert not fast.enter(f, source)
    assert not fast.inside
