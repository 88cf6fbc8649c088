"""The compensator in flight, in a small closed loop of its own: a point mass behind a first-order attitude loop."""

import math

import msgspec
import numpy as np
import pytest

from mavquad import active_flight, active_tick, airframe, quat
from mavquad.compensate import active_model
from mavquad.errors import ConfigError
from mavquad.estimate import quad_error
from mavquad.signals import NAN3, ZERO3, Applied, Attitude, Command, Estimate, Imu, Position, Target

G_M_S2 = 9.80665
X500 = msgspec.structs.replace(airframe.load("x500"), bounds=airframe.ModelBounds())  # errors as the design note has them
DT_S = 0.008
PUSH = (0.8, -0.5, 0.6)


class Loop:
    """Truth: v' = g e3 - R e3 T + PUSH, attitude and thrust through the airframe's lags. A PD law holds the origin."""

    def __init__(self, params=None, own_estimate=None, noise_seed=1, compensate=True):
        self.gains = active_flight.gains(params or active_flight.Params(delay_s=0.0), X500)
        self.state = active_flight.init(self.gains)
        self.p, self.v = np.zeros(3), np.zeros(3)
        self.roll = self.pitch = 0.0
        self.thrust = G_M_S2
        self.sent = (0.0, 0.0, G_M_S2)
        self.own_estimate = own_estimate or (lambda _: ZERO3)
        self.rng = np.random.default_rng(noise_seed)
        self.compensate = compensate
        self.k = 0
        self.push = PUSH
        self.hide = set()
        self.rows = []

    def specific_force(self):
        q = quat.from_euler(self.roll, self.pitch, 0.0)
        body = quat.rotate_back(q, self.push)
        return (body[0], body[1], body[2] - self.thrust), q

    def run(self, seconds):
        for _ in range(round(seconds / DT_S)):
            self.tick()

    def tick(self):
        self.k += 1
        for _ in range(4):
            a = np.array(active_model.acceleration_of((self.roll, self.pitch, self.thrust), 0.0)) + self.push
            self.p, self.v = self.p + 0.25 * DT_S * self.v, self.v + 0.25 * DT_S * a
            lag = 0.25 * DT_S / X500.attitude.lag_s
            self.roll += lag * (self.sent[0] - self.roll)
            self.pitch += lag * (self.sent[1] - self.pitch)
            self.thrust += 0.25 * DT_S / X500.rotors.lag_s * (self.sent[2] - self.thrust)
        t_us = round(1e6 * self.k * DT_S)
        noise = self.rng.uniform(-1, 1, 8)
        body, _ = self.specific_force()
        q = quat.from_euler(self.roll + 0.003 * noise[0], self.pitch + 0.003 * noise[1], 0.0)
        v = tuple(float(x) for x in self.v + 0.04 * noise[2:5])
        samples = [Attitude(t_us, q, ZERO3), Imu(t_us, tuple(np.array(body) + 0.2 * noise[5:8]), ZERO3)]
        if self.k % 3 == 0:
            samples.append(Position(t_us, tuple(self.p), v))
        for sample in samples:
            if type(sample) not in self.hide:
                self.state = active_flight.observe(self.gains, self.state, sample)
        own = self.own_estimate(self)
        law = tuple(float(x) for x in -3.0 * self.p - 3.0 * self.v - np.array(own))
        nominal = Command(law, 0.0, 0.0, NAN3, own)
        applied = Applied(t_us, quat.from_euler(self.sent[0], self.sent[1], 0.0), self.sent[2], NAN3, 0.0)
        estimate = Estimate(t_us, tuple(self.p), v, q, ZERO3, NAN3, NAN3)
        self.state, command = active_flight.step(self.gains, self.state, estimate, nominal, applied, t_us)
        self.command = command if self.compensate else nominal
        self.sent = active_model.attitude_for(self.command.a_ned_m_s2, 0.0)
        shown = dict(zip(active_flight.PUBLISHED, active_flight.published(self.state), strict=True))
        self.rows.append({**shown, "distance": float(np.linalg.norm(self.p))})

    def last(self, name, seconds=2.0):
        return np.array([row[name] for row in self.rows[-round(seconds / DT_S) :]])


