"""A helicopter's hover model from a flight in which its sticks were swept on top of its inner loop (`mavquad fly sweep`).

The sticks as added are in the companion's SET_ACTUATOR_CONTROL_TARGET (group 3), as applied in the autopilot's
ACTUATOR_CONTROL_TARGET; the answer in ATTITUDE, HIGHRES_IMU and LOCAL_POSITION_NED, all by the vehicle's stamps. Records are cut where
the sticks rest; doublets are kept for the check.

A stick is held for 20 ms and stamped some milliseconds late. Between two of its changes the answer is not a delayed one: the yaw rate
has gone a part of its way. So the delay is fitted first, then the answer is taken at the true changes and everything is fitted again.
"""

from typing import NamedTuple

import numpy as np

from mavquad.errors import LogError
from mavquad.identify import fit, spectrum, structures, timebase, verify
from mavquad.identify.fit import Fit
from mavquad.identify.spectrum import Record, Response
from mavquad.identify.start import families
from mavquad.identify.structures import Structure
from mavquad.identify.timebase import Held
from tools.identify_log import Flight, Sticks

DT_S = 0.02
REST_S = 2.0  # of quiet sticks between two records
EDGE_S = 4.5  # of quiet kept before and after a record
GRID_RAD_S = spectrum.log_grid(0.4, 45.0)
STICKS = ("lat", "lon", "ped", "col")  # roll, pitch, yaw, throttle
PARTS = {  # structure, its sticks in its own order, its outputs: columns of (u, v, w, p, q, r, phi, theta)
    "longitudinal": (structures.REF_LON, (1, 0), (0, 4, 7)),
    "lateral": (structures.REF_LAT, (1, 0), (1, 3, 6)),
    "yaw and heave": (structures.REF_YAW, (2, 3), (2, 5)),
}
EARLIEST_S, LATEST_S = -0.03, 0.1  # of the answer against the stamps of the applied sticks: these may be late themselves
DOUBTFUL_CHI2 = 5.0  # above: no start was good, more are tried
ALIGNED_S = 2e-4  # of delay left: the answer is taken where the sticks change
TIED = 0.98  # correlation above which two parameters cannot be told apart
Span = tuple[float, float]


class Hover(NamedTuple):
    """One decoupled part of the hover model."""

    name: str
    structure: Structure
    response: Response
    found: Fit
    check: verify.Check | None  # of doublets that were not fitted
    notes: tuple[str, ...]
    late_s: float = 0.0  # of the answer against the stamps of the sticks, already taken out; negative: the stamps are late


class Swept(NamedTuple):
    """The flight on one even clock, and where what was flown."""

    t_s: np.ndarray  # (n,)
    r: np.ndarray  # (n, 4) lat, lon, ped, col as added
    u: np.ndarray  # (n, 4) as applied
    y: np.ndarray  # (n, 8) u, v, w, p, q, r, phi, theta
    sweeps: tuple[tuple[int, Span], ...]  # stick and span
    checks: tuple[Span, ...]


def identify(flight: Flight) -> tuple[list[Hover], list[str]]:
    """Every part that was swept, and what is missing for the others. Raises LogError where the log holds no sweep of the sticks."""
    swept = resampled(flight)
    if not swept.sweeps:
        raise LogError("the sticks were never swept for 20 s or more (mavquad fly sweep --vehicle helicopter)")
    found, missing = [], []
    for name, (structure, sticks, outputs) in PARTS.items():
        try:
            first = part(swept, name, structure, sticks, outputs)
            late_s = float(np.mean(structures.delays_s(first.found.structure, first.found.parameters)))
            if abs(late_s) > ALIGNED_S:
                moved = resampled(flight, late_s)
                first = part(moved, name, structure, sticks, outputs, first.found)._replace(late_s=late_s)
            found.append(first)
        except LogError as error:
            missing.append(f"{name}: {error}")
    return found, missing


