"""The stream in front of every observer: each kind of bad input with the counter it lands on, the clock, and the torque's mean."""

import math

import numpy as np
import pytest

from mavquad import airframe, quat, signals
from mavquad.estimate import gsmo, gsmo_core, gsmo_stream
from mavquad.estimate.gsmo_stream import Clock, Counts, Stream, Torque

Q = quat.exp((0.2, -0.1, 0.3))
ZERO = (0.0, 0.0, 0.0)
TINY = 1e-310  # denormal
BAD = {  # what arrives 10 ms after the last good sample, and what it is counted as
    "NaN": ((math.nan, 0.0, 0.0, 1.0), 10_000, "not_finite"),
    "infinite": ((1.0, -math.inf, 0.0, 0.0), 10_000, "not_finite"),
    "overflowing norm": ((1e200, 0.0, 0.0, 0.0), 10_000, "not_finite"),
    "zero norm": ((0.0, 0.0, 0.0, 0.0), 10_000, "bad_norm"),
    "denormal": ((TINY, TINY, -TINY, TINY), 10_000, "bad_norm"),
    "too long": (tuple(1.051 * x for x in Q), 10_000, "bad_norm"),
    "too short": (tuple(0.949 * x for x in Q), 10_000, "bad_norm"),
    "same stamp": (Q, 0, "duplicate"),
    "0.1 ms later": (Q, 100, "duplicate"),
    "0.1 ms earlier": (Q, -100, "duplicate"),
    "older": (Q, -101, "late"),
    "much older": (Q, -30_000_000, "late"),
    "no clock's time": (Q, 1 << 63, "bad_stamp"),
}


def sampled(variant, n=20, period_us=10_000):
    gains = gsmo.gains(gsmo.Params(variant=variant))
    state = gsmo.init(gains)
    for k in range(n):
        turned = quat.mul(Q, quat.exp((0.01 * k, 0.0, 0.0)))
        state = gsmo.observe(gains, state, signals.Attitude(period_us * k, turned, ZERO))
    return gains, state, period_us * (n - 1)


@pytest.mark.parametrize("variant", ["online", "relay", "implicit-third-order"])
@pytest.mark.parametrize("name", BAD)
def test_bad_samples_change_no_rate_and_are_counted_by_reason(variant, name):
    q, later_us, reason = BAD[name]
    gains, state, last_us = sampled(variant)
    before = gsmo.read(gains, state, last_us)
    after_it = gsmo.observe(gains, state, signals.Attitude(last_us + later_us, q, ZERO))
    after = gsmo.read(gains, after_it, last_us)
    assert after[:2] == before[:2]
    expected = before[2].counts._replace(**{reason: 1})
    assert after[2].counts == expected
    assert after[2].counts.accepted == 20


@pytest.mark.parametrize("variant", ["online", "relay", "implicit-third-order", "implicit-super-twisting"])
@pytest.mark.parametrize("gap_us", [1_000, 10_000, 26_000, 100_000, 1_000_000, 10_000_000])
def test_after_a_gap_the_rate_is_found_again(variant, gap_us):
    gains, state, last_us = sampled(variant, 60)
    n = 60 if variant == "online" else 500
    for k in range(n):
        turned = quat.mul(Q, quat.exp((0.59 + 1e-6 * gap_us + 0.01 * k, 0.0, 0.0)))
        state = gsmo.observe(gains, state, signals.Attitude(last_us + gap_us + 10_000 * k, turned, ZERO))
        _, w, health = gsmo.read(gains, state, last_us + gap_us + 10_000 * k)
        assert all(math.isfinite(x) for x in w)
    assert health.counts.gaps == (gap_us >= 26_000)
    assert health.counts.accepted == 60 + n
    assert w == pytest.approx((1.0, 0.0, 0.0), abs=0.35 if variant == "relay" else 0.15)


def test_counting_by_the_verdict():
    counts = np.zeros(10, np.int64)
    for what in (gsmo_stream.ACCEPTED, gsmo_stream.GAP, gsmo_stream.RESTART, gsmo_stream.LATE):
        gsmo_stream.tally(counts, what)
    assert Counts(*counts)._asdict() == {**dict.fromkeys(Counts._fields, 0), "accepted": 3, "gaps": 1, "restarts": 1, "late": 1}


