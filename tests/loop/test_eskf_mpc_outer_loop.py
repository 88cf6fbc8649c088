"""The flight faces around a point mass with an autopilot's lag, wind, and telemetry as it is: what each part is worth.

The ordering is that of the design note on a real autopilot: PD, PID, observer with PD, LQR on (p, v, a) with prediction, drag
feed-forward and slow integral, the same with body rates.
"""

from dataclasses import replace
from functools import lru_cache

import pytest

from mavquad import airframe
from mavquad.control import mpc_flight, pd, pid
from mavquad.estimate import direct
from mavquad.estimate import extended_state_flight as eskf
from mavquad.signals import Attitude, Position
from tests.oracles.point_mass import World, fly

FRAME = airframe.load(
    "x500",
    (
        "attitude.natural_frequency_rad_s=10.954",
        "attitude.damping=0.9129",
        "attitude.delay_s=0.03",
        "drag.linear_n_s_m=[0.5,0.5,0.5]",
        "drag.quadratic_n_s2_m2=[0.03,0.03,0.03]",
    ),
)
ESKF = eskf.Params(position_sigma_m=0.005, velocity_sigma_m_s=0.02)
MPC = mpc_flight.Params()
CIRCLE = World()
ELLIPSE = World(speed_m_s=8.0, radius_m=18.0)
BARE = {"lag_s": 0.002, "predict": False, "jerk_feed_forward": 0.0, "drag_feed_forward": 0.0, "integral_1_s3": 0.0}


@lru_cache
def _mpc(world: World, estimator: eskf.Params = ESKF, controller: mpc_flight.Params = MPC) -> float:
    rms, _ = fly(world, eskf, eskf.gains(estimator, FRAME), mpc_flight, mpc_flight.gains(controller, FRAME))
    return rms


def _rival(world: World, module) -> float:
    params = module.Params(drag_feed_forward=0.0)
    return fly(world, direct, direct.gains(direct.Params(), FRAME), module, module.gains(params, FRAME))[0]


def test_the_ordering_of_a_real_autopilot_comes_out():
    observer_pd = _mpc(CIRCLE, replace(ESKF, drag=0.0, anchor_s=0.0), mpc_flight.Params(r_input=0.5, **BARE))
    with_rates = _mpc(replace(CIRCLE, rates=True), ESKF, replace(MPC, rates=True, lag_s=0.05, delay_s=0.03))
    ranks = [_rival(CIRCLE, pd), _rival(CIRCLE, pid), observer_pd, _mpc(CIRCLE), with_rates]
    assert ranks == sorted(ranks, reverse=True)
    assert ranks[3] < 0.2 * ranks[1]
    assert ranks[3] < 0.06  # the note's circle at 7 m/s of wind: .058; with rates .039
    assert ranks[4] < 0.04


@pytest.mark.parametrize(
    ("world", "estimator", "controller", "factor"),
    [
        (ELLIPSE, replace(ESKF, drag=0.0), replace(MPC, drag_feed_forward=0.0), 1.2),  # drag along the path
        (ELLIPSE, ESKF, replace(MPC, jerk_feed_forward=0.0), 1.05),  # the path's jerk
        (CIRCLE, replace(ESKF, anchor_s=0.0), replace(MPC, integral_1_s3=0.0), 1.5),  # telemetry that disagrees with itself
        (replace(CIRCLE, down_s=0.08, up_s=0.08), ESKF, replace(MPC, predict=False), 3.0),  # a slow link
        (CIRCLE, ESKF, replace(MPC, compensate=False), 1.5),  # the observer itself
    ],
)
def test_each_part_is_worth_its_keep(world, estimator, controller, factor):
    assert _mpc(world, estimator, controller) > factor * _mpc(world)


def test_a_thrust_delay_unknown_to_the_observer_is_seen_by_its_echo():
    world = replace(CIRCLE, delay_s=0.1, seconds=14.0)
    assert _mpc(world) < _mpc(world, replace(ESKF, echo=False))


def test_late_repeated_and_missing_samples_are_borne():
    def spoil(t_us, sample):
        if isinstance(sample, Position) and sample.t_us % 60_000 == 0:
            return None
        return sample._replace(t_us=sample.t_us - 8000) if isinstance(sample, Attitude) and t_us % 400_000 == 0 else sample

    gains = eskf.gains(ESKF, FRAME), mpc_flight.gains(MPC, FRAME)
    rms, _ = fly(CIRCLE, eskf, gains[0], mpc_flight, gains[1], spoil)
    assert rms < 0.08


def test_a_heavier_vehicle_costs_little():
    assert _mpc(replace(CIRCLE, mass=1.25)) < 0.08  # the note: .047 at a thrust loss of 26 %
