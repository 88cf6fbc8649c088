"""`mavquad bench`: its parts, its table; the figures themselves are a machine's."""

import json
import math
import sys
from pathlib import Path

import pytest

from mavquad import wire
from mavquad.errors import ConfigError
from mavquad.link.columns import Log
from tools import bench, peers
from tools.__main__ import main
from tools.benches import Row, bulk, cpu_s, growth, live, reading


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


def test_the_live_contestants_fly_the_same_setpoint(tmp_path):
    told = []
    with live._bound() as vehicle:
        vehicle.settimeout(60.0)
        for kind in (live._OurLoop, live._PipelineLoop, live._MavutilLoop):
            (tmp_path / kind.__name__).mkdir()
            loop = kind(vehicle.getsockname()[1], tmp_path / kind.__name__)
            for k in (30, 31, 32):
                vehicle.sendto(b"".join(live.telemetry(k)), loop.sock.getsockname())
                loop.turn(k)
                (frame,) = wire.split(vehicle.recv(2048))[0]
            loop.close()
            told.append(wire.decode(frame))
    assert told[0] == told[1]
    assert told[0].time_boot_ms == told[2].time_boot_ms == 256
    assert told[0].thrust == pytest.approx(told[2].thrust, abs=1e-3)
    assert told[0].q == pytest.approx(told[2].q, abs=1e-2)


def test_the_limit_in_c_and_a_missing_peer_are_rows_whatever_happens(monkeypatch, tmp_path):
    ours = Row("plant + attitude control", "ours", 2.0, "M steps/s")
    for home, said in ((tmp_path, "is not installed"), (Path(sys.prefix), f"is missing in {sys.prefix}")):
        monkeypatch.setenv("MAVQUAD_PEERS", str(home))
        rows = [*bulk._rotorpy(ours), bulk._crazyflow(1000, 2, "rk4")]
        assert [math.isnan(row.value) for row in rows] == [True, True]
        assert [said in row.note and "make bench" in row.note for row in rows] == [True, True]
        told = reading._child("fasttlogparser", tmp_path / "no.tlog")
        assert said in told
    monkeypatch.setattr(bulk.shutil, "which", lambda name: None)
    assert "no C compiler" in bulk._limit().note


def test_peers_live_beside_the_project_unless_told(monkeypatch, tmp_path):
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "python").symlink_to(sys.executable)
    monkeypatch.delenv("MAVQUAD_PEERS", raising=False)
    monkeypatch.setattr(peers, "_BESIDE", tmp_path)
    assert peers.run("somebody", "import json, sys; print(json.dumps([sys.argv[1], 4]))", 7) == ["7", 4]
    with pytest.raises(ConfigError, match="somebody failed: ZeroDivisionError"):
        peers.run("somebody", "1 / 0")
    monkeypatch.setenv("MAVQUAD_PEERS", str(tmp_path / "elsewhere"))
    with pytest.raises(ConfigError, match="somebody is not installed: `make bench` brings it"):
        peers.run("somebody", "")


def test_ratios_are_over_the_peers_own_figures(monkeypatch):
    monkeypatch.setattr(bulk.peers, "run", lambda peer, program, *words: [200.0, 400.0, 500.0])
    plain, ratio = bulk._rotorpy(Row("plant + attitude control", "ours", 2.0, "M steps/s"))
    assert plain.value == pytest.approx(400e-6)
    assert "rounds 0.0002 to 0.0005" in plain.note
    assert ratio.value == pytest.approx(5000.0)
    assert "different physics" in ratio.note


def test_growth_says_how_cost_grows():
    rows = growth._table("a task", "ours", "things", [(1, 1.0), (2, 2.0), (4, 8.0)], "s")
    note = "exponent 2.00 between the last two; from the first to the last 2.3 s for each more"
    assert [row.note for row in rows] == ["", "", note]
    assert rows[0].what == "a task, 1 things"


def test_growth_measures_ours_against_every_size():
    for rows, sizes, of in (
        (growth.horizon(0.1), (10, 20, 40, 80), "steps of horizon"),
        (growth.streams(0.1), (1, 4, 16, 64), "further streams"),
        (growth.states(0.1)[:4], (6, 12, 24, 48), "states"),
    ):
        assert [row.what.split(", ")[-1] for row in rows] == [f"{n} {of}" for n in sizes]
        assert all(row.value > 0.0 and row.who.startswith("ours") for row in rows)
        assert "exponent" in rows[-1].note
