"""A flight in bulk begins in the air: the vehicle hovers under the autopilot's own loop, after two seconds setpoints take over.

Vehicle time starts at 8.192 s (ArduPilot: 20.48 s), so that gusts and faults of a scenario (whose flights take off and engage at 10 to 13 s) meet the
same part of the path. What cannot be flown here is refused with the option that flies it.
"""

import functools
from typing import Any, NamedTuple

import msgspec
import numpy as np

from mavquad import airframe
from mavquad import plan as plans
from mavquad.settings import Companion
from sitl import config, px4
from sitl.params import Table
from sitl.plant import GRAVITY_M_S2
from sitl.state import POSITION, Record
from sitl.vehicle import Vehicle
from tools.bulk import normals
from tools.bulk.state import AUTOPILOT, DRAWN, FLIGHT, NOISE, PID, TRACE, WIRES
from tools.scenarios import Resolved

# whole numbers of control periods, and of the blocks in which the simulated autopilot draws
START_US = 8_192_000
_START_ARDUPILOT_US = 20_480_000  # it knows where it is from 20 s on
HOVER_US = 2_000_000
OVER_US = 500_000  # flown on after the path
_FUSED = {"pid": PID, "pd": PID, "autopilot": AUTOPILOT}


class Prepared(NamedTuple):
    """One flight as `fused.fly` takes it."""

    flight: Record
    vehicle: Vehicle
    noise: Record
    wires: Record
    plan: plans.Plan
    end_us: int


class _Undrawn(Vehicle):
    """A vehicle whose noise is drawn step by step inside the compiled flight."""

    def _noise(self, seed: int) -> tuple[list[np.random.Generator], np.ndarray]:
        return [np.random.default_rng([seed, 1 + i]) for i in DRAWN], np.zeros((0, 0))

    def _draw(self) -> None:
        self._left = 0

    def noise(self) -> Record:
        """The generators, undrawn, for the compiled flight."""
        return Record(NOISE, generators=[normals.words(generator) for generator in self._generators])


def start_us(sitl: config.Sitl) -> int:
    """Vehicle time at which a flight in bulk begins."""
    return START_US if sitl.personality == "px4" else _START_ARDUPILOT_US


def end_us(plan: plans.Plan, sitl: config.Sitl) -> int:
    """Vehicle time at which it is over."""
    path_us = round(1e6 * (plan.settings.settle_s + plan.path.duration_s))
    return start_us(sitl) + HOVER_US + path_us + OVER_US


def why_not(resolved: Resolved) -> str:
    """Why a flight cannot begin in the air at all, or nothing."""
    sitl = resolved.sitl
    if airframe.load(sitl.airframe, tuple(sitl.overrides)).kind != "quadrotor":
        return f"airframe {sitl.airframe} is no quadrotor"
    if resolved.companion.controller == "sweep":
        return "controller sweep identifies in a flight of its own"
    return ""


def why_not_fused(resolved: Resolved) -> str:
    """Why a flight cannot be one compiled function, or nothing."""
    sitl, companion = resolved.sitl, resolved.companion
    link = msgspec.to_builtins(sitl.link)
    wire = [f"link.{name}" for name, value in link.items() if value and name not in ("delay_ms", "reorder_ms")]
    checks = (
        (companion.controller not in _FUSED, f"controller {companion.controller}"),
        (companion.compensator != "none", f"compensator {companion.compensator}"),
        (companion.estimator not in ("auto", "direct"), f"estimator {companion.estimator}"),
        (sitl.personality != "px4", f"personality {sitl.personality}"),
        (sitl.attitude_source != "ahrs", f"attitude {sitl.attitude_source}"),
        (bool(wire), ", ".join(wire)),
        (bool(sitl.faults), "faults"),
        (sitl.link.delay_ms > 500.0, f"link.delay_ms = {sitl.link.delay_ms:g}"),
    )
    return "; ".join(what for bad, what in checks if bad) or why_not(resolved)


@functools.lru_cache(maxsize=64)
def _plan(companion: bytes) -> plans.Plan:
    return plans.build(msgspec.json.decode(companion, type=Companion))


def plan_of(resolved: Resolved) -> plans.Plan:
    """The companion's plan, without observers that only watch; the same object for the same settings. Raises ConfigError."""
    settings = msgspec.structs.replace(resolved.companion, seed=None, observers=())
    return _plan(msgspec.json.encode(settings))


