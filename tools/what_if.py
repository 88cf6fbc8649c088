"""What a companion would have commanded over a recorded flight, beside what the autopilot acted on.

Open loop: the vehicle did what it did; at every step the chosen controller sees its estimator's state there and the path that was
wanted. For a flight of this companion that path is the one in its trace. Of any other log nobody knows what was wanted: then it is the
path as flown, smoothed without lag, so that what is compared is how the same motion is asked for.
"""

import bisect
import heapq
import math
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from mavquad import config, plan
from mavquad.errors import ConfigError
from mavquad.estimate import record
from mavquad.estimate.rate_filters import zero_phase
from mavquad.lifecycle import ENGAGED, STATES
from mavquad.plan import CONTROLLERS, Plan
from mavquad.setpoint import attitude, limits
from mavquad.settings import Companion
from mavquad.signals import (
    NAN3,
    ZERO3,
    Applied,
    Attitude,
    Command,
    Demand,
    Estimate,
    Imu,
    Position,
    Quat,
    Setpoint,
    Target,
    Vec3,
)
from tools import observers
from tools.recorded import G_M_S2, Flown, euler
from tools.trace import read_trace

Array = NDArray[Any]
SMOOTH_HZ = 1.0  # of the path as flown
MOST = 15_000  # steps of a what-if that nobody asked for: a long log is taken in longer steps
_KEYS = ("controller", "compensator", "estimator")


class Wanted(NamedTuple):
    """The path that was wanted, by vehicle time."""

    source: str
    t_us: Array  # (n,)
    values: Array  # (n, 14): p, v, a, j NED, yaw, yaw rate


class WhatIf(NamedTuple):
    """What would have been commanded at each step."""

    label: str
    wanted: str
    t_us: Array  # (m,)
    attitude_rad: Array  # (m, 3) roll, pitch, yaw
    thrust_m_s2: Array  # (m,)


def settings(spec: str, base: Companion) -> Companion:
    """`controller=iadrc,compensator=asmf,iadrc.wc_xy_rad_s=2` over a companion's settings. Raises ConfigError."""
    changed: dict[str, Any] = {}
    tune = {name: dict(values) for name, values in base.tune.items()}
    for part in filter(None, spec.split(",")):
        key, equals, text = (word.strip() for word in part.partition("="))
        stage, dot, name = key.partition(".")
        if not equals or not (dot or key in _KEYS):
            raise ConfigError(f"--what-if {part!r}: expected one of {', '.join(_KEYS)} or STAGE.PARAMETER, then =VALUE")
        if dot:
            tune.setdefault(stage, {})[name] = config.value(text)
        else:
            changed[key] = text
    controller = changed.get("controller", base.controller)
    if controller in ("autopilot", "sweep") or controller not in CONTROLLERS:
        able = [name for name in CONTROLLERS if name not in ("autopilot", "sweep")]
        raise ConfigError(f"--what-if controller={controller}: expected one of {', '.join(able)}")
    plain = {**msgspec.to_builtins(base), **changed, "tune": tune}
    if "controller" in changed and "estimator" not in changed:
        plain["estimator"] = "auto"
    return config.convert(plain, Companion, "--what-if")


def wanted(flight: Flown, trace: Path) -> Wanted | None:
    """The path of the flight's own trace where it lies there, else the path as flown; None where no position is known."""
    if trace.exists():
        own = read_trace(trace)
        known = np.isfinite(own.column("ref_p_n"))
        if known.sum() > 10:
            t_us = own.column("t_us")[known].astype(np.int64)
            p, v, a = (own.vector(name)[known] for name in ("ref_p", "ref_v", "ref_a"))
            return _wanted(f"the path of {trace.name}", t_us, p, v, a, flight)
    if flight.position is None or flight.position.arrival_us.size < 20:
        return None
    t_us, p, v = flight.position.columns
    order = np.argsort(t_us, kind="stable")
    t_us, p, v = t_us[order], p[order], v[order]
    grid = np.arange(t_us[0], t_us[-1], 50_000)
    if grid.size < 40:
        return None
    p, v = (np.column_stack([np.interp(grid, t_us, c) for c in x.T]) for x in (p, v))
    smooth = zero_phase(np.column_stack([p, v]), SMOOTH_HZ, 0.05)
    a = np.gradient(smooth[:, 3:], 0.05, axis=0)
    return _wanted("the path as it was flown, smoothed", grid, smooth[:, :3], smooth[:, 3:], a, flight)


