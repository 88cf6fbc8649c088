"""The page of a campaign: distributions with intervals, pairs on the same seeds, the worst flights linked; drawn by a browser."""

import json
import math
import re
import shutil
import sqlite3

import numpy as np
import pytest

from tests.oracles import browser
from tools import __main__ as tools_main
from tools import campaign_report
from tools.campaigns.grid import Flight
from tools.campaigns.store import Result, Store

pytestmark = pytest.mark.xdist_group("flights")
SEEDS = range(1, 11)


def _summary(rmse_m, ok=True):
    return {"ok": ok, "failures": [] if ok else ["lost <its> way"], "rmse_m": {"position": rmse_m}, "max_error_m": 3.0 * rmse_m}


@pytest.fixture(scope="session")
def results(tmp_path_factory):
    """Three variants over ten seeds in two scenarios: `good` a third of `pid`'s error, `same` with other noise, one failure."""
    path = tmp_path_factory.mktemp("campaign") / "three.sqlite"
    rng = np.random.default_rng(4)
    with Store(path) as store:
        rows = []
        for case in ("calm", "windy"):
            for seed in SEEDS:
                luck = rng.uniform(0.1, 0.3)  # of the seed: the same for every variant
                for variant, share in (("pid", 1.0), ("good", 0.33), ("same", 1.0)):
                    flight = Flight(case, "px4", variant, seed, (case, variant, str(seed)), {})
                    lost = (case, variant, seed) == ("windy", "same", 7)
                    value = 5.0 if lost else share * luck + rng.normal(0.0, 0.005)
                    rows.append((flight, Result(flight.id, _summary(value, not lost))))
        store.add("udp", rows)
    return path


@pytest.fixture(scope="session")
def page(results, flown, tmp_path_factory):
    """The page, with the run folder of its worst flight kept."""
    worst = Flight("windy", "px4", "same", 7, ("windy", "same", "7"), {}).id
    shutil.copytree(flown[0], results.with_name(f"{results.name}.runs") / worst)
    assert tools_main.main(["report", str(results)]) == 0
    return results.with_suffix(".html")


def test_the_first_screen_says_who_is_better_by_how_much(page):
    lead = page.read_text().split("<section>")[0]
    assert "59 of 60 flights went as they should." in lead
    assert "How we know:" in lead
    said = re.findall(
        r"windy px4: (\w+) against pid ([+-][\d.]+) m position rmse .*?better in (\d+) of 10 seeds: ([\w ]+)\.", lead
    )
    told = {name: (float(median), int(better), verdict) for name, median, better, verdict in said}
    assert told["good"][0] < -0.05
    assert told["good"][1:] == (10, "better")
    assert told["same"][2] == "no clear difference"


def test_the_worst_flight_is_linked_to_its_report_and_can_be_repeated(page):
    text = page.read_text()
    links = re.findall(r'<a href="([^"]+)">([^<]+)</a>', text)
    assert [words for _, words in links] == ["windy px4 same seed 7"]
    assert (page.parent / links[0][0]).read_text().startswith("<!doctype html>")
    assert "mavquad fly windy same 7" in text
    assert "lost &lt;its&gt; way" in text


def test_pairs_and_intervals_are_those_of_the_numbers(results):
    rows = campaign_report.read(results)
    values = {(r["scenario"], r["variant"], r["seed"]): r["rmse_m"] for r in rows}
    found = {(p.case, p.variant): p for p in campaign_report.pairings(rows, ["pid", "good", "same"], "pid", "rmse_m")}
    good = found["calm px4", "good"]
    expected = [values["calm", "good", s] - values["calm", "pid", s] for s in SEEDS]
    np.testing.assert_allclose(good.differences, expected)
    assert good.median == pytest.approx(np.median(expected))
    assert good.low < good.median < good.high < 0.0
    assert good.p == pytest.approx(2.0 / 2**10)  # all ten on one side: the exact signed-rank test
    assert ("calm px4", "pid") not in found


def test_an_interval_of_a_median_covers_it_as_often_as_it_says():
    rng, inside = np.random.default_rng(8), 0
    for _ in range(150):
        _, low, high = campaign_report.interval(rng.normal(2.0, 1.0, 20))
        inside += low <= 2.0 <= high
    assert 0.90 < inside / 150 < 0.99
    assert all(math.isnan(x) for x in campaign_report.interval(np.array([])))


def test_files_that_hold_no_campaign_are_refused(tmp_path, capsys):
    text = tmp_path / "text.sqlite"
    text.write_text("not a database at all, " * 50)
    empty = tmp_path / "empty.sqlite"
    with Store(empty):
        pass
    other = tmp_path / "other.sqlite"
    with sqlite3.connect(other) as db:
        db.execute("CREATE TABLE birds (name TEXT)")
    db.close()
    for path, says in ((text, "no campaign's results"), (empty, "holds no flight yet"), (other, "no such table")):
        assert tools_main.main(["report", str(path)]) == 1
        said = capsys.readouterr().err
        assert says in said
        assert said.count("\n") == 1


def test_a_baseline_that_was_not_flown_is_refused(results, capsys):
    assert tools_main.main(["report", str(results), "--baseline", "mpc"]) == 1
    assert "no variant is called 'mpc'; it holds good, pid, same" in capsys.readouterr().err


def test_the_page_is_small_and_every_figure_is_filled(page):
    text = page.read_text()
    assert len(text.encode()) <= 8e6
    figures = [json.loads(s.replace("<\\/", "</")) for s in re.findall(r'<script type="application/json">(.*?)</script>', text)]
    assert [f["layout"]["title"]["text"] for f in figures][:2] == ["rmse_m", "max_error_m"]
    assert all({t["type"] for t in f["data"]} == {"box"} for f in figures)


@pytest.mark.skipif(browser.BROWSER is None, reason="no chromium on this machine; Debian's package is enough")
@pytest.mark.slow
def test_a_browser_draws_the_campaign_without_an_error(page, tmp_path):
    result = browser.probe(page, tmp_path)
    assert result["seen"] == []
    assert result["drawn"] == result["plots"] >= 4
    assert result["image"] > 5_000