def prepare(resolved: Resolved) -> Prepared:
    """Everything that one compiled flight works on. Ask `why_not_fused` before."""
    sitl, plan = resolved.sitl, plan_of(resolved)
    vehicle = _Undrawn(sitl)
    autopilot = px4.Px4(vehicle, Table(px4.defaults(vehicle.tuned), sitl.params, bytewise=True), _silent)
    lift_off(vehicle, sitl, autopilot, plan.settings.takeoff_m)
    flight = Record(FLIGHT)
    intervals = [_interval(vehicle, plan, name) for name in ("ATTITUDE_QUATERNION", "LOCAL_POSITION_NED", "ATTITUDE_TARGET")]
    for name, value in {
        "t_us": START_US,
        "period_us": 1000 * sitl.period_ms,
        "step_us": vehicle.dt_us,
        "delay_us": round(1000.0 * sitl.link.delay_ms),
        "attitude_us": intervals[0],
        "position_us": intervals[1],
        "echo_us": intervals[2],
        "attitude_due_us": _first(intervals[0]),
        "position_due_us": _first(intervals[1]),
        "echo_due_us": _first(intervals[2]),
        "controller": _FUSED[plan.settings.controller],
        "engage_us": START_US + HOVER_US,
        "settle_us": round(1e6 * plan.settings.settle_s),
        "wanted_gap_us": plan.control_us,
        "carry_s": plan.estimator.gains.carry_s,
        "hover_thrust": plan.airframe.hover_thrust,
        "score_from_us": -max(1, round(1e6 * resolved.scenario.flight.score_from_s)),
        "score_to_us": round(1e6 * (plan.settings.settle_s + plan.path.duration_s)),
    }.items():
        flight[name] = value
    return Prepared(flight, vehicle, vehicle.noise(), Record(WIRES), plan, end_us(plan, sitl))


def fly(p: Prepared, until_us: int | None = None, trace: np.ndarray | None = None) -> int:
    """Fly a prepared flight on, to its end unless told. Returns the rows of `trace` that were filled."""
    from tools.bulk import fused

    rows = np.empty((0, TRACE)) if trace is None else trace
    gains = p.plan.controller.gains
    v = p.vehicle
    records = (p.flight.array, v.state.array, v.setpoint.array, v.constants.array)
    return int(
        fused.fly(
            *records, v._gusts, p.noise.array, p.wires.array, gains, p.plan.limits, p.plan.path, until_us or p.end_us, rows
        )
    )


def lift_off(vehicle: Vehicle, sitl: config.Sitl, autopilot: Any, height_m: float) -> None:
    """From the ground into a hover over the same place, rotors and integrals as they are after a while of it."""
    tuned, true = vehicle.tuned, vehicle.true
    assert tuned.rotors is not None
    assert true.rotors is not None
    s, here = vehicle.state, sitl.start.p_ned_m
    up = (here[0], here[1], here[2] - height_m)
    vehicle.t_us = start_us(sitl)
    s["step"] = vehicle.t_us // vehicle.dt_us
    s["p_ned_m"], s["aim_p"], s["grounded"] = up, up, 0
    s["past"][:, :3] = up
    s["nav_p_ned_m"] = s["nav_p_ned_m"] - (0.0, 0.0, height_m)
    thrust = 0.25 * true.body.mass_kg * GRAVITY_M_S2
    s["thrust_n"], s["outputs"] = thrust, thrust / true.rotors.thrust_max_n
    share = thrust / true.rotors.thrust_max_n
    s["thrust"] = s["lift"] = share
    most = 4.0
    excess = GRAVITY_M_S2 * (share / tuned.hover_thrust - 1.0)
    s["velocity_integral"] = (0.0, 0.0, -min(most, max(-most, excess)))
    autopilot.t_us = autopilot._ground_us = vehicle.t_us
    autopilot.armed, autopilot.landed, autopilot.flown = True, False, True
    vehicle.setpoint["kind"] = POSITION  # so that the integral is kept
    autopilot.start_hold()


def _interval(vehicle: Vehicle, plan: plans.Plan, name: str) -> int:
    wanted_us = round(1e6 / plan.settings.link.rates_hz.get(name, px4.STREAMS_HZ[name]))
    return max(vehicle.dt_us, -(-wanted_us // vehicle.dt_us) * vehicle.dt_us)


def _first(interval_us: int) -> int:
    return (START_US // interval_us + 1) * interval_us


def _silent(severity: int, text: str) -> None:
    """Nobody listens to an autopilot that talks to itself."""
