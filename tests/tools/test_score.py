"""Scores against truth: on traces and truths whose error is known."""

import math

import numpy as np
import pytest

from mavquad import wire
from mavquad.errors import LogError
from mavquad.link import tlog
from mavquad.link.columns import Log
from tools import score
from tools.trace import Trace

ENGAGED = 4.0


def _flight(error_m=(0.3, 0.0, -0.4), n=2000):
    """A trace at 125 Hz and truth every 10 ms, the vehicle off its path by a constant; engaged from 2 s on."""
    t_us = 8_000 * np.arange(n)
    t = 1e-6 * t_us
    ref = np.column_stack([np.sin(t), 0.5 * t, np.full(n, -5.0)])
    w = np.column_stack([0.1 * t, np.zeros(n), np.ones(n)])
    rows = np.column_stack([t_us, np.where(t >= 2.0, ENGAGED, 3.0), ref, w + np.array([0.01, 0.0, -0.02])])
    names = ("t_us", "state", "ref_p_n", "ref_p_e", "ref_p_d", "gsmo w_x", "gsmo w_y", "gsmo w_z")
    true_us = 10_000 * np.arange(round(1.1 * n))
    at = 1e-6 * true_us
    p = np.column_stack([np.sin(at), 0.5 * at, np.full(len(at), -5.0)]) + error_m
    omega = np.column_stack([0.1 * at, np.zeros(len(at)), np.ones(len(at))])
    return Trace(names, rows), score.Truth(true_us, p, np.zeros((len(at), 4)), omega, {})


def test_a_constant_error_is_its_own_rmse_and_largest_error():
    trace, true = _flight()
    use = score.scored(trace, ENGAGED, 3.0, 10.0)
    scores = score.position_scores(score.position_error(Trace(trace.names, trace.rows[use]), true))
    assert scores["rmse_m"]["n"] == pytest.approx(0.3, abs=1e-4)  # truth is interpolated over 10 ms of a sine
    assert scores["rmse_m"]["e"] == pytest.approx(0.0, abs=1e-9)
    assert scores["rmse_m"]["position"] == pytest.approx(0.5, abs=1e-4)
    assert scores["max_error_m"] == pytest.approx(0.5, abs=1e-4)


def test_scored_is_the_engaged_part_between_the_given_seconds():
    trace, _ = _flight()
    use = score.scored(trace, ENGAGED, 3.0, 10.0)
    t_s = 1e-6 * trace.column("t_us")[use]
    assert (t_s[0], t_s[-1]) == (pytest.approx(5.0), pytest.approx(12.0))
    assert score.engaged_us(trace, ENGAGED) == 2_000_000
    assert not score.scored(trace, 5.0, 3.0, 10.0).any()


def test_rates_are_scored_per_axis_and_beside_the_gyro():
    trace, true = _flight()
    use = score.scored(trace, ENGAGED, 3.0, 10.0)
    gyro = np.zeros(3000, [("time_usec", "<u8"), ("xgyro", "<f4"), ("ygyro", "<f4"), ("zgyro", "<f4")])
    gyro["time_usec"] = 4_000 * np.arange(3000)
    gyro["xgyro"] = 0.1 * 4e-3 * np.arange(3000) + 0.5
    gyro["zgyro"] = 1.0
    scores = score.rate_scores(trace, true, use, gyro)
    np.testing.assert_allclose(scores["gsmo"], [0.01, 0.0, 0.02], atol=1e-9)
    np.testing.assert_allclose(scores["gyro"], [0.5, 0.0, 0.0], atol=1e-6)
    assert score.rate_scores(trace, true, np.zeros(len(trace.rows), bool), gyro) == {}


def test_no_path_or_no_row_has_no_score():
    nothing = score.position_scores(np.empty((0, 3)))
    assert math.isnan(nothing["max_error_m"])
    assert math.isnan(score.position_scores(np.full((5, 3), np.nan))["rmse_m"]["position"])


def _log(path, frames):
    with tlog.Writer(path) as writer:
        for t, raw in frames:
            writer.write(t, raw)
    return Log(path)


def test_lost_messages_are_the_gaps_in_each_senders_sequence(tmp_path):
    def beat(seq, component=1):
        return wire.encode("HEARTBEAT", (2, 12, 0, 0, 4, 3), seq=seq, system=1, component=component)

    def attitude(seq):
        return wire.encode("ATTITUDE", (1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), seq=seq, system=1, component=1)

    frames = [beat(253), attitude(254), attitude(255), beat(2), attitude(3), beat(9, 191), beat(10, 191), attitude(8)]
    log = _log(tmp_path / "a.tlog", [(i, raw) for i, raw in enumerate(frames)])
    assert score.messages_lost(log) == 2 + 4  # 0, 1 and 4..7
    assert score.messages_lost(log, {(1, 191)}) == 0


def test_truth_is_read_by_its_own_stamps_and_its_absence_is_said(tmp_path):
    frames = []
    for i in range(5):
        t = 8_000 * i
        fields = (
            t,
            1,
            12,
            1.0 * i,
            0.0,
            -5.0,
            (1.0, 0.0, 0.0, 0.0),
            0.0,
            0.0,
            0.0,
            0.1,
            0.2,
            0.3,
            (0.0,) * 21,
            (0.0,) * 21,
            0,
            0,
            0,
        )
        frames.append((t, wire.encode("ODOMETRY", fields, seq=i, system=1, component=25)))
        data = (0.1 * i, *(0.0,) * 57)
        frames.append((t, wire.encode("DEBUG_FLOAT_ARRAY", (t, "truth", 1, data), seq=i, system=1, component=25)))
        frames.append((t, wire.encode("DEBUG_FLOAT_ARRAY", (t, "other", 2, (9.0,) * 58), seq=i, system=1, component=191)))
    true = score.truth(_log(tmp_path / "t.tlog", frames))
    np.testing.assert_allclose(true.p_ned_m[:, 0], np.arange(5.0))
    np.testing.assert_allclose(true.omega_rad_s, np.tile(np.float32([0.1, 0.2, 0.3]), (5, 1)))
    np.testing.assert_allclose(true.extra["f_n"], np.float32(0.1 * np.arange(5)), atol=1e-9)
    with pytest.raises(LogError, match="no ODOMETRY"):
        score.truth(_log(tmp_path / "none.tlog", frames[2::3]))
    with pytest.raises(LogError, match="no DEBUG_FLOAT_ARRAY|no truth"):
        score.truth(_log(tmp_path / "half.tlog", frames[0::3]))
