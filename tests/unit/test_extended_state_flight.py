"""estimate/extended_state_flight.py: what telemetry does to it, sample by sample."""

import math

import numpy as np
import pytest

from mavquad import airframe, quat
from mavquad.errors import ConfigError
from mavquad.estimate import extended_state_flight as flight
from mavquad.setpoint.attitude import attitude, thrust_vector
from mavquad.signals import NAN3, ZERO3, Applied, Attitude, Imu, Position, Target

G = 9.80665
FRAME = airframe.load("x500", ("drag.linear_n_s_m=[0.4,0.4,0.4]", "drag.quadratic_n_s2_m2=[0,0,0]"))
GAINS = flight.gains(flight.Params(), FRAME)


def _fly(gains, seconds, f, *, q=quat.IDENTITY, thrust=G, thrust_true=None, echo=None, bias=ZERO3, spoil=None, delay_s=0.0):
    """A vehicle under constant thrust, attitude and disturbance (with its drag); returns state, estimate, truth."""
    state, p, v = flight.init(gains), np.zeros(3), np.zeros(3)
    estimate = None
    for ms in range(4, round(1000 * seconds) + 1, 4):
        true = thrust if thrust_true is None else thrust_true
        a = np.array([0.0, 0.0, G]) - quat.rotate(q, (0.0, 0.0, true)) + np.array(f) - 0.2 * v
        p, v = p + 4e-3 * v + 8e-6 * a, v + 4e-3 * a
        samples = [Attitude(1000 * ms, q, ZERO3)]
        if ms % 20 == 0:
            told = [Target(1000 * ms, q, NAN3, echo, 7)] if echo is not None else []
            samples = [Position(1000 * ms, tuple(p), tuple(v + bias)), *told, *samples]
        for sample in samples:
            sample = spoil(sample) if spoil else sample
            if sample is not None:
                state = flight.observe(gains, state, sample)
        if sample is None:  # the attitude paces the control
            continue
        state, estimate = flight.step(gains, state, Applied(1000 * ms, q, thrust, NAN3, delay_s), 1000 * ms)
    return state, estimate, (p, v)


def test_a_constant_disturbance_is_found_beside_the_known_drag():
    q = quat.from_euler(0.1, -0.2, 0.7)
    f = (0.8, -0.5, 0.3)
    _, estimate, (p, v) = _fly(GAINS, 6.0, f, q=q, thrust=G / 0.97)
    np.testing.assert_allclose(estimate.p_ned_m, p, atol=0.02)
    np.testing.assert_allclose(estimate.v_ned_m_s, v, atol=0.02)
    np.testing.assert_allclose(estimate.f_ned_m_s2, np.array(f) - 0.2 * v, atol=0.03)  # the total, drag included


@pytest.mark.parametrize(("silence_s", "near_m"), [(0.6, 0.01), (1.4, 0.01), (3.0, 0.05)])
def test_after_a_silence_the_vehicle_is_where_it_flew_to(silence_s, near_m):
    """The filter left where it was would be 1.5 m behind, and believe in it; past what it integrates it begins again."""

    def silent(sample):
        return None if 4e6 <= sample.t_us < 4e6 + 1e6 * silence_s else sample

    q = quat.from_euler(0.15, -0.1, 0.0)
    _, estimate, (p, v) = _fly(GAINS, 4.1 + silence_s, (0.5, 0.3, 0.1), q=q, thrust=G / 0.985, spoil=silent)
    assert math.hypot(v[0], v[1]) > 2.5
    np.testing.assert_allclose(estimate.p_ned_m, p, atol=near_m)


def test_a_velocity_that_disagrees_with_the_position_leaves_no_offset():
    _, estimate, (p, _) = _fly(GAINS, 12.0, ZERO3, bias=(0.02, -0.025, 0.0))
    anchored = np.abs(np.array(estimate.p_ned_m) - p).max()
    off = flight.gains(flight.Params(anchor_s=0.0), FRAME)
    _, estimate, (p, _) = _fly(off, 12.0, ZERO3, bias=(0.02, -0.025, 0.0))
    free = np.abs(np.array(estimate.p_ned_m) - p).max()
    assert free > 0.004
    assert anchored < 0.2 * free


