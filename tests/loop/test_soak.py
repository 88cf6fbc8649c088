"""`make soak`: eighty minutes of vehicle time at ten times real time with faults, an independent listener between the programs.

Memory stays flat, clocks do not drift, nothing unflyable is sent, and every frame the listener passed on is in one of the two logs.

A tenth of a second is a second of this vehicle's time. Where the machine stands still for so long, companion and autopilot let go, as they
should; a person would engage again, and so does the listener. A watch on every core says when the machine stood still, and
the scheduler for how long the programs waited for a core: to let go without either is an error.
"""

import argparse
import contextlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
import zlib
from pathlib import Path

import pytest

from mavquad import lifecycle, wire
from mavquad.link import tlog
from mavquad.settings import Companion
from tests.fuzz.targets import judge_outbox
from tools import flight, fly

MINUTES = float(os.environ.get("MAVQUAD_SOAK_MINUTES", "80"))
SPEED = 10.0
HEARTBEAT = wire.ID["HEARTBEAT"]
SETPOINT = wire.ID["SET_ATTITUDE_TARGET"]
STALL_S = 0.015  # what the watches tell
HELD_UP_S, RECENT_S = (
    0.03,
    1.5,
)  # for so long the programs were kept from running, so shortly before they let go: it is the reason
ENGAGE, LAND = lifecycle.CMD_ENGAGE, lifecycle.CMD_LAND
WATCH = f"""
import os, sys, time
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {{int(sys.argv[1])}})
before = time.monotonic()
while True:
    time.sleep(0.001)
    now = time.monotonic()
    if now - before > {STALL_S}:
        os.write(1, b"%.6f %.6f\\n" % (now, now - before))
    before = now
"""
LINK = {"loss": 0.01, "duplicate": 0.005, "reorder": 0.005, "corrupt": 0.002, "jitter_ms": 5.0}


class Tally:
    """Frames of one direction, by number and by a sum that does not depend on their order."""

    def __init__(self):
        self.frames = self.sum = 0

    def add(self, raw):
        self.frames += 1
        self.sum = (self.sum + zlib.crc32(raw)) & (1 << 64) - 1

    def __eq__(self, other):
        return (self.frames, self.sum) == (other.frames, other.sum)

    def __repr__(self):
        return f"{self.frames} frames, sum {self.sum:x}"


