"""`mavquad paper asmf`: its rows, its names, its report."""

import argparse
import json

import pytest

from mavquad.errors import ConfigError
from tools.papers import asmf


def run(capsys, *words):
    parser = argparse.ArgumentParser()
    asmf.add_arguments(parser)
    assert asmf.run(parser.parse_args([*words, "--processes", "1"])) == 0
    return capsys.readouterr().out


def test_rows_carry_scenario_config_seed_metric_unit_and_medians(capsys):
    out = json.loads(run(capsys, "--scenario", "quad-hover", "--config", "PI,ASMF", "--seeds", "3,5", "--json"))
    assert out["paper"] == "asmf"
    assert {(r["scenario"], r["config"], r["seed"]) for r in out["rows"]} == {
        ("quad-hover", config, seed) for config in ("PI", "ASMF") for seed in (3, 5, None)
    }
    found = {r["metric"]: r for r in out["rows"] if r["config"] == "ASMF" and r["seed"] is None}
    assert {"rms_m", "max_m", "vert_rms", "inside_pct", "half_width", "empty", "inflations"} <= found.keys()
    assert found["rms_m"]["stat"] == "median"
    assert found["rms_m"]["unit"] == "m"
    assert found["inside_pct"]["value"] == 100.0


def test_a_table_shows_one_line_per_scenario_and_config(capsys):
    out = run(capsys, "--scenario", "quad-line12", "--config", "PD,KF", "--seeds", "7")
    assert len(out.splitlines()) == 3
    assert "quad-line12" in out


def test_the_three_phases_of_the_line_come_from_one_flight():
    assert asmf.plan("heli-hover,heli-leg1,heli-leg2", "active", [1, 2]) == [
        ("heli-line", "active", 1),
        ("heli-line", "active", 2),
    ]


def test_names_that_are_not_known_are_refused():
    with pytest.raises(ConfigError, match="--scenario 'quad-square' is not known; expected some of: guarantee"):
        asmf.plan("quad-square", "", [1])
    with pytest.raises(ConfigError, match="--config 'PID' is not known"):
        asmf.plan("", "PID", [1])
    with pytest.raises(ConfigError, match="none of these is flown in heli-ellipse"):
        asmf.plan("heli-ellipse", "INDI", [1])


@pytest.mark.slow
def test_the_report_is_one_page_with_the_paper_s_figures(capsys, tmp_path):
    page = tmp_path / "asmf.html"
    run(capsys, "--scenario", "quad-ellipse", "--seeds", "1", "--report", str(page))
    text = page.read_text(encoding="utf-8")
    assert all(f"Figure {n}" in text for n in range(9, 19))
    assert "Guaranteed while the stated noise and rate bounds hold" in text
    assert len(text) < 8e6