def test_ten_older_samples_in_a_row_each_newer_than_the_last_are_a_new_clock():
    s = gsmo_stream.begin(gsmo_stream.init(), 1_000_000)
    for k in range(9):
        verdict, what, s, *_ = gsmo_stream.admit(s, 100 * k + 1, Q)
        assert (verdict, what) == (gsmo_stream.REFUSED, gsmo_stream.LATE)
        assert (s.clock.late_run, s.clock.late_t_us) == (k + 1, 100 * k + 1)
    verdict, what, new, *_ = gsmo_stream.admit(s, 901, Q)
    assert (verdict, what, new.clock) == (gsmo_stream.FIRST, gsmo_stream.RESTART, Clock(901, 1, 0.0, 0, 0.0, 0, 0))
    _, _, back, *_ = gsmo_stream.admit(s, 700, Q)  # older than the last of the run: the run begins anew
    assert back.clock.late_run == 1
    verdict, what, *_ = gsmo_stream.admit(s, 1_000_000 + 20_000_001, Q)
    assert (verdict, what) == (gsmo_stream.FIRST, gsmo_stream.RESTART)
    assert gsmo_stream.admit(s, 1_000_000 + 20_000_000, Q)[0] == gsmo_stream.NEXT


def test_the_period_is_a_running_mean_that_gaps_do_not_enter():
    c = gsmo_stream.advance_clock(Clock(0, 1, 0.0, 0, 0.0, 3, 5), 20_000, 0.02)
    assert c == Clock(20_000, 2, 0.02, 0, 0.0, 0, 0)
    c = gsmo_stream.advance_clock(c, 50_000, 0.03)
    assert (c.fresh, c.period_s) == (3, pytest.approx(0.025))
    many = Clock(0, 200, 0.02, 4, 0.09, 0, 0)
    assert gsmo_stream.advance_clock(many, 30_000, 0.03).period_s == pytest.approx(0.02 + 0.01 / 50)
    assert gsmo_stream.advance_clock(many, 30_000, 0.03).slow == 0
    gap = gsmo_stream.advance_clock(many, 70_000, 0.07)
    assert gap == Clock(70_000, 201, 0.02, 5, 0.07, 0, 0)
    assert gsmo_stream.advance_clock(gap, 170_000, 0.1) == Clock(170_000, 202, 0.02, 6, 0.07, 0, 0)
    ninth = Clock(0, 200, 0.02, 9, 0.09, 0, 0)
    assert gsmo_stream.advance_clock(ninth, 70_000, 0.08) == Clock(70_000, 201, 0.08, 0, 0.0, 0, 0)
    first_slow = gsmo_stream.advance_clock(Clock(0, 200, 0.02, 0, 0.0, 0, 0), 60_000, 0.06)
    assert (first_slow.slow, first_slow.slow_s) == (1, 0.06)


def test_the_torque_is_held_and_averaged_over_the_period():
    s = gsmo_stream.begin(gsmo_stream.init(), 0)
    used, s = gsmo_stream.heard_torque(s, 2_000, (1.0, -2.0, 0.5))
    assert used
    used, s = gsmo_stream.heard_torque(s, 6_000, (3.0, 4.0, -1.0))
    assert s.torque.total == pytest.approx((0.004 * 1.0, 0.004 * -2.0, 0.004 * 0.5))
    _, _, s, dt_s, _, mean = gsmo_stream.admit(s, 10_000, Q)
    assert dt_s == pytest.approx(0.01)
    np.testing.assert_allclose(mean, np.array([0.004 * 1.0 + 0.004 * 3.0, -0.008 + 0.016, 0.002 - 0.004]) / 0.01)
    assert s.torque == Torque((3.0, 4.0, -1.0), 10_000, 10_000, ZERO)
    _, _, s, _, _, mean = gsmo_stream.admit(s, 20_000, Q)
    assert mean == pytest.approx((3.0, 4.0, -1.0))
    assert gsmo_stream.integrate_torque(s.torque, 20_000) == s.torque
    none_yet = Stream(s.clock, s.torque._replace(since_us=30_000, from_us=30_000))
    assert gsmo_stream.admit(none_yet, 25_000, Q)[5] == (3.0, 4.0, -1.0)


