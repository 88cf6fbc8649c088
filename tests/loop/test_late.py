"""A late companion slows down or lets go, and never oscillates: stalled, starved, a loop of 200 ms, all in wind, on vehicle time.

Every flight is a function of vehicle time (`tests/oracles/late.py`); only the last test stops a real process, and waits for what it
says, however long that takes.
"""

import json
import math
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path as File

import pytest

from mavquad import lifecycle, plan_file, wire
from mavquad.link import tlog
from mavquad.paths import Path
from mavquad.plan import build
from mavquad.settings import Companion
from tests.oracles.autopilot import Autopilot
from tests.oracles.late import Late, every, on_time, stalled
from tools import playback

WIND = ("wind.mean_m_s=4", "wind.w20_m_s=4")
ALL = ("pd", "pid", "adrc", "iadrc", "eskf-mpc")


def engaged(controller, seed=3):
    path = Path(name="hover", duration_s=300.0)
    settings = Companion(path=path, observers=(), controller=controller, settle_s=0.5, takeoff_m=2.0)
    late = Late(settings, f"seed={seed}", *WIND).engage()
    assert late.life.state == lifecycle.ENGAGED, late.texts
    return late.run(3.0)


def now_s(late):
    return 1e-6 * late.sim.t_us


def flown_well(late, last_s, spread_m):
    assert late.life.state == lifecycle.ENGAGED, late.texts
    assert max(late.spread(last_s)) < spread_m
    assert math.dist(late.truth[-1][1:], late.flight.anchor_p_m) < 0.7
    assert not late.sim.autopilot.crashed


def left_aside(request, controller, seed, late_s):
    """What is not reached: pd has no integral, and slowed by 0.3 s and more the wind of seed 12 leaves it 0.76 to 1.13 m aside."""
    if (controller, seed) == ("pd", 12) and late_s >= 0.3:
        request.applymarker(
            pytest.mark.xfail(strict=True, reason="pd has no integral: slowed, this wind leaves it over 0.7 m aside")
        )


@pytest.mark.parametrize("controller", ["iadrc", *[pytest.param(name, marks=pytest.mark.slow) for name in ("pid", "eskf-mpc")]])
def test_a_loop_of_200_ms_is_flown_slower_and_without_oscillation(controller):
    late = engaged(controller)
    late.wakes = every(0.2)
    late.run(8.0)
    flown_well(late, 4.0, 0.12)  # iadrc as quick as ever: 0.19 m and growing
    assert any("late, flying slower" in text for text in late.texts)
    assert late.flight.slow == 2


def test_one_flight_through_stalls_of_50_to_500_ms_and_back_in_time():
    late = engaged("iadrc")
    for stall_s in (0.05, 0.2, 0.5):
        late.wakes = stalled(now_s(late), stall_s)
        late.run(2.0)
        assert late.life.state == lifecycle.ENGAGED, (stall_s, late.texts)
        assert math.dist(late.truth[-1][1:], late.flight.anchor_p_m) < 0.6
    assert late.flight.slow == 3
    late.wakes = on_time
    late.run(6.5)
    flown_well(late, 3.0, 0.08)
    assert late.flight.slow == 0
    said = [text for text in late.texts if "late" in text or "in time" in text]
    assert said[-1] == "mavquad: in time again"


def test_a_vehicle_clock_that_stood_still_is_no_lateness_of_ours():
    """A simulator that its machine left alone for 0.3 s. What looks late is so for a TIMESYNC's time, not for a minute."""
    late = engaged("pid")
    late.halted_us = lambda: 300_000
    late.run(0.1)
    assert late.flight.late_s > 0.25
    late.run(8.0)
    assert late.flight.late_us == 0
    assert late.flight.slow == 0
    flown_well(late, 1.0, 0.1)


def test_a_simulator_at_two_thirds_of_real_time_is_flown():
    late = engaged("pid")
    began_us = late.sim.t_us
    late.halted_us = lambda: (late.sim.t_us - began_us) // 2
    late.run(10.0)
    flown_well(late, 5.0, 0.15)
    assert not any("too late" in text for text in late.texts)


def test_a_stall_of_a_second_is_survived_or_given_back():
    """The autopilot's own failsafe takes over after a second; we never fight it, and never come back as if nothing had been."""
    late = engaged("pid")
    before = len(late.setpoints)
    late.wakes = stalled(now_s(late), 0.2)
    late.run(0.21)
    assert len(late.setpoints) - before < 15  # of 25 control steps those that are not old, with newer ones behind them
    late.wakes = stalled(now_s(late), 1.3)
    late.run(3.0)
    assert late.life.state == lifecycle.RELEASED
    assert "set by another" in late.life.reason or "no telemetry" in late.life.reason
    count = len(late.setpoints)
    late.run(1.0)
    assert len(late.setpoints) == count
    assert not late.sim.autopilot.crashed


