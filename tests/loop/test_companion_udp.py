"""The live companion as a process over real UDP (loopback, free ports), against the scripted autopilot."""

import itertools
import json
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from mavquad import __main__ as companion_main
from mavquad import wire
from mavquad.link import tlog
from tests.oracles.autopilot import Autopilot

CONFIG = 'observers = []\nsettle_s = 0.5\n[path]\nname = "hover"\nduration_s = 1.0\n'


def companion(tmp_path, port, *more):
    config = tmp_path / "companion.toml"
    config.write_text(CONFIG)
    words = ["--endpoint", f"udpout:127.0.0.1:{port}", "--config", str(config), "--run", str(tmp_path / "run"), *more]
    return subprocess.Popen(
        [sys.executable, "-m", "mavquad", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=Path.cwd()
    )


@pytest.fixture
def ground():
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(("127.0.0.1", 0))
    sock.settimeout(90.0)
    yield sock
    sock.close()


def lockstep(sock, autopilot, until, seconds=60.0):
    """Serve periods until `until(autopilot)`; each waits for the barrier's answer."""
    _, address = sock.recvfrom(65535)
    end = autopilot.t_us + 1e6 * seconds
    while autopilot.t_us < end and not until(autopilot):
        sock.sendto(b"".join(autopilot.step()), address)
        want = autopilot.t_us * 1000
        answered = False
        while not answered:
            for _, m in wire.parse(sock.recvfrom(65535)[0]):
                answered |= type(m).__name__ == "TIMESYNC" and m.tc1 != 0 and m.ts1 == want
                if type(m).__name__ != "TIMESYNC":
                    autopilot.hear(_again(m))
    return address


def _again(message):
    return wire.encode(type(message).__name__, tuple(message), seq=0, system=1, component=191)


def landed(autopilot):
    return "SET_ATTITUDE_TARGET" in autopilot.heard and not autopilot.armed


def test_a_lockstep_flight_over_udp_leaves_a_whole_log_and_a_summary(tmp_path, ground):
    process = companion(tmp_path, ground.getsockname()[1], "--lockstep", "--engage")
    autopilot = Autopilot()
    lockstep(ground, autopilot, landed)
    assert landed(autopilot)
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    summary = json.loads(out)
    assert [s["state"] for s in summary["states"]] == ["configuring", "observing", "streaming", "engaged", "released"]
    assert summary["setpoints_sent"] == sum(name == "SET_ATTITUDE_TARGET" for name in autopilot.heard)
    with (tmp_path / "run" / "flight.tlog").open("rb") as stream:
        stamps = [t for t, _ in tlog.read(stream)]
    assert stamps == sorted(stamps)
    assert len(stamps) > summary["messages_received"]


def test_killed_and_started_again_it_takes_over_into_a_second_log(tmp_path, ground):
    autopilot = Autopilot()
    first = companion(tmp_path, ground.getsockname()[1], "--lockstep", "--engage")
    lockstep(ground, autopilot, lambda a: len(a.setpoints) > 150)
    first.kill()
    first.communicate(timeout=60)
    with (tmp_path / "run" / "flight.tlog").open("rb") as stream:
        assert sum(1 for _ in tlog.read(stream)) > 500
    n = len(autopilot.setpoints)
    second = companion(tmp_path, ground.getsockname()[1], "--lockstep", "--engage")
    ground.settimeout(0.2)
    while True:  # what the first one had still sent
        try:
            data, _ = ground.recvfrom(65535)
        except TimeoutError:
            continue
        if any(type(m).__name__ == "HEARTBEAT" for _, m in wire.parse(data)):
            break
    ground.settimeout(90.0)
    lockstep(ground, autopilot, landed)
    second.send_signal(signal.SIGTERM)
    out, err = second.communicate(timeout=60)
    assert second.returncode == 0, err
    assert len(autopilot.setpoints) > n
    assert "engaged" in [s["state"] for s in json.loads(out)["states"]]
    assert (tmp_path / "run" / "flight-2.tlog").stat().st_size > 10_000


def test_at_a_speed_its_timers_run_in_vehicle_time(tmp_path, ground):
    """A hundred seconds of HEARTBEATs, by their stamps, in a second or two."""
    process = companion(tmp_path, ground.getsockname()[1], "--speed", "100")
    _, address = ground.recvfrom(65535)
    ground.sendto(wire.encode("HEARTBEAT", (2, 12, 0, 0, 4, 3), seq=0, system=1, component=1), address)
    begun, beats = time.monotonic(), 0
    while beats < 100:
        beats += sum(type(m).__name__ == "HEARTBEAT" for _, m in wire.parse(ground.recvfrom(65535)[0]))
    assert time.monotonic() - begun < 50.0
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=60)
    assert process.returncode == 0
    with (tmp_path / "run" / "flight.tlog").open("rb") as stream:
        stamps = [t for t, frame in tlog.read(stream) if frame.component == 191 and frame.msgid == 0]
    assert stamps[90] - stamps[0] >= 90_000_000


