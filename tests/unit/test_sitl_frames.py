"""Frames made by kernels: byte for byte what `wire.encode` makes of the same fields; the ring in which they wait; the truth."""

import io
import math

import numpy as np
import pytest

from mavquad import wire
from mavquad.link.tlog import read
from sitl import config, frames, links, telemetry
from sitl.ring import Ring
from tests.oracles.client import Client


def spoken(client):
    """The next loop period's frames of every message with a layout, and the same from their builders."""
    sim, link = client.sim, client.link
    builds = telemetry.builders(sim)
    sim.run_until(sim.t_us + sim.vehicle.dt_us)
    got = [frame for data in sim.collect(link) for frame in wire.split(data)[0]]
    names = [name for name in telemetry.ORDER if name in telemetry.LAYOUTS]
    seq, ids = got[0].seq, [wire.ID[name] for name in names]
    expected = [wire.encode(name, builds[name](), seq=seq + i, system=1, component=1) for i, name in enumerate(names)]
    return [frame for frame in got if frame.msgid in ids], expected


@pytest.mark.parametrize(
    ("personality", "rates"), [("px4", False), ("px4", True), ("ardupilot", False)], ids=["attitude", "rates", "ardupilot"]
)
def test_every_layout_is_what_its_builder_says(personality, rates):
    c = Client(f"personality={personality}", "link.delay_ms=0", "attitude_source=both", "noise.mocap_delay_ms=7")
    if personality == "px4":
        c.take_off(2.0)
        c.run(1.2, lambda: c.attitude(0.05, -0.03, 0.4, rates=(0.1, 0.0, -0.2), mask=128 if rates else 7))
        assert c.command(176, 1, 6, 0) == 0
        c.run(0.3, lambda: c.attitude(0.05, -0.03, 0.4, rates=(0.1, 0.0, -0.2), mask=128 if rates else 7))
    else:
        c.take_off_guided(3.0)
    for name in c.link.streams:
        c.sim.set_interval(c.link, name, c.sim.vehicle.dt_us if name in telemetry.LAYOUTS else -1)
    c.sim.collect(c.link)
    for _ in range(60):
        got, expected = spoken(c)
        assert [frame.raw for frame in got] == expected
    assert len(expected) == len(telemetry.LAYOUTS)


def test_the_servos_stamp_wraps_in_32_bits_by_kernel_and_by_builder():
    """After 71.6 minutes; a wire with faults has its frames made in Python."""
    c = Client("link.delay_ms=0")
    for name in c.link.streams:
        c.sim.set_interval(c.link, name, c.sim.vehicle.dt_us if name in telemetry.LAYOUTS else -1)
    c.sim.collect(c.link)
    c.sim.autopilot.boot_us = c.sim.t_us - (1 << 32) + 3 * c.sim.vehicle.dt_us
    c.sim._voice.booted(c.sim.autopilot)
    stamps = []
    for _ in range(6):
        got, expected = spoken(c)
        assert [frame.raw for frame in got] == expected
        stamps += [wire.decode(frame).time_usec for frame in got if frame.msgid == wire.ID["SERVO_OUTPUT_RAW"]]
    assert stamps[0] > stamps[-1] > 0
    noisy = Client("link.loss=0.1", "link.jitter_ms=1")
    noisy.sim.autopilot.boot_us = noisy.sim.t_us - (1 << 32) + 100_000
    noisy.sim._voice.booted(noisy.sim.autopilot)
    noisy.run(0.5)
    assert noisy.last["SERVO_OUTPUT_RAW"].time_usec < 1_000_000


def ring(**link):
    sitl = config.load(None, [f"link.{name}={value}" for name, value in link.items()])
    return Ring(sitl, frames.tables({"HEARTBEAT": None}, {}))


def test_what_waits_grows_and_leaves_in_order_packed_as_the_queue_packs_it():
    r = ring(delay_ms=2)
    stranger = wire.encode("SYSTEM_TIME", (5, 6), seq=77, system=9, component=1)
    sent = []
    for k in range(1000):
        item = (
            stranger
            if k % 7 == 3
            else ("ATTITUDE", (k, 0.1, -0.2, math.nan, 0.0, 0.0, 0.0))
            if k % 2
            else ("PING", (k, 0, 0, 0))
        )
        r.put(1000 * k, item)
        sent.append(item)
    left, own = [], 0
    for t_us, barrier_ns in ((10_000, -1), (500_000, 500_000_000), (2_000_000, -1)):
        ours, datagrams, log = r.leave(t_us, 10**15 + t_us, barrier_ns)
        split = [frame for data in datagrams for frame in wire.split(data)[0]]
        assert links.datagrams([frame.raw for frame in split]) == datagrams
        assert list(read(io.BytesIO(log))) == [(10**15 + t_us, frame) for frame in split]
        assert ours == sum(frame.system == 1 for frame in split)
        assert (split[-1].msgid == wire.ID["TIMESYNC"]) == (barrier_ns >= 0)
        assert len(left) + len(split) - (barrier_ns >= 0) == min(1000, t_us // 1000 - 1)
        left += split[:-1] if barrier_ns >= 0 else split
        own += ours
    seq = 0
    for k, (frame, item) in enumerate(zip(left, sent, strict=True)):
        if k == 499:
            seq += 1  # the barrier's
        if isinstance(item, bytes):
            assert frame.raw == item
        else:
            assert frame.raw == wire.encode(*item, seq=seq, system=1, component=1)
            seq += 1
    assert own == seq
    assert r.leave(10**9, 0, -1) == (0, [], b"")


def test_the_truth_in_the_log_is_the_state_of_the_vehicle():
    log = []
    c = Client("wind.mean_m_s=4", "wind.w20_m_s=8", record=lambda t_us, data: log.append(data))
    c.take_off(2.0)
    log.clear()
    c.period()
    s, said = (
        c.sim.vehicle.state,
        {type(m).__name__: m for m in (wire.decode(frame) for _, frame in read(io.BytesIO(b"".join(log))))},
    )
    odometry, extra = said["ODOMETRY"], said["DEBUG_FLOAT_ARRAY"]
    assert odometry.time_usec == extra.time_usec == c.sim.t_us
    assert (odometry.x, odometry.y, odometry.z) == pytest.approx(s["p_ned_m"])
    R = s["R"].reshape(3, 3)
    assert (odometry.vx, odometry.vy, odometry.vz) == pytest.approx(R.T @ s["v_ned_m_s"], rel=1e-6, abs=1e-6)
    assert odometry.q == pytest.approx(c.sim.vehicle.quaternion(), rel=1e-6, abs=1e-7)
    assert extra.name == "truth"
    assert extra.data[6:9] == pytest.approx(s["wind_ned_m_s"], rel=1e-6)
    assert extra.data[9] == pytest.approx(sum(s["thrust_n"]) / c.sim.vehicle.constants["mass_kg"], rel=1e-6)
    assert np.linalg.norm(extra.data[:3]) > 0.1  # the wind
    assert s["summed"] == 0
    assert extra.data[10:] == (0.0, 0.0) + (0.0,) * 46


@pytest.mark.parametrize("loss", [0.0, 0.01])  # made by a kernel, made by Python
def test_motion_capture_that_is_late_from_the_start_has_no_time_before_it(loss):
    c = Client("attitude_source=mocap", "noise.mocap_delay_ms=25", "link.delay_ms=0", f"link.loss={loss}")
    stamps = []
    c.on = lambda m: stamps.append(m.time_usec) if type(m).__name__ == "ATT_POS_MOCAP" else None
    c.run(0.1)
    assert stamps[:4] == [0, 0, 5_000, 15_000]
