"""Excitation and frequency responses: known filters, exact sums, closed loops, and what cannot be used."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavquad.errors import ConfigError, LogError
from mavquad.identify import excitation, spectrum
from mavquad.identify.excitation import Sweep
from mavquad.identify.spectrum import Record

DT_S = 0.02


@pytest.fixture
def rng():
    return np.random.default_rng(4)


# ---- excitation ------------------------------------------------------------------------------------------------------
@given(st.floats(0.0, 100.0))
def test_a_sweep_stays_inside_its_amplitude_and_is_quiet_at_both_ends(t_s):
    plan = Sweep(amplitude=0.2)
    assert abs(excitation.value(plan, t_s)) <= 0.2
    if t_s < 5.0 or t_s > 95.0:
        assert excitation.value(plan, t_s) == 0.0


def test_the_phase_of_a_sweep_is_the_integral_of_its_frequency():
    """Away from the fades, the zero crossings come where the frequency integrated by a fine sum says."""
    plan = Sweep(amplitude=1.0)
    t = np.arange(5.0, 60.0, 1e-3)
    f = np.array([excitation.frequency_hz(plan, x) for x in t])
    phase = 2.0 * np.pi * np.concatenate([[0.0], np.cumsum(0.5 * (f[1:] + f[:-1])) * 1e-3])
    steady = t > 9.0
    ours = np.array([excitation.value(plan, x) for x in t[steady]])
    np.testing.assert_allclose(ours, np.sin(phase[steady]), atol=1e-4)  # the fine sum's own error


def test_a_sweep_runs_from_its_first_to_its_last_frequency():
    plan = Sweep(amplitude=1.0, f_start_hz=0.1, f_end_hz=5.0, duration_s=70.0)
    assert excitation.frequency_hz(plan, 0.0) == pytest.approx(0.1)
    assert excitation.frequency_hz(plan, 75.0) == pytest.approx(5.0, rel=0.01)  # 0.0187 (e^4 - 1) = 1.0023


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"f_start_hz": 9.0}, "f_start_hz"),
        ({"amplitude": 0.0}, "amplitude"),
        ({"amplitude": math.nan}, "amplitude"),
        ({"duration_s": 5.0}, "duration_s"),
        ({"f_start_hz": 0.005}, "less than one period"),
    ],
)
def test_a_sweep_that_cannot_be_flown_is_refused(change, message):
    with pytest.raises(ConfigError, match=message):
        Sweep(**{"amplitude": 0.1, **change})


def test_a_sweep_too_fast_for_the_commands_is_refused():
    with pytest.raises(ConfigError, match="7 Hz"):
        excitation.check_rate(Sweep(amplitude=0.1), 0.05)


def test_coloured_noise_has_the_spread_and_the_memory_asked_for(rng):
    x = excitation.ar1(200_000, 0.02, 0.3, 0.15, rng)
    assert np.std(x) == pytest.approx(0.3, rel=0.03)
    assert np.corrcoef(x[:-1], x[1:])[0, 1] == pytest.approx(math.exp(-0.02 / 0.15), abs=0.01)


# ---- frequency responses ---------------------------------------------------------------------------------------------
def filtered(r, gain):
    """y = gain * (u after a discrete first-order lag 0.1/(1 - 0.9 z^-1)) for every input and output pair."""
    lagged = np.zeros_like(r)
    for k in range(1, len(r)):
        lagged[k] = 0.9 * lagged[k - 1] + 0.1 * r[k - 1]
    return lagged @ np.asarray(gain).T


def truth(omega, gain):
    z = np.exp(1j * omega * DT_S)
    return (0.1 / (z - 0.9))[:, None, None] * np.asarray(gain)[None]


GAIN = [[1.0, -0.4], [0.3, 2.0], [-0.7, 0.1]]


def open_loop(rng, noise=0.0):
    records = []
    for axis in (0, 1):
        r = excitation.record(Sweep(amplitude=0.3, duration_s=50.0), DT_S, axis, 2, rng)
        y = filtered(r, GAIN)
        records.append(Record(DT_S, r, r, y + noise * rng.standard_normal(y.shape)))
    return records


def test_lpm_finds_a_known_response_of_two_inputs_and_three_outputs(rng):
    found = spectrum.lpm(open_loop(rng), spectrum.log_grid(1.0, 40.0, 20))
    error = np.abs(found.h / truth(found.omega_rad_s, GAIN) - 1.0)
    assert np.median(error) < 1e-4  # the records start and end at rest: only the local curvature is left
    assert error.max() < 0.01


def test_the_spread_lpm_states_is_the_spread_seen(rng):
    """Normalised errors over noisy records: their root mean square is one within the statistics of 2 x 60 points x 4 seeds."""
    seen = []
    for _ in range(4):
        found = spectrum.lpm(open_loop(rng, noise=0.01), spectrum.log_grid(1.0, 40.0, 10))
        seen.append((found.h / truth(found.omega_rad_s, GAIN) - 1.0) / found.sd)
    z = np.concatenate([x.ravel() for x in seen])
    assert 0.8 < np.sqrt(np.mean(np.abs(z) ** 2) / 2.0) < 1.25


def test_what_neighbouring_frequencies_share_is_stated(rng):
    """The mean error over close frequencies spreads as the covariance says; taken for independent it would spread a third less."""
    seen, alone = [], []
    for _ in range(6):
        found = spectrum.lpm(open_loop(rng, noise=0.01), spectrum.log_grid(3.0, 6.0, 16))
        k, p, m = found.h.shape
        np.testing.assert_allclose(np.diag(found.covariance.reshape(k * p * m, -1)).real, 2.0 * found.sd.ravel() ** 2)
        mean = np.mean(np.log(found.h / truth(found.omega_rad_s, GAIN)), axis=0)
        for i, j in np.ndindex(p, m):
            seen.append(np.abs(mean[i, j]) ** 2 / np.mean(found.covariance[:, i, j, :, i, j]).real)
            alone.append(np.abs(mean[i, j]) ** 2 / np.mean(2.0 * found.sd[:, i, j] ** 2) * k)
    assert 0.7 < np.sqrt(np.mean(seen)) < 1.35  # 36 complex samples
    assert np.sqrt(np.mean(alone)) > 1.4 * np.sqrt(np.mean(seen))


def closed_loop(rng):
    """A noisy plant fed back by its own measurement: the input depends on the noise."""
    records = []
    for _ in range(2):
        r = excitation.record(Sweep(amplitude=0.05, duration_s=80.0), DT_S, 0, 1, rng)
        disturbance = excitation.ar1(len(r), DT_S, 0.008, 0.5, rng)
        u, y = np.zeros(len(r)), np.zeros(len(r))
        lag = 0.0
        for k in range(len(r)):
            y[k] = lag + disturbance[k]
            u[k] = r[k, 0] - 6.0 * y[k]
            lag = 0.9 * lag + 0.1 * u[k]
        records.append(Record(DT_S, r, u[:, None], y[:, None]))
    return records


def test_feedback_biases_the_direct_estimate_and_not_the_joint_one(rng):
    records = closed_loop(rng)
    grid = spectrum.log_grid(2.0, 20.0, 15)
    direct = spectrum.welch(records, grid, (8.0,), joint=False)
    joint = spectrum.welch(records, grid, (8.0,))
    exact = truth(grid, [[1.0]])
    assert np.median(np.abs(direct.h / exact - 1.0)) > 3.0 * np.median(np.abs(joint.h / exact - 1.0))
    local = spectrum.lpm(records, grid)
    z = np.abs(local.h / truth(local.omega_rad_s, [[1.0]]) - 1.0) / local.sd
    assert np.sqrt(np.mean(z**2) / 2.0) < 1.6


def test_welch_uses_a_window_only_above_two_of_its_periods(rng):
    found = spectrum.welch(open_loop(rng), np.array([0.5, 1.0, 3.0]), (8.0,))
    np.testing.assert_allclose(found.omega_rad_s, [3.0])  # 4 pi / 8 s = 1.57 rad/s
    with pytest.raises(LogError, match="longest window"):
        spectrum.welch(open_loop(rng), np.array([0.5]), (8.0,))


def test_ordinary_coherence_is_one_without_noise_and_low_for_strangers(rng):
    x = rng.standard_normal(6000)
    _, same = spectrum.ordinary_coherence(x, 2.0 * x, DT_S)
    _, strangers = spectrum.ordinary_coherence(x, rng.standard_normal(6000), DT_S)
    assert same[1:].min() > 0.999999
    assert np.median(strangers) < 0.2


# ---- what cannot be used ---------------------------------------------------------------------------------------------
def test_records_that_cannot_be_used_are_refused_with_the_reason(rng):
    good = open_loop(rng)[0]
    with pytest.raises(LogError, match="no record"):
        spectrum.checked([])
    broken = good.r.copy()
    broken[7, 0] = math.nan
    with pytest.raises(LogError, match="not finite"):
        spectrum.checked([good._replace(r=broken)])
    with pytest.raises(LogError, match=r"10\.0 s long"):
        spectrum.checked([Record(DT_S, good.r[:500], good.u[:500], good.y[:500])])
    with pytest.raises(LogError, match="never moves"):
        spectrum.checked([good._replace(r=np.zeros_like(good.r))])
    with pytest.raises(LogError, match="expected equal"):
        spectrum.checked([good._replace(y=good.y[:-1])])
    with pytest.raises(LogError, match="one rate"):
        spectrum.checked([good, good._replace(dt_s=0.01)])


def test_saturation_is_told_and_not_fatal(rng):
    good = open_loop(rng)[0]
    assert spectrum.checked([good]) == []
    notes = spectrum.checked([good._replace(u=np.where(np.abs(good.u) > 0.1, 1.0, good.u))])
    assert "at its limit" in notes[0]


def test_inputs_that_move_as_one_are_refused(rng):
    r = excitation.record(Sweep(amplitude=0.3, duration_s=50.0), DT_S, 0, 2, rng)
    r[:, 1] = 0.5 * r[:, 0]
    with pytest.raises(LogError, match="off-axis excitation is missing"):
        spectrum.lpm([Record(DT_S, r, r, filtered(r, GAIN))] * 2, spectrum.log_grid(1.0, 20.0, 5))
