"""`mavquad bench`: its parts, its table; the figures themselves are a machine's."""

import json
import math

import pytest

from mavquad.link.columns import Log
from tools import bench
from tools.__main__ import main
from tools.benches import Row, cpu_s, reading


def test_every_part_can_be_measured_and_says_what_it_is():
    known = bench.parts()
    assert "reading" in known
    for name, line in known.items():
        module = __import__(f"tools.benches.{name.replace('-', '_')}", fromlist=["measure"])
        assert callable(module.measure), name
        assert len(line) > 20, name


def test_the_log_of_the_reading_part_is_whole(tmp_path):
    reading.make_log(tmp_path / "bench.tlog", 3000)
    log = Log(tmp_path / "bench.tlog")
    assert (len(log), log.junk_bytes, log.problem) == (3000, 0, "")
    assert {s.name for s in log.streams} == {name for name, _ in reading.MIX}


def test_contestants_read_the_same_messages(tmp_path):
    reading.make_log(tmp_path / "bench.tlog", 2000)
    for who in ("ours, columns", "ours, streaming", "pymavlink"):
        told = reading.contest(who, tmp_path / "bench.tlog")
        assert told.messages == 2000
        assert told.cpu_s > 0.0


def test_rows_come_as_a_table_and_as_json(monkeypatch, capsys):
    rows = [Row("a task", "ours", 2.0, "Hz"), Row("a task", "a peer", math.nan, "Hz", "not installed")]
    monkeypatch.setattr(reading, "measure", lambda seconds: rows)
    assert main(["bench", "reading"]) == 0
    assert capsys.readouterr().out.splitlines()[1] == "reading  a task  a peer  -  Hz  not installed"
    assert main(["bench", "reading", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rows"][1]["value"] is None


def test_an_unknown_part_is_said(capsys):
    assert main(["bench", "singing"]) == 1
    assert "no part is called 'singing'; known: " in capsys.readouterr().err


def test_cpu_time_is_that_of_the_work():
    assert cpu_s(lambda: sum(range(200_000)), 3) == pytest.approx(cpu_s(lambda: sum(range(200_000)), 3), rel=3.0)
    assert cpu_s(lambda: None) < cpu_s(lambda: sum(range(200_000)))
