import json

import pytest

from mavquad.errors import ConfigError
from tools.papers import common


@pytest.mark.parametrize(("text", "seeds"), [("1-3", [1, 2, 3]), ("101,7", [101, 7]), ("1-2,2-4", [1, 2, 3, 4]), (" 5 ", [5])])
def test_seeds_are_read_as_written(text, seeds):
    assert common.parse_seeds(text) == seeds


@pytest.mark.parametrize("text", ["", "a", "1-b", "5-1", "1,,2"])
def test_bad_seeds_are_refused_with_what_to_write(text):
    with pytest.raises(ConfigError, match="write"):
        common.parse_seeds(text)


def test_medians_go_by_scenario_config_and_metric_and_say_so():
    rows = [
        common.row("s", c, seed, "m", "m", value)
        for c, seed, value in [("a", 1, 3.0), ("a", 2, 1.0), ("a", 3, 9.0), ("b", 1, 7.0)]
    ]
    found = common.medians([*rows, common.row("s", "a", None, "m", "m", 100.0, "mean")])
    assert [(one["config"], one["value"], one["seed"], one["stat"]) for one in found] == [
        ("a", 3.0, None, "median"),
        ("b", 7.0, None, "median"),
    ]


def test_process_map_keeps_the_order_in_one_process_and_in_two():
    assert list(common.process_map(abs, [-3, 2, -1], processes=1)) == [3, 2, 1]
    assert list(common.process_map(abs, [-3, 2, -1], processes=2)) == [3, 2, 1]


def test_json_is_one_object_with_the_rows(capsys):
    common.print_json("x", [common.row("s", "c", None, "m", "m", 1.5, "median")])
    found = json.loads(capsys.readouterr().out)
    assert found["paper"] == "x"
    assert found["rows"][0]["stat"] == "median"
