"""One step of every observer of the family against the same note in numpy: what turns if a sign turns. Short enough uncompiled."""

import math

import numpy as np
import pytest

from mavquad import airframe, linalg, quat, signals
from mavquad.estimate import gsmo, gsmo_core, gsmo_implicit, gsmo_members, gsmo_online, gsmo_relay, gsmo_stream, lie, torque
from tests.oracles import rates

GYRO = (0.3, -0.5, 0.2)
Q = quat.exp((0.4, -0.7, 0.3))
W = (1.0, -2.0, 1.5)
A0, A1, A2 = (0.5, -1.0, 2.0), (0.8, -1.5, 1.0), (1.1, -2.0, 0.3)
I1, I2 = (0.3, 0.2, -0.4), (1.0, -2.0, 0.5)
H = 0.05
FAR = quat.mul(Q, quat.exp((-0.3, 0.5, 0.25)))  # the sample: every axis off, with different signs
NEAR = quat.mul(Q, quat.exp((0.01, -0.008, -0.02)))


def close(found, expected, atol=1e-12):
    np.testing.assert_allclose(np.concatenate([np.ravel(x) for x in found]), np.concatenate([np.ravel(x) for x in expected]), rtol=0, atol=atol)  # fmt: skip


def same_way(a, b):
    return np.array(b) if np.dot(a, b) >= 0.0 else -np.array(b)


def arrays(*vectors):
    return [np.array(v) for v in vectors]


def test_steps():
    q, w, a0, a1, a2, i1, i2 = arrays(Q, W, A0, A1, A2, I1, I2)
    close(lie.step_1(lie.CAYLEY, GYRO, Q, W, A0, I1, I2, H), rates.lie_euler(GYRO, q, w, a0, i1, i2, H))
    close(lie.step_2(lie.CAYLEY, GYRO, Q, W, A0, A1, I1, I2, H), rates.midpoint(GYRO, q, w, a0, a1, i1, i2, H))
    close(lie.step_2(lie.EXP, GYRO, Q, W, A0, A1, I1, I2, H), rates.midpoint(GYRO, q, w, a0, a1, i1, i2, H, exponential=True))
    close(lie.step_4(GYRO, Q, W, A0, A1, A2, I1, I2, H), rates.classical(GYRO, q, w, a0, a1, a2, i1, i2, H))


@pytest.mark.parametrize("variant", gsmo.EXPLICIT)
@pytest.mark.parametrize("measured", [FAR, NEAR])
@pytest.mark.parametrize("calm", [0, 9, 10])
def test_one_tick_of_the_explicit_observers(variant, measured, calm):
    """Note, section 5, steps 3 to 7; the schedule of section 7."""
    params = gsmo.Params(variant=variant, k1_rad_s=3.0, k2_rad_s2=7.0, layer_rad=0.3)
    gains = gsmo.fixed_gains(params, GYRO).relay
    q, w, z, a0, a1 = arrays(Q, W, measured, A0, A1)
    e = rates.error(z, q)
    k1, k2, after = 3.0, 7.0, calm
    if variant == "scheduled":
        size = np.abs(e).max()
        after = 0 if size > 0.2 else 10 if calm >= 10 else calm + 1
        if after >= 10:
            k1, k2 = 0.5, 2.5
    x = {"sat": np.clip(e / 0.3, -1, 1), "tanh": np.tanh(e / 0.3)}.get(variant, np.sign(e))
    i1 = k1 * np.sqrt(np.abs(e)) * x if variant == "super-twisting" else k1 * x
    moved = rates.cayley_matrix(H * (w + H / 2 * rates.euler_equation(GYRO, w, a0))) @ z
    expected = rates.midpoint(GYRO, q, w, a0, a1, i1, k2 * x, H)
    found = gsmo_relay.tick(gains, gsmo_relay.State(Q, W, measured, calm), False, A0, A1, A2, H)
    close(found[:3], (*expected, moved))
    assert found.calm == after
    coasting = gsmo_relay.tick(gains, gsmo_relay.State(Q, W, measured, calm), True, A0, A1, A2, H)
    close(coasting[:3], (*rates.midpoint(GYRO, q, w, a0, a1, np.zeros(3), np.zeros(3), H), moved))