def test_an_unknown_push_is_cancelled_and_its_bounds_hold_it():
    plain, corrected = Loop(compensate=False), Loop()
    plain.run(12.0)
    corrected.run(12.0)
    assert plain.last("distance").mean() > 0.3
    assert corrected.last("distance").max() < 0.03
    for axis, push in zip("ned", PUSH, strict=True):
        settled = corrected.rows[100:]
        assert all(row[f"f_{axis}_low"] <= push <= row[f"f_{axis}_high"] for row in settled)
        assert abs(corrected.last(f"f_{axis}").mean() - push) < 0.05
    assert corrected.last("guarantee").min() == 1.0
    assert corrected.last("empty")[-1] == 0.0


@pytest.mark.parametrize("share", [0.5, 1.0, 1.5])
def test_what_the_controller_cancels_itself_is_cancelled_once(share):
    loop = Loop(own_estimate=lambda _: tuple(share * x for x in PUSH))
    loop.run(12.0)
    assert loop.last("distance").max() < 0.03
    np.testing.assert_allclose([loop.last(f"given_back_{axis}")[-1] for axis in "ned"], np.array(PUSH) * share, atol=1e-9)
    np.testing.assert_allclose(loop.command.f_cancelled_m_s2, [loop.last(f"f_{axis}")[-1] for axis in "ned"], atol=1e-9)


def test_authority_ramps_up_in_two_seconds_and_without_it_the_controller_s_own_estimate_flies():
    loop = Loop()
    loop.run(1.008)
    assert loop.rows[-1]["authority"] == pytest.approx(0.5, abs=0.01)
    loop.run(1.5)
    assert loop.rows[-1]["authority"] == 1.0
    none = Loop(active_flight.Params(delay_s=0.0, authority=0.0), own_estimate=lambda _: PUSH)
    none.run(8.0)
    assert none.last("distance").max() < 0.03
    assert none.last("given_back_n").max() == 0.0


def test_a_wound_up_integral_takes_over_only_as_far_as_the_bounds_believe_it():
    loop = Loop(own_estimate=lambda _: (6.0, 0.0, 0.0))
    loop.run(6.0)
    high = loop.rows[-1]["f_n_high"]
    loop.gains = loop.gains._replace(authority=0.0)
    loop.run(1.0)
    assert loop.rows[-1]["authority"] == 0.0
    assert abs(loop.command.f_cancelled_m_s2[0] - high) < active_tick.WOUND_UP_M_S2 + 0.6


def test_a_lost_accelerometer_widens_the_bounds_and_softens_the_correction():
    loop = Loop()
    loop.run(6.0)
    narrow = loop.rows[-1]["half_width"]
    loop.hide = {Imu}
    loop.run(3.0)
    assert loop.rows[-1]["half_width"] > 1.5 * narrow
    assert loop.last("distance").max() < 0.2  # velocity alone is slower, and still better than no correction (0.37)
    loop.hide = {Imu, Position}
    loop.run(4.0)
    assert loop.rows[-1]["authority"] < 0.6


def test_an_impossible_jump_of_velocity_is_seen_and_dropped():
    loop = Loop()
    loop.run(4.0)
    t_us = round(1e6 * loop.k * DT_S)
    for k in range(3):  # the next velocity is due in three ticks: nothing covers these
        loop.state = active_flight.observe(loop.gains, loop.state, Position(t_us + 8000 * (k + 1) - 1, ZERO3, (30.0, 0.0, 0.0)))
        loop.tick()
    assert loop.rows[-1]["empty"] >= 1.0
    assert loop.rows[-1]["guarantee"] == 0.0
    assert abs(loop.rows[-1]["f_n"] - PUSH[0]) < 0.3
    loop.run(1.0)
    assert loop.rows[-1]["guarantee"] == 1.0


