"""`mavquad check`: what it makes of what an autopilot grants; and of nobody."""

import json
import math
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from mavquad import lifecycle
from mavquad.settings import Companion
from tools import __main__ as tools_main
from tools import check, warm

ROOT = Path(__file__).resolve().parents[2]
SUMMARY = {
    "rates_hz": {"ATTITUDE_QUATERNION": 250.0, "LOCAL_POSITION_NED": 50.0, "HIGHRES_IMU": 0.0, "SYS_STATUS": math.nan},
    "state": "observing",
    "hover_thrust": 0.5,
    "delay_s": 0.01,
    "messages_lost": 3,
}
MEASURED = {"ATTITUDE_QUATERNION": 250.0, "LOCAL_POSITION_NED": 50.0, "ATTITUDE_TARGET": 50.0, "HEARTBEAT": 1.0}


def _life(autopilot, **params):
    life = lifecycle.init(Companion())
    return life._replace(target=(1, 1), autopilot=autopilot, params=tuple(params.items()))


def _judge(autopilot=12, measured=MEASURED, **params):
    return check._judge(SUMMARY, _life(autopilot, **params), measured, ["hello"])


def _runs(found):
    return {m["name"] for m in found["methods"] if m["runs"]}


def test_methods_run_on_what_arrives_and_say_what_they_lack():
    found = _judge()
    assert found["can_fly"]
    assert {"pd", "pid", "autopilot", "gsmo"} <= _runs(found)
    lacking = {m["name"]: m["why"] for m in found["methods"] if not m["runs"]}
    assert lacking["gsmo:torque=motors"] == "SERVO_OUTPUT_RAW at 0.0 Hz, at least 20 needed"
    assert "ATT_POS_MOCAP" in lacking["gsmo:source=mocap"]
    assert found["also_sends"] == {"ATTITUDE_TARGET": 50.0, "HEARTBEAT": 1.0}
    granted = {r["message"]: r["granted_hz"] for r in found["asked_for"]}
    assert (granted["HIGHRES_IMU"], granted["SYS_STATUS"]) == (0.0, None)
    json.dumps(found, allow_nan=False)


def test_too_slow_an_attitude_or_no_position_is_in_the_way():
    found = _judge(measured={**MEASURED, "ATTITUDE_QUATERNION": 4.0})
    assert not found["can_fly"]
    assert "ATTITUDE_QUATERNION or ATTITUDE at 4.0 Hz, at least 40 needed" in found["missing"][0]
    assert _judge(measured={**MEASURED, "ATTITUDE_QUATERNION": 4.0, "ATTITUDE": 50.0})["can_fly"]
    assert not _judge(measured={"ATTITUDE": 50.0})["can_fly"]


def test_on_ardupilot_thrust_must_be_thrust():
    assert "GUID_OPTIONS is 0" in _judge(3, GUID_OPTIONS=0.0)["missing"][0]
    assert "GUID_OPTIONS is nan" in _judge(3)["missing"][0]
    assert _judge(3, GUID_OPTIONS=9.0)["can_fly"]
    assert "its modes are not known" in _judge(0)["missing"][0]


def test_people_see_rates_methods_and_what_is_in_the_way(capsys):
    check.show(_judge(3, GUID_OPTIONS=0.0))
    shown = capsys.readouterr().out
    assert "ArduPilot 1/1" in shown
    assert "refused" in shown
    assert "no answer" in shown
    assert "in the way: GUID_OPTIONS is 0" in shown


def test_a_simulated_autopilot_is_checked_over_udp(capsys):
    warm.vehicle()
    port = _free_port()
    command = [sys.executable, "-m", "sitl", "--endpoint", f"udpin:127.0.0.1:{port}", "--max-time", "60"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as sitl:
        try:
            assert sitl.stderr is not None
            assert "sitl: px4" in sitl.stderr.readline()
            assert tools_main.main(["check", f"udpout:127.0.0.1:{port}", "--seconds", "6", "--json"]) == 0
        finally:
            sitl.terminate()
            sitl.communicate(timeout=20)
    found = json.loads(capsys.readouterr().out)
    assert (found["autopilot"], found["can_fly"], found["armed"]) == ("PX4", True, False)
    assert found["parameters"]["MPC_THR_HOVER"] == pytest.approx(0.5735)
    rates = {r["message"]: r for r in found["asked_for"]}
    assert rates["ATTITUDE_QUATERNION"]["granted_hz"] == 250.0


def test_nobody_there_is_said(capsys):
    assert tools_main.main(["check", f"udpin:127.0.0.1:{_free_port()}", "--seconds", "2"]) == 1
    assert "no HEARTBEAT of an autopilot in 2 s" in capsys.readouterr().err
    assert tools_main.main(["check", "udpin:127.0.0.1:1", "--seconds", "1"]) == 1
    assert "expected 2 to 3600" in capsys.readouterr().err


def test_ctrl_c_ends_the_listening_and_the_time_said_is_the_time_listened(capsys):
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    done = threading.Event()

    def press():
        while not done.wait(0.2):
            os.kill(os.getpid(), signal.SIGINT)

    signal.signal(signal.SIGINT, lambda *_: None)  # until the companion heeds it
    keyboard = threading.Thread(target=press)
    keyboard.start()
    try:
        assert tools_main.main(["check", f"udpin:127.0.0.1:{_free_port()}", "--seconds", "60"]) == 1
    finally:
        done.set()
        keyboard.join()
        for number, handler in before.items():
            signal.signal(number, handler)
    said = re.search(r"no HEARTBEAT of an autopilot in ([\d.]+) s", capsys.readouterr().err)
    assert said
    assert float(said[1]) < 60.0


def _free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        return sock.getsockname()[1]
