"""`mavquad replay` on recordings of a real autopilot and on files that are none."""

import csv
import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from pymavlink import mavutil

from tools import __main__ as tools_main

DATA = Path(__file__).resolve().parents[1] / "data"
SWEEP, FLIGHT = DATA / "sweep-roll-20s.tlog", DATA / "flight1-20s.tlog"


def _replay(capsys, *words):
    assert tools_main.main(["replay", *map(str, words), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.parametrize("path", [SWEEP, FLIGHT])
def test_message_counts_equal_those_of_pymavlink(path, capsys):
    result = _replay(capsys, path)
    ours = {(s["system"], s["component"], s["name"]): s["count"] for s in result["streams"]}
    theirs: Counter[tuple[int, int, str]] = Counter()
    log = mavutil.mavlink_connection(str(path), dialect="ardupilotmega")
    while (m := log.recv_msg()) is not None:
        raw = m.get_msgbuf()  # its own header of an unknown message is empty
        theirs[raw[5], raw[6], m.get_type()] += 1
    log.close()
    assert ours == theirs
    assert result["junk_bytes"] == 0


def test_the_observer_stands_beside_the_plain_ways_to_the_rates(capsys):
    r = _replay(capsys, SWEEP, "--observer", "gsmo", "--observer", "gsmo:variant=relay")["rates"]
    rms = {(w["method"], w["torque"]): w["rms_rad_s"] for w in r["ways"]}
    assert r["source"] == "1/1 ATTITUDE_QUATERNION"
    assert r["sample_hz"] == pytest.approx(100.0)
    plain = rms["difference", "-"]
    # the roll sweep: half a sample late at its acceleration; slower filters are later; the paper's relay chatters
    assert plain[0] < rms["difference, 20 Hz Butterworth", "-"][0] < rms["difference, 5 Hz Butterworth", "-"][0]
    assert rms["difference, extrapolated half a sample", "-"][0] < plain[0]
    assert rms["gsmo", "unknown"][0] < plain[0] < rms["gsmo:variant=relay", "unknown"][0]
    assert rms["gsmo:variant=relay", "from SERVO_OUTPUT_RAW"][0] < rms["gsmo:variant=relay", "unknown"][0]
    assert r["torque_model"]["explained"][0] > 0.8


def test_the_span_can_be_chosen_and_an_empty_one_is_said(capsys):
    r = _replay(capsys, SWEEP, "--from", "5", "--to", "10")["rates"]
    assert (r["from_s"], r["to_s"], r["span"]) == (5.0, 10.0, "as asked for")
    assert r["samples"] == pytest.approx(500, abs=3)
    r = _replay(capsys, SWEEP, "--from", "100")["rates"]
    assert "at least 100 are needed" in r["problem"]


def test_people_get_a_table(capsys, tmp_path):
    page = tmp_path / "page.html"
    assert tools_main.main(["replay", str(SWEEP), "--out", str(page)]) == 0
    shown = capsys.readouterr().out
    assert shown.splitlines()[-1] == str(page)
    assert "ATTITUDE_QUATERNION" in shown
    assert "difference, 20 Hz Butterworth" in shown


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_the_pipelines_trace_of_a_foreign_log_is_written(suffix, tmp_path, capsys):
    config = tmp_path / "own.toml"
    config.write_text('controller = "pd"\nobservers = []\n')
    out = tmp_path / f"trace{suffix}"
    result = _replay(capsys, SWEEP, "--config", config, "--csv", out)
    if suffix == ".csv":
        with out.open(newline="") as stream:
            rows = list(csv.DictReader(stream))
        w_x = np.array([float(row["w_x"]) for row in rows])
    else:
        rows = pytest.importorskip("pyarrow.parquet").read_table(out)
        w_x = rows.column("w_x").to_numpy()
    assert len(w_x) == result["trace"]["rows"] > 1900  # a step per attitude sample of 20 s at 100 Hz
    assert 0.05 < np.std(w_x) < 1.0


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (None, "no such file"),
        (b"", "empty"),
        (b"not a log at all, but a text of some length\n" * 20, "not a tlog"),
        (b"\x89MCAP0\r\n" + bytes(100), "MCAP"),
    ],
)
def test_a_file_that_is_no_log_is_refused_in_one_line(content, says, tmp_path, capsys):
    path = tmp_path / "x.tlog"
    if content is not None:
        path.write_bytes(content)
    assert tools_main.main(["replay", str(path)]) == 1
    said = capsys.readouterr().err
    assert says in said
    assert "x.tlog" in said
    assert said.count("\n") == 1


def test_a_cut_log_is_read_to_its_last_whole_message_and_said(tmp_path, capsys):
    path = tmp_path / "cut.tlog"
    path.write_bytes(SWEEP.read_bytes()[:400_001])
    assert tools_main.main(["replay", str(path), "--json"]) == 0
    shown = capsys.readouterr()
    assert "truncated at byte 400001" in shown.err
    assert json.loads(shown.out)["messages"] > 5000


def test_verify_without_the_flights_plan_says_what_is_missing(tmp_path, capsys):
    path = tmp_path / "flight.tlog"
    path.write_bytes(SWEEP.read_bytes()[:100_000])
    assert tools_main.main(["replay", str(path), "--verify"]) == 1
    assert "plan.toml: no such file" in capsys.readouterr().err


def test_the_whole_recording_gives_the_rates_of_the_issue(recordings, capsys):
    path = recordings / "arducopter-sitl-sweep-calm.tlog"
    r = _replay(capsys, path, "--from", "55", "--to", "250")["rates"]
    rms = {(w["method"], w["torque"]): w["rms_rad_s"] for w in r["ways"]}
    np.testing.assert_allclose(r["signal_rms_rad_s"], [0.263, 0.249, 0.140], rtol=0.01)
    np.testing.assert_allclose(rms["difference", "-"], [0.0166, 0.0165, 0.0013], rtol=0.03)
    np.testing.assert_allclose(rms["difference, extrapolated half a sample", "-"], [0.0084, 0.0083, 0.0019], rtol=0.03)
    np.testing.assert_allclose(rms["difference, 20 Hz Butterworth", "-"], [0.0475, 0.0472, 0.0026], rtol=0.03)
    assert all(a <= b for a, b in zip(rms["gsmo", "unknown"], rms["difference, extrapolated half a sample", "-"], strict=True))


def test_an_observer_of_another_attitude_source_is_refused(capsys):
    assert tools_main.main(["replay", str(SWEEP), "--observer", "gsmo:source=mocap"]) == 1
    assert "rates are compared on ATTITUDE_QUATERNION here" in capsys.readouterr().err