def part(
    swept: Swept, name: str, structure: Structure, sticks: tuple[int, ...], outputs: tuple[int, ...], near: Fit | None = None
) -> Hover:
    """One part of the model, from the regression's starts unless a fit is `near`. Raises LogError with the stick that was not swept."""
    spans = [(stick, span) for stick, span in swept.sweeps if stick in sticks]
    idle = [STICKS[s] for s in sticks if s not in {stick for stick, _ in spans}]
    if idle:
        raise LogError(f"stick {' and '.join(idle)} never swept; add --axis {' --axis '.join(_axis(s) for s in idle)}")
    records = [_record(swept, span, sticks, outputs) for _, span in spans]
    notes = spectrum.checked(records)
    response = spectrum.lpm(records, GRID_RAD_S)
    stamped = structures.with_delays(structure, LATEST_S, EARLIEST_S)
    if near is None:
        starts = fit.ranked_starts(fit.problem(structure, response), families(structure, response))
    else:
        starts = [near.theta[: len(structure.free)]]
    whole = fit.fit(stamped, response, starts=[np.append(theta, np.zeros(len(sticks))) for theta in starts])
    if near is not None:
        whole = whole._replace(agreeing=near.agreeing, starts=near.starts)
    elif whole.chi2 > DOUBTFUL_CHI2:
        starts = fit.ranked_starts(fit.problem(structure, response), families(structure, response, between=True))
        more = fit.fit(stamped, response, starts=[whole.theta, *(np.append(theta, np.zeros(len(sticks))) for theta in starts)])
        whole = more if more.ml < whole.ml else whole
    check = None
    for span in swept.checks:
        model = structure.build(whole.parameters)
        check = verify.check(model, _trimmed(_record(swept, span, sticks, outputs)))
    return Hover(name, structure, response, whole, check, (*notes, *doubts(whole)))


def doubts(found: Fit) -> list[str]:
    """What this record does not tell: a parameter (Cramer-Rao above 40 %), two apart (correlation above 0.98), the whole (chi2)."""
    notes = [
        f"{name} +- {cr:.0f} % (1 sigma) cannot be told from this record"
        for name, cr in found.cr_pct.items()
        if cr > fit.INSENSITIVE_PCT and not name.startswith(structures.DELAY)
    ]
    free = found.structure.free
    groups: list[set[int]] = []
    for i, j in np.argwhere(np.abs(np.triu(found.correlation, 1)) > TIED).tolist():
        touched = [group for group in groups if group & {i, j}]
        groups = [group for group in groups if group not in touched] + [set().union({i, j}, *touched)]
    notes += [f"{', '.join(free[i] for i in sorted(group))} move together (correlations above {TIED})" for group in groups]
    if not fit.CHI2_BAND[0] <= found.chi2 <= fit.CHI2_BAND[1]:
        notes.append(f"chi2 {found.chi2:.1f}: more than noise is left over; the bars are widened by its root")
    return notes


def resampled(flight: Flight, late_s: float = 0.0) -> Swept:
    """Sticks and answers on one clock, and its records; answers are read `late_s` after the sticks' stamps.

    Raises LogError with the message that is missing.
    """
    s = flight.sticks
    if s is None:
        raise LogError("no SET_ACTUATOR_CONTROL_TARGET of group 3: record what the companion sends (mavquad fly sweep)")
    if len(s.applied_t_s) == 0:
        raise LogError("no ACTUATOR_CONTROL_TARGET: ask the autopilot for the applied sticks at 50 Hz or more")
    if flight.position is None:
        raise LogError("no LOCAL_POSITION_NED: ask the autopilot for it at 50 Hz")
    turn, position, imu = flight.attitude, flight.position, flight.imu
    streams = {"ACTUATOR_CONTROL_TARGET": s.applied_t_s, turn.source: turn.t_s, position.source: position.t_s}
    streams |= {} if imu is None else {imu.source: imu.t_s}
    for name, at in streams.items():
        hz = 1.0 / timebase.rhythm(at).period_s
        if hz < 0.9 / DT_S:
            raise LogError(f"{name} comes at {hz:.0f} Hz; the rotor needs {1 / DT_S:.0f} Hz")
    begin, end = max(at[0] for at in (*streams.values(), s.added_t_s)), min(at[-1] for at in (*streams.values(), s.added_t_s))
    begin += (_phase_s(s) - begin) % DT_S
    t = np.arange(begin, end - 2.0 * DT_S, DT_S)
    edges = np.append(t, t[-1] + DT_S)
    held = [
        np.column_stack([timebase.held_mean(Held(at, values[:, i]), edges) for i in range(4)])
        for at, values in ((s.added_t_s, s.added), (s.applied_t_s, s.applied))
    ]
    then = t + late_s
    euler = np.column_stack([np.interp(then, turn.t_s, turn.euler_rad[:, i]) for i in range(3)])
    at, rates = (turn.t_s, turn.rate_rad_s) if imu is None else (imu.t_s, imu.second)
    omega = np.column_stack([np.interp(then, at, rates[:, i]) for i in range(3)])
    v_ned = np.column_stack([np.interp(then, position.t_s, position.second[:, i]) for i in range(3)])
    y = np.column_stack([in_body(euler, v_ned), omega, euler[:, :2]])
    gaps = [gap for at in streams.values() for gap in timebase.rhythm(at).gaps]
    sweeps, checks = _spans(t, held[0], gaps)
    return Swept(t, held[0], held[1], y, sweeps, checks)


