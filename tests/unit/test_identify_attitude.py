"""The attitude response from irregular commands and late telemetry: recovery, clocks, choice of parts, what is refused."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavquad.errors import LogError
from mavquad.identify import attitude, timebase
from mavquad.identify.attitude import SecondOrder
from mavquad.identify.excitation import Sweep, value
from mavquad.identify.timebase import Held, Sampled

TRUTH = (0.97, 12.0, 0.8, 0.035)


def commands(rng, seconds=80.0, amplitude=0.12):
    """A sweep sent at about 50 Hz with the irregular spacing of a real companion."""
    t = np.cumsum(rng.uniform(0.014, 0.026, round(seconds / 0.02)))
    plan = Sweep(amplitude=amplitude, f_start_hz=0.1, f_end_hz=5.0, duration_s=70.0)
    return Held(t, np.array([value(plan, x) for x in t]))


def answered(u, truth=TRUTH, period=0.01, noise=1e-4, rng=None):
    """The attitude by its differential equation, integrated at 1 ms with the exact held input: an independent simulation."""
    gain, wn, zeta, delay = truth
    h = 1e-3
    t = np.arange(u.t_s[0], u.t_s[-1], h)
    command = timebase.held_at(u, t - delay)
    # before the first command could act, it holds its first value: the sweep begins at zero
    x, v, out = 0.0, 0.0, np.empty(t.size)
    for k in range(t.size):
        out[k] = x
        a = wn * wn * (gain * command[k] - x) - 2.0 * zeta * wn * v
        v_half = v + 0.5 * h * a
        x += h * v_half
        v = v_half + 0.5 * h * (wn * wn * (gain * command[k] - x) - 2.0 * zeta * wn * v_half)
    step = round(period / h)
    y = out[::step] + (noise * rng.standard_normal(out[::step].size) if rng is not None else 0.0)
    return Sampled(t[::step], y)


@pytest.fixture
def rng():
    return np.random.default_rng(11)


# ---- the response ----------------------------------------------------------------------------------------------------
def test_gain_frequency_damping_and_delay_come_back_within_their_stated_spread(rng):
    u = commands(rng)
    found = attitude.identify(u, answered(u, rng=rng), [(float(u.t_s[0]), float(u.t_s[-1]))])
    for got, sd, wanted in zip(found.model[:4], found.model.sd, TRUTH, strict=True):
        assert abs(got - wanted) < 4.0 * sd + 0.01 * wanted
    assert found.model.omega_n_rad_s == pytest.approx(12.0, rel=0.03)
    assert found.model.delay_s == pytest.approx(0.035, abs=0.002)
    assert found.coherence[(found.f_hz >= 0.2) & (found.f_hz <= 4.0)].min() > 0.95


def test_the_model_predicts_another_flight_from_its_commands_alone(rng):
    u = commands(rng)
    other = Held(u.t_s, 0.2 * np.sign(np.sin(0.7 * u.t_s)) * (u.t_s > 2.0))
    truth = SecondOrder(*TRUTH, (0.0, 0.0, 0.0, 0.0), 1.0, 40)
    y = answered(other)
    t = np.arange(1.0, 60.0, 0.01)
    np.testing.assert_allclose(attitude.predict(truth, other, t), np.interp(t, y.t_s, y.value), atol=2e-3)


@given(st.floats(2.0, 40.0), st.floats(0.2, 3.0), st.floats(0.0, 0.2))
def test_the_step_time_is_when_a_simulated_step_has_gone_63_percent(wn, zeta, delay):
    model = SecondOrder(1.0, wn, zeta, delay, (0.0,) * 4, 1.0, 40)
    late = attitude.step_time_s(model)
    step = Held(np.array([0.0, 1.0]), np.array([0.0, 1.0]))
    t = np.arange(0.0, 1.0 + late + 0.3, 1e-3)
    y = attitude.predict(model, step, t)
    assert t[np.argmax(y >= 0.63)] - 1.0 == pytest.approx(late, abs=3e-3)


def test_a_faster_loop_than_the_sweep_is_not_given_a_frequency(rng):
    u = commands(rng)
    found = attitude.identify(u, answered(u, (1.0, 400.0, 1.0, 0.0), rng=rng), [(float(u.t_s[0]), float(u.t_s[-1]))])
    assert found.model.omega_n_rad_s > attitude.FASTEST_RAD_S or found.model.sd[1] > 0.4 * found.model.omega_n_rad_s


# ---- what is refused -------------------------------------------------------------------------------------------------
def test_telemetry_at_4_hz_is_refused_with_the_rate_it_needs(rng):
    u = commands(rng)
    with pytest.raises(LogError, match=r"4\.0 Hz; needs 17 Hz"):
        attitude.identify(u, answered(u, period=0.25), [(0.0, 70.0)])


def test_a_command_that_never_moves_is_refused(rng):
    u = commands(rng)
    still = Held(u.t_s, np.full(u.t_s.size, 0.1))
    with pytest.raises(LogError, match="record a sweep"):
        attitude.identify(still, answered(u), [(0.0, 70.0)])
    with pytest.raises(LogError, match="moves for 0 s"):
        attitude.parts(u.t_s, np.column_stack([still.value, u.value]), 0)


def test_noise_without_an_answer_is_refused(rng):
    u = commands(rng)
    y = Sampled(np.arange(0.0, 80.0, 0.01), 0.01 * rng.standard_normal(8000))
    with pytest.raises(LogError, match="coherent"):
        attitude.identify(u, y, [(1.0, 78.0)])


def test_an_answer_against_the_command_is_refused_as_a_sign_convention(rng):
    u = commands(rng)
    y = answered(u)
    with pytest.raises(LogError, match="against the command"):
        attitude.identify(u, Sampled(y.t_s, -y.value), [(float(u.t_s[0]), float(u.t_s[-1]))])


def test_gaps_are_cut_and_not_interpolated(rng):
    assert attitude.whole_parts(0.0, 100.0, [(20.0, 21.0), (60.0, 70.0), (200.0, 201.0)]) == [
        (0.0, 20.0),
        (21.0, 60.0),
        (70.0, 100.0),
    ]
    u = commands(rng)
    y = answered(u)
    hole = (y.t_s < 33.0) | (y.t_s > 35.0)
    found = attitude.identify(u, Sampled(y.t_s[hole], y.value[hole]), [(float(u.t_s[0]), float(u.t_s[-1]))])
    assert found.model.omega_n_rad_s == pytest.approx(12.0, rel=0.05)


# ---- which part ------------------------------------------------------------------------------------------------------
def test_the_sweep_of_an_axis_is_fitted_and_the_rest_is_left_to_check():
    t = np.arange(0.0, 200.0, 0.02)
    plan = Sweep(amplitude=0.12, f_start_hz=0.1, f_end_hz=5.0, duration_s=60.0)
    roll = np.array([value(plan, x) for x in t])
    pitch = np.array([value(plan, x - 70.0) for x in t])
    both = 0.2 * np.sin(1.3 * t) * ((t > 150.0) & (t < 190.0))
    found = attitude.parts(t, np.column_stack([roll + both, pitch + both]), 1)
    assert found.swept
    ((start, end),) = found.fit
    assert 70.0 < start < 80.0
    assert 130.0 < end < 140.0
    assert all(b <= start or a >= end for a, b in found.check)
    assert any(a >= 145.0 for a, b in found.check)


def test_without_a_sweep_the_first_part_is_fitted_and_the_last_checked():
    t = np.arange(0.0, 120.0, 0.02)
    wander = 0.1 * np.sin(0.9 * t) + 0.1 * np.sin(2.3 * t)
    found = attitude.parts(t, np.column_stack([wander, wander[::-1]]), 0)
    assert not found.swept
    assert max(b for _, b in found.fit) <= min(a for a, _ in found.check)


# ---- one clock -------------------------------------------------------------------------------------------------------
@given(st.floats(-5.0, 5.0), st.floats(-2e-4, 2e-4))
def test_arrival_stamps_come_onto_the_vehicle_clock(offset, drift):
    rng = np.random.default_rng(5)
    boot = np.arange(10.0, 200.0, 0.01)
    arrival = offset + (1.0 + drift) * boot + 0.003 + rng.exponential(0.004, boot.size)
    found = timebase.clock(arrival, boot)
    there = np.array([20.0, 100.0, 190.0])
    back = timebase.to_vehicle_s(found, offset + (1.0 + drift) * there + 0.003)
    np.testing.assert_allclose(back, there, atol=1.5e-3)  # the least delayed of 100 exponential delays a second


def test_a_clock_that_stalls_is_followed_in_pieces():
    boot = np.arange(0.0, 100.0, 0.01)
    stall = np.interp(boot, [0.0, 30.0, 40.0, 100.0], [0.0, 0.0, 2.0, 2.0])
    found = timebase.clock(boot + stall, boot)
    assert found.unsteady_s > 0.3
    np.testing.assert_allclose(timebase.to_vehicle_s(found, np.array([10.0, 82.0])), [10.0, 80.0], atol=0.02)


def test_a_restart_ends_an_epoch():
    boot = np.concatenate([np.arange(50.0, 60.0, 0.1), np.arange(0.0, 30.0, 0.1)])
    assert timebase.longest_epoch(boot) == slice(100, 400)


@given(st.lists(st.floats(0.01, 0.5), min_size=2, max_size=20), st.floats(0.0, 1.0))
def test_the_mean_of_a_held_signal_is_its_integral(spacing, start):
    t = start + np.cumsum(spacing)
    u = Held(t, np.sin(3.0 * np.arange(t.size)))
    edges = np.linspace(start - 0.3, float(t[-1]) + 0.3, 7)
    fine = np.linspace(edges[0], edges[-1], 60_001)
    sums = [np.mean(timebase.held_at(u, fine[(fine >= a) & (fine < b)])) for a, b in itertools.pairwise(edges)]
    np.testing.assert_allclose(timebase.held_mean(u, edges), sums, atol=2e-3)


def test_rhythm_tells_gaps_from_jitter():
    t = np.concatenate([np.arange(0.0, 1.0, 0.02), np.arange(1.5, 2.0, 0.02)])
    found = timebase.rhythm(t)
    assert found.period_s == pytest.approx(0.02)
    assert len(found.gaps) == 1
    assert found.jitter < 0.01
    with pytest.raises(LogError, match="no stream"):
        timebase.rhythm(t[:2])


def test_repeated_and_broken_samples_are_left_out():
    found = timebase.monotone(np.array([0.0, 1.0, 1.0, 3.0, 2.0]), np.array([1.0, 2.0, 9.0, math.nan, 4.0]))
    np.testing.assert_allclose(found.t_s, [0.0, 1.0, 2.0])
