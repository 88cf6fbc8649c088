"""Campaigns: the file, the draws, rows that survive being killed, paired statistics, workers that are killed; two real flights."""

import contextlib
import json
import os
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavquad.errors import ConfigError, FlightError, LogError
from tools import campaign as command
from tools import scenarios
from tools.__main__ import main
from tools.campaigns import grid, over_udp, table, workers
from tools.campaigns.draw import draw
from tools.campaigns.store import SCORES, Result, Store

ROOT = Path(__file__).resolve().parents[2]
FILE = """
about = "two controllers, hovering"
seeds = "7"
baseline = "pd"
metrics = ["rmse_m", "misses"]
set = ["path.duration_s=2", "flight.takeoff_m=1", "flight.score_from_s=1"]
[[scenario]]
name = "hover"
[[variant]]
name = "pd"
controller = "pd"
[[variant]]
name = "pid"
controller = "pid"
[draw]
"vehicle.mass" = { uniform = [-5, 5], percent = true }
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "two.toml"
    path.write_text(FILE)
    return path


@pytest.mark.parametrize("name", grid.names())
def test_every_campaign_that_comes_along_can_be_flown(name):
    flights = list(grid.flights(grid.load(name, "3")))
    assert len({flight.id for flight in flights}) == len(flights)
    command._check_metrics(grid.load(name))
    for flight in flights:
        args, resolved = over_udp.resolve(flight.words)
        assert (args.seed, resolved.sitl.seed) == (3, 3)
        assert flight.command.startswith("mavquad fly ")


def test_the_owners_questions_are_the_campaigns():
    assert set(grid.names()) >= {"reference", "iadrc", "eskf-mpc", "asmf"}
    iadrc = list(grid.flights(grid.load("iadrc")))
    assert len(iadrc) == 2 * 2 * 4 * 5
    _, one = over_udp.resolve(iadrc[0].words)
    assert (one.sitl.wind.mean_m_s, one.sitl.wind.w20_m_s, one.sitl.overrides[0]) == (4, 6, "body.mass_kg=+20%")
    _, mpc = over_udp.resolve(next(grid.flights(grid.load("eskf-mpc"))).words)
    assert (mpc.sitl.wind.rotor_model, mpc.sitl.link.delay_ms, mpc.sitl.link.jitter_ms) == ("G", 35, 10)
    gusts = over_udp.resolve(next(grid.flights(grid.load("asmf"))).words)[1].sitl.wind.gusts
    assert all(3.0 <= gust.speed_m_s <= 6.0 for gust in gusts)
    assert len(gusts) == 6


def test_variants_meet_the_same_draws_and_other_seeds_other_ones(file):
    one, two, other, _ = grid.flights(grid.load(str(file), "7,8"))
    assert one.drawn == two.drawn != other.drawn
    assert one.words[one.words.index("--set") + 1 :][-1] == f"vehicle.mass={one.drawn['vehicle.mass']}"
    assert [f.id for f in grid.flights(grid.load(str(file), "8,7"))][2:] == [one.id, two.id]


@given(st.integers(0, 2**31), st.floats(-1e6, 1e6), st.floats(0.0, 1e6))
def test_a_draw_is_inside_and_the_same_again(seed, low, width):
    spec = {"uniform": [low, low + width], "digits": 17}
    x = draw("a", spec, seed)
    assert low <= x <= low + width
    assert draw("a", spec, seed) == x


def test_draws_have_the_distribution_they_say():
    normal = [draw("n", {"normal": [2.0, 0.5], "low": 1.5}, i) for i in range(2000)]
    assert min(normal) >= 1.5
    assert 2.1 < sum(normal) / 2000 < 2.2  # of a normal cut at -1 sigma: 2 + 0.5 * 0.288
    logs = [draw("l", {"log_uniform": [0.01, 100.0]}, i) for i in range(2000)]
    assert 0.45 < sum(x < 1.0 for x in logs) / 2000 < 0.55
    kinds = [draw("c", [{"kind": {"choice": ["a", "b"]}, "probability": 0.25}], i) for i in range(2000)]
    assert 0.2 < sum(map(len, kinds)) / 2000 < 0.3
    assert {k[0]["kind"] for k in kinds if k} == {"a", "b"}
    assert draw("p", {"uniform": [5, 5], "percent": True}, 1) == "+5%"
    assert draw("x", {"uniform": [0, 1]}, 1) != draw("y", {"uniform": [0, 1]}, 1)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (FILE.replace('name = "pid"', 'name = "pd"'), "none twice"),
        (FILE.replace('baseline = "pd"', 'baseline = "pdd"'), "expected a variant, pd, pid"),
        (FILE.replace("rmse_m", "rmsem"), "'rmsem' is no column of the results; known: rmse_m"),
        (FILE.replace("uniform", "unifrom"), "unifrom"),
        (FILE.replace("[-5, 5]", "[5, -5]"), "expected low <= high"),
        (FILE.replace('"7"', '"7-x"'), "'7-x' is not a number or a range"),
        (FILE.replace('controller = "pid"', 'controller = "pidd"'), "pidd"),
        (FILE.replace("about", "abuot"), 'did you mean "about"'),
        (FILE.replace('name = "hover"', 'name = "hovver"'), "no scenario is called 'hovver'"),
    ],
)
def test_a_mistake_is_one_line_before_anything_flies(text, says, tmp_path, capsys):
    path = tmp_path / "wrong.toml"
    path.write_text(text)
    assert main(["campaign", str(path), "--over-udp", "--out", str(tmp_path / "x.sqlite")]) == 1
    shown = capsys.readouterr().err.strip()
    assert says in shown
    assert shown.count("\n") == 0


def test_rows_are_there_whole_or_not_at_all_and_never_twice(file, tmp_path):
    flights = list(grid.flights(grid.load(str(file), "1-3")))
    summary = {"rmse_m": {"position": 0.1}, "solver": {"qp_p99_s": 0.002}, "ok": True, "failures": []}
    with Store(tmp_path / "s.sqlite") as store:
        store.add("udp", [(flights[0], Result(flights[0].id, summary))])
        store.add("udp", [(flights[0], Result(flights[0].id, {**summary, "rmse_m": {"position": 9.9}}))])
        with pytest.raises(AttributeError):
            store.add("udp", [(flights[1], Result(flights[1].id, summary)), (flights[2], None)])
    with Store(tmp_path / "s.sqlite") as store:
        assert store.finished("udp") == {flights[0].id}
        assert store.finished("other") == set()
        (row,) = store.rows("udp", flights)
    assert (row["rmse_m"], row["qp_p99_us"], row["ok"], row["inside_pct"]) == (0.1, 2000.0, 1, None)
    assert row["command"] == flights[0].command
    (tmp_path / "text.sqlite").write_text("this is no database, however long it is read" * 50)
    with pytest.raises(LogError, match="choose another --out"):
        Store(tmp_path / "text.sqlite")


def test_the_table_pairs_by_seed_and_says_what_is_missing(file):
    campaign = grid.load(str(file), "1-3")
    rows = []
    for flight in grid.flights(campaign):
        value = {"pd": 1.0, "pid": 0.5}[flight.variant] * flight.seed
        ok = flight.seed < 3
        rows.append({**dict.fromkeys(SCORES), **flight._asdict(), "rmse_m": value if ok else None, "misses": 0, "ok": ok})
    pd, pid, *_ = table.cells(campaign, rows)
    assert (pd["median"], pd["min"], pd["max"], pd["ratio"]) == (1.5, 1.0, 2.0, 1.0)
    assert (pid["ratio"], pid["better"], pid["pairs"], pid["flown"], pid["ok"], pid["known"]) == (0.5, 2, 2, 3, 2, 2)
    lines = table.text(campaign, table.cells(campaign, rows)).splitlines()
    assert lines[1] == "pd      1.50 (1.00 - 2.00) 1 not ok"
    assert lines[2] == "pid     0.750 (0.500 - 1.00) x0.50 1 not ok"


def _work(number, folder, deadly):
    """A worker's task: leaves a mark, and the first to meet `deadly` is killed over it."""
    mark = Path(folder) / f"{number}-{os.getpid()}"
    mark.touch()
    if number == deadly and len(list(Path(folder).glob(f"{number}-*"))) == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


