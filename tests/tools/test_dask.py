"""A campaign on a dask cluster of separate worker processes, one of which is killed in mid-run; slow: the cluster alone takes seconds."""

import contextlib
import json
import os
import signal
import sqlite3
import threading
import time
from collections import Counter

import pytest

from tools.__main__ import main

distributed = pytest.importorskip("distributed")
FILE = """
about = "many short flights"
seeds = "1-12"
set = ["path.duration_s=3", "companion.settle_s=0.5"]
[[scenario]]
name = "hover"
[[variant]]
name = "pid"
controller = "pid"
[[variant]]
name = "adrc"
controller = "adrc"
"""


def _rows(path):
    if not path.exists():
        return []
    with contextlib.closing(sqlite3.connect(path, timeout=10)) as db:
        try:
            return [row[0] for row in db.execute("SELECT id FROM flights")]
        except sqlite3.OperationalError:
            return []


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of a cluster whose worker dies
def test_a_worker_killed_in_mid_run_costs_nothing_and_nothing_comes_twice(tmp_path, capsys):
    file, out = tmp_path / "many.toml", tmp_path / "many.sqlite"
    file.write_text(FILE)
    killed = []

    def kill(cluster):
        while len(_rows(out)) < 2:
            time.sleep(0.01)
        victim = next(iter(cluster.workers.values()))
        killed.append(victim.process.process.pid)
        os.kill(killed[0], signal.SIGKILL)

    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
        thread = threading.Thread(target=kill, args=(cluster,), daemon=True)
        thread.start()
        assert main(["campaign", str(file), "--out", str(out), "--dask", cluster.scheduler_address, "--json"]) == 0
        thread.join(10)
    told = json.loads(capsys.readouterr().out)
    assert killed
    assert len(told["rows"]) == 24
    assert [row["problem"] for row in told["rows"]] == [""] * 24
    assert set(Counter(_rows(out)).values()) == {1}
    alone = tmp_path / "alone.sqlite"  # the same flights here: the same scores to the last bit
    assert main(["campaign", str(file), "--out", str(alone), "--seeds", "1-3", "--jobs", "1", "--json"]) == 0
    here = json.loads(capsys.readouterr().out)["rows"]
    assert [row["rmse_m"] for row in here] == [row["rmse_m"] for row in told["rows"][:6]]


def test_an_address_where_nobody_listens_is_said(tmp_path, capsys):
    file = tmp_path / "one.toml"
    file.write_text(FILE.replace("1-12", "1"))
    assert main(["campaign", str(file), "--out", str(tmp_path / "x.sqlite"), "--dask", "nonsense://1"]) == 1
    assert "no scheduler answers there" in capsys.readouterr().err.splitlines()[-1]
