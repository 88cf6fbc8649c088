"""One short flight, flown once for all tests that look at what a flight leaves behind."""

import json

import pytest

from tools import __main__ as tools_main

SHORT = ["hover", "--seed", "7", "--set", "path.duration_s=3", "--set", "flight.takeoff_m=2", "--no-report"]


@pytest.fixture(scope="session")
def flown(tmp_path_factory):
    """A short flight's folder and its summary."""
    run = tmp_path_factory.mktemp("flown") / "run"
    assert tools_main.main(["fly", *SHORT, "--run", str(run), "--json"]) == 0
    return run, json.loads((run / "summary.json").read_text())