class Listener:
    """Stands between the two programs: passes each datagram on, tallies what it passed, judges every setpoint."""

    def __init__(self, port):
        self.front = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)  # the companion's side
        self.front.bind(("127.0.0.1", 0))
        self.back = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.back.connect(("127.0.0.1", port))
        for sock in (self.front, self.back):
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 23)
        self.companion = None
        self.down, self.up, self.setpoints, self.greetings = Tally(), Tally(), 0, 0

    def serve(self, seconds):
        """What comes within a while."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            for sock in select.select([self.front, self.back], [], [], left)[0]:
                with contextlib.suppress(ConnectionError):
                    if sock is self.front:
                        data, self.companion = sock.recvfrom(65536)
                        self._up(data)
                        self.back.send(data)
                    elif self.companion:
                        data = sock.recv(65536)
                        self.front.sendto(data, self.companion)
                        for frame in wire.datagram(data)[0]:
                            self.down.add(frame.raw)

    def _up(self, data):
        for frame in wire.datagram(data)[0]:
            if not self.down.frames and frame.msgid == HEARTBEAT:
                self.greetings += 1  # into the dark, before anybody was heard: no part of what a log replays
                continue
            self.up.add(frame.raw)
            if frame.msgid == SETPOINT:
                self.setpoints += 1
                judge_outbox(Companion(), [(0, frame.raw)])

    def ask(self, number):
        """A request to the companion as a ground station behind the autopilot would send it; it is heard like all that is passed on."""
        raw = wire.encode("COMMAND_LONG", (1, 191, number, 0, *(0.0,) * 7), seq=0, system=255, component=190)
        self.down.add(raw)
        self.front.sendto(raw, self.companion)

    def close(self):
        self.front.close()
        self.back.close()


def faults(length_s):
    """Every two minutes something else, all of it flyable."""
    kinds = (
        'kind = "ekf_reset", value = [2.0, -1.0, 0.0]',
        'kind = "push", duration_s = 0.3, force_n = [6.0, 6.0, 0.0]',
        'kind = "nan", sensor = "gyro", duration_s = 1.0',
        'kind = "bias", sensor = "accel", duration_s = 5.0, value = [0.3, 0.0, 0.0]',
        'kind = "motor", motor = 2, effectiveness = 0.9, duration_s = 5.0',
        'kind = "freeze", sensor = "imu", duration_s = 0.5',
    )
    times = range(60, int(length_s) - 20, 120)
    return "[" + ", ".join(f"{{ t_s = {t}.0, {kinds[i % len(kinds)]} }}" for i, t in enumerate(times)) + "]"


def start(run, name, *words):
    with (run / f"{name}.json").open("wb") as out, (run / f"{name}.txt").open("wb") as err:
        module = "sitl" if name == "sitl" else "mavquad"
        command = [sys.executable, "-P", "-m", module, *map(str, words)]
        return subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=out, stderr=err, start_new_session=True)


@contextlib.contextmanager
def watches(path):
    """A process on every core that writes down when it was not run for a while: (monotonic time, how long), one a line."""
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [0]
    with path.open("ab") as out:
        running = [subprocess.Popen([sys.executable, "-c", WATCH, str(core)], stdout=out) for core in cores]
        try:
            yield
        finally:
            for one in running:
                one.kill()
                one.wait()


def waited_s(*pids):
    """For how long these processes could have run and were not let, since they began (Linux)."""
    return sum(1e-9 * int(Path(f"/proc/{pid}/schedstat").read_text().split()[1]) for pid in pids)


def told(path):
    """(state, reason) as the companion said it last."""
    states = [line.split("  ", 2)[-1].partition(": ") for line in path.read_text().splitlines()]
    return next(
        (
            (state.split()[-1], why)
            for state, _, why in reversed(states)
            if state.split()[-1:] and state.split()[-1] in lifecycle.STATES
        ),
        ("", ""),
    )


def stalls(path):
    return [tuple(map(float, line.split())) for line in path.read_text().splitlines()]


def memory_kib(child):
    status = Path(f"/proc/{child.pid}/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0])


def received(path, tally, ours):
    """Adds the frames of a log that came from others, or those that are ours."""
    if path.exists():
        with path.open("rb") as stream:
            for _, frame in tlog.read(stream):
                if ((frame.system, frame.component) == (1, 191)) == ours:
                    tally.add(frame.raw)


def drift(path):
    """Vehicle seconds per logged second of the first and of the last quarter of a flight.tlog, by ATTITUDE_QUATERNION."""
    pairs = []
    with path.open("rb") as stream:
        for t_us, frame in tlog.read(stream):
            if frame.msgid == wire.ID["ATTITUDE_QUATERNION"]:
                pairs.append((1e-6 * t_us, 1e-3 * wire.decode(frame).time_boot_ms))
    quarter = len(pairs) // 4
    parts = pairs[quarter // 4 : quarter], pairs[3 * quarter :]
    return [(part[-1][1] - part[0][1]) / (part[-1][0] - part[0][0]) for part in parts], pairs[-1][1]


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_a_long_flight_with_faults_at_ten_times_real_time(tmp_path, capsys):
    length_s = 60.0 * MINUTES
    parser = argparse.ArgumentParser()
    fly.add_arguments(parser)
    words = ["hover", "--set", f"path.duration_s={2 * length_s}", "--set", f"flight.max_time_s={length_s + 300}"]
    for name, value in LINK.items():
        words += ["--set", f"link.{name}={value}"]
    run = tmp_path / "run"
    flight.prepare(run, fly.resolve(parser.parse_args([*words, "--set", f"faults={faults(length_s)}"])))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        port = sock.getsockname()[1]
    end = ["--exit-when-landed", 2.0, "--max-time", length_s + 300.0]
    sitl = start(run, "sitl", "--config", run / "sitl.toml", "--endpoint", f"udpin:127.0.0.1:{port}", "--log", run / "sitl.tlog", "--speed", SPEED, *end)  # fmt: skip
    listener = Listener(port)
    there = f"udpout:127.0.0.1:{listener.front.getsockname()[1]}"
    companion = start(
        run, "companion", "--config", run / "companion.toml", "--endpoint", there, "--run", run, "--engage", "--speed", SPEED
    )
    seen, queued, released, landing = [], [], [], False
    watched = contextlib.ExitStack()
    watched.enter_context(watches(tmp_path / "stalls.txt"))
    try:
        while sitl.poll() is None and companion.poll() is None:
            listener.serve(0.2)
            with contextlib.suppress(OSError, IndexError):
                seen.append((flight.vehicle_time_s(run / "flight.trace"), memory_kib(sitl), memory_kib(companion)))
                queued.append((time.monotonic(), waited_s(sitl.pid, companion.pid, os.getpid())))
            state, why = told(run / "companion.txt")
            over = bool(seen) and seen[-1][0] > length_s
            if state == lifecycle.RELEASED and not landing:
                released.append((time.monotonic(), why))
                listener.serve(1.0)
                listener.ask(ENGAGE)
                listener.serve(1.0)
            elif state == lifecycle.ENGAGED and over and not landing:
                landing = True
                listener.ask(LAND)
    finally:
        for child in (companion, sitl):
            if child.poll() is None:
                child.send_signal(signal.SIGTERM)
            ends_s = time.monotonic() + 30.0
            while child.poll() is None and time.monotonic() < ends_s:
                listener.serve(0.2)  # the last frames are passed on too
            if child.poll() is None:
                child.kill()
        listener.serve(0.2)
        listener.close()
        watched.close()
    said = (run / "companion.txt").read_text()
    report, summary = json.loads((run / "sitl.json").read_text()), json.loads((run / "companion.json").read_text())
    logged_down, logged_up = Tally(), Tally()
    for log in sorted(run.glob("*.tlog")):
        if log.name != "sitl.tlog":
            received(log, logged_down, ours=False)
            received(log, logged_up, ours=True)
    rates, last_s = drift(run / "flight.tlog")
    with capsys.disabled():
        print(f"\n{report['sim_time_s']:.0f} s flown at {report['realtime_factor']} x real time, {report['late_s']} s behind")
        print(f"down: {listener.down} passed on, {logged_down} logged; up: {listener.up} passed on, {logged_up} logged")
        print(f"clock: {SPEED * report['wall_s'] - report['sim_time_s'] - SPEED * report['late_s']:.2f} s unaccounted for")
        print(f"{listener.setpoints} setpoints judged; vehicle over logged time {rates[0]:.4f} then {rates[1]:.4f}")
        print(f"refused {summary['refused']}; counts {summary['counts']}")
        stood = stalls(tmp_path / "stalls.txt")
        print(f"a core stood still {len(stood)} times, {1e3 * max([0.0, *(long for _, long in stood)]):.0f} ms at most")
        print(f"the programs waited {queued[-1][1]:.1f} s for a core")
        print(f"let go and engaged again: {[why for _, why in released]}")
    assert "engaged" in said, said
    assert report["landed"], said
    assert not report["crashed"]
    assert report["sim_time_s"] > length_s
    for noticed, why in released:
        held_up_s = sum(long for ended, long in stood if noticed - RECENT_S < ended <= noticed)
        waits = [wait for t, wait in queued if t <= noticed]
        before = [wait for t, wait in queued if t <= noticed - RECENT_S]
        held_up_s = max(held_up_s, waits[-1] - (before or waits)[-1])
        assert held_up_s > HELD_UP_S, f"let go while the machine ran: {why}"
    asked = 1  # the first request to engage is logged, and never was on the wire
    assert logged_down.frames - asked == listener.down.frames
    assert logged_up == listener.up
    assert listener.greetings <= 10
    assert listener.setpoints == summary["setpoints_sent"] > 50 * length_s
    assert abs(report["sim_time_s"] - last_s) < 5.0  # the two programs end at one time
    lost_s = SPEED * report["wall_s"] - report["sim_time_s"] - SPEED * report["late_s"]  # late_s: what the machine did not give
    assert abs(lost_s) < 0.005 * length_s
    assert report["late_s"] > 0.0 or abs(rates[1] / rates[0] - 1.0) < 0.02
    for column, name in ((1, "sitl"), (2, "companion")):
        early = max(row[column] for row in seen if 30.0 < row[0] < 0.4 * length_s)
        late = max(row[column] for row in seen if row[0] > 0.75 * length_s)
        with capsys.disabled():
            print(f"{name}: {early / 1024:.1f} MiB early, {late / 1024:.1f} MiB late")
        assert late - early < 8 * 1024
