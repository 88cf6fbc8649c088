"""Whole flights as a person starts them: two processes over UDP in lockstep; what they leave behind; what goes wrong, in one line."""

import functools
import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from mavquad.errors import FlightError
from mavquad.link.columns import Log
from tests.tools.conftest import SHORT
from tools import __main__ as tools_main
from tools import flight, fly
from tools.trace import read_trace

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.xdist_group("flights")


def test_a_flight_goes_well_and_says_so_with_every_key(flown):
    run, summary = flown
    keys = [
        "scenario",
        "seed",
        "vehicle",
        "controller",
        "compensator",
        "duration_s",
        "realtime_factor",
        "rmse_m",
        "max_error_m",
        "rate_rmse_rad_s",
        "setpoints_sent",
        "messages_received",
        "messages_lost",
        "setpoint_misses",
        "latency_us",
        "states",
        "landed",
        "ok",
        "failures",
    ]
    assert set(keys) <= set(summary)
    assert (summary["scenario"], summary["seed"], summary["ok"], summary["failures"]) == ("hover", 7, True, [])
    assert (summary["landed"], summary["setpoint_misses"], summary["messages_lost"]) == (True, 0, 0)
    assert summary["rmse_m"]["position"] < 0.1
    assert set(summary["rate_rmse_rad_s"]) == {"gsmo", "gyro"}
    assert [s["state"] for s in summary["states"]] == ["configuring", "observing", "streaming", "engaged", "released"]
    names = {p.name for p in run.iterdir()}
    assert {"flight.tlog", "flight.trace", "sitl.tlog", "plan.toml", "summary.json", "sitl.toml", "companion.toml"} <= names


def test_the_command_in_the_summary_repeats_the_flight_byte_for_byte(flown, tmp_path):
    run, summary = flown
    words = summary["command"].split()
    assert words[:2] == ["mavquad", "fly"]
    assert tools_main.main([*words[1:], "--run", str(tmp_path / "again"), "--no-report", "--json"]) == 0
    for name in ("flight.tlog", "sitl.tlog", "flight.trace"):
        assert (tmp_path / "again" / name).read_bytes() == (run / name).read_bytes()


def test_the_flight_replays_bit_for_bit(flown, capsys):
    run, _ = flown
    assert tools_main.main(["replay", str(run / "flight.tlog"), "--verify", "--json"]) == 0
    verdict = json.loads(capsys.readouterr().out)
    assert (verdict["ok"], verdict["compared"], verdict["parting"]) == (True, "bit for bit", None)
    assert verdict["trace_rows_compared"] == len(read_trace(run / "flight.trace").rows) > 500
    assert verdict["received"] + verdict["sent_compared"] == len(Log(run / "flight.tlog"))


def test_another_seed_at_a_speed_is_another_flight_that_replays_and_may_fall_short(flown, tmp_path, capsys):
    _, summary = flown
    run = tmp_path / "run"
    patient = [
        f"safety.{key}=20" for key in ("hold_s", "level_s", "release_s", "late_s", "delay_s")
    ]  # a busy machine is late at 2 x
    words = [
        *SHORT,
        "--speed",
        "2",
        "--set",
        "require.rmse_m=0.0001",
        *(word for change in patient for word in ("--set", change)),
    ]
    words[words.index("7")] = "8"
    assert tools_main.main(["fly", *words, "--run", str(run), "--json"]) == 1
    shown = capsys.readouterr()
    other = json.loads(shown.out)
    assert not other["ok"]
    assert "at most 0.0001 m" in other["failures"][0]
    assert shown.err.strip().splitlines()[-1].startswith("mavquad: the flight was not as it should be: position rmse")
    assert other["rmse_m"] != summary["rmse_m"]
    assert 0.0 <= other["pacing_ms"]["p50"] <= other["pacing_ms"]["p99"] <= other["pacing_ms"]["max"]
    assert summary["pacing_ms"] is None
    assert tools_main.main(["replay", str(run / "flight.tlog"), "--verify"]) == 0
    assert "bit for bit" in capsys.readouterr().out