def test_what_is_not_finite_is_dropped_and_nothing_heard_changes_nothing():
    gains = active_flight.gains(active_flight.Params(), X500)
    state = active_flight.init(gains)
    for sample in (
        Imu(1, NAN3, ZERO3),
        Attitude(1, (math.nan, 0.0, 0.0, 0.0), ZERO3),
        Position(1, ZERO3, (math.inf, 0.0, 0.0)),
        Target(1, (math.nan, 0.0, 0.0, 0.0), ZERO3, 0.5, 0),
        "something else",
    ):
        assert active_flight.observe(gains, state, sample) is state
    nominal = Command((0.1, 0.2, 0.3), 0.0, 0.0, NAN3, ZERO3)
    applied = Applied(8000, quat.IDENTITY, G_M_S2, NAN3, 0.0)
    estimate = Estimate(8000, ZERO3, ZERO3, quat.IDENTITY, ZERO3, NAN3, NAN3)
    state, command = active_flight.step(gains, state, estimate, nominal, applied, 8000)
    assert command == nominal
    assert len(active_flight.published(state)) == len(active_flight.PUBLISHED)


@pytest.mark.parametrize("jump_us", [-5_000_000, 3_000_000])
def test_a_clock_that_jumps_begins_again_without_a_bump(jump_us):
    loop = Loop()
    loop.run(4.0)
    loop.k += round(1e-6 * jump_us / DT_S)
    loop.tick()
    assert loop.rows[-1]["authority"] == 0.0
    assert np.isfinite(loop.command.a_ned_m_s2).all()
    loop.run(6.0)
    assert loop.last("distance").max() < 0.05


def test_vertex_never_flies_and_a_helicopter_is_refused():
    with pytest.raises(ConfigError, match="vertex.*never flies"):
        active_flight.gains(active_flight.Params(mode="vertex"), X500)
    with pytest.raises(ConfigError, match="models a quadrotor"):
        active_flight.gains(active_flight.Params(), airframe.Airframe(
            name="r50", kind="helicopter", hover_thrust=0.5, body=X500.body, attitude=X500.attitude
        ))  # fmt: skip
    with pytest.raises(ConfigError, match=r"asmf\.authority"):
        active_flight.Params(authority=2.0)


@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.5])
def test_attitude_and_acceleration_are_inverse(yaw):
    rng = np.random.default_rng(3)
    for _ in range(50):
        a = tuple(rng.uniform(-6, 6, 3))
        attitude = active_model.attitude_for(a, yaw)
        np.testing.assert_allclose(active_model.acceleration_of(attitude, yaw), a, atol=1e-9)


def test_while_the_thrust_changes_the_published_bounds_allow_for_its_delay():
    """The thrust acts 10 ms later than the model thinks: f is off by as much as the thrust has moved."""
    model = quad_error.gains(quad_error.Params(thrust_lag_s=0.03))
    state = quad_error.init(model, ZERO3, ZERO3, G_M_S2)
    command, thrust, outside, width = G_M_S2, [G_M_S2] * 2, 0, []
    for k in range(1, 800):
        if k % 25 == 0:
            command = G_M_S2 + (2.5 if k % 50 else -2.5)
        thrust.append(quad_error.thrust_after(thrust[-1], command, 0.03, 0.008))
        acts = thrust[-2] + 0.25 * (thrust[-3] - thrust[-2])
        felt = 0.5 * (acts + thrust[-3])  # the mean over the tick is 4 ms old
        measured = quad_error.Measured(ZERO3, NAN3, (0.0, 0.0, -felt), 0.0, 0.0, 0.004)
        state = quad_error.step(model, state, (0.0, 0.0, command), measured, 0.008, 8000 * k)
        cut, f = quad_error.bounds_f(state, 2), state.thrust_m_s2 - acts
        outside += not cut.low <= f <= cut.high
        width.append(cut.high - cut.low)
    assert outside == 0
    assert np.median(width) < 2.0
