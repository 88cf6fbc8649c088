"""The flight face of the geometric sliding mode observers: samples in, rates out, whatever the samples are worth."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavquad import airframe, quat, signals
from mavquad.errors import ConfigError
from mavquad.estimate import gsmo

PERIOD_US = 10_000
X500 = airframe.load("x500")


def wave(n, period_us=PERIOD_US):
    """A smooth attitude record and its true body rates: (t_us (n,), q (n,4), omega (n,3))."""
    t_us = np.arange(n, dtype=np.int64) * period_us
    fine = 20
    h = 1e-6 * period_us / fine
    q, qs, ws = (1.0, 0.0, 0.0, 0.0), [], []
    for k in range(n):
        qs.append(q)
        ws.append(_rates(1e-6 * t_us[k]))
        for j in range(fine):
            w = _rates(1e-6 * t_us[k] + (j + 0.5) * h)
            q = quat.mul(q, quat.exp((w[0] * h, w[1] * h, w[2] * h)))
    return t_us, np.array(qs), np.array(ws)


def _rates(t):
    return (1.5 * math.sin(2.0 * t), math.cos(1.3 * t), 0.5 * math.sin(t))


RECORD = wave(600)


@pytest.mark.parametrize("variant", gsmo.VARIANTS)
def test_live_and_bulk_are_the_same_bits(variant):
    t_us, q, _ = RECORD
    gains = gsmo.gains(gsmo.Params(variant=variant))
    omega, q_hat, counts = gsmo.run_record(gains, t_us[:100], q[:100])
    state = gsmo.init(gains)
    for k in range(100):
        state = gsmo.observe(gains, state, signals.Attitude(int(t_us[k]), tuple(q[k]), signals.ZERO3))
        q_read, w_read, health = gsmo.read(gains, state, int(t_us[k]))
        assert w_read == tuple(omega[k])
        assert q_read == tuple(q_hat[k])
    assert health.counts == counts
    assert counts.accepted == 100


def test_a_sign_flip_of_any_sample_changes_no_bit():
    t_us, q, _ = RECORD
    flips = np.where(np.random.default_rng(3).random(len(q)) < 0.5, -1.0, 1.0)[:, None]
    for variant in gsmo.VARIANTS:
        gains = gsmo.gains(gsmo.Params(variant=variant))
        plain, _, _ = gsmo.run_record(gains, t_us, q)
        flipped, _, _ = gsmo.run_record(gains, t_us, q * flips)
        np.testing.assert_array_equal(plain, flipped, err_msg=variant)


def test_motor_commands_become_the_torque_of_the_mixer():
    gains = gsmo.gains(gsmo.Params(torque="motors", inertia="airframe"), X500)
    state = gsmo.observe(gains, gsmo.init(gains), signals.Motors(0, (0.5, 0.5, 0.6, 0.6)))
    rotors, body = X500.rotors, X500.body
    one = 0.1 * (rotors.thrust_max_n - rotors.thrust_min_n)
    yaw = -2.0 * one * rotors.torque_per_thrust_m / body.inertia_kg_m2[2]  # 3 and 4 turn clockwise: the nose goes left
    np.testing.assert_allclose(state.floats[2:5], (0.0, 0.0, yaw), atol=1e-12)
    state = gsmo.observe(gains, gsmo.init(gains), signals.Motors(0, (0.5, 0.6, 0.6, 0.5)))
    roll = 2.0 * one * rotors.arm_m * math.sqrt(0.5) / body.inertia_kg_m2[0]  # 2 and 3 are on the left: it rolls right
    np.testing.assert_allclose(state.floats[2:5], (roll, 0.0, 0.0), atol=1e-12)


def test_settings_that_cannot_work_are_refused_with_the_key():
    for wrong, key in (
        ({"variant": "reley"}, "variant"),
        ({"order": 3}, "order"),
        ({"L": 0.0}, "L"),
        ({"k1_rad_s": math.nan}, "k1_rad_s"),
        ({"source": "gyro"}, "source"),
    ):
        with pytest.raises(ConfigError, match=f"gsmo.{key}"):
            gsmo.Params(**wrong)
    with pytest.raises(ConfigError, match="airframe"):
        gsmo.gains(gsmo.Params(torque="motors"))


hostile = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True),
    st.sampled_from([0.0, 5e-324, 1e-310, math.nan, math.inf, -math.inf, 1e308]),
)
samples = st.lists(
    st.tuples(
        st.sampled_from([0, 1, 50, 100, 101, 1000, 10_000, 3_000_000, 10_000_000, 30_000_000, -5, -20_000]),
        st.one_of(
            st.tuples(hostile, hostile, hostile, hostile),
            st.builds(quat.exp, st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3))),
        ),
        st.one_of(st.none(), st.tuples(hostile, hostile, hostile, hostile)),
    ),
    max_size=20,
)


@given(record=samples, variant=st.sampled_from(gsmo.VARIANTS))
def test_nothing_that_arrives_makes_the_output_not_finite_and_every_sample_is_counted(record, variant):
    gains = gsmo.gains(gsmo.Params(variant=variant, torque="motors", inertia="airframe"), X500)
    state = gsmo.init(gains)
    t_us, refused_torque = 0, 0
    for step_us, q, motors in record:
        t_us += step_us
        if motors is not None:
            state = gsmo.observe(gains, state, signals.Motors(t_us, motors))
            refused_torque += not all(math.isfinite(m) for m in motors)
        state = gsmo.observe(gains, state, signals.Attitude(t_us, q, signals.ZERO3))
        for ahead_us in (-1000, 0, 4000, 20_000_000):
            q_hat, w, _ = gsmo.read(gains, state, t_us + ahead_us)
            assert all(math.isfinite(x) for x in (*q_hat, *w))
            assert abs(quat.norm(q_hat) - 1.0) < 1e-9
    counts = gsmo.health(state, t_us).counts
    refused = counts.not_finite + counts.bad_norm + counts.duplicate + counts.late
    assert counts.accepted + refused == len(record)
    assert counts.bad_torque >= refused_torque


def test_a_restarted_boot_clock_is_taken_up_again_and_a_late_sample_is_not():
    t_us, q, w = RECORD
    gains = gsmo.gains(gsmo.Params())
    stamps = np.concatenate([t_us[:300] + 10_000_000, [10_000_000 + t_us[290]], t_us[300:]])
    quats = np.concatenate([q[:300], q[290:291], q[300:]])
    omega, _, counts = gsmo.run_record(gains, stamps, quats)
    assert counts.late == 1 + 9
    assert counts.restarts == 1
    assert np.abs(omega[-100:] - w[-100:]).max() < 0.02


def test_a_silent_stream_is_said_to_coast_and_then_to_be_stale():
    t_us, q, _ = RECORD
    gains = gsmo.gains(gsmo.Params())
    state = gsmo.init(gains)
    assert gsmo.read(gains, state, 0)[2].stale
    for k in range(150):
        state = gsmo.observe(gains, state, signals.Attitude(int(t_us[k]), tuple(q[k]), signals.ZERO3))
    last = int(t_us[149])
    seen = [gsmo.read(gains, state, last + late_us)[2] for late_us in (0, 30_000, 60_000)]
    assert [h.coasting for h in seen] == [False, True, True]
    assert [h.stale for h in seen] == [False, False, True]
    assert seen[0].settled
