"""Bounds of one vehicle from its log: estimated, then tried by the filter itself over the same flight until nothing contradicts."""

import math
from typing import NamedTuple

import numpy as np

from mavquad.airframe import ModelBounds
from mavquad.errors import LogError
from mavquad.estimate import quad_error
from mavquad.identify import bounds, timebase
from mavquad.identify.bounds import Bound, Calm
from mavquad.identify.timebase import Held
from tools.identified import Identified
from tools.identify_log import Flight, Setpoints

TICK_S = bounds.TICK_S
ROUNDS = 20
WIDEN = 1.15
NAN3 = (math.nan, math.nan, math.nan)
GROUPS = {  # outputs of the filter -> the bounds that are widened where one of them contradicts
    "attitude": ((0, 1), ("b_f_attitude_rad_s", "b_attitude_rad", "e_attitude_rad")),
    "velocity": ((2, 3, 4), ("e_velocity_m_s", "b_velocity_m_s")),
    "acceleration": ((5, 6, 7), ("e_acceleration_m_s2", "b_f_m_s2")),
}


class Trial(NamedTuple):
    """One pass of the filter over the flight."""

    contradictions: int
    inflations: int
    by_group: dict[str, int]
    first_s: float  # of the first contradiction; NaN for none
    half_width_m_s2: float  # median of the published interval of f


class Calibration(NamedTuple):
    bounds: dict[str, Bound]
    span_s: tuple[float, float]
    source: str  # the commands
    tau_s: float
    delay_s: float
    thrust_lag_s: float
    default: Trial  # with the bounds of the design note
    own: Trial
    rounds: int  # of widening


def calibrate(found: Identified, thrust_lag_s: float) -> Calibration:
    """Raises LogError with what the log lacks."""
    flight = found.flight
    setpoints = flight.sent or flight.target
    if setpoints is None:
        raise LogError(f"{flight.path}: bounds need commands (SET_ATTITUDE_TARGET or ATTITUDE_TARGET); record them at 50 Hz")
    for stream, name in ((flight.imu, "HIGHRES_IMU"), (flight.position, "LOCAL_POSITION_NED")):
        if stream is None:
            raise LogError(f"{flight.path}: bounds need {name}; ask the autopilot for it at 50 Hz")
    if found.thrust is None:
        reason = next((m for m in found.missing if m.startswith("hover thrust")), "hover thrust was not found")
        raise LogError(f"{flight.path}: bounds need the thrust scale: {reason}")
    models = [r.found.model for r in found.of(setpoints.source) if r.axis in ("roll", "pitch")]
    if not models:
        raise LogError(f"{flight.path}: bounds need the attitude response from {setpoints.source}, which was not found")
    tau_s = float(np.mean([2.0 * m.zeta / m.omega_n_rad_s for m in models]))
    delay_s = float(np.mean([m.delay_s for m in models]))
    span = _span(flight, setpoints)
    calm = _calm(found, setpoints, span, tau_s, delay_s, thrust_lag_s)
    own = bounds.bounds(calm)
    default = trial(flight, calm, ModelBounds(), span)
    rounds = 0
    result = trial(flight, calm, model_bounds(own), span)
    while result.contradictions and rounds < ROUNDS:
        for group, (_, names) in GROUPS.items():
            if result.by_group[group]:
                own = bounds.widened(own, names, WIDEN)
        rounds += 1
        result = trial(flight, calm, model_bounds(own), span)
    return Calibration(own, span, setpoints.source, tau_s, delay_s, thrust_lag_s, default, result, rounds)


def model_bounds(own: dict[str, Bound]) -> ModelBounds:
    return ModelBounds(**{key: one.value for key, one in own.items()}, tick_s=TICK_S)


