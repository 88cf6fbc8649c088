"""The bank: what it must reach with nothing tuned, and that it never looks ahead."""

import math

import numpy as np
import pytest

from mavquad import quat
from mavquad.estimate import gsmo, gsmo_members, gsmo_online
from tools.papers.geometric import setup
from tools.papers.geometric.runs import run
from tools.papers.geometric.setup import IDENTITY, ZERO, after, rms
from tools.papers.geometric.tables import FAST_W, coloured

CONFIGS = setup.configurations()
ONLINE = gsmo.gains(gsmo.Params())


def error(config, source, stimulus, w0=ZERO):
    return run(CONFIGS[config], stimulus, IDENTITY, w0)[0] - source.w


def test_what_was_published_does_not_depend_on_what_comes_later():
    source = setup.truth()
    q = setup.noisy(source.q, 0.3, np.random.default_rng(1))
    t_us = (1e6 * source.t).round().astype(np.int64)
    whole, q_whole, _ = gsmo.run_record(ONLINE, t_us, q)
    for n in (1, 2, 3, 50, 700):
        part, q_part, _ = gsmo.run_record(ONLINE, t_us[:n], q[:n])
        np.testing.assert_array_equal(part, whole[:n])
        np.testing.assert_array_equal(q_part, q_whole[:n])


def test_a_step_leaves_the_state_it_was_given_as_it_was():
    from mavquad.signals import ZERO3, Attitude

    state = gsmo.init(ONLINE)
    for k in range(20):
        kept = [a.copy() for a in (state.ints, state.floats, state.bank)]
        after_it = gsmo.observe(ONLINE, state, Attitude(10_000 * k, quat.exp((0.01 * k, 0.0, 0.0)), ZERO3))
        for a, b in zip(kept, (state.ints, state.floats, state.bank), strict=True):
            np.testing.assert_array_equal(a, b)
        state = after_it


def test_after_a_change_of_noise_it_settles_within_4_s_to_what_tuning_reaches():
    source = setup.truth(ZERO, 60.0)
    found = []
    for seed in (1, 2):
        quiet, loud = (setup.stimulus(source, noise_deg=n, seed=seed, torque_scale=0.0) for n in (0.05, 1.0))
        samples = np.where(((source.t >= 20.0) & (source.t < 40.0))[:, None], loud.samples, quiet.samples)
        e = error("online", source, quiet._replace(samples=samples))
        spans = ((24.0, 40.0), (44.0, 60.0))
        found.append([rms(e[(source.t >= a) & (source.t < b)]) for a, b in spans])
    loud, quiet = np.mean(found, axis=0)
    assert loud <= 1.3 * 0.062  # the third-order observer and the Kalman filter tuned for 1 deg: 0.071, 0.060
    assert quiet <= 1.3 * 0.0114  # tuned for 0.05 deg


@pytest.mark.parametrize(("noise_deg", "tuned_kalman"), [(0.1, 0.0183), (0.5, 0.0624)])
def test_a_noisy_tumble_is_within_1_6_times_of_the_tuned_kalman_filter(noise_deg, tuned_kalman):
    source = setup.truth(FAST_W)
    keep = after(source, 1.0)
    stimuli = [setup.stimulus(source, noise_deg=noise_deg, seed=s, torque_scale=0.0) for s in (1, 2, 3)]
    assert np.mean([rms(error("online-J", source, s, FAST_W)[keep]) for s in stimuli]) <= 1.6 * tuned_kalman


@pytest.mark.parametrize(("tau_s", "kalman"), [(0.05, 0.052), (0.2, 0.057), (1.0, 0.045), (0.1, 0.058), (0.4, 0.053)])
def test_noise_that_can_be_predicted_is_not_taken_for_motion(tau_s, kalman):
    source = setup.truth()
    keep = after(source, 1.0)
    found = [rms(error("online", source, coloured(source, tau_s, 0.5, seed))[keep]) for seed in (1, 2, 3, 4)]
    assert np.mean(found) <= 1.3 * kalman


