"""The fast lane against the pipeline: the same log, setpoints, trace and flight, to the last bit, or untouched."""

import io
import math
import random
import struct

import numpy as np
import pytest

from mavquad import config, control_step, lane, lifecycle, pipeline, wire
from mavquad import flight as flights
from mavquad import plan as plans
from mavquad.jit import COMPILED
from mavquad.link import clock, health, tlog
from mavquad.settings import Companion

pytestmark = pytest.mark.skipif(not COMPILED, reason="the lane is there for speed: without the compiler nobody takes it")
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
@pytest.mark.parametrize("controller", ["pid", "pd"])
def test_a_flight_is_the_same_to_the_last_bit(controller, state, autopilot):
    plan = plan_of(controller=controller, path={"name": "circle"})
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