def test_the_schedule_has_a_dead_zone_and_forgets():
    assert [gsmo_relay.count_calm(c, (0.0, -s, 0.0)) for c, s in ((3, 0.21), (10, 0.17), (3, 0.17), (3, 0.1))] == [0, 10, 0, 4]
    assert [gsmo_relay.sign(x) for x in (-0.1, 0.0, 0.1)] == [-1.0, 0.0, 1.0]


@pytest.mark.parametrize("b", [0.3, -0.2, 3e-6, -2e-6, 0.004, -0.004])
def test_one_axis_of_the_implicit_observers(b):
    T, k1, k2, L = 0.02, 3.0, 7.0, 5.0
    g = T * (k1 + T * k2)
    sigma = np.clip(b / g, -1, 1)
    close(gsmo_implicit.correct_axis(gsmo_implicit.RELAY, k1, k2, L, b, T), (b - g * sigma, T * k2 * sigma, 0.0))
    close(gsmo_implicit.correct_axis(gsmo_implicit.SUPER_TWISTING, k1, k2, L, b, T), rates.super_twisting(b, T, k1, k2))
    close(gsmo_implicit.correct_axis(gsmo_implicit.THIRD_ORDER, k1, k2, L, b, T), rates.third_order(b, T, L))


@pytest.mark.parametrize(("a2", "a1", "excess"), [(2.0, 0.3, 5.0), (0.1, 4.0, 1e-4), (0.5, 0.01, 3.0)])
def test_the_cubic_has_its_root_within_a_few_newton_steps(a2, a1, excess):
    z = gsmo_implicit.solve_cubic(a2, a1, excess)
    assert ((z + a2) * z + a1) * z == pytest.approx(excess, rel=1e-13)


@pytest.mark.parametrize("kind", gsmo.IMPLICIT.values())
def test_one_sample_of_the_implicit_observers(kind):
    """q := q exp(-(b - y)); w and d take their share; between samples the body alone moves."""
    T, d = 0.02, (0.4, -0.6, 499.99)
    gains = gsmo_implicit.Gains(kind, lie.CAYLEY, 3.0, 7.0, 5.0, 500.0, 0.8, GYRO)
    found = gsmo_implicit.correct(gains, gsmo_implicit.State(Q, W, d), FAR, T)
    b = (rates.rotation(FAR).inv() * rates.rotation(Q)).as_rotvec()
    share = np.array([gsmo_implicit.correct_axis(kind, 3.0, 7.0, 5.0, x, T) for x in b])
    back = (rates.rotation(found.q).inv() * rates.rotation(Q)).as_rotvec()
    close((back, found.w, found.d), (b - share[:, 0], np.array(W) - share[:, 1], np.clip(np.array(d) - share[:, 2], -500, 500)))
    low = gsmo_implicit.correct(gains, gsmo_implicit.State(Q, W, (-499.99, -499.99, -499.99)), quat.mul(Q, quat.exp((-0.3, -0.3, -0.3))), T)  # fmt: skip
    assert min(low.d) >= -500.0
    for stale in (False, True):
        after = gsmo_implicit.predict(gains, gsmo_implicit.State(Q, W, d), stale, A0, A1, H)
        q, w, a0, a1 = arrays(Q, W, np.add(A0, d), np.add(A1, d))
        zero = np.zeros(3)
        close(after[:2], rates.midpoint(GYRO, q, w, a0, a1, zero, zero, H), atol=1e-10)
        close(after[2:], (np.array(d) * (math.exp(-H / 0.8) if stale else 1.0),))


def motion(n, seed):
    """(q_meas, T) of a noisy turn with uneven samples, one long gap."""
    rng = np.random.default_rng(seed)
    q, samples = np.array(Q), []
    for k in range(n):
        T = (0.05 if k == 8 else 0.015) if k % 3 else 0.0125
        q = rates.quaternion(rates.rotation(q) * rates.Rotation.from_rotvec(T * np.array([1.5, -2.0, 1.0 + 3.0 * k * T])), q)
        noisy = rates.rotation(q) * rates.Rotation.from_rotvec(0.004 * rng.standard_normal(3))
        samples.append((tuple(rates.quaternion(noisy, q if k % 2 else -q)), T))
    return samples


