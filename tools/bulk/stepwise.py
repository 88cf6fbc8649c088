"""A whole flight stage by stage: the simulated autopilot and the companion's pipeline in one process, frames handed over directly.

Any controller, compensator, personality, link or fault; the very code of a flight over UDP, less sockets, logs, take-off and landing,
and with only those messages that some stage uses.
"""

from typing import NamedTuple

import numpy as np

from mavquad import control_step, lifecycle, pipeline, wire
from mavquad.errors import ConfigError
from mavquad.lifecycle import ENGAGED, OBSERVING
from sitl import ardupilot, config, px4
from sitl.autopilot import TICK_US, Home
from sitl.simulation import Simulation
from tools.bulk.setup import HOVER_US, end_us, lift_off, plan_of, why_not
from tools.bulk.state import TRACE
from tools.scenarios import Resolved
from tools.score import TRUTH, Truth
from tools.trace import Trace


class Flown(NamedTuple):
    """What a flight leaves behind, as a run folder would."""

    trace: Trace  # of the companion
    truth: Truth
    misses: int
    solver: dict[str, float]
    grounded: bool


class Loop:
    """One flight, period by period."""

    def __init__(self, resolved: Resolved) -> None:
        reason = why_not(resolved)
        if reason:
            raise ConfigError(f"not from the air: {reason}; with --over-udp it flies")
        sitl = resolved.sitl
        self.plan = plan_of(resolved)
        self.sim = sim = Simulation(sitl)
        lift_off(sim.vehicle, sitl, sim.autopilot, self.plan.settings.takeoff_m)
        self.engage_us = sim.t_us + HOVER_US
        sim._tick_us = (sim.t_us // TICK_US + 1) * TICK_US
        here = sitl.start.p_ned_m
        sim.autopilot.home = Home(here, (1.0, 0.0, 0.0, 0.0))
        if isinstance(sim.autopilot, ardupilot.ArduPilot):
            sim.autopilot.mode = ardupilot.GUIDED
        self.link = sim.open_link()
        self._choose_streams()
        self.flight = pipeline.start(self.plan)
        self.flight.life = self.flight.life._replace(
            state=OBSERVING,
            target=(sitl.system, sitl.component),
            autopilot=sim.autopilot.kind,
            armed=True,
            mode=lifecycle.GUIDED if sitl.personality == "ardupilot" else lifecycle.OFFBOARD,
            landed=2,
            airborne=True,
            steady_us=1,
        )
        self.flight.origin_m = here
        self.end_us = end_us(self.plan, sitl)
        self._rows: list[tuple[float, ...]] = []
        self._truth: list[tuple[float, ...]] = []

    def _choose_streams(self) -> None:
        sim, rates = self.sim, self.plan.settings.link.rates_hz
        used = set(self.plan.samples.values()) - {"ATTITUDE"}
        for name in self.link.streams:
            hz = min(rates.get(name, 0.0) or sim._default_hz(name), sim.autopilot.rate_limit_hz) if name in used else 0.0
            sim.set_interval(self.link, name, round(1e6 / hz) if hz else -1)

    def period(self) -> None:
        """One control period: vehicle time, what has arrived at the companion, its answers."""
        sim, flight = self.sim, self.flight
        sim.run_until(sim.period_end_us)
        sim.end_period()
        if flight.life.state == OBSERVING and sim.t_us >= self.engage_us:
            self.flight = flight = self._engage()
        stamp = config.EPOCH_US + sim.t_us
        for data in sim.collect(self.link):
            flight = pipeline.feed_all(self.plan, flight, stamp, wire.split(data)[0])
            self._send(flight)
        flight = pipeline.advance(self.plan, flight, stamp)
        self._send(flight)
        self.flight = flight

    def _send(self, flight: pipeline.Flight) -> None:
        for _, raw in flight.outbox:
            self.sim.receive(self.link, raw)
        self._rows += flight.trace

    def _engage(self) -> pipeline.Flight:
        flight, autopilot = self.flight.clone(), self.sim.autopilot
        flight.life = flight.life._replace(state=ENGAGED, phase="path")
        control_step.anchor(self.plan, flight)
        flight.path_t0_us = flight.now_us + round(1e6 * self.plan.settings.settle_s)
        autopilot.setpoint_us = self.sim.t_us
        if isinstance(autopilot, px4.Px4):
            autopilot.mode = (px4.OFFBOARD, 0)
            autopilot.start_external()
        return flight

    def fly(self, until_us: int | None = None) -> Flown:
        """To the end, or to a time; ends early where the ground is met."""
        state = self.sim.vehicle.state
        while self.sim.t_us < (until_us or self.end_us) and not state["grounded"]:
            self.period()
            told = self.sim.truth()
            moved = (*state["p_ned_m"], *told["true_q_wxyz"], *state["omega_rad_s"])
            felt = (*told["force_m_s2"], *told["torque_rad_s2"], *state["wind_ned_m_s"], told["thrust_m_s2"])
            self._truth.append((self.sim.t_us, *moved, *felt, told["misses"], told["engaged"]))
        return self._flown()

    def note(self) -> list[float]:
        """The row that `fused` writes of the same instant."""
        s = self.sim.vehicle.state
        R = s["R"]
        return [self.sim.t_us, *s["p_ned_m"], *s["v_ned_m_s"], R[2], R[5], R[8], s["thrust"]]

    def noted(self, until_us: int) -> np.ndarray:
        """(n, 11) `note` of every period until then."""
        rows = []
        while self.sim.t_us < until_us:
            self.period()
            rows.append(self.note())
        return np.array(rows).reshape(-1, TRACE)

    def _flown(self) -> Flown:
        t = np.array(self._truth)
        extra = {name: t[:, 11 + i] for i, name in enumerate(TRUTH)}
        truth = Truth(t[:, 0].astype(np.int64), t[:, 1:4], t[:, 4:8], t[:, 8:11], extra)
        names = self.plan.trace_names
        trace = Trace(names, np.array(self._rows).reshape(-1, len(names)))
        module, state = self.plan.controller.module, self.flight.controller
        solver = module.diagnostics(state) if hasattr(module, "diagnostics") else {}
        return Flown(trace, truth, self.sim.misses, solver, bool(self.sim.vehicle.state["grounded"]))