def test_the_echo_tells_the_thrust_that_acts_whatever_was_sent():
    """Sent and echoed agree first (that gives the scale); then the echo drops and so does the filter's known thrust."""
    state, _, _ = _fly(GAINS, 3.0, ZERO3, echo=0.55)
    assert state.scale == pytest.approx(G / 0.55, rel=1e-6)
    state = flight.observe(GAINS, state, Target(state.t_us, quat.IDENTITY, NAN3, 0.44, 7))
    for i in range(1, 60):
        state = flight.observe(GAINS, state, Attitude(state.t_us + 4000, quat.IDENTITY, ZERO3))
        if i % 5 == 0:
            state = flight.observe(GAINS, state, Target(state.t_us, quat.IDENTITY, NAN3, 0.44, 7))
    assert state.thrust_m_s2 == pytest.approx(0.8 * G, rel=0.06)  # the scale creeps meanwhile


def test_without_an_echo_the_thrust_sent_acts_one_delay_later():
    state = flight.init(GAINS)
    for ms in range(4, 404, 4):
        state = flight.observe(GAINS, state, Attitude(1000 * ms, quat.IDENTITY, ZERO3))
        sent = G if ms <= 204 else 12.0  # "last sent": the one of the step before
        state, _ = flight.step(GAINS, state, Applied(1000 * ms, quat.IDENTITY, sent, NAN3, 0.1), 1000 * ms)
        if ms <= 300:
            assert state.thrust_m_s2 == pytest.approx(G, abs=1e-9)
    assert state.thrust_m_s2 == pytest.approx(12.0, abs=0.15)  # three rotor lags after the change arrived


def test_an_echo_says_which_of_our_setpoints_acts():
    """The delay is 60 ms where 20 were measured, and every fifth setpoint is lost: the echo puts the line right."""
    state, sent, told = flight.init(GAINS), [], 0
    for k in range(1, 200):
        now = 8000 * k
        state = flight.observe(GAINS, state, Attitude(now, quat.IDENTITY, ZERO3))
        arrived = [u for i, (t, u) in enumerate(sent) if t + 60_000 <= now and i % 5]
        if k % 3 == 0 and arrived:
            state = flight.observe(GAINS, state, Target(now, quat.IDENTITY, NAN3, float(np.float32(arrived[-1])), 7))
            acting = [s for s in state.sent if s.acts_us <= now][-1]
            assert acting.collective == arrived[-1]
            assert state.known_us == now
            told += 1
        last = sent[-1][1] if sent else 0.5
        state, _ = flight.step(GAINS, state, Applied(now, quat.IDENTITY, G * last / 0.5, NAN3, 0.02, 0.0, last), now)
        sent.append((now, 0.5 + 0.1 * math.sin(0.05 * k)))
    assert told > 50
    stamps = [s.acts_us for s in state.sent]
    assert stamps == sorted(stamps)


def _share(gust_m_s2, jolt_m_s2=0.0, least=0.03, seed=3):
    """The share of the growth after a minute of hover in vertical gusts (memory 0.35 s), with one jolt to the north at its end."""
    gains, rng = flight.gains(flight.Params(f_growth_least=least), FRAME), np.random.default_rng(seed)
    state, p, v, f = flight.init(gains), np.zeros(3), np.zeros(3), np.zeros(3)
    keep = math.exp(-0.02 / 0.35)
    for k in range(1, 3000):
        f[2] = keep * f[2] + gust_m_s2 * math.sqrt(1.0 - keep * keep) * rng.standard_normal()
        f[0] = jolt_m_s2 if k > 2980 else 0.0
        a = f - 2.0 * v - 1.0 * p  # held about a point; what holds it is thrust, known to the filter
        q, thrust = attitude(thrust_vector(tuple(a - f), 1.0, 1.0, 20.0), 0.0)
        state = flight.observe(gains, state, Attitude(20_000 * k, q, ZERO3))
        state, _ = flight.step(gains, state, Applied(20_000 * k, q, thrust, NAN3, 0.0), 20_000 * k)
        p, v = p + 0.02 * v + 2e-4 * a, v + 0.02 * a
        told = p + 0.02 * rng.standard_normal(3), v + 0.03 * rng.standard_normal(3)
        state = flight.observe(gains, state, Position(20_000 * k + 19_000, tuple(told[0]), tuple(told[1])))
    return state.growth.share