def _wanted(source: str, t_us: Array, p: Array, v: Array, a: Array, flight: Flown) -> Wanted:
    dt_s = np.maximum(1e-6 * np.diff(t_us, append=2 * t_us[-1] - t_us[-2]), 1e-3)
    j = np.clip(np.diff(a, append=a[-1:], axis=0) / dt_s[:, None], -20.0, 20.0)
    ta, q, _ = flight.attitude.columns
    order = np.argsort(ta, kind="stable")
    heading = np.unwrap(euler(q[order])[:, 2])
    if heading.size > 40:
        heading = zero_phase(heading[:, None], SMOOTH_HZ, 1e-6 * float(np.median(np.diff(ta[order]))))[:, 0]
    yaw = np.interp(t_us, ta[order], heading)
    return Wanted(source, t_us, np.column_stack([p, v, a, j, yaw, np.gradient(yaw) / dt_s]))


def sent(flight: Flown, trace: Path) -> WhatIf | None:
    """What this companion did send, of a flight of its own whose trace lies there."""
    if not trace.exists():
        return None
    own = read_trace(trace)
    flown = (own.column("state") == STATES.index(ENGAGED)) & np.isfinite(own.column("sent_q_w"))
    if not flown.any():
        return None
    thrust = G_M_S2 * (own.column("sent_thrust") / own.column("hover_thrust"))[flown]
    attitudes = euler(own.vector("sent_q", "wxyz")[flown])
    label = f"sent by this companion ({trace.name})"
    return WhatIf(label, f"the path of {trace.name}", own.column("t_us")[flown].astype(np.int64), attitudes, thrust)


