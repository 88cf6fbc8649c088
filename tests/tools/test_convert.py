"""`mavquad convert`: what is written can be read back to the last bit."""

import csv
import json
import math
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader

from mavquad.link.columns import Log
from tests.oracles.logs import ulog
from tools.__main__ import main

DATA = Path(__file__).parent.parent / "data"
SWEEP = DATA / "sweep-roll-20s.tlog"
SLICE = ["--from", "2", "--until", "3"]


@pytest.fixture(scope="module")
def attitude() -> np.ndarray:
    log = Log(SWEEP)
    start = int(log.t_us.min())
    return log.columns("ATTITUDE_QUATERNION", start_us=start + 2_000_000, end_us=start + 3_000_000)


def test_parquet_gives_every_value_back(tmp_path, attitude):
    assert main(["convert", str(SWEEP), "--to", "parquet", "--out", str(tmp_path / "out"), *SLICE]) == 0
    assert len(list((tmp_path / "out").iterdir())) == 19  # the two TIMESYNC lie elsewhere
    table = pq.read_table(tmp_path / "out" / "1-1-ATTITUDE_QUATERNION.parquet")
    assert table.num_rows == len(attitude) == 100
    for name in ("t_us", "q1", "yawspeed", "frame_seq"):
        assert table[name].to_numpy().tobytes() == np.ascontiguousarray(attitude[name]).tobytes()
    assert np.array(table["repr_offset_q"].to_pylist()).shape == (100, 4)


def test_csv_gives_every_value_back(tmp_path, attitude, capsys):
    out = tmp_path / "out"
    assert (
        main(["convert", str(SWEEP), "--to", "csv", "--out", str(out), "--only", "ATTITUDE_QUATERNION", *SLICE, "--json"]) == 0
    )
    assert json.loads(capsys.readouterr().out) == {"out": str(out), "tables": {"1/1/ATTITUDE_QUATERNION": 100}, "notes": []}
    with (out / "1-1-ATTITUDE_QUATERNION.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert [int(row["t_us"]) for row in rows] == attitude["t_us"].tolist()
    assert np.array([row["q2"] for row in rows], np.float32).tobytes() == attitude["q2"].tobytes()
    assert np.array([row["repr_offset_q[3]"] for row in rows], np.float32).tolist() == attitude["repr_offset_q"][:, 3].tolist()


def test_mcap_holds_every_message_in_the_order_of_time(tmp_path, attitude):
    out = tmp_path / "out.mcap"
    assert main(["convert", str(SWEEP), "--to", "mcap", "--out", str(out), *SLICE]) == 0
    with out.open("rb") as stream:
        found = [
            (channel.topic, message.log_time, json.loads(message.data))
            for _, channel, message in make_reader(stream).iter_messages()
        ]
    times = [t for _, t, _ in found]
    assert times == sorted(times)
    ours = [data for topic, _, data in found if topic == "/1/1/ATTITUDE_QUATERNION"]
    assert [data["t_us"] for data in ours] == attitude["t_us"].tolist()
    assert np.array([data["q1"] for data in ours], np.float32).tobytes() == attitude["q1"].tobytes()


def test_signals_have_units_in_their_names(tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["convert", str(SWEEP), "--to", "csv", "--signals", "--out", str(out), *SLICE]) == 0
    heads = {path.stem: path.read_text().split("\n", 1)[0] for path in out.iterdir()}
    assert heads["attitude"] == "t_us,q_w,q_x,q_y,q_z,omega_x_rad_s,omega_y_rad_s,omega_z_rad_s,arrival_us"
    assert heads["position"] == "t_us,p_n_m,p_e_m,p_d_m,v_n_m_s,v_e_m_s,v_d_m_s,arrival_us"
    assert heads["motors"].startswith("t_us,command_1,command_2")
    assert set(heads) == {"attitude", "imu", "position", "motors", "target"}


def test_a_ulog_is_converted_and_what_it_is_too_slow_for_is_said(tmp_path, capsys):
    rows = [(250_000 * i, 1.0, 0.0, 0.0, math.nan if i == 3 else 0.0) for i in range(8)]
    (tmp_path / "f.ulg").write_bytes(ulog({"vehicle_attitude": ("uint64_t timestamp;float[4] q;", rows)}))
    assert main(["convert", str(tmp_path / "f.ulg"), "--to", "mcap", "--out", str(tmp_path / "a.mcap")]) == 0
    with (tmp_path / "a.mcap").open("rb") as stream:
        messages = [json.loads(m.data) for _, _, m in make_reader(stream).iter_messages()]
    assert messages[3]["q"] == [1.0, 0.0, 0.0, None]  # JSON has no NaN
    capsys.readouterr()
    assert main(["convert", str(tmp_path / "f.ulg"), "--to", "parquet", "--signals", "--out", str(tmp_path / "b")]) == 0
    said = capsys.readouterr()
    assert "attitude at 4.0 Hz is too slow" in said.err
    assert pq.read_table(tmp_path / "b" / "attitude.parquet").num_rows == 7


def test_a_cut_log_is_converted_as_far_as_it_goes(tmp_path, capsys):
    (tmp_path / "cut.tlog").write_bytes(SWEEP.read_bytes()[:50_000])
    assert main(["convert", str(tmp_path / "cut.tlog"), "--to", "csv", "--out", str(tmp_path / "out")]) == 0
    assert "truncated at byte 50000" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["nowhere.tlog", "--to", "csv"], "nowhere.tlog: no such file"),
        ([str(SWEEP), "--to", "csv", "--only", "NOTHING"], "nothing to convert is left"),
        ([str(SWEEP), "--to", "csv", "--out", str(DATA)], "exists already and is not overwritten"),
        ([str(SWEEP), "--to", "csv", "--dialect", "klingon"], "pymavlink has no dialect 'klingon'"),
    ],
)
def test_what_cannot_be_converted_is_said_in_one_line(words, text, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["convert", *words]) == 1
    said = capsys.readouterr().err
    assert text in said
    assert said.count("\n") == 1