def test_the_first_second_under_noise_is_flagged_and_half_as_bad():
    source = setup.truth()
    early, late = ((source.t >= a) & (source.t < b) for a, b in ((0.1, 0.3), (0.3, 1.0)))
    found = []
    for seed in range(1, 9):
        size = np.linalg.norm(
            error("online", source, setup.stimulus(source, noise_deg=0.5, seed=seed, torque_scale=0.0)), axis=1
        )
        found.append((size[early].max(), size[late].max()))
    first, then = np.mean(found, axis=0)
    assert first <= 0.5 * 0.58
    assert then <= 0.20
    from mavquad.signals import ZERO3, Attitude

    state = gsmo.init(ONLINE)
    settled = []
    for k in range(60):
        state = gsmo.observe(ONLINE, state, Attitude(20_000 * k, IDENTITY, ZERO3))
        settled.append(gsmo.read(ONLINE, state, 20_000 * k)[2].settled)
    assert settled == [k >= 50 for k in range(60)]


@pytest.mark.parametrize("noise_deg", [0.05, 0.3, 1.0])
def test_the_noise_is_told_from_the_stream_itself(noise_deg):
    source = setup.truth()
    q = setup.noisy(source.q, noise_deg, np.random.default_rng(4))[::2]
    bank = gsmo_online.of(gsmo_online.new(tuple(q[0])))
    gsmo_online.start(bank, tuple(q[0]))
    for k in range(1, len(q)):
        gsmo_online.advance(bank, ZERO, ZERO, 0.02, 0.01, 1.0)
        gsmo_online.correct(bank, tuple(q[k]), 0.02, 0.02, k)
    assert math.degrees(math.sqrt(bank.best[2])) == pytest.approx(noise_deg, rel=0.2)
    np.testing.assert_allclose(bank.weight.sum(axis=0), 1.0, atol=1e-12)


def test_a_member_that_is_lost_goes_on_from_the_best():
    bank = gsmo_online.of(gsmo_online.new(IDENTITY))
    gsmo_online.start(bank, IDENTITY)
    for k in range(1, 30):
        gsmo_online.advance(bank, ZERO, ZERO, 0.01, 0.01, 1.0)
        gsmo_online.correct(bank, quat.exp((0.01 * k, 0.0, 0.0)), 0.01, 0.01, k)
    bank.x[3, gsmo_members.W] = math.nan
    bank.x[-1, :4] = quat.exp((0.0, 2.0, 0.0))
    gsmo_online.advance(bank, ZERO, ZERO, 0.01, 0.01, 1.0)
    gsmo_online.correct(bank, quat.exp((0.3, 0.0, 0.0)), 0.01, 0.01, 30)
    best = int(bank.best[1])
    assert best not in (3, gsmo_members.MEMBERS - 1)
    for i in (3, gsmo_members.MEMBERS - 1):
        np.testing.assert_array_equal(bank.x[i, : gsmo_members.N], bank.x[best, : gsmo_members.N])


def test_a_linear_members_gains_are_those_of_a_dense_kalman_filter():
    rng = np.random.default_rng(5)
    for phi, share in ((0.0, 0.0), (0.7, gsmo_members.WHITE_SHARE)):
        root = rng.standard_normal((4, 4))
        p = root @ root.T
        row = np.zeros((1, gsmo_members.COVARIANCES))
        order = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2), (0, 3), (1, 3), (2, 3), (3, 3)]
        row[0] = [p[i] for i in order]
        T, jerk = 0.3, 2.0
        f = np.array([[1, T, T * T / 2, 0], [0, 1, T, 0], [0, 0, 1, 0], [0, 0, 0, phi]])
        noise = np.zeros((4, 4))
        noise[:3, :3] = jerk * np.array(
            [[T**5 / 20, T**4 / 8, T**3 / 6], [T**4 / 8, T**3 / 3, T**2 / 2], [T**3 / 6, T**2 / 2, T]]
        )
        noise[3, 3] = 1.0 - phi**2
        m = f @ p @ f.T + noise
        seen = np.array([1.0, 0.0, 0.0, 1.0])
        gain = m @ seen / (seen @ m @ seen + share)
        found = gsmo_members.linear_gains(row, 0, T, phi, jerk, share)
        np.testing.assert_allclose(found, gain, rtol=1e-12)
        expected = m - np.outer(gain, seen @ m)
        np.testing.assert_allclose(row[0], [expected[i] for i in order], rtol=1e-9, atol=1e-12)