def _fatal(number):
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_killed_worker_loses_nothing_and_a_deadly_flight_is_given_up(tmp_path):
    chunks = [[i] for i in range(5)]
    found = list(workers.run(_work, chunks, lambda chunk: (chunk[0], str(tmp_path), 2), 2))
    assert sorted(answer for _, answer in found) == [0, 1, 4, 9, 16]
    assert sorted(chunk[0] for chunk, _ in found) == [0, 1, 2, 3, 4]
    with pytest.raises(FlightError, match="3 workers were killed over the same flights: 7"):
        list(workers.run(_fatal, [[7]], lambda chunk: (chunk[0],), 1))


@pytest.mark.xdist_group("flights")
def test_killed_in_mid_flight_it_goes_on_without_losing_or_repeating_one(file, tmp_path, capsys):
    out = tmp_path / "two.sqlite"
    words = ["campaign", str(file), "--over-udp", "--out", str(out), "--jobs", "1"]
    runs = tmp_path / "two.sqlite.runs"
    with subprocess.Popen([sys.executable, "-m", "tools", *words], cwd=ROOT, stderr=subprocess.DEVNULL) as child:
        while not _rows(out) or not any(runs.glob("*/flight.tlog")):
            assert child.poll() is None
            time.sleep(0.02)
        child.send_signal(signal.SIGKILL)
    before = _rows(out)
    assert len(before) == 1
    (cut,) = runs.iterdir()
    deadline = time.monotonic() + 60.0
    while _alive(str(cut)):
        assert time.monotonic() < deadline
        time.sleep(0.05)

    assert main([*words, "--json"]) == 0
    shown = capsys.readouterr()
    assert "1 of 2 flights are there already" in shown.err
    told = json.loads(shown.out)
    assert told["speed"]["flights"] == 1
    assert _rows(out)[:1] == before
    assert not runs.exists()
    pd, pid = told["rows"]
    assert (pd["variant"], pid["variant"], pd["ok"], pid["ok"]) == ("pd", "pid", 1, 1)
    assert pd["rmse_m"] != pid["rmse_m"]

    assert main(words) == 0  # nothing left to fly: the table alone
    assert "2 flights in" in capsys.readouterr().out
    repeat = pid["command"].split()[1:]
    assert main([*repeat, "--run", str(tmp_path / "again"), "--no-report", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rmse_m"]["position"] == pid["rmse_m"]


def test_a_flight_that_cannot_be_flown_is_a_row_that_says_why(tmp_path):
    (tmp_path / "file").touch()
    (result,) = over_udp.fly_chunk([("hover", "--seed", "1")], ["x"], str(tmp_path / "file"), "none")
    assert (result.id, result.summary) == ("x", {})
    assert "cannot be written" in result.problem


def test_faults_can_be_set_as_a_whole():
    changed = scenarios.load("hover", ['faults=[{kind = "motor", motor = 2, effectiveness = 0.8, t_s = 9.0}]'])
    assert (changed.faults[0].motor, changed.faults[0].effectiveness) == (2, 0.8)
    with pytest.raises(ConfigError, match="kind"):
        scenarios.load("hover", ['faults=[{kind = "motr", t_s = 9.0}]'])


def test_without_a_terminal_progress_is_a_line(capsys, file):
    flights = list(grid.flights(grid.load(str(file))))
    progress = command.Progress(2, 0)
    progress.begin()
    progress.flown(flights[:1], [Result("a", {})])
    progress.flown(flights[1:], [Result("b", {"rmse_m": {"position": 0.25}})])
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("2 of 2 flights, ")
    assert line.endswith("hover pid seed 7: rmse 0.250 m")


def _rows(path):
    if not path.exists():
        return []
    with contextlib.closing(sqlite3.connect(path, timeout=10)) as db:
        try:
            return db.execute("SELECT * FROM flights ORDER BY rowid").fetchall()
        except sqlite3.OperationalError:  # no table yet
            return []


def _alive(text):
    """Processes that name this folder."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if text.encode() in path.read_bytes():
                found.append(path.parent.name)
        except OSError:
            continue
    return found