def test_the_bank_is_the_notes_bank():
    first, *rest = motion(14, 3)
    bank, expected = gsmo_online.of(gsmo_online.new(first[0])), rates.Bank(first[0], GYRO)
    gsmo_online.start(bank, first[0])
    np.testing.assert_allclose(bank.weight, expected.p, atol=1e-14)
    period, last = 0.014, 0.0
    for k, (q, T) in enumerate(rest, start=1):
        gap = 2.5 * period
        gsmo_online.advance(bank, GYRO, A0, T, 0.01, gap)
        expected.advance(A0, T, 0.01, gap)
        gsmo_online.correct(bank, q, T, period, k)
        expected.correct(np.array(q), T, period)
        for i in range(gsmo_members.MEMBERS):
            np.testing.assert_allclose(same_way(expected.q[i], bank.x[i, :4]), expected.q[i], atol=1e-9)
        np.testing.assert_allclose(bank.x[:, 4:7], expected.w, rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(bank.x[:, 7:10], expected.d, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(bank.x[:, 10:], np.vstack([expected.n, np.zeros((0, 3))]), atol=1e-9)
        np.testing.assert_allclose(bank.weight, expected.p, atol=1e-6)
        assert bank.best[0] == pytest.approx(expected.N)
        if expected.S is not None:
            np.testing.assert_allclose(bank.scale, expected.S, rtol=1e-6)
            np.testing.assert_allclose(bank.v, expected.V, rtol=1e-4, atol=1e-9)
            assert int(bank.best[1]) == expected.best
            assert bank.best[2] == pytest.approx(expected.noise, rel=1e-6)
        close(gsmo_online.mixed(bank)[1:], (expected.rates(),), atol=1e-6)
        last = bank.best[2]
    assert last > 0.0
    assert expected.rescued > 0


def test_the_bank_behind_a_stream_is_the_bank_told_of_every_sample():
    """Live, from the first sample on: how many there were before, how long ago, how they come."""
    gains = gsmo.gains(gsmo.Params())
    state, bank = gsmo.init(gains), None
    for k, (q, _) in enumerate(motion(7, 5)):
        state = gsmo.observe(gains, state, signals.Attitude(20_000 * k, q, (0.0, 0.0, 0.0)))
        if bank is None:
            bank = gsmo_online.of(gsmo_online.new(q))
            continue
        gsmo_online.advance(bank, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.02, 0.01, 2.5 * 0.02)
        gsmo_online.correct(bank, q, 0.02, 0.02, k)
        _, w, health = gsmo.read(gains, state, 20_000 * k)
        np.testing.assert_allclose(w, gsmo_online.mixed(bank)[1], rtol=1e-9)
        assert health.counts.accepted == k + 1
        ahead = gsmo_online.of(state.bank.copy())
        gsmo_online.advance(ahead, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.03, 0.01, 2.5 * 0.02)
        np.testing.assert_allclose(gsmo.read(gains, state, 20_000 * k + 30_000)[1], gsmo_online.mixed(ahead)[1], rtol=1e-9)


def test_members_are_clamped_where_their_torque_states_run_away():
    x, p = np.zeros((gsmo_members.MEMBERS, gsmo_members.STATES)), np.zeros((gsmo_members.LINEAR, gsmo_members.COVARIANCES))
    gsmo_members.start(x, p, quat.IDENTITY)
    gsmo_members.second_sample(p, 1e-3)
    last = gsmo_members.LINEAR - 1
    for angle in (2.5, -2.5):
        far = quat.exp((angle / 2, angle / 3, angle / 4))
        for i in (11, last):
            p[i, gsmo_members.P22] = 1e9
            gsmo_members.correct_linear(x, p, i, far, 1e-3, 0.0, 1e15)
            assert np.abs(x[i, 7:10]).max() <= 500.0
        for j in range(gsmo_members.THIRD):
            i = gsmo_members.LINEAR + j
            x[i, 7:10] = -499.9999 if angle < 0 else 499.9999
            gsmo_members.correct_third(x, j, far, 10.0)
            assert np.abs(x[i, 7:10]).max() <= 500.0


def test_the_torque_of_a_motor_behind_its_lag():
    """Against the lag's differential equation integrated in small steps."""
    frame = airframe.load("x500")
    m = torque.mixer(frame)
    spun = torque.spin_up(m, torque.AT_REST, 0, (0.5, 0.4, 0.6, 0.3))
    np.testing.assert_allclose(spun[1], np.array(m.rows) @ np.array(spun[0].thrust_n))
    assert torque.spin_up(m, torque.AT_REST, 500_000, (0.5, 0.4, 0.6, 0.3))[1] == spun[1]  # whenever the first one comes
    spin, _ = torque.spin_up(m, spun[0], 30_000, (0.7, 0.7, 0.2, 0.1))
    spin, mean = torque.spin_up(m, spin, 50_000, (0.1, 0.2, 0.3, 0.9))
    asked = [np.array(c) * (m.thrust_max_n - m.thrust_min_n) + m.thrust_min_n for c in ((0.5, 0.4, 0.6, 0.3), (0.7, 0.7, 0.2, 0.1), (0.1, 0.2, 0.3, 0.9))]  # fmt: skip
    thrust, n = asked[0].copy(), 4000
    total = np.zeros(4)
    for level, seconds in zip(asked, (0.030, 0.020, 0.020), strict=True):
        total[:] = 0.0
        for _ in range(n):
            before = thrust
            thrust = thrust + seconds / n * (level - (thrust + 0.5 * seconds / n * (level - thrust) / m.lag_s)) / m.lag_s
            total += 0.5 * (before + thrust) / n
    np.testing.assert_allclose(mean, np.array(m.rows) @ total, rtol=1e-6, atol=1e-6)
    j = frame.body.inertia_kg_m2
    np.testing.assert_allclose(
        torque.gyro_ratios(j), -np.cross(W, np.array(j) * W) / j / [W[1] * W[2], W[2] * W[0], W[0] * W[1]]
    )


def test_each_motor_turns_the_body_its_own_way():
    """FRD, rotors as the airframe numbers them: the torque of one newton, by r x F and by the rotor's drag."""
    frame = airframe.load("x500")
    rotors, j = frame.rotors, frame.body.inertia_kg_m2
    places = {"x": [(45, 1), (225, 1), (315, -1), (135, -1)], "plus": [(0, -1), (90, 1), (180, -1), (270, 1)]}
    for layout, wanted in places.items():
        made = torque._places(_with(rotors, layout))
        for (x, y, spin), (bearing, counter_clockwise) in zip(made, wanted, strict=True):
            place = rotors.arm_m * np.array([math.cos(math.radians(bearing)), math.sin(math.radians(bearing)), 0.0])
            np.testing.assert_allclose((x, y), place[:2], atol=1e-12)
            assert spin == counter_clockwise
    for k, (bearing, spin) in enumerate(places["x"]):
        place = rotors.arm_m * np.array([math.cos(math.radians(bearing)), math.sin(math.radians(bearing)), 0.0])
        moment = np.cross(place, (0.0, 0.0, -1.0)) + np.array([0.0, 0.0, spin * rotors.torque_per_thrust_m])
        np.testing.assert_allclose([row[k] for row in torque.mixer(frame).rows], moment / j, atol=1e-12)


def _with(rotors, layout):
    import msgspec

    return msgspec.structs.replace(rotors, layout=layout)


def test_small_vectors():
    a, b = arrays(W, A0)
    close(
        (linalg.add(W, A0), linalg.sub(W, A0), linalg.axpy(2.0, W, A0), linalg.cross(W, A0)),
        (a + b, a - b, 2 * a + b, np.cross(a, b)),
    )
    assert linalg.dot(W, A0) == pytest.approx(a @ b)
    assert linalg.norm(W) == pytest.approx(np.linalg.norm(a))
    assert [linalg.clip(x, -1.0, 2.0) for x in (-3.0, 0.5, 3.0)] == [-1.0, 0.5, 2.0]


def test_small_quaternions_and_the_ends_of_their_maps():
    tiny = (3e-7, -2e-7, 1e-7)
    np.testing.assert_allclose(
        quat.exp(tiny), quat.exp(tuple(1e3 * x for x in tiny))[0:1] + tuple(0.5 * x for x in tiny), atol=1e-7
    )
    assert 1.0 - quat.exp((9e-7, 0.0, 0.0))[0] == pytest.approx(9e-7**2 / 8, abs=3e-16)
    x = 9.9e-7
    assert quat.exp((x, 0.0, 0.0))[1] / x - 0.5 == pytest.approx(-(x**2) / 48, abs=1e-16)
    np.testing.assert_allclose(quat.log((1.0, 4e-9, -3e-9, 2e-9)), (8e-9, -6e-9, 4e-9), rtol=1e-12)
    np.testing.assert_allclose(quat.log((-1.0, 4e-9, -3e-9, 2e-9)), (-8e-9, 6e-9, -4e-9), rtol=1e-12)
    assert quat.norm((1.0, -2.0, 3.0, 4.0)) == pytest.approx(math.sqrt(30.0))
    close((quat.normalize((0.0, 3.0, 4.0, 0.0)),), ((0.0, 0.6, 0.8, 0.0),))


def core(q, w=W, calm=3):
    return gsmo_core.Core(q, w, FAR, (0.1, -0.2, 0.3), calm)


def test_a_fixed_variant_moves_in_equal_ticks_and_coasts_when_its_sample_is_old():
    params = gsmo.Params(variant="relay", k1_rad_s=1.0, k2_rad_s2=2.0, tick_s=0.01)
    gains = gsmo.fixed_gains(params, GYRO)
    found = gsmo_core.advance(gains, core(Q), 0.004, A0, 0.0501)  # 6 ticks of 8.35 ms; older than 20 ms from the fourth on
    state = gsmo_relay.State(Q, W, FAR, 3)
    for k in range(6):
        state = gsmo_relay.tick(gains.relay, state, k >= 3, A0, A0, A0, 0.0501 / 6)
    close((found.q, found.w, found.z, found.d), (state.q, state.w, state.z, (0.1, -0.2, 0.3)), atol=1e-13)
    third = gsmo.fixed_gains(gsmo.Params(variant="implicit-third-order", tick_s=0.01, forget_s=0.5), GYRO)
    found = gsmo_core.advance(third, core(Q), 0.008, A0, 0.04)  # 4 ticks; a gap after 20 ms: the last one fades
    implicit = gsmo_implicit.State(Q, W, (0.1, -0.2, 0.3))
    for k in range(4):
        implicit = gsmo_implicit.predict(third.implicit, implicit, k >= 3, A0, A0, 0.01)
    close((found.q, found.w, found.d), implicit, atol=1e-13)
    assert gsmo_core.advance(third, core(Q), 0.008, A0, 0.0) == core(Q)


@pytest.mark.parametrize("q", [(math.nan, 0.0, 0.0, 0.0), (0.0, math.inf, 0.0, 0.0), (0.0, 0.0, -math.inf, 0.0), (0.0, 0.0, 0.0, math.inf)])  # fmt: skip
def test_what_is_not_sane(q):
    assert gsmo_core.sane(Q, W, W)
    assert not gsmo_core.sane(q, W, W)
    assert not gsmo_core.sane(Q, (0.0, 1001.0, 0.0), W)
    assert not gsmo_core.sane(Q, W, (0.0, -math.inf, 0.0))


def test_packing_and_unpacking_give_back_every_number():
    ints, floats = np.zeros(gsmo_core.INTS, np.int64), np.zeros(gsmo_core.FLOATS)
    clock = gsmo_stream.Clock(11, 12, 0.013, 14, 0.015, 16, 17)
    stream = gsmo_stream.Stream(clock, gsmo_stream.Torque((1.0, 2.0, 3.0), 18, 19, (4.0, 5.0, 6.0)))
    here = gsmo_core.Core((1.0, 2.0, 3.0, 4.0), (5.0, 6.0, 7.0), (8.0, 9.0, 10.0, 11.0), (12.0, 13.0, 14.0), 15)
    gsmo_stream.pack(stream, ints, floats)
    gsmo_core.pack_core(here, ints, floats)
    assert gsmo_stream.unpack(ints, floats) == stream
    assert gsmo_core.unpack_core(ints, floats) == here
    assert list(ints[:10]) == [0] * 10
    assert len(set(ints[10:])) == len(ints[10:])
    assert len(set(floats[8:])) == 14
