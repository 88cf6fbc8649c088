"""The helicopter's compensator in flight, closed around the truth of the paper's experiment: full kinematics, wind, derivatives by speed."""

import math

import numpy as np
import pytest

from mavquad import active_helicopter, airframe, quat
from mavquad.errors import ConfigError
from mavquad.identify import models
from mavquad.setpoint import limits
from mavquad.signals import NAN3, ZERO3, Applied, Attitude, Command, Controls, Demand, Estimate, Position
from tools.papers.active import helicopter as truth

HELICOPTER = airframe.load("helicopter")
TICK_US = active_helicopter.TICK_US
NOMINAL = Command(ZERO3, 0.0, 0.0, NAN3, ZERO3)


def at_rest(t_us):
    return Demand(t_us, ZERO3, ZERO3, ZERO3, ZERO3, 0.0, 0.0)


def away(t_us):
    """From rest to 4 m/s northwards in 4 s."""
    t = 1e-6 * t_us - 3.0
    s, v, a = (0.0, 0.0, 0.0) if t < 0.0 else (0.5 * t * t, t, 1.0) if t < 4.0 else (8.0 + 4.0 * (t - 4.0), 4.0, 0.0)
    return Demand(t_us, (s, 0.0, 0.0), (v, 0.0, 0.0), (a, 0.0, 0.0), ZERO3, 0.0, 0.0)


class Loop:
    """One tick of 20 ms: telemetry, the compensator, its sticks from the next tick on (an attitude hold's before that)."""

    def __init__(self, path=at_rest, wind=(2.0, -3.0, 0.0), echoes=True, **params):
        self.gains = active_helicopter.gains(active_helicopter.Params(delay_s=0.02, **params), HELICOPTER)
        self.state = active_helicopter.init(self.gains)
        model = models.ref_13()
        self.plant = truth.Plant(np.ascontiguousarray(model.a), np.ascontiguousarray(model.b))
        self.stick = self.acted = np.zeros(4)
        self.wind, self.path, self.echoes = np.array(wind), path, echoes
        self.z = np.zeros(17)
        self.rng, self.k = np.random.default_rng(1), 0
        self.rows, self.errors = [], []

    def run(self, seconds):
        for _ in range(round(seconds / truth.DT_S)):
            self.tick()

    def tick(self):
        self.k += 1
        z, self.acted = self.z, self.stick
        for _ in range(4):
            truth._advance(z, self.plant, self.stick, self.wind, 0.25 * truth.DT_S)
        t_us = self.k * TICK_US
        q = quat.from_euler(z[truth.PHI], z[truth.THETA], z[truth.PSI])
        body = (z[truth.U], z[truth.V], z[truth.W])
        v = np.array(quat.rotate(q, body)) + 0.05 * self.rng.uniform(-1, 1, 3)
        omega = tuple(np.array([z[truth.P], z[truth.Q], z[truth.R]]) + 0.01 * self.rng.uniform(-1, 1, 3))
        place = tuple(float(x) for x in z[13:16])
        samples = [Attitude(t_us, q, omega), Position(t_us, place, tuple(float(x) for x in v))]
        lon, lat, ped, col = (float(s) for s in self.stick)
        if self.echoes:
            samples.append(Controls(t_us, (lat, lon, ped, col)))
        for sample in samples:
            self.state = active_helicopter.observe(self.gains, self.state, sample)
        estimate = Estimate(t_us, place, tuple(v), q, omega, NAN3, NAN3)
        applied = Applied(t_us, q, 9.8, NAN3, 0.0)
        self.state, self.command = active_helicopter.step(self.gains, self.state, estimate, NOMINAL, applied, t_us, self.path)
        if math.isfinite(self.command.sticks[0]):
            lat, lon, ped, col = self.command.sticks
            self.stick = np.array([lon, lat, ped, col])
        else:  # somebody holds it meanwhile
            error = np.zeros(17)
            error[:13] = z[:13]
            self.stick = -self.gains.target.k_attitude @ error[:13]
        self.rows.append(dict(zip(active_helicopter.PUBLISHED, active_helicopter.published(self.state), strict=True)))
        self.errors.append(math.dist(self.path(t_us).p_ned_m, place))


def test_the_nominal_flies_until_the_filter_has_settled_and_then_the_path_is_held_in_wind():
    loop = Loop()
    loop.run(0.9)
    assert math.isnan(loop.command.sticks[0])
    assert loop.rows[-1]["authority"] == 0.0
    loop.run(15.0)
    assert math.isfinite(loop.command.sticks[0])
    assert loop.command.a_ned_m_s2 == NOMINAL.a_ned_m_s2  # kept for the way back
    assert max(loop.errors[-100:]) < 0.08
    assert loop.rows[-1]["empty"] == 0.0
    assert min(row["guarantee"] for row in loop.rows[50:]) == 1.0


