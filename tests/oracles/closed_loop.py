"""The whole companion flown on the simulated autopilot, in one process on vehicle time."""

import numpy as np

from mavquad import lifecycle, paths, pipeline, wire
from mavquad.companion import request
from mavquad.paths import Path
from mavquad.settings import Companion
from sitl import config, simulation

WIND = ("wind.mean_m_s=4", "wind.w20_m_s=6", "wind.from_deg=250", 'overrides=["body.mass_kg=+20%"]')


class Flown:
    """One flight from the ground until `seconds` after the path began: errors against the truth, texts, kinds of setpoints."""

    def __init__(self, controller, path="circle", seconds=12.0, changes=WIND, seed=1, **settings):
        self.errors, self.f, self.f_true, self.texts, self.published, self.masks = [], [], [], [], [], set()
        self.sticks = 0
        self.sim = simulation.Simulation(config.load(None, [f"seed={seed}", *changes]))
        self.link = self.sim.open_link()
        self.plan = pipeline.build(
            Companion(path=path if isinstance(path, Path) else Path(name=path), controller=controller, observers=(), **settings)
        )
        self.flight = pipeline.start(self.plan)
        asked = 0
        while self.sim.t_us < 60_000_000:
            self._period()
            life = self.flight.life
            if not asked and life.state == lifecycle.OBSERVING:
                asked = self.sim.t_us
                frame = request(lifecycle.CMD_ENGAGE, self.plan, 0)
                self._take(pipeline.feed(self.plan, self.flight, self.sim.epoch_us + asked, frame))
            begun = self.flight.path_t0_us if life.state == lifecycle.ENGAGED else 1 << 62
            if self.sim.t_us > begun:
                self._score()
            if self.sim.t_us > begun + 1e6 * seconds:
                return
        raise AssertionError(f"never flew: {self.flight.life} {self.texts}")

    def _period(self):
        self.sim.run_period()
        for data in self.sim.collect(self.link):
            for frame in wire.split(data)[0]:
                if not pipeline.accepts(self.plan, self.flight, frame):
                    self._take(pipeline.feed(self.plan, self.flight, self.sim.epoch_us + self.sim.t_us, frame))

    def _take(self, flight):
        self.flight = flight
        for _, raw in flight.outbox:
            self.sim.receive(self.link, raw)
            _, message = next(iter(wire.parse(raw)))
            if type(message).__name__ == "STATUSTEXT":
                self.texts.append(message.text)
            elif type(message).__name__ == "SET_ATTITUDE_TARGET" and flight.life.state == lifecycle.ENGAGED:
                self.masks.add(message.type_mask)
            elif type(message).__name__ == "SET_ACTUATOR_CONTROL_TARGET" and message.group_mlx == 0:
                self.sticks += 1
            elif type(message).__name__ == "DEBUG_FLOAT_ARRAY" and message.name.startswith("disturb"):
                self.published.append((message.data[:3], flight.estimate.f_ned_m_s2))
        flight.outbox, flight.trace = [], []

    def _score(self):
        view = self.sim.vehicle.state.view
        f = self.flight
        wanted = paths.demand(self.plan.path, f.path_t0_us, f.anchor_p_m, f.anchor_yaw_rad, self.sim.t_us)
        self.errors.append(np.array(view["p_ned_m"]) - wanted.p_ned_m)
        self.f_true.append(np.array(view["disturbance_m_s2"]) / max(1, int(np.ravel(view["summed"])[0])))
        for name in ("disturbance_m_s2", "disturbance_rad_s2", "summed"):
            view[name][...] = 0
        self.f.append(f.estimate.f_ned_m_s2)

    def rmse(self):
        return float(np.sqrt(np.mean(np.sum(np.square(self.errors), axis=1))))