def trial(flight: Flight, calm: Calm, tried: ModelBounds, span: tuple[float, float]) -> Trial:
    """The flying filter over the flight's own messages, tick by tick, with the newest that had been stamped by then."""
    assert flight.imu is not None
    assert flight.position is not None
    model = quad_error.gains(quad_error.Params(bounds=tried, attitude_tau_s=calm.tau_s, thrust_lag_s=calm.thrust_lag_s))
    t = np.arange(span[0] + TICK_S, span[1], TICK_S)
    middle = t - 0.5 * TICK_S
    commands = np.column_stack(
        [
            timebase.held_at(calm.roll, middle - calm.delay_s),
            timebase.held_at(calm.pitch, middle - calm.delay_s),
            timebase.held_at(calm.thrust_m_s2, middle),
        ]
    )
    turn, imu, position = flight.attitude, flight.imu, flight.position
    at = [np.searchsorted(stream, t, side="right") for stream in (turn.t_s, imu.t_s, position.t_s)]
    state = quad_error.init(
        model,
        tuple(position.second[at[2][0] - 1]),
        tuple(turn.euler_rad[at[0][0] - 1]),
        float(commands[0, 2]),
    )
    by_output = np.zeros(quad_error.N_OUTPUTS, int)
    widths, first = [], math.nan
    for k in range(1, t.size):
        a, i, p = (int(index[k]) for index in at)
        a0, i0, p0 = (int(index[k - 1]) for index in at)
        measured = quad_error.Measured(
            tuple(turn.euler_rad[a - 1]) if a > a0 else NAN3,
            tuple(position.second[p - 1]) if p > p0 else NAN3,
            tuple(imu.first[i0:i].mean(axis=0)) if i > i0 else NAN3,
            float(t[k] - turn.t_s[a - 1]),
            float(t[k] - position.t_s[p - 1]),
            float(t[k] - imu.t_s[i0:i].mean()) if i > i0 else 0.0,
        )
        before = state.filter.n_bad
        state = quad_error.step(model, state, tuple(commands[k]), measured, TICK_S, round(1e6 * t[k]))
        bad = state.filter.n_bad > before
        if bad.any():
            by_output += bad
            first = float(t[k]) if math.isnan(first) else first
        cut = quad_error.bounds_f(state, 0)
        widths.append(0.5 * (cut.high - cut.low))
    intervals = sum(one.empty for one in state.intervals)
    groups = {name: int(by_output[list(outputs)].sum()) for name, (outputs, _) in GROUPS.items()}
    groups["acceleration"] += int(intervals)
    return Trial(int(state.filter.empty + intervals), int(state.filter.inflations), groups, first, float(np.median(widths)))


def _span(flight: Flight, setpoints: Setpoints) -> tuple[float, float]:
    """The longest stretch in the air with commands and every stream alive."""
    assert flight.imu is not None
    assert flight.position is not None
    streams = (setpoints.t_s, flight.attitude.t_s, flight.imu.t_s, flight.position.t_s)
    spans = list(flight.flying)
    for t in streams:
        gaps = [g for g in timebase.rhythm(t).gaps if g[1] - g[0] > 0.2]
        edges = [(-math.inf, float(t[0])), *gaps, (float(t[-1]), math.inf)]
        for start, end in edges:
            spans = [(x, y) for a, b in spans for x, y in ((a, min(b, start)), (max(a, end), b)) if y > x]
    if not spans:
        raise LogError(f"{flight.path}: commands, attitude, accelerometer and velocity are never there together in flight")
    start, end = max(spans, key=lambda s: s[1] - s[0])
    return start + 1.0, end - 1.0


def _calm(
    found: Identified, setpoints: Setpoints, span: tuple[float, float], tau_s: float, delay_s: float, thrust_lag_s: float
) -> Calm:
    flight, thrust = found.flight, found.thrust
    assert thrust is not None
    assert flight.imu is not None
    assert flight.position is not None
    t = np.arange(span[0], span[1], TICK_S)
    echoed = flight.target or setpoints  # what the vehicle says it acts on, where it says so
    scale = 9.80665 / thrust.hover.value
    tilt = np.cos(echoed.euler_rad[:, 0]) * np.cos(echoed.euler_rad[:, 1]) if thrust.over_cosine else 1.0

    def columns(at: np.ndarray, values: np.ndarray) -> np.ndarray:
        return np.column_stack([np.interp(t, at, values[:, i]) for i in range(3)])

    return Calm(
        t,
        columns(flight.attitude.t_s, flight.attitude.euler_rad),
        columns(flight.imu.t_s, flight.imu.first),
        columns(flight.position.t_s, flight.position.second),
        Held(setpoints.t_s, setpoints.euler_rad[:, 0]),
        Held(setpoints.t_s, setpoints.euler_rad[:, 1]),
        Held(echoed.t_s, scale * echoed.thrust / tilt),
        tau_s,
        delay_s,
        thrust_lag_s,
    )