def test_a_folder_with_a_flight_is_not_overwritten(flown, capsys):
    run, _ = flown
    before = (run / "flight.tlog").read_bytes()
    assert tools_main.main(["fly", *SHORT, "--run", str(run)]) == 1
    assert "holds a flight already" in capsys.readouterr().err
    assert (run / "flight.tlog").read_bytes() == before


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--controller", "pidd"], "pidd"),
        (["--observer", "gsmoo"], "no observer is called 'gsmoo'"),
        (["--observer", "gsmo:variant=relaxed"], "relaxed"),
        (["--set", "pid.kp_typo=1"], 'unknown key "kp_typo" in [tune.pid]'),
        (["--set", "wind.mean=1"], 'did you mean "mean_m_s"'),
        (["--speed", "0"], "expected 0.01 to 1000"),
        (["--airframe", "x5000"], "no airframe is called 'x5000'"),
    ],
)
def test_a_mistake_is_one_line_before_anything_flies(words, says, tmp_path, capsys):
    assert tools_main.main(["fly", *SHORT, *words, "--run", str(tmp_path / "run")]) == 1
    shown = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("compiling kernels (once)")]
    assert len(shown) == 1
    assert says in shown[0]
    assert not (tmp_path / "run").exists()


def test_ctrl_c_ends_both_programs_and_leaves_whole_logs(tmp_path):
    run = tmp_path / "run"
    command = [sys.executable, "-m", "tools", "fly", "circle", "--speed", "1", "--no-report", "--run", str(run)]
    heeded = functools.partial(
        signal.signal, signal.SIGINT, signal.SIG_DFL
    )  # a suite in the background passes on that it is ignored
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True, preexec_fn=heeded) as child:
        deadline = time.monotonic() + 60.0
        while not (run / "flight.tlog").exists() or (run / "flight.tlog").stat().st_size < 20_000:
            assert time.monotonic() < deadline
            assert child.poll() is None
            time.sleep(0.05)
        child.send_signal(signal.SIGINT)
        _, said = child.communicate(timeout=60)
    assert child.returncode == 1
    assert said.splitlines()[-1] == "mavquad: stopped by Ctrl-C"
    assert Log(run / "flight.tlog").problem == ""
    assert Log(run / "sitl.tlog").problem == ""
    for name in ("sitl", "companion"):  # both have ended: each has written its last line
        assert json.loads((run / f"{name}.json").read_text().splitlines()[-1])


def test_a_program_that_ends_in_flight_is_named_with_its_last_words(tmp_path, monkeypatch):
    run = tmp_path / "run"
    run.mkdir()
    (run / "sitl.toml").write_text("seed = -1\n")
    (run / "companion.toml").write_text("")
    flown = flight.fly(run, flight.Pace(None), 60.0, lambda t_s, said: None)
    assert len(flown.problems) == 1
    assert "seed = -1" in flown.problems[0]


def test_a_companion_that_refuses_to_fly_ends_the_flight_with_its_reason(tmp_path, capsys):
    words = [*SHORT, "--personality", "ardupilot", "--set", "params.GUID_OPTIONS=0", "--run", str(tmp_path / "run")]
    assert tools_main.main(["fly", *words]) == 1
    assert "never engaged (last: released set GUID_OPTIONS to 8)" in capsys.readouterr().err


def test_an_unwritable_place_is_said(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(FlightError, match="cannot be written"):
        flight.prepare(blocked / "run", None)  # type: ignore[arg-type]


def test_progress_on_a_pipe_is_a_line_per_change(capsys):
    with fly.Progress(lambda: 10.0) as progress:
        progress.watch(float("nan"), [])
        progress.watch(1.0, ["    0.100 s  configuring: PX4 1/1"])
        progress.watch(12.0, ["   10.096 s  engaged: setpoints are flown"])
    assert capsys.readouterr().err.splitlines() == ["0.100 s  configuring: PX4 1/1", "10.096 s  engaged: setpoints are flown"]
    with fly.Progress(lambda: 10.0, quiet=True) as progress:
        progress.watch(1.0, ["x"])
    assert capsys.readouterr().err == ""
