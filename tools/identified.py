"""Everything that one log tells of its vehicle, and everything it does not: the work behind `mavquad identify`."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np

from mavquad.errors import LogError
from mavquad.identify import attitude, doubts, lift, noise, timebase, vehicle, verify
from mavquad.identify.attitude import Axis, Parts, SecondOrder
from mavquad.identify.lift import Lift
from mavquad.identify.noise import Noise
from mavquad.identify.timebase import Held, Sampled
from mavquad.identify.vehicle import Drag, GyroFilter, Thrust, Torque
from tools import identify_doubts
from tools.identify_log import Flight, Setpoints, sampled

if TYPE_CHECKING:
    from tools.identify_hover import Hover

Span = tuple[float, float]
AXES = ("roll", "pitch", "yaw")
BAND_HZ = (0.2, 4.0)
COHERENT = 0.95
LEAD_S = 3.0  # of prediction before what is compared: the model has forgotten its start
UNKNOWABLE = (
    "mass_kg and inertia_kg_m2: a log shows force over mass and torque over inertia, never these alone; weigh the vehicle",
)
T = TypeVar("T")


class Checked(NamedTuple):
    """A prediction of a part that was not fitted."""

    span_s: Span
    fit_pct: float
    tic: float
    t_s: np.ndarray
    measured: np.ndarray
    predicted: np.ndarray


class Response(NamedTuple):
    """One axis from one input: fitted, and checked elsewhere."""

    axis: str
    source: str  # the message commanded with
    found: Axis
    swept: bool
    checks: tuple[Checked, ...]

    @property
    def t63_s(self) -> float:
        return attitude.step_time_s(self.found.model)

    @property
    def coherence_min(self) -> float:
        inside = (self.found.f_hz >= BAND_HZ[0]) & (self.found.f_hz <= BAND_HZ[1])
        return float(self.found.coherence[inside].min())

    @property
    def coherent_hz(self) -> Span:
        """The widest unbroken band with coherence above 0.95."""
        good = self.found.coherence > COHERENT
        edges = np.flatnonzero(np.diff(np.concatenate([[False], good, [False]]).astype(int))).reshape(-1, 2)
        if not len(edges):
            return (0.0, 0.0)
        a, b = max(edges, key=lambda e: e[1] - e[0])
        return float(self.found.f_hz[a]), float(self.found.f_hz[b - 1])


class Identified(NamedTuple):
    flight: Flight
    responses: tuple[Response, ...]
    gyro: dict[str, GyroFilter]
    thrust: Thrust | None
    drag: Drag | None
    torque: dict[str, Torque]
    noise: dict[str, Noise]
    missing: tuple[str, ...]  # what cannot be identified from this log, and what to record
    notes: tuple[str, ...]
    hover: tuple["Hover", ...] = ()  # of a helicopter whose sticks were swept
    lift: Lift | None = None  # of a vehicle whose thrust was swept

    def of(self, source: str) -> list[Response]:
        return [r for r in self.responses if r.source == source]


def identify(flight: Flight, fit_s: Span | None = None, check_s: Span | None = None) -> Identified:
    """Everything from one flight. Spans are chosen from the commands unless given (vehicle seconds since the log's start)."""
    missing: list[str] = []
    responses: list[Response] = []
    for setpoints, name, advice in (
        (flight.sent, "SET_ATTITUDE_TARGET", "record what the companion sends, with a sweep on each axis (mavquad fly sweep)"),
        (flight.target, "ATTITUDE_TARGET", "ask the autopilot for ATTITUDE_TARGET at 50 Hz"),
    ):
        if setpoints is None:
            missing.append(f"response from {name}: no {name} in this log; {advice}")
            continue
        if flight.sticks is not None:
            missing.append(f"response from {name}: the sticks were swept in this log, not the attitude")
            continue
        for i, axis in enumerate(AXES):
            got = _try(missing, f"{axis} from {name}", partial(response, flight, setpoints, i, fit_s, check_s))
            if got is not None:
                responses.append(got)
    motion = sampled(flight)
    foreign = identify_doubts.foreign_axes(flight, motion)

    def own(work: Callable[[], T], *streams: str) -> Callable[[], T]:
        """The work, or a refusal where one of its streams has other axes than expected."""

        def refusing() -> T:
            for stream in streams:
                if stream in foreign:
                    raise LogError(foreign[stream])
            return work()

        return refusing

    thrust = _try(missing, "hover thrust", own(lambda: vehicle.hover(motion), "accelerometer"))
    lifted = _try(missing, "thrust response", own(partial(_lift, flight), "accelerometer"))
    drag = _try(missing, "drag", own(lambda: vehicle.drag(motion), "accelerometer", "velocity"))
    gyro: dict[str, GyroFilter] = {}
    torque: dict[str, Torque] = {}
    for i, axis in enumerate(AXES):
        spans = next((r.found.fitted_from for r in responses if r.axis == axis), flight.flying)
        if i < 2 and (one := _try(missing, f"gyro filter, {axis}", own(partial(_gyro, flight, i, spans), f"rate {axis}"))):
            gyro[axis] = one
        about = f"torque per command, {axis}"
        if turned := _try(missing, about, own(partial(_torque, flight, i, spans), f"gyro {axis}")):
            torque[axis] = turned
    notes = [
        *flight.notes,
        *identify_doubts.recording(flight, {(r.axis, r.source): r.found.fitted_from for r in responses}),
        *_doubts(responses),
    ]
    hover = _hover(flight, missing)
    return Identified(
        flight,
        tuple(responses),
        gyro,
        thrust,
        drag,
        torque,
        noises(flight),
        (*missing, *UNKNOWABLE),
        tuple(notes),
        hover,
        lifted,
    )


def _hover(flight: Flight, missing: list[str]) -> "tuple[Hover, ...]":
    """The hover model, where somebody added to a helicopter's sticks."""
    if flight.sticks is None:
        return ()
    from tools import identify_hover  # half a minute of work: only where there is something to find

    found, unswept = _try(missing, "hover model", lambda: identify_hover.identify(flight)) or ([], [])
    missing += [f"hover model, {words}" for words in unswept]
    return tuple(found)


def response(flight: Flight, setpoints: Setpoints, i: int, fit_s: Span | None, check_s: Span | None) -> Response:
    """One axis from one input. Raises LogError with what is missing."""
    chosen = attitude.parts(setpoints.t_s, setpoints.euler_rad[:, :2], i) if i < 2 else _yaw_parts(setpoints)
    if fit_s is not None:
        chosen = chosen._replace(fit=(fit_s,))
    if check_s is not None:
        chosen = chosen._replace(check=(check_s,))
    u, y = Held(setpoints.t_s, setpoints.euler_rad[:, i]), Sampled(flight.attitude.t_s, flight.attitude.euler_rad[:, i])
    found = attitude.identify(u, y, chosen.fit)
    checks = tuple(checked(found, u, y, span) for span in chosen.check)
    return Response(AXES[i], setpoints.source, found, chosen.swept, checks)


def checked(found: Axis, u: Held, y: Sampled, span: Span) -> Checked:
    """Predict a span from its commands alone and compare."""
    dt = timebase.rhythm(y.t_s).period_s
    lead = min(LEAD_S, max(0.0, span[0] - float(u.t_s[0])))
    t = np.arange(span[0] - lead, span[1], dt)
    predicted = attitude.predict(found.model, u, t, found.offset_rad)
    measured = np.interp(t, y.t_s, y.value)
    keep = t >= span[0]
    one, two = measured[keep, None], predicted[keep, None]
    return Checked(span, float(verify.fit_pct(one, two)[0]), float(verify.tic(one, two)[0]), t[keep], one[:, 0], two[:, 0])


def _yaw_parts(setpoints: Setpoints) -> Parts:
    """Yaw alone decides: roll and pitch move for other reasons."""
    return attitude.parts(setpoints.t_s, setpoints.euler_rad[:, 2:], 0)


def _spanned(flight: Flight, spans: Sequence[Span]) -> Span:
    if not spans:
        raise LogError("never in the air in this log")
    return max(spans, key=lambda s: s[1] - s[0])


def _gyro(flight: Flight, i: int, spans: Sequence[Span]) -> GyroFilter:
    turn = flight.attitude
    dt = timebase.rhythm(turn.t_s).period_s
    if dt > 0.025:
        raise LogError(f"{turn.source} comes at {1 / dt:.0f} Hz; needs 40 Hz or more")
    if not np.all(np.isfinite(turn.rate_rad_s)):
        raise LogError(f"{turn.source} carries no body rates")
    start, end = _spanned(flight, spans)
    t = np.arange(start, end, dt)
    angle, rate = (np.interp(t, turn.t_s, column[:, i]) for column in (turn.euler_rad, turn.rate_rad_s))
    return vehicle.gyro_filter(dt, angle, rate)[0]


def _lift(flight: Flight) -> Lift:
    commands = flight.sent or flight.target
    if flight.sticks is not None:
        raise LogError("the sticks were swept in this log, not the thrust")
    if commands is None or flight.imu is None:
        raise LogError("no thrust (SET_ATTITUDE_TARGET) beside an accelerometer (HIGHRES_IMU); record both at 50 Hz or more")
    inside = doubts.inside(commands.t_s, flight.flying)
    t, thrust = commands.t_s[inside], commands.thrust[inside]
    if len(t) < 100:
        raise LogError("no thrust commanded in flight; sweep it (mavquad fly sweep --axis thrust)")
    chosen = attitude.parts(t, thrust[:, None], 0)
    if not chosen.swept:
        raise LogError("thrust was never swept; mavquad fly sweep --axis thrust")
    return lift.lift(Held(t, thrust), Sampled(flight.imu.t_s, -flight.imu.first[:, 2]), chosen.fit)


def _torque(flight: Flight, i: int, spans: Sequence[Span]) -> Torque:
    if flight.motors is None:
        raise LogError("no SERVO_OUTPUT_RAW with moving motors in this log; ask for it at 50 Hz")
    t_motor, motors = flight.motors
    if motors.shape[1] < 3:
        raise LogError(f"{motors.shape[1]} motors move in SERVO_OUTPUT_RAW; a multirotor has three or more")
    t_gyro, gyro = (flight.imu.t_s, flight.imu.second) if flight.imu else (flight.attitude.t_s, flight.attitude.rate_rad_s)
    start, end = _spanned(flight, spans)
    a, b = (t_gyro >= start) & (t_gyro <= end), (t_motor >= start) & (t_motor <= end)
    if a.sum() < 100 or b.sum() < 100:
        raise LogError("gyro and motor commands do not overlap long enough")
    return vehicle.torque(t_gyro[a], gyro[a, i], t_motor[b], motors[b])


def noises(flight: Flight) -> dict[str, Noise]:
    """Noise of every stream in flight, by message and field; streams too short are left out."""
    found: dict[str, Noise] = {}
    turn = flight.attitude
    tables = [
        (turn.source, turn.t_s, {"roll": turn.euler_rad[:, 0], "pitch": turn.euler_rad[:, 1], "yaw": turn.euler_rad[:, 2]})
    ]
    tables[0][2].update({f"{a}speed": turn.rate_rad_s[:, k] for k, a in enumerate(AXES)})
    for source, names in ((flight.imu, ("acc", "gyro")), (flight.position, ("", "v"))):
        if source is not None:
            columns = {}
            for vectors, name in ((source.first, names[0]), (source.second, names[1])):
                for k, axis in enumerate("xyz"):
                    columns[f"{name}{axis}" if name in ("", "v") else f"{axis}{name}"] = vectors[:, k]
            tables.append((source.source, source.t_s, columns))
    for message, t, fields in tables:
        air = np.zeros(t.size, bool)
        for start, end in flight.flying:
            air |= (t >= start) & (t < end)
        for field, values in fields.items():
            good = air & np.isfinite(values)
            if good.sum() >= 50:
                found[f"{message}.{field}"] = noise.noise(t[good], values[good])
    return found


def _try(missing: list[str], what: str, work: Callable[[], T]) -> T | None:
    """The result, or a line among what is missing."""
    try:
        return work()
    except LogError as error:
        missing.append(f"{what}: {error}")
        return None


def _doubts(responses: Sequence[Response]) -> list[str]:
    notes = []
    for r in responses:
        m, name = r.found.model, f"{r.axis} from {r.source}"
        if not r.swept:
            notes.append(f"{name}: no sweep of this axis alone; fitted from ordinary manoeuvres, less certain")
        if m.sd[1] > 0.4 * m.omega_n_rad_s or m.omega_n_rad_s > attitude.FASTEST_RAD_S:
            lag = 1e3 * (2.0 * m.zeta / m.omega_n_rad_s + m.delay_s)
            notes.append(
                f"{name}: faster than this record can resolve; only its lag, {lag:.0f} ms, is told, not wn and zeta apart"
            )
        if m.chi2 > 3.0:
            notes.append(
                f"{name}: chi2 {m.chi2:.1f}: not a second-order answer within its error bars (shaping, limits); bars widened"
            )
    return notes


def summary(found: Identified) -> dict[str, Any]:
    """Plain data for --json."""
    flight = found.flight

    def figure(one: vehicle.Figure) -> dict[str, float]:
        return {"value": one.value, "sd": one.sd, "seconds": one.seconds}

    def one(r: Response) -> dict[str, Any]:
        m: SecondOrder = r.found.model
        names = ("gain", "natural_frequency_rad_s", "damping", "delay_s")
        return {
            "axis": r.axis,
            "input": r.source,
            **dict(zip(names, m[:4], strict=True)),
            **{f"{name}_sd": sd for name, sd in zip(names, m.sd, strict=True)},
            "t63_s": r.t63_s,
            "chi2": m.chi2,
            "offset_rad": r.found.offset_rad,
            "coherence_min_0.2_4_hz": r.coherence_min,
            "coherent_hz": r.coherent_hz,
            "swept": r.swept,
            "fitted_s": r.found.fitted_from,
            "check": [{"span_s": c.span_s, "fit_pct": c.fit_pct, "tic": c.tic} for c in r.checks],
        }

    late = flight.clock.jitter_s
    return {
        "log": str(flight.path),
        "messages": flight.messages,
        "length_s": flight.length_s,
        "flying_s": flight.flying,
        "attitude": [one(r) for r in found.responses],
        "gyro_filter": {k: {"cutoff_hz": v.cutoff_hz.value, "sd": v.cutoff_hz.sd, "lag_s": v.lag_s} for k, v in found.gyro.items()},
        "hover_thrust": figure(found.thrust.hover) if found.thrust else None,
        "thrust_gain_m_s2": figure(found.thrust.gain_m_s2) if found.thrust else None,
        "thrust_response": dict(zip(("gain_m_s2", "lag_s", "delay_s", "sd", "chi2"), found.lift[:5], strict=True)) if found.lift else None,
        "thrust_over_cosine": found.thrust.over_cosine if found.thrust else None,
        "drag": {
            "linear_1_s": [figure(f) for f in found.drag.linear_1_s],
            "quadratic_1_m": [figure(f) for f in found.drag.quadratic_1_m],
            "fastest_m_s": found.drag.fastest_m_s,
            "wind_ned_m_s": found.drag.wind_ned_m_s,
        }
        if found.drag
        else None,
        "torque": {
            k: {"gain_rad_s2": v.gain_rad_s2.value, "sd": v.gain_rad_s2.sd, "pattern": v.pattern, "lag_s": v.lag_s, "explained": v.explained}
            for k, v in found.torque.items()
        },
        "noise": {k: v._asdict() for k, v in found.noise.items()},
        "link": {
            "drift_ppm": flight.clock.drift_ppm,
            "jitter_s": {"p50": float(np.percentile(late, 50)), "p99": float(np.percentile(late, 99))} if late.size else None,
            "round_trip_s": {"p50": float(np.median(flight.round_trip_s)), "n": int(flight.round_trip_s.size)}
            if flight.round_trip_s.size
            else None,
        },
        "hover": [
            {
                "part": h.name,
                "parameters": h.found.parameters,
                "sd": dict(zip(h.found.structure.free, h.found.sd.tolist(), strict=True)),
                "chi2": h.found.chi2, "J": h.found.j, "agreeing_starts": h.found.agreeing,
                "check": None if h.check is None else {"fit_pct": h.check.fit_pct.tolist(), "tic": h.check.tic.tolist()},
                "notes": list(h.notes),
            }
            for h in found.hover
        ],
        "missing": list(found.missing),
        "notes": list(found.notes),
    }  # fmt: skip
