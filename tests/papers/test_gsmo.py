"""The observer's note, section 9: what an implementation must show, evaluated at every tick."""

import json

import numpy as np
import pytest

from tools.papers import gsmo
from tools.papers.geometric import orders, recording, setup, tables, tuned, words
from tools.papers.geometric.runs import run
from tools.papers.geometric.setup import IDENTITY, ZERO, after, rms

CONFIGS = setup.configurations()
SEEDS = (1, 2, 3)


def figures(rows, **more):
    """{metric: value} of the rows for all seeds."""
    return {r["metric"]: r["value"] for r in rows if r["seed"] is None and all(r.get(k) == v for k, v in more.items())}


def test_integrators_have_their_order_and_only_order_4_sees_the_bracket():
    rows = orders.integrator_order()
    slopes = {r["config"]: r["value"] for r in rows if r["metric"] == "slope"}
    expected = {"RKMK 1 Euler": 1, "RKMK 2 midpoint": 2, "RKMK 2 Heun": 2, "RKMK 4": 4, "RKMK 4, wrong bracket sign": 2}
    expected |= {"RKMK 4, no bracket": 2, "RKMK 4, no quadratic term": 2, "Euler + renorm": 1, "RK4 + renorm": 4}
    for name, order in expected.items():
        assert slopes[name] == pytest.approx(order, abs=0.1), name
    assert next(r["value"] for r in rows if r["config"] == "RKMK 4" and r.get("h_s") == 0.025) <= 2e-8


@pytest.mark.parametrize(("order", "name"), [(1, "RKMK 1 Euler"), (2, "RKMK 2 midpoint"), (4, "RKMK 4")])
def test_the_steps_of_the_observers_are_those_of_the_tableaus(order, name):
    np.testing.assert_allclose(orders.ours(order, 0.05, 100), orders.end_attitude(name, 0.05), atol=1e-13)


def test_the_norm_is_kept_for_a_million_steps():
    for row in orders.norm_drift():
        if row["config"] in ("Cayley", "exp"):
            assert row["value"] <= 1e-12, row


@pytest.mark.parametrize(("name", "expected"), [("G1", 0.0566), ("G2", 0.0566), ("G3", 0.0354), ("G4", 0.0177)])
def test_exact_start_chatters_as_much_as_h_k2_over_root_2(name, expected):
    found = figures(tables.exact_start(CONFIGS[name]))
    assert found["raw_rms"] == pytest.approx(expected, rel=0.05)
    assert found["att_rms_deg"] <= 3.0  # the sign errors that only the attitude shows
    assert found["norm_drift"] <= 1e-13


@pytest.mark.parametrize("name", ["G5", "G7", "G7b", "G8", "G9", "B2a", "B2b"])
def test_exact_start_without_chatter(name):
    assert figures(tables.exact_start(CONFIGS[name]))["raw_rms"] <= 5e-5


def test_general_start():
    for name in ("G1", "G2"):
        found = figures(tables.general_start(CONFIGS[name]))
        assert 0.045 <= found["raw_rms"] <= 0.060
        assert max(found["zero_phase_rms"], found["mff_rms"]) <= 0.025
        assert found["t_170deg"] <= 2.3
        assert found["t_3rads"] <= 1.7
    found = figures(tables.general_start(CONFIGS["G7"]))
    assert found["t_170deg"] <= 0.6
    assert found["t_3rads"] <= 0.3


def test_unknown_torque():
    for name, bound in (("G7", 0.045), ("G8", 0.012), ("G9", 0.001), ("online", 0.0005)):
        found = figures(tables.noise(CONFIGS[name], (1,), (0.0,)), torque="unknown")
        assert found["raw_rms"] <= bound, name
    third = setup.implicit("G9, L = 2", "implicit-third-order", L=2.0)
    rows = tables.noise(third, SEEDS, (0.1, 0.5))
    assert figures(rows, torque="unknown", noise_deg=0.1)["raw_rms"] <= 0.020
    assert figures(rows, torque="unknown", noise_deg=0.5)["raw_rms"] <= 0.050


