"""Dryden turbulence, gusts and rotors in wind against the numbers of MIL-F-8785C and the paper's reference vehicle."""

import math

import numpy as np
import pytest
from scipy import signal

from sitl import config, rotors, vehicle, wind

SPAN_M = 0.42
FEET_10 = 3.048
HOURS = 3  # of 2000 s each


@pytest.mark.parametrize(
    ("w20", "height", "length_u", "length_w", "sigma_u", "sigma_w", "mean", "sigma_p", "tau_w"),
    [
        (5, 3.048, 23.055, 3.048, 0.9815, 0.5, 4.292, 0.8396, 0.7102),
        (10, 3.048, 23.055, 3.048, 1.9630, 1.0, 8.583, 1.6793, 0.3551),
        (15, 3.048, 23.055, 3.048, 2.9445, 1.5, 12.875, 2.5189, 0.2367),
        (10, 6.096, 43.766, 6.096, 1.9291, 1.0, 10.000, 1.1874, 0.6096),
    ],
)
def test_lengths_and_intensities_are_the_standards(w20, height, length_u, length_w, sigma_u, sigma_w, mean, sigma_p, tau_w):
    i = wind.intensity(w20, height, SPAN_M)
    assert i == pytest.approx((length_u, length_w, sigma_u, sigma_w, sigma_p), rel=1e-4)
    assert wind.mean_at(w20, height) == pytest.approx(mean, abs=1e-3)
    assert i.length_w_m / wind.mean_at(w20, height) == pytest.approx(tau_w, rel=1e-3)


@pytest.fixture(scope="module")
def turbulence():
    """(3, 200000, 5): three records of 2000 s at W20 10, 10 ft, each started from the stationary distribution."""
    d = wind.dryden(10.0, FEET_10, SPAN_M, wind.mean_at(10.0, FEET_10))
    records = np.zeros((HOURS, 200_000, 5))
    for seed, out in enumerate(records):
        rng = np.random.default_rng(seed)
        wind.series(d.F, d.B, d.C, d.P0 @ rng.standard_normal(7), rng.standard_normal((len(out), 7)), out)
    return records


def test_variances_are_the_theory(turbulence):
    # q: theory of the filter (s/V)/(1 + 4b/(pi V) s) behind H_w, by integration; the others sigma squared
    theory = (1.9630**2, 1.9630**2, 1.0, 1.6793**2, 0.744)
    assert turbulence.var(axis=(0, 1)) == pytest.approx(theory, rel=0.04)


def test_spectra_are_the_theory_in_every_band(turbulence):
    i, v = wind.intensity(10.0, FEET_10, SPAN_M), wind.mean_at(10.0, FEET_10)
    f, measured = signal.welch(turbulence, fs=100.0, nperseg=8192, axis=1)
    measured = measured.mean(axis=0)
    w = 2.0 * math.pi * f
    tu, tw, lag = i.length_u_m / v, i.length_w_m / v, 4.0 * SPAN_M / (math.pi * v)
    s = 1j * w
    lateral = np.sqrt(tu) * i.sigma_u_m_s * (1 + math.sqrt(3) * tu * s) / (1 + tu * s) ** 2
    down = np.sqrt(tw) * i.sigma_w_m_s * (1 + math.sqrt(3) * tw * s) / (1 + tw * s) ** 2
    filters = [
        i.sigma_u_m_s * np.sqrt(2 * tu) / (1 + tu * s),
        lateral,
        down,
        i.sigma_p_rad_s * np.sqrt(2 * lag) / (1 + lag * s),
        down * (s / v) / (1 + lag * s),
    ]
    for channel, H in enumerate(filters):
        theory = 2.0 * np.abs(H) ** 2  # one-sided over Hz
        for low, high in ((0.1, 1.0), (1.0, 10.0), (10.0, 60.0)):
            band = (w >= low) & (w < high)
            ratio = measured[band, channel].sum() / theory[band].sum()
            assert 0.85 < ratio < 1.15, (channel, low, high, ratio)