def run(flight: Flown, chosen: Companion, label: str, path: Wanted, most: int = 1 << 62) -> WhatIf:
    """The controller (and compensator) at every step of the span that counts where a path is known; at most about `most` steps."""
    own = chosen if flight.vehicle_source else msgspec.structs.replace(chosen, airframe="x500")
    built = plan.build(own, flight.vehicle)
    seen = _estimates(flight, built)
    use = flight.inside(seen.t_us) & (seen.t_us >= path.t_us[0]) & (seen.t_us <= path.t_us[-1])
    use &= np.isfinite(seen.p_ned_m).all(axis=1)
    at = np.flatnonzero(use)
    every = max(1, -(-at.size // most))
    at = at[::every]
    stepper = _Stepper(flight, built, path)
    t_us = seen.t_us[at]
    inputs = zip(
        t_us.tolist(), *(_tuples(c[at]) for c in (seen.p_ned_m, seen.v_ned_m_s, seen.f_ned_m_s2)), *_held(flight, t_us), strict=True
    )  # fmt: skip
    rows = [stepper.step(*row) for row in inputs]
    q, thrust = np.array([q for q, _ in rows]).reshape(-1, 4), np.array([thrust for _, thrust in rows])
    words = label if every == 1 else f"{label} (every {20 * every} ms)"
    return WhatIf(words, path.source, t_us, euler(q), thrust)


def _tuples(columns: Array) -> list[Any]:
    return list(map(tuple, columns.tolist()))


def _held(flight: Flown, t_us: Array) -> tuple[list[Any], list[Any], list[float]]:
    """Attitude, body rates and specific thrust as last known at each time."""
    ta, q, w = flight.attitude.columns
    order = np.argsort(ta, kind="stable")
    last = order[np.maximum(np.searchsorted(ta[order], t_us, side="right") - 1, 0)]
    thrust = np.full(t_us.size, G_M_S2)
    if flight.command is not None and flight.command.t_us.size:
        order = np.argsort(flight.command.t_us, kind="stable")
        at = np.searchsorted(flight.command.t_us[order], t_us, side="right") - 1
        thrust = np.where(at >= 0, flight.command.thrust_m_s2[order][np.maximum(at, 0)], G_M_S2)
    return _tuples(q[last]), _tuples(w[last]), thrust.tolist()


def _estimates(flight: Flown, built: Plan) -> record.Observed:
    name = built.estimator.module.__name__.rpartition(".")[2]
    for known, runner in observers.RUNS.items():
        if known != "asmf" and name.startswith({"joint": "joint", "leso": "leso", "eskf": "extended"}[known]):
            return runner(built.estimator.gains, flight.events)
    return observers.direct(flight)


class _Stepper:
    """The control part of the pipeline, fed from the record."""

    def __init__(self, flight: Flown, built: Plan, path: Wanted) -> None:
        self.plan, self.hover = built, flight.hover_thrust
        self.controller = built.controller.module.init(built.controller.gains)
        self.compensator = built.compensator.module.init(built.compensator.gains) if built.compensator else None
        if built.compensator is not None:
            self.compensator_gains = built.compensator.gains._replace(hover_thrust=flight.hover_thrust)
        self.t_us, self.sent = 0, Setpoint((1.0, 0.0, 0.0, 0.0), ZERO3, flight.hover_thrust, 7)
        self.stamps, self.rows = path.t_us.tolist(), _tuples(path.values)
        self.events = _samples(flight) if self.compensator is not None else iter(())
        self.next: Any = next(self.events, None)

    def demand(self, t_us: int) -> Demand:
        i = min(max(bisect.bisect_left(self.stamps, t_us), 1), len(self.stamps) - 1)
        t0, t1 = self.stamps[i - 1], self.stamps[i]
        w = min(max((t_us - t0) / max(t1 - t0, 1), 0.0), 1.0)
        row = tuple((1.0 - w) * a + w * b for a, b in zip(self.rows[i - 1], self.rows[i], strict=True))
        return Demand(t_us, row[0:3], row[3:6], row[6:9], row[9:12], row[12], row[13])  # type: ignore[arg-type]

    def step(self, t_us: int, p: Vec3, v: Vec3, f: Vec3, q: Quat, omega: Vec3, thrust: float) -> tuple[Quat, float]:
        """(attitude, specific thrust) that would have been commanded."""
        estimate = Estimate(t_us, p, v, q, omega, f, NAN3, 0.0, thrust)
        demand, dt_s = self.demand(t_us), min(0.2, 1e-6 * (t_us - self.t_us)) if self.t_us else 0.02
        module, gains = self.plan.controller.module, self.plan.controller.gains
        self.controller, command = module.step(gains, self.controller, estimate, demand, self.demand, dt_s)
        if self.compensator is not None:
            command = self._corrected(estimate, command, t_us)
        self.t_us = t_us
        gate = self.plan.limits
        up = attitude.thrust_vector(command.a_ned_m_s2, gate.tilt_rad, 0.2 * G_M_S2, 1.8 * G_M_S2)
        wanted, size = attitude.attitude(up, command.yaw_rad)
        self.sent, _ = limits.apply(gate, self.sent, Setpoint(wanted, ZERO3, self.hover * size / G_M_S2, 7), dt_s)
        return self.sent.q_wxyz, G_M_S2 * self.sent.thrust / self.hover

    def _corrected(self, estimate: Estimate, command: Command, t_us: int) -> Command:
        assert self.plan.compensator is not None
        module = self.plan.compensator.module
        while self.next is not None and self.next.t_us <= t_us:
            self.compensator = module.observe(self.compensator_gains, self.compensator, self.next)
            self.next = next(self.events, None)
        silent = Applied(t_us, (math.nan,) * 4, math.nan, NAN3, 0.0)  # what acted is the record's own target, never ours
        self.compensator, corrected = module.step(
            self.compensator_gains, self.compensator, estimate, command, silent, t_us, self.demand
        )
        return corrected  # type: ignore[no-any-return]


def _samples(flight: Flown) -> Any:
    """The compensator's samples by vehicle time."""
    found = flight.recording.signals
    streams = []
    for kind in (Position, Imu, Target, Attitude):
        if kind in found:
            signal = found[kind]
            order = np.argsort(signal.columns[0], kind="stable")
            fields = [map(tuple, c[order].tolist()) if c.ndim == 2 else c[order].tolist() for c in signal.columns]
            streams.append(map(kind._make, zip(*fields, strict=True)))
    return heapq.merge(*streams, key=lambda sample: sample.t_us)


def against(flight: Flown, what: WhatIf) -> dict[str, Any]:
    """rms of what would have been commanded less what the autopilot acted on: roll, pitch [deg], specific thrust [m/s^2]."""
    row: dict[str, Any] = {"what_if": what.label, "wanted": what.wanted, "steps": int(what.t_us.size)}
    command = flight.command
    if command is None or not what.t_us.size:
        return row
    at = np.searchsorted(command.t_us, what.t_us, side="right") - 1
    known = at >= 0
    was, thrust = command.attitude_rad[np.maximum(at, 0)], command.thrust_m_s2[np.maximum(at, 0)]
    for i, name in enumerate(("roll", "pitch")):
        difference = np.degrees(what.attitude_rad[:, i] - was[:, i])[known]
        if np.isfinite(difference).any():
            row[f"{name}_rms_deg"] = float(np.sqrt(np.nanmean(difference**2)))
    row["thrust_rms_m_s2"] = float(np.sqrt(np.mean((what.thrust_m_s2 - thrust)[known] ** 2)))
    return row
