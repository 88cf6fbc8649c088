"""The joint observer and IADRC as they fly: against a vehicle with wind, delay, lag, a wrong mass and bad telemetry."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavquad import airframe, config, plan, quat
from mavquad.control import adrc_flight, iadrc_flight, lagged, pid
from mavquad.errors import ConfigError
from mavquad.estimate import applied_thrust, direct, joint_flight, joint_tick, leso_flight
from mavquad.settings import Companion
from mavquad.signals import NAN3, ZERO3, Applied, Attitude, Demand, Estimate, Imu, Position
from tests.oracles.outer_flight import World, fly

X500 = airframe.load("x500")
PAIRS = {
    "pid": (direct, pid),
    "adrc": (leso_flight, adrc_flight),
    "iadrc": (joint_flight, iadrc_flight),
}


def flown(name, estimate=None, control=None, **world):
    estimator, controller = PAIRS[name]
    e = estimator.gains(estimate or estimator.Params(), X500)
    return fly(World(**world), estimator, e, controller, controller.gains(control or controller.Params(), X500))


@pytest.fixture(scope="module")
def in_wind():
    """One flight of each, in wind with a wrong mass."""
    return {name: flown(name, seconds=14.0) for name in PAIRS}


def test_in_wind_with_a_wrong_mass_iadrc_beats_adrc_and_pid(in_wind):
    rmse = {name: record.rmse() for name, record in in_wind.items()}
    assert rmse["iadrc"] <= 0.5 * rmse["adrc"]
    assert rmse["iadrc"] <= 0.4 * rmse["pid"]
    assert rmse["iadrc"] <= 0.03


def test_feed_forward_of_the_disturbance_s_rate_is_worth_its_noise(in_wind):
    without = flown("iadrc", joint_flight.Params(feedforward=0.0), seconds=14.0)
    assert in_wind["iadrc"].rmse() < 0.85 * without.rmse()


@pytest.mark.parametrize(
    "world",
    [{"link_s": 0.06, "wn": 10.0}, {"wn": 22.0, "zeta": 0.7, "v_bias": (0.03, -0.03), "thrust": 1 / 1.2, "push": (8.0, 2.0)}],
    ids=lambda w: ",".join(w),
)
def test_delay_lag_thrust_biased_velocity_and_pushes_are_borne(world):
    record = flown("iadrc", seconds=12.0, **world)
    assert record.rmse() < 0.06
    assert record.worst() < 0.20


@pytest.mark.slow
@pytest.mark.parametrize("path", ["hover", "rectangle"])
def test_the_other_paths_too(path):
    rmse = {name: flown(name, path=path, seconds=35.0).rmse() for name in PAIRS}
    assert rmse["iadrc"] <= 0.5 * min(rmse["adrc"], rmse["pid"])


def test_the_disturbance_estimate_follows_the_true_one_with_little_lag():
    record = flown("iadrc", seconds=18.0, gust=(2.5, 2.5, 2.5), memory_s=(1.5, 1.5, 1.5), drift_rad=0.0)
    truth, estimate = np.array(record.f_true), np.array(record.f)
    for axis in range(3):
        a = truth[:, axis] - truth[:, axis].mean()
        scores = [np.corrcoef(a[: len(a) - s], estimate[s:, axis])[0, 1] for s in range(60)]
        assert max(scores) > 0.85
        assert 0.008 * int(np.argmax(scores)) < 0.2


def _spoilt(sample, rng):
    """One in four lost; one in ten with a NaN in it; some an old one again."""
    r = rng.random()
    if r < 0.25:
        return None
    if r < 0.35:
        return sample._replace(**{sample._fields[1]: (math.nan,) * len(sample[1])}) if isinstance(sample[1], tuple) else sample
    return sample


def test_lost_and_broken_samples_cost_accuracy_and_nothing_else():
    record = flown("iadrc", seconds=12.0, change=_spoilt)
    assert record.rmse() < 0.06
    assert np.isfinite(np.array(record.f)).all()


# ---- the estimator alone ---------------------------------------------------------------------------------------------
G = joint_flight.gains(joint_flight.Params(), X500)
LEVEL = (1.0, 0.0, 0.0, 0.0)


def at_rest(seconds, gains=G, delay_s=0.0, thrust=9.80665):
    """A vehicle that hangs still, everything told at its rate."""
    state, now = joint_flight.init(gains), 0
    for ms in range(4, round(1000 * seconds), 4):
        now = 1000 * ms
        state = joint_flight.observe(gains, state, Attitude(now, LEVEL, ZERO3))
        if ms % 20 == 0:
            state = joint_flight.observe(gains, state, Position(now, (1.0, 2.0, -5.0), ZERO3))
        if ms % 8 == 0:
            state, estimate = joint_flight.step(gains, state, Applied(now, LEVEL, thrust, NAN3, delay_s), now)
    return state, estimate, now


def test_before_a_position_there_is_no_estimate_and_after_one_there_is():
    state = joint_flight.init(G)
    state = joint_flight.observe(G, state, Attitude(1000, LEVEL, ZERO3))
    state, estimate = joint_flight.step(G, state, Applied(1000, LEVEL, 9.8, NAN3, 0.0), 1000)
    assert math.isnan(estimate.p_ned_m[0])
    state = joint_flight.observe(G, state, Position(2000, (1.0, 2.0, -3.0), (0.1, 0.2, 0.3)))
    state, estimate = joint_flight.step(G, state, Applied(2000, LEVEL, 9.8, NAN3, 0.0), 2000)
    assert estimate.p_ned_m == pytest.approx((1.0, 2.0, -3.0))
    assert estimate.v_ned_m_s == pytest.approx((0.1, 0.2, 0.3))


def test_thrust_that_does_not_carry_is_a_disturbance():
    _, estimate, _ = at_rest(6.0, thrust=8.0)
    assert estimate.f_ned_m_s2 == pytest.approx((0.0, 0.0, 8.0 - 9.80665), abs=1e-3)
    assert estimate.thrust_m_s2 == pytest.approx(8.0)


def test_the_same_sample_twice_is_the_same_as_once_and_an_old_one_is_ignored():
    state, _, now = at_rest(1.0)
    again = Position(int(state.view(joint_tick.RECORD)["position_us"][0]), (50.0, 50.0, 50.0), ZERO3)
    for sample in (
        again,
        again._replace(t_us=now - 600_000),
        Attitude(int(state.view(joint_tick.RECORD)["attitude_us"][0]), quat.from_euler(1.0, 0, 0), ZERO3),
    ):
        assert joint_flight.observe(G, state, sample) is state


def test_a_late_position_is_carried_forward_to_now():
    speed = (3.0, 0.0, 0.0)
    state = joint_flight.observe(G, joint_flight.init(G), Attitude(1000, LEVEL, ZERO3))
    state = joint_flight.observe(G, state, Position(1000, ZERO3, speed))
    for ms in range(5, 402, 4):
        state = joint_flight.observe(G, state, Attitude(1000 * ms, LEVEL, ZERO3))
        if (ms - 1) % 20 == 0 and ms > 60:  # sampled 60 ms ago
            then = 1e-3 * (ms - 60)
            state = joint_flight.observe(G, state, Position(1000 * (ms - 60), (3.0 * then, 0.0, 0.0), speed))
    _, estimate = joint_flight.step(G, state, Applied(401_000, LEVEL, 9.80665, NAN3, 0.0), 401_000)
    assert estimate.p_ned_m[0] == pytest.approx(3.0 * 0.4, abs=0.05)  # 0.18 m behind if taken as new; drag slows it a little


def test_after_a_silence_it_begins_again_where_it_is_told():
    state, before, now = at_rest(3.0, thrust=9.0)
    state = joint_flight.observe(G, state, Attitude(now + 2_000_000, LEVEL, ZERO3))
    state = joint_flight.observe(G, state, Position(now + 2_000_000, (9.0, 9.0, -9.0), ZERO3))
    _, estimate = joint_flight.step(G, state, Applied(now + 2_000_000, LEVEL, 9.0, NAN3, 0.0), now + 2_000_000)
    assert estimate.p_ned_m == pytest.approx((9.0, 9.0, -9.0))
    assert estimate.f_ned_m_s2[2] == pytest.approx(before.f_ned_m_s2[2], abs=0.1)  # what was learnt is kept


def test_the_gyro_stands_in_where_no_attitude_comes():
    state, _, now = at_rest(1.0)
    for k in range(1, 100):
        state = joint_flight.observe(G, state, Imu(now + 200_000 + 4000 * k, (0.0, 0.0, -9.8), (0.5, 0.0, 0.0)))
    assert state.view(joint_tick.RECORD)["omega_rad_s"][0, 0] == pytest.approx(0.5, abs=0.01)


def test_thrust_is_what_was_sent_a_delay_ago_and_the_echo_counts_where_there_is_one():
    record = joint_flight.init(G)
    thrust = record.view(joint_tick.RECORD)[0]
    assert applied_thrust.acting(thrust, 0, True) == pytest.approx(9.80665)
    for k in range(100):
        applied_thrust.remember(thrust, 8000 * k, 10.0 + 0.01 * k, 0.04)
    assert applied_thrust.acting(thrust, 8000 * 99, True) == pytest.approx(10.0 + 0.01 * 94)
    for k in range(60, 100):
        applied_thrust.hear(thrust, 8000 * k, (9.95 + 0.01 * k) / 20.0)
    assert thrust.scale == pytest.approx(20.0)
    assert applied_thrust.acting(thrust, 8000 * 100, True) == pytest.approx(10.94)
    assert applied_thrust.acting(thrust, 8000 * 100 + 500_000, True) == pytest.approx(10.99)  # the echo has grown old
    before = record.copy()
    applied_thrust.hear(thrust, 1, 0.5)
    applied_thrust.remember(thrust, 10**6, math.nan, math.nan)
    assert before.tobytes() == record.tobytes()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"w0_xy_rad_s": 40.0}, "w0.dt at most 0.6"),
        ({"q_velocity": 0.0}, "joint.q_velocity"),
        ({"feedforward": 1.2}, "feedforward = 1.2"),
        ({"anchor_s": 0.1}, "anchor_s"),
        ({"accel_tau_s": -1.0}, "accel_tau_s"),
    ],
)
def test_impossible_settings_of_the_estimator_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        joint_flight.Params(**settings)


def test_a_filter_too_slow_for_its_observers_is_warned_of():
    verdicts = [
        f.verdict for f in joint_flight.checks(joint_flight.Params(q_velocity=1e-5, sigma_velocity_m_s=1.0, w0_xy_rad_s=25.0))
    ]
    assert verdicts[0] == "warn"
    assert {f.verdict for f in joint_flight.checks(joint_flight.Params())} == {"ok"}


def planned(**settings):
    return plan.build(config.convert({"controller": "iadrc", **settings}, Companion, "test"), X500)


def test_what_the_design_checks_warn_of_is_in_the_plan_and_what_they_refuse_is_not_built():
    assert [w for w in planned().warnings if "below 3 wc" in w]
    assert planned(tune={"iadrc": {"wc_xy_rad_s": 2.5, "wc_z_rad_s": 2.5}}).warnings == ()
    with pytest.raises(
        ConfigError, match=r"iadrc: w0/wc xy: 1\.33, limit 1\.5: w0 8 is below 1\.5 wc \(6\); raise w0 or lower wc"
    ):
        planned(tune={"iadrc": {"wc_xy_rad_s": 6.0}})


# ---- the controller alone --------------------------------------------------------------------------------------------
C = iadrc_flight.gains(iadrc_flight.Params(), X500)
vectors = st.tuples(*[st.floats(-3.0, 3.0)] * 3)


@given(a=vectors, u=vectors, rest=vectors, h=st.floats(1e-3, 0.3))
def test_the_motion_under_a_command_is_exact(a, u, rest, h):
    vehicle = C.vehicle._replace(drag_linear_1_s=ZERO3, drag_quadratic_1_m=ZERO3)
    queue = iadrc_flight.init(C).queue.copy()
    queue[-1] = -1.0, *u
    p, v, a2 = lagged.ahead(vehicle, ZERO3, (1.0, 0.0, 0.0), a, rest, queue, 0.0, h, h)
    t = (np.arange(4000) + 0.5) * h / 4000
    for i in range(3):
        lag_s = vehicle.lag_down_s if i == 2 else vehicle.lag_s
        acc = u[i] + (a[i] - u[i]) * np.exp(-t / lag_s) + rest[i]
        assert v[i] == pytest.approx((1.0 if i == 0 else 0.0) + acc.sum() * h / 4000, abs=1e-5)
        assert p[i] == pytest.approx((h if i == 0 else 0.0) + ((h - t) * acc).sum() * h / 4000, abs=1e-5)
        assert a2[i] == pytest.approx(u[i] + (a[i] - u[i]) * math.exp(-h / lag_s), abs=1e-9)


def test_commands_under_way_are_carried_through_each_from_its_time():
    queue = iadrc_flight.init(C).queue.copy()
    for k in range(10):
        queue[k - 10] = 0.01 * k, float(k), 0.0, 0.0
    quick = C.vehicle._replace(lag_s=1e-6, lag_down_s=1e-6, drag_linear_1_s=ZERO3, drag_quadratic_1_m=ZERO3)
    _, v, _ = lagged.ahead(quick, ZERO3, ZERO3, ZERO3, ZERO3, queue, 0.0901, 0.05, 0.05)
    # at 0.09 command 4 (sent at 0.04) is in force; then 5, 6, 7, 8 for 10 ms each, and 9 takes over as the prediction ends
    assert v[0] == pytest.approx(0.01 * (4 + 5 + 6 + 7 + 8), abs=1e-3)


@settings(max_examples=12)
@given(roll=st.floats(-1.0, 1.0), pitch=st.floats(-1.0, 1.0), yaw=st.floats(-3.0, 3.0), a=vectors)
def test_body_rates_turn_the_thrust_axis_onto_the_command_and_the_nose_onto_its_heading(roll, pitch, yaw, a):
    q, aim_yaw, dt = quat.from_euler(roll, pitch, yaw), 0.5, 0.02
    for _ in range(200):
        q = quat.integrate(q, iadrc_flight.body_rates(q, a, aim_yaw, 8.0), dt)
    up = np.array(quat.rotate(q, (0.0, 0.0, 1.0)))
    wanted = np.array([-a[0], -a[1], 9.80665 - a[2]])
    np.testing.assert_allclose(up, wanted / np.linalg.norm(wanted), atol=0.02)
    assert abs(math.remainder(quat.yaw(q) - aim_yaw, 2 * math.pi)) < 0.02


def test_the_attitude_loop_is_closed_here_only_below_20_ms():
    rates = iadrc_flight.gains(iadrc_flight.Params(loop="rates"), X500)
    still = Demand(0, (1.0, 0.0, -5.0), ZERO3, ZERO3, ZERO3, 0.0, 0.0)
    for delay_s, finite in ((0.01, True), (0.03, False)):
        estimate = Estimate(0, (0.0, 0.0, -5.0), ZERO3, LEVEL, ZERO3, ZERO3, NAN3, delay_s, 9.80665)
        _, command = iadrc_flight.step(rates, iadrc_flight.init(rates), estimate, still, lambda t: still, 0.008)
        assert math.isfinite(command.omega_rad_s[0]) == finite
    assert command.omega_rad_s[1] != command.omega_rad_s[1]


def test_flying_on_body_rates_works_too():
    record = flown("iadrc", control=iadrc_flight.Params(loop="rates"), seconds=10.0, rates=True)
    assert record.rmse() < 0.03


def test_the_law_says_what_it_cancels_and_a_missing_estimate_cancels_nothing():
    still = Demand(0, (0.0, 0.0, -5.0), ZERO3, ZERO3, ZERO3, 0.0, 0.0)
    for f, cancelled in (((0.5, -0.2, 0.1), (0.5, -0.2, 0.1)), (NAN3, ZERO3)):
        estimate = Estimate(0, (0.0, 0.0, -5.0), ZERO3, LEVEL, ZERO3, f, NAN3)
        plain = adrc_flight.gains(adrc_flight.Params(), X500)
        _, command = adrc_flight.step(plain, adrc_flight.init(plain), estimate, still, lambda t: still, 0.008)
        assert command.f_cancelled_m_s2 == pytest.approx(cancelled)
        assert command.a_ned_m_s2 == pytest.approx([-x for x in cancelled])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"wc_xy_rad_s": 30.0}, "wc_xy_rad_s = 30"),
        ({"quicken": 0.5}, "quicken = 0.5"),
        ({"delay_max_s": 2.0}, "delay_max_s = 2"),
        ({"tilt_max_deg": 80.0}, "tilt_max_deg = 80"),
        ({"jerk_feed_forward": -1.0}, "jerk_feed_forward = -1"),
        ({"loop": "motors"}, "attitude or rates"),
    ],
)
def test_impossible_settings_of_the_controller_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        iadrc_flight.Params(**settings)


def test_a_slower_attitude_gets_a_lower_bandwidth():
    slow = airframe.load("x500", ("attitude.natural_frequency_rad_s=7",))
    assert iadrc_flight.gains(iadrc_flight.Params(), slow).wc[0] < 0.7 * C.wc[0]