def test_turbulence_starts_stationary():
    d = wind.dryden(10.0, FEET_10, SPAN_M, wind.mean_at(10.0, FEET_10))
    np.testing.assert_allclose(d.F @ d.P0 @ d.P0.T @ d.F.T + d.B @ d.B.T, d.P0 @ d.P0.T, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(np.diag(d.C @ d.P0 @ d.P0.T @ d.C.T)[:4], (1.9630**2, 1.9630**2, 1.0, 1.6793**2), rtol=1e-4)


@pytest.mark.parametrize("model", [rotors.MODEL_P, rotors.MODEL_G])
def test_still_air_gives_the_still_thrust(model):
    assert rotors.in_wind(model, 1.815, 0.0, 0.0, 0.0, 1.293, 0.01) == pytest.approx(1.815, rel=1e-9)


def test_model_p_has_the_papers_numbers():
    T0 = 0.74 * 9.81 / 4.0  # the reference vehicle in hover
    v_d = math.sqrt(T0 / (2.0 * 1.293 * 0.01))
    assert v_d == pytest.approx(8.38, abs=0.005)
    slope = (rotors.in_wind(rotors.MODEL_P, T0, 0.0, 0.0, 1e-3, 1.293, 0.01) - T0) / 1e-3
    assert slope == pytest.approx(0.217, abs=5e-4)
    side = rotors.in_wind(rotors.MODEL_P, T0, 8.583, 0.0, 0.0, 1.293, 0.01)  # the mean wind adds 40 %: no real rotor does
    assert side / T0 == pytest.approx(1.43, abs=0.01)


def test_model_g_has_the_real_sign_and_solves_glauert():
    T0, rho, disk = 1.815, 1.293, 0.01
    v_d = math.sqrt(T0 / (2.0 * rho * disk))
    less = rotors.in_wind(rotors.MODEL_G, T0, 0.0, 0.0, 2.0, rho, disk)
    more = rotors.in_wind(rotors.MODEL_G, T0, 0.0, 0.0, -2.0, rho, disk)
    assert less < T0 < more
    # against the converged root: four damped steps leave under 2 % of v_d
    v_i = v_d
    for _ in range(200):
        v_i = 0.5 * (v_i + v_d * v_d / math.hypot(3.0, v_i + 2.0))
    exact = T0 * (1.0 - 0.45 * (v_i + 2.0 - v_d) / v_d)
    assert rotors.in_wind(rotors.MODEL_G, T0, 3.0, 0.0, 2.0, rho, disk) == pytest.approx(exact, rel=0.01)
    assert rotors.in_wind(rotors.MODEL_G, 0.05, 0.0, 0.0, 30.0, rho, disk) == 0.0


def airborne(*changes):
    v = vehicle.Vehicle(config.load(None, list(changes)))
    v.state["p_ned_m"], v.state["grounded"] = (0.0, 0.0, -50.0), 0
    return v


def test_wind_comes_from_where_it_is_said_to():
    v = airborne("wind.mean_m_s=5", "wind.from_deg=270")
    v.run(10)
    assert v.state["wind_ned_m_s"] == pytest.approx((0.0, 5.0, 0.0), abs=1e-12)


def test_the_profile_is_the_mean_at_the_height():
    v = airborne("wind.mean_m_s=10", "wind.profile=true")
    v.state["p_ned_m"] = (0.0, 0.0, -6.096)
    v.run(1)
    assert v.state["wind_ned_m_s"][0] == pytest.approx(-10.0, rel=1e-6)


def test_a_gust_rises_holds_and_goes():
    v = airborne("wind.gusts=[{t_s=1.0, duration_s=4.0, speed_m_s=6.0, from_deg=180.0}]")
    seen = {}
    for _ in range(300):
        seen[round(1e-6 * v.t_us, 3)] = v.state["wind_ned_m_s"][0]
        v.run(10)
    assert seen[1.0] == 0.0
    assert seen[1.52] == pytest.approx(3.0, abs=0.12)  # half way up at a quarter of the first half, held for 10 ms
    assert seen[3.0] == pytest.approx(6.0)
    assert seen[5.5] == 0.0


def test_turbulence_of_a_flight_has_the_intensity_of_its_height():
    v = airborne("wind.w20_m_s=10", "wind.turbulence_height_m=3.048", "wind.turbulence_airspeed_m_s=40")
    v.setpoint["kind"] = 0
    rows = []
    for _ in range(20_000):  # 200 s at a high airspeed: the slow channels are averaged, too
        v.state["p_ned_m"] = (0.0, 0.0, -50.0)
        v.run(5)
        rows.append(v.state["wind_ned_m_s"].copy())
    assert np.std(rows, axis=0) == pytest.approx((1.963, 1.963, 1.0), rel=0.1)