@pytest.mark.parametrize(
    "torque", [(math.nan, 0.0, 0.0), (0.0, math.inf, 0.0), (6e4, -6e4, 0.0), (0.0, 0.0, -1.1e5), (1e308, 1e308, -1e308)]
)
def test_absurd_torque_is_refused(torque):
    s = gsmo_stream.begin(gsmo_stream.init(), 0)
    assert gsmo_stream.heard_torque(s, 1_000, torque) == (False, s)
    ints, floats = gsmo.init(gsmo.gains(gsmo.Params()))[:2]
    gsmo_core.torque_sample(ints, floats, 1_000, torque)
    assert Counts(*ints[:10].tolist()).bad_torque == 1


def test_torque_of_another_time_is_refused_and_before_the_first_sample_only_kept():
    s = gsmo_stream.begin(gsmo_stream.init(), 50_000_000)
    a = (1.0, 2.0, -3.0)
    for t_us, used in (
        (50_000_000 - 20_000_001, False),
        (50_000_000 + 20_000_001, False),
        (30_000_000, True),
        (70_000_000, True),
    ):
        assert gsmo_stream.heard_torque(s, t_us, a)[0] == used
    used, before = gsmo_stream.heard_torque(gsmo_stream.init(), 7, a)
    assert used
    assert before.torque == Torque(a, 7, 7, ZERO)
    assert gsmo_stream.begin(before, 99).torque == Torque(a, 99, 99, ZERO)
    assert gsmo_stream.lost(s) == Stream(Clock(50_000_000, 0, 0.0, 0, 0.0, 0, 0), Torque(ZERO, 50_000_000, 50_000_000, ZERO))


def test_a_quaternion_within_5_percent_is_taken_at_unit_length():
    s = gsmo_stream.begin(gsmo_stream.init(), 0)
    for scale in (0.951, 1.049):
        _, _, _, _, unit, _ = gsmo_stream.admit(s, 10_000, tuple(scale * x for x in Q))
        np.testing.assert_allclose(unit, Q, atol=1e-15)


def test_a_prediction_is_that_of_the_body_and_ends_after_2_s():
    frame = airframe.load("x500")
    for variant in ("online", "implicit-third-order"):
        gains = gsmo.gains(gsmo.Params(variant=variant, torque="motors", inertia="airframe"), frame)
        state = gsmo.init(gains)
        for k in range(400):
            state = gsmo.observe(gains, state, signals.Attitude(10_000 * k, quat.exp((0.005 * k, 0.0, 0.0)), ZERO))
        at = [gsmo.read(gains, state, 3_990_000 + late_us) for late_us in (-50_000, 0, 20_000, 2_000_000, 9_000_000)]
        turned = [quat.log(q)[0] for q, _, _ in at]
        assert turned[0] == turned[1] == pytest.approx(1.995, abs=1e-5)
        assert turned[2] == pytest.approx(2.005, abs=1e-4)
        assert at[3][:2] == at[4][:2]
        assert [h.age_s for _, _, h in at] == pytest.approx([0.0, 0.0, 0.02, 2.0, 9.0])
        assert gsmo.read(gains, state, 1 << 62)[2].stale


def test_a_lost_observer_starts_again_with_the_sample_that_showed_it():
    """Two good samples half a turn apart in 0.2 ms: no vehicle turns at that rate."""
    for variant in ("online", "implicit-super-twisting"):
        gains = gsmo.gains(gsmo.Params(variant=variant, L=1e9))
        state = gsmo.init(gains)
        for k in range(30):
            state = gsmo.observe(gains, state, signals.Attitude(200 * k, quat.exp((3.0 * (k % 2), 0.0, 0.0)), ZERO))
            _, w, health = gsmo.read(gains, state, 200 * k)
            assert math.hypot(*w) <= gsmo_core.MAX_RATE_RAD_S
        assert health.counts.lost > 0


def test_rates_are_settled_after_a_second_of_samples_and_a_lone_observer_has_no_member():
    for n, settled in ((90, False), (100, False), (103, True), (140, True)):
        _, state, t_us = sampled("relay", n)
        health = gsmo.health(state, t_us)
        assert (health.settled, health.member) == (settled, -1), n