@pytest.mark.parametrize(
    ("words", "told"), [(["--speed", "0"], "expected 0.01 to 1000"), (["--speed", "2", "--lockstep"], "no speed")]
)
def test_a_speed_that_cannot_be_is_said(tmp_path, words, told):
    process = companion(tmp_path, 1, *words)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 1
    assert told in err


def test_an_endpoint_that_never_answers_is_said_after_five_seconds_and_ctrl_c_leaves_cleanly(tmp_path, ground):
    process = companion(tmp_path, ground.getsockname()[1])
    ground.recvfrom(65535)
    begun = time.monotonic()
    line = process.stderr.readline()
    assert time.monotonic() - begun > 3.0
    assert "no MAVLink from udp 0.0.0.0:" in line
    assert "still trying" in line
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    assert json.loads(out)["state"] == "searching"


def test_a_ground_station_on_a_link_of_its_own_sees_both_sides_and_speaks_to_both(tmp_path, ground):
    """What it says to the autopilot goes on, what it says to us stays here, and nobody poses as the autopilot."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        station.bind(("127.0.0.1", 0))
        station.setblocking(False)
        forward = f"udpout:127.0.0.1:{station.getsockname()[1]}"
        process = companion(tmp_path, ground.getsockname()[1], "--lockstep", "--forward", forward)
        seen, passed = [], []

        def say(address):
            words = [
                ("HEARTBEAT", (6, 8, 0, 0, 4, 3), 255, 190),
                ("PARAM_REQUEST_READ", (1, 191, "", 0), 255, 190),
                ("COMMAND_LONG", (1, 1, 512, 0, 148.0, *(0.0,) * 6), 255, 190),
                ("SYS_STATUS", (0, 0, 0, 0, 0, 0, 7, 0, 0, 0, 0, 0, 0, 0, 0, 0), 1, 1),  # not its own name
            ]
            for i, (name, fields, system, component) in enumerate(words):
                station.sendto(wire.encode(name, fields, seq=i, system=system, component=component), address)

        def listened():
            try:
                data, address = station.recvfrom(65535)
            except BlockingIOError:
                return False
            frames = wire.split(data)[0]
            if not seen:
                say(address)
            seen.extend(frames)
            names = {(f.component, wire.NAME[f.msgid]) for f in seen}
            return {(191, "PARAM_VALUE"), (1, "ATTITUDE_QUATERNION"), (191, "TIMESYNC")} <= names and len(passed) >= 2

        autopilot = Autopilot()
        _, address = ground.recvfrom(65535)
        while autopilot.t_us < 60e6 and not listened():
            ground.sendto(b"".join(autopilot.step()), address)
            answered = False
            while not answered:
                data = ground.recvfrom(65535)[0]
                passed.extend(f for f in wire.split(data)[0] if (f.system, f.component) != (1, 191))
                for _, m in wire.parse(data):
                    answered |= type(m).__name__ == "TIMESYNC" and m.tc1 != 0 and m.ts1 == autopilot.t_us * 1000
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert {wire.NAME[f.msgid] for f in passed} == {"HEARTBEAT", "COMMAND_LONG"}
    assert json.loads(out)["refused"]["our autopilot's id from another address"] == 1
    numbers = [f.seq for f in seen if f.component == 191]
    assert all((b - a) & 0xFF == 1 for a, b in itertools.pairwise(numbers))


@pytest.mark.parametrize(
    ("endpoint", "said"),
    [
        ("udpin:127.0.0.1:{port}", "in use"),
        ("udp:127.0.0.1:1", "expected udpin:HOST:PORT"),
        ("tcp:127.0.0.1:1", "is the other side listening?"),
        ("serial:/dev/none:57600", "check the device's name"),
        ("udpin:127.0.0.1:99999", "above 65535"),
    ],
)
def test_an_endpoint_that_cannot_be_opened_is_one_line(tmp_path, ground, endpoint, said):
    text = endpoint.format(port=ground.getsockname()[1])
    words = [sys.executable, "-m", "mavquad", "--endpoint", text, "--run", str(tmp_path / "run")]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1
    assert said in done.stderr
    assert done.stderr.count("\n") == 1


def test_ctrl_c_before_anything_has_begun_is_one_line(monkeypatch, capsys):
    def interrupted(args):
        raise KeyboardInterrupt

    monkeypatch.setattr(companion_main, "run", interrupted)
    assert companion_main.main(["--endpoint", "udpin:127.0.0.1:0"]) == 1
    assert capsys.readouterr().err == "mavquad: stopped by Ctrl-C\n"