def test_a_starved_companion_lets_go_and_says_so():
    """Each frame takes longer than there is: it falls behind for good."""
    late = engaged("iadrc")
    late.frame_us = 1600.0
    late.run(4.0)
    assert late.life.state == lifecycle.RELEASED
    assert any("too late" in text or "no telemetry" in text for text in late.texts), late.texts
    assert any("flying slower" in text for text in late.texts)
    late.run(2.0)
    assert not late.sim.autopilot.crashed
    tilt = 1.0 - 2.0 * sum(x * x for x in late.sim.vehicle.state["ahrs_q_wxyz"][1:3])
    assert tilt > math.cos(math.radians(25.0))


@pytest.mark.slow
@pytest.mark.parametrize("controller", ALL)
@pytest.mark.parametrize("seed", [11, 12])
@pytest.mark.parametrize("stall_s", [0.05, 0.1, 0.2, 0.3, 0.5, 0.8])
def test_stalls_again_and_again(controller, seed, stall_s, request):
    left_aside(request, controller, seed, stall_s)
    late = engaged(controller, seed)
    late.wakes = stalled(now_s(late), stall_s, 3.0)
    late.run(30.0)
    if late.life.state == lifecycle.ENGAGED:
        flown_well(late, 20.0, 0.35)
    else:
        assert late.life.reason
        assert not late.sim.autopilot.crashed


@pytest.mark.slow
@pytest.mark.parametrize("controller", ALL)
@pytest.mark.parametrize("seed", [11, 12])
@pytest.mark.parametrize("period_s", [0.05, 0.1, 0.2, 0.3])
def test_slow_loops(controller, seed, period_s, request):
    left_aside(request, controller, seed, period_s)
    late = engaged(controller, seed)
    late.wakes = every(period_s)
    late.run(30.0)
    flown_well(late, 20.0, 0.35)


# ---- a real process ----------------------------------------------------------------------------------------------------------
CONFIG = 'observers = []\nsettle_s = 0.5\n[path]\nname = "hover"\nduration_s = 60.0\n'


@pytest.mark.slow  # of the wall clock: a loaded machine is late by itself
def test_a_stopped_process_says_that_it_was_late_and_its_log_replays(tmp_path):
    config, run = tmp_path / "companion.toml", tmp_path / "run"
    config.write_text(CONFIG)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        words = ["--endpoint", f"udpout:127.0.0.1:{sock.getsockname()[1]}", "--config", str(config), "--run", str(run)]
        process = subprocess.Popen(
            [sys.executable, "-m", "mavquad", *words, "--engage"],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            cwd=File.cwd(),
        )
        try:
            texts = _stop_in_flight(sock, process)
        finally:
            process.send_signal(signal.SIGCONT)
            process.send_signal(signal.SIGTERM)
            out, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    assert json.loads(out)["setpoints_sent"] > 0
    assert any("late" in text or "released" in text for text in texts)
    plan = build(plan_file.read(run / "plan.toml").companion)
    with (run / "flight.tlog").open("rb") as stream:
        assert playback.verify(plan, tlog.read(stream), own=(1, 191)).parting is None


def _stop_in_flight(sock, process):
    """A hovering autopilot in wall time; the companion is stopped once setpoints flow. What it said until it spoke of it."""
    autopilot, texts = Autopilot(), []
    autopilot.armed, autopilot.p[2] = True, -5.0
    sock.settimeout(60.0)
    _, address = sock.recvfrom(65535)
    sock.settimeout(0.005)
    begun = time.monotonic()
    stopped_at, gone_on = math.inf, False
    while time.monotonic() - begun < 120.0:
        while autopilot.t_us < 1e6 * (time.monotonic() - begun):
            sock.sendto(b"".join(raw for raw in autopilot.step() if _message(raw) != "TIMESYNC"), address)
        try:
            data = sock.recv(65535)
        except TimeoutError:
            data = b""
        for frame, message in wire.parse(data):
            autopilot.hear(frame.raw)
            if type(message).__name__ == "STATUSTEXT":
                texts.append(message.text)
        if autopilot.setpoints and math.isinf(stopped_at):
            process.send_signal(signal.SIGSTOP)
            stopped_at = time.monotonic()
        elif not gone_on and time.monotonic() - stopped_at > 0.6:
            process.send_signal(signal.SIGCONT)
            gone_on = True
        if gone_on and any("late" in text or "released" in text for text in texts):
            return texts
    raise AssertionError(f"nothing was said of it: {texts}, {len(autopilot.setpoints)} setpoints")


def _message(raw):
    return wire.NAME[int.from_bytes(raw[7:10], "little")]
