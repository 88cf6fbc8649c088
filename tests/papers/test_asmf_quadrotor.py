"""Design note of the ASMF, sections 8 and 10: the quadrotor companion, no ramp. Seeds of the note and others."""

import math

import numpy as np
import pytest

from tools.papers.active import quadrotor, surroundings

DT_S = quadrotor.DT_S
HOVER = surroundings.hover(60.0, DT_S)
LINE_12 = surroundings.line(12.0, math.radians(135.0), DT_S)
ELLIPSE = surroundings.ellipse(8.0, 60.0, DT_S)
SEEDS = (1, 2, 17, 101, 311)


def values(config, case, seed):
    return {name: value for name, (value, _) in quadrotor.metrics(quadrotor.fly(config, case, seed)).items()}


@pytest.mark.parametrize(
    ("path", "lead_s", "rms_m", "max_m"),
    [(HOVER, 0.0, 0.04, 0.10), (LINE_12, 0.0, 0.20, 0.90), (ELLIPSE, 0.15, 0.18, 0.32), (ELLIPSE, 0.0, 0.24, 0.40)],
    ids=["hover", "line12", "ellipse-lead", "ellipse"],
)
def test_the_corrected_quadrotor_reaches_the_note_and_beats_pd_and_pi(path, lead_s, rms_m, max_m):
    case = quadrotor.Case(path=path, lead_s=lead_s)
    for seed in SEEDS:
        asmf, pd, pi = (values(config, case, seed) for config in ("ASMF", "PD", "PI"))
        assert asmf["rms_m"] <= rms_m
        assert asmf["max_m"] <= max_m
        assert pd["rms_m"] >= 8.0 * asmf["rms_m"]
        assert pi["rms_m"] >= 6.0 * asmf["rms_m"]
        assert asmf["inside_pct"] == asmf["published_inside_pct"] == 100.0
        assert asmf["empty"] == asmf["inflations"] == 0


def test_spikes_dropouts_and_a_lost_accelerometer_cost_little():
    for seed in SEEDS:
        spikes = values("ASMF", quadrotor.Case(path=ELLIPSE, spikes=0.02), seed)
        assert spikes["rms_m"] <= 0.25
        assert spikes["inflations"] == 0
        assert spikes["empty"] > 20  # they are seen
        assert spikes["published_inside_pct"] >= 99.0
        dropout = values("ASMF", quadrotor.Case(path=ELLIPSE, dropout_s=(20.0, 21.0)), seed)
        assert dropout["rms_m"] <= 0.24
        assert dropout["inside_pct"] == 100.0
        blind = values("ASMF", quadrotor.Case(path=ELLIPSE, imu=False), seed)
        assert blind["rms_m"] <= 0.32
        assert blind["half_width"] > 2.0
        assert blind["inside_pct"] == 100.0


def test_the_published_interval_is_several_times_narrower_than_the_ellipsoid():
    found = values("ASMF", quadrotor.Case(path=HOVER), 23)
    assert found["published_half_width"] <= 0.35
    assert found["published_half_width"] < 0.3 * found["half_width"]


def test_a_random_corner_of_the_bounds_adds_chatter_and_the_middle_of_the_interval_does_not():
    centre, minmax, vertex = (
        values("ASMF", quadrotor.Case(path=LINE_12, mode=mode), 4) for mode in ("centre", "minmax", "vertex")
    )
    assert vertex["vert_rms"] > 3.0 * centre["vert_rms"]
    assert minmax["rms_m"] < 1.2 * centre["rms_m"]


def test_the_same_seed_flies_the_same_flight():
    case = quadrotor.Case(path=HOVER)
    np.testing.assert_array_equal(quadrotor.fly("ASMF", case, 5).p_m, quadrotor.fly("ASMF", case, 5).p_m)