def test_in_calm_air_the_filter_follows_less_of_the_noise():
    calm = [_share(0.0, seed=seed) for seed in (3, 4)]
    assert max(calm) < 0.08
    assert min(_share(1.2, seed=seed) for seed in (3, 4)) > 0.7
    assert _share(0.0, jolt_m_s2=6.0) > 2.0 * calm[0]  # a gust along the ground wakes it within 0.4 s
    assert _share(0.0, least=1.0) == 1.0  # off
    with pytest.raises(ConfigError, match="f_growth_least"):
        flight.Params(f_growth_least=0.0)


def test_an_estimate_from_an_older_sample_has_longer_to_wait_for_its_command():
    state, _, _ = _fly(GAINS, 1.0, ZERO3)
    for age_s, expected in ((0.015, 0.075), (-0.02, 0.04), (-0.2, 0.0), (math.nan, 0.06)):
        _, estimate = flight.step(GAINS, state, Applied(state.t_us, quat.IDENTITY, G, NAN3, 0.06, age_s), state.t_us)
        assert estimate.delay_s == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("what", ["nan position", "nan attitude", "twice", "stale", "unknown"])
def test_bad_samples_change_nothing(what):
    state, _, _ = _fly(GAINS, 1.0, ZERO3)
    t = state.t_us
    bad = {
        "nan position": Position(t + 1000, (math.nan, 0.0, 0.0), ZERO3),
        "nan attitude": Attitude(t + 1000, (math.nan, 0.0, 0.0, 0.0), ZERO3),
        "twice": Attitude(t, quat.IDENTITY, ZERO3),
        "stale": Position(t - 900_000, (5.0, 5.0, 5.0), ZERO3),
        "unknown": Imu(t, ZERO3, ZERO3),
    }[what]
    assert flight.observe(GAINS, state, bad) == state


def test_a_lost_velocity_stream_leaves_a_filter_on_position_alone():
    def mute(sample):
        return sample._replace(v_ned_m_s=NAN3) if isinstance(sample, Position) and sample.t_us > 2_000_000 else sample

    state, estimate, (p, v) = _fly(GAINS, 8.0, (0.5, 0.0, 0.0), spoil=mute)
    np.testing.assert_allclose(estimate.p_ned_m, p, atol=0.05)
    np.testing.assert_allclose(estimate.v_ned_m_s, v, atol=0.1)
    assert state.axes[0].r == (GAINS.horizontal.r_first, GAINS.horizontal.r_second)


def test_a_negative_thrust_or_a_delay_out_of_range_is_never_believed():
    state, _, _ = _fly(GAINS, 1.0, ZERO3)
    before = state.sent
    state, estimate = flight.step(GAINS, state, Applied(state.t_us, quat.IDENTITY, -5.0, NAN3, 7.0), state.t_us)
    assert state.sent == before
    assert estimate.delay_s == 1.0
    _, estimate = flight.step(GAINS, state, Applied(state.t_us, quat.IDENTITY, G, NAN3, math.nan), state.t_us)
    assert estimate.delay_s == 1.0


def test_before_the_first_position_the_estimate_says_so():
    state, estimate = flight.step(GAINS, flight.init(GAINS), Applied(0, quat.IDENTITY, G, NAN3, 0.0), 4000)
    assert math.isnan(estimate.p_ned_m[0])
    assert state.axes is None


@pytest.mark.parametrize("change", [{"adapt": 0.5}, {"anchor_s": 0.05}, {"f_growth": 0.0}, {"drag": -1.0}])
def test_impossible_parameters_are_refused(change):
    with pytest.raises(ConfigError, match=r"eskf\."):
        flight.Params(**change)