def test_what_the_model_lacks_is_inside_the_bounds():
    loop, width = Loop(away), []
    for _ in range(600):
        loop.tick()
        if loop.k < 60:
            continue
        z, plant, row = loop.z, loop.plant, loop.rows[-1]
        rate = truth._rate(z, plant, loop.acted, loop.wind)[:13]
        lacks = rate - plant.a @ z[:13] - plant.b @ loop.acted - truth.heli_error.known_terms(z)
        f = quat.rotate(loop.state.attitude.q_wxyz, tuple(float(lacks[i]) for i in (truth.U, truth.V, truth.W)))
        for axis, value in zip("ned", f, strict=True):
            assert row[f"f_{axis}_low"] <= value <= row[f"f_{axis}_high"]
            width.append(row[f"f_{axis}_high"] - row[f"f_{axis}_low"])
    assert max(loop.errors[-100:]) < 0.25
    assert max(width) < 16.0  # an ellipsoid around boxes: wide, and not everything


def test_f_holds_the_point_where_no_integral_does():
    with_f, without = Loop(integral_1_s=0.0), Loop(integral_1_s=0.0, authority=0.02)
    with_f.run(10.0)
    without.run(10.0)
    assert np.mean(without.errors[-100:]) > 3.0 * np.mean(with_f.errors[-100:])


def test_no_echo_of_the_sticks_and_no_fresh_velocity_leave_the_nominal_to_fly():
    silent = Loop(echoes=False)
    silent.run(2.0)
    assert math.isnan(silent.command.sticks[0])
    assert math.isnan(silent.rows[-1]["f_n"])
    loop = Loop()
    loop.run(3.0)
    assert math.isfinite(loop.command.sticks[0])
    loop.echoes = False
    loop.run(1.0)
    assert math.isnan(loop.command.sticks[0])
    assert loop.rows[-1]["authority"] == 0.0


def test_an_integral_does_not_wind_up_while_somebody_else_flies():
    loop = Loop(lambda t_us: at_rest(t_us)._replace(p_ned_m=(3.0, 0.0, 0.0)))
    step = active_helicopter.step

    def deaf(*args):
        state, command = step(*args)
        loop.asked = command.sticks
        return state, NOMINAL

    active_helicopter.step = deaf
    try:
        loop.run(4.0)
    finally:
        active_helicopter.step = step
    assert math.isfinite(loop.asked[0])
    assert loop.state.memory.integral_m == (0.0, 0.0, 0.0)


def test_what_is_not_finite_is_dropped_and_a_clock_that_jumps_begins_again():
    loop = Loop()
    loop.run(2.0)
    for sample in (
        Controls(1, (math.nan, 0.0, 0.0, 0.0)),
        Attitude(1, quat.IDENTITY, NAN3),
        Position(1, NAN3, ZERO3),
        "something else",
    ):
        assert active_helicopter.observe(loop.gains, loop.state, sample) is loop.state
    loop.k += 500
    loop.tick()
    assert math.isnan(loop.command.sticks[0])
    loop.run(3.0)
    assert math.isfinite(loop.command.sticks[0])


def test_a_vehicle_without_a_hover_model_and_impossible_numbers_are_refused():
    with pytest.raises(ConfigError, match=r"no \[hover_model\]"):
        active_helicopter.gains(active_helicopter.Params(), airframe.load("x500"))
    with pytest.raises(ConfigError, match=r"asmf\.authority"):
        active_helicopter.Params(authority=2.0)
    with pytest.raises(ConfigError, match=r"asmf\.delay_s"):
        active_helicopter.Params(delay_s=1.0)


def test_the_gate_of_the_sticks_is_finite_bounded_and_slewed():
    first, bits = limits.sticks(None, (0.1, -2.0, math.nan, 0.4), 0.02)
    assert first == (0.1, -1.0, 0.0, 0.4)
    assert bits == limits.NOT_FINITE | limits.STICK
    second, bits = limits.sticks(first, (0.1, 1.0, 0.0, math.inf), 0.02)
    assert second == pytest.approx((0.1, -1.0 + 0.02 * limits.STICK_SLEW_PER_S, 0.0, 0.4))
    assert bits == limits.NOT_FINITE | limits.STICK
    assert limits.sticks(first, first, 0.02) == (first, 0)