def in_body(euler_rad: np.ndarray, v_ned: np.ndarray) -> np.ndarray:
    """(n, 3) velocities along the body's axes, of roll, pitch, yaw (n, 3) and NED velocities (n, 3)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_euler("ZYX", euler_rad[:, ::-1]).inv().apply(v_ned)


def _phase_s(s: Sticks) -> float:
    """A time at which the applied sticks change, where they do so evenly; else any."""
    change = s.applied_t_s[1:][np.any(np.diff(s.applied, axis=0) != 0.0, axis=1)]
    if len(change) == 0:
        return float(s.applied_t_s[0])
    angle = np.angle(np.mean(np.exp(2j * np.pi * change / DT_S)))
    return float(angle / (2.0 * np.pi) * DT_S)


def _spans(t: np.ndarray, r: np.ndarray, gaps: list[Span]) -> tuple[tuple[tuple[int, Span], ...], tuple[Span, ...]]:
    """Records between rests of the sticks: sweeps by the stick that moves most, and steps (one stick at a time, few values)."""
    moving = np.flatnonzero(np.any(np.abs(r) > 1e-9, axis=1))
    if len(moving) == 0:
        return (), ()
    cuts = np.flatnonzero(np.diff(t[moving]) > REST_S)
    firsts, lasts = moving[np.append(0, cuts + 1)], moving[np.append(cuts, len(moving) - 1)]
    sweeps, checks = [], []
    for first, last in zip(firsts, lasts, strict=True):
        inside = r[first : last + 1]
        steps = all(len(np.unique(np.round(column, 4))) <= 12 for column in inside.T)
        for a, b in _without(gaps, (float(t[first]) - EDGE_S, float(t[last]) + EDGE_S)):
            if b - a < spectrum.SHORTEST_S:
                continue
            if steps:
                checks.append((a, b))
            else:
                sweeps.append((int(np.argmax(inside.std(axis=0))), (a, b)))
    return tuple(sweeps), tuple(checks)


def _without(gaps: list[Span], span: Span) -> list[Span]:
    """A span cut at every gap of a stream: samples are not made up."""
    parts = [span]
    for start, end in gaps:
        parts = [(x, y) for a, b in parts for x, y in ((a, min(b, start)), (max(a, end), b)) if y > x]
    return parts


def _record(swept: Swept, span: Span, sticks: tuple[int, ...], outputs: tuple[int, ...]) -> Record:
    keep = (swept.t_s >= span[0]) & (swept.t_s < span[1])
    return Record(DT_S, swept.r[keep][:, sticks], swept.u[keep][:, sticks], swept.y[keep][:, outputs])


def _trimmed(record: Record) -> Record:
    """About the mean of its first two seconds, before anything was added."""
    rest = round(2.0 / record.dt_s)
    return record._replace(u=record.u - record.u[:rest].mean(axis=0), y=record.y - record.y[:rest].mean(axis=0))


def _axis(stick: str) -> str:
    return ("roll", "pitch", "yaw", "thrust")[STICKS.index(stick)]