@pytest.mark.parametrize("name", ["G1", "G2", "G6", "G7", "G8", "G9", "B1b", "B2b", "online"])
def test_a_random_sign_of_every_sample_changes_nothing(name):
    source = setup.truth()
    plain, _ = run(CONFIGS[name], setup.stimulus(source), IDENTITY, ZERO)
    flipped, _ = run(CONFIGS[name], setup.stimulus(source, seed=3, flips=True), IDENTITY, ZERO)
    assert np.abs(plain - flipped).max() <= 1e-9


def test_half_of_the_samples_dropped_changes_the_relay_by_less_than_5_percent():
    source = setup.truth()
    keep = after(source, 1.0)
    plain, dropped = (
        rms((run(CONFIGS["G2"], setup.stimulus(source, seed=5, drop=d), IDENTITY, ZERO)[0] - source.w)[keep]) for d in (0, 0.5)
    )
    assert dropped == pytest.approx(plain, rel=0.05)


@pytest.mark.parametrize(("h", "spin"), orders.SPINS)
def test_what_the_geometric_map_buys_in_a_spin(h, spin):
    for name in orders.MAPS:
        assert orders.spin_bias(name, h, spin) == pytest.approx(orders.spin_theory(name, h, spin), rel=0.01, abs=1e-5)


def test_the_long_way_round_is_never_taken():
    source = setup.truth()
    start = tuple(-x for x in tables.turned(np.radians(170.0) * tables.AXIS))
    for name in ("G1", "G2", "G7", "G9", "B1a"):
        _, q = run(CONFIGS[name], setup.stimulus(source), start, ZERO)
        assert setup.attitude_error_deg(source, q).max() <= 170.0 + 0.5, name


def test_the_bank_meets_its_acceptance_on_the_papers_experiment():
    third = {0.1: 0.0173, 0.5: 0.0451, 1.0: 0.0677}
    rows = tables.noise(CONFIGS["online"], range(1, 9), (0.0, *third))
    assert figures(rows, torque="unknown", noise_deg=0.0)["raw_rms"] <= 0.0005
    for noise_deg, bound in third.items():
        assert figures(rows, torque="unknown", noise_deg=noise_deg)["raw_rms"] <= bound
        worst = max(
            r["value"]
            for r in rows
            if r["seed"] is not None and (r["metric"], r["torque"], r["noise_deg"]) == ("raw_rms", "unknown", noise_deg)
        )
        assert worst <= 1.1 * bound


def test_the_bank_meets_its_acceptance_on_a_real_recording(recordings):
    record = recording.read(recordings / recording.WHOLE)
    rows = recording.judged(record)
    for axis in "xyz":
        ours, line = (words.value(rows, "recording", name, f"raw_rms_{axis}") for name in ("online", "extrapolated difference"))
        assert ours <= line, axis


def test_the_command_gives_every_scenario_as_rows_and_says_what_holds(capsys):
    words_of = ["--seeds", "1", "--processes", "1", "--json"]
    import argparse

    parser = argparse.ArgumentParser()
    gsmo.add_arguments(parser)
    assert gsmo.run(parser.parse_args([*words_of, "--scenario", "8.1", "--scenario", "gap", "--config", "G2"])) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert {r["scenario"] for r in rows} == {"8.1", "gap"}
    assert {r["config"] for r in rows} == {"G2"}
    kinds = {job[0] for job in gsmo.plan(gsmo.SCENARIOS, None, [1], recording.find())}
    assert kinds >= {"8.1", "8.2", "8.3", "8.4", "8.5", "tumble", "gap", "tuned"}
    text = words.tables(rows) + "\n".join(words.claims(rows))
    assert "G2" in text
    assert "The observer tracks the rates well with the torque known: holds" in text
    assert set(tuned.METHODS) >= {"MEKF 9 states", "difference + Butterworth"}
