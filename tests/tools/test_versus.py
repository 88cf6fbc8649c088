"""Two flights beside each other: the page, the sentence, and what is asked of `fly` for each side."""

import argparse
import json
import re

import pytest

from mavquad.errors import ConfigError
from tools import versus

pytestmark = pytest.mark.xdist_group("flights")


def options(*words):
    parser = argparse.ArgumentParser()
    versus.add_arguments(parser)
    return parser.parse_args(words)


def test_the_page_shows_both_flights_on_one_time_axis_and_links_their_reports(flown, tmp_path):
    run, summary = flown
    (tmp_path / "left").symlink_to(run)
    (tmp_path / "right").symlink_to(run)
    args = options("hover", "--left", "pd", "--right", "eskf-mpc+asmf")
    text = (tmp_path / versus.draw(tmp_path, args).name).read_text()
    figures = [json.loads(s.replace("<\\/", "</")) for s in re.findall(r'<script type="application/json">(.*?)</script>', text)]
    error = next(f for f in figures if "True position less wanted" in f["layout"]["title"]["text"])
    assert [trace["name"] for trace in error["data"]] == ["pd", "eskf-mpc+asmf"]
    assert 'href="left/report.html"' in text
    assert 'href="right/report.html"' in text
    assert text.count(summary["command"]) == 2
    assert len(text.encode()) < 8e6


@pytest.mark.parametrize(("left", "right", "words"), [(0.12, 0.03, "4.0 times nearer"), (0.03, 0.12, "4.0 times further from")])
def test_the_sentence_says_which_is_nearer(left, right, words):
    results = [{"rmse_m": {"position": x}} for x in (left, right)]
    assert words in versus.verdict(results, options())


@pytest.mark.parametrize("side", ["--left", "--right"])
def test_a_side_that_does_not_exist_is_refused_before_anything_flies(tmp_path, side):
    with pytest.raises(ConfigError, match="mpcc"):
        versus.run(options(side, "mpcc", "--run", str(tmp_path / "run")))
    assert not (tmp_path / "run").exists()


def test_a_change_that_only_the_right_side_refuses_is_known_before_the_left_one_flies(tmp_path):
    with pytest.raises(ConfigError, match="horizn"):
        versus.run(options("hover", "--set", "eskf-mpc.horizn=3", "--run", str(tmp_path / "run")))
    assert not (tmp_path / "run").exists()
