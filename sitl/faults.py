"""What goes wrong on request, at its instant of vehicle time: sensors, rotors, pushes, jumps of the estimator, a restart.

NaN, freeze, dropout and spikes are faults of what is *sent* (the autopilot itself has a second sensor); a bias is in the sensor and so
in everything behind it.
"""

import math
from typing import TYPE_CHECKING

import numpy as np

from sitl.config import Fault
from sitl.links import NEVER
from sitl.telemetry import SENSOR_OF

if TYPE_CHECKING:
    from sitl.simulation import Simulation

SPIKES = 0.02  # of the samples while the fault is at work
_SPIKED = {"gyro": ("gyro_rad_s", "rates_rad_s"), "accel": ("accel_m_s2",), "position": ("nav_v_ned_m_s",)}
_BIASES = {"gyro": "gyro_bias", "accel": "accel_bias", "position": "position_bias"}


class Faults:
    """The faults of one run and those that are at work now. `due_us` is when the next one begins or ends."""

    def __init__(self, faults: list[Fault], sim: "Simulation") -> None:
        self._sim = sim
        self._events: list[tuple[int, bool, Fault]] = []
        for fault in faults:
            start_us = round(1e6 * fault.t_s)
            self._events.append((start_us, True, fault))
            if fault.duration_s > 0.0:
                self._events.append((start_us + round(1e6 * fault.duration_s), False, fault))
        self._events.sort(key=lambda event: event[0])
        self.due_us = self._events[0][0] if self._events else NEVER
        self._active: dict[str, str] = {}  # sensor -> nan, freeze, dropout or spikes
        self._spikes: dict[str, tuple[float, ...]] = {}
        self._rng = np.random.default_rng([sim.config.seed, 96])
        self._frozen: dict[tuple[str, str], list[float]] = {}

    def apply(self, t_us: int) -> None:
        """Begin and end what is due."""
        while self._events and self._events[0][0] <= t_us:
            _, begins, fault = self._events.pop(0)
            self._change(fault, begins)
        self.due_us = self._events[0][0] if self._events else NEVER

    @property
    def none(self) -> bool:
        """All sensors are well."""
        return not self._active

    @property
    def sick(self) -> set[str]:
        """Sensors that are not well: for the health bits."""
        return set(self._active)

    def read(self, sensor: str, view: str) -> list[float]:
        """What a sensor says now, as its fault lets it."""
        values: list[float] = self._sim.vehicle.state.view[view].tolist()
        kind = self._active.get(sensor) if self._active else None
        if kind == "nan":
            return [math.nan] * len(values)
        if kind == "freeze":
            return self._frozen.setdefault((sensor, view), values)
        if kind == "spikes" and view in _SPIKED[sensor] and self._rng.random() < SPIKES:
            signs = self._rng.choice((-1.0, 1.0), 3).tolist()
            return [x + sign * size for x, sign, size in zip(values, signs, self._spikes[sensor], strict=True)]
        return values

    def drops(self, message: str) -> bool:
        """Whether a dropout keeps a message from being sent."""
        return any(self._active.get(sensor) == "dropout" for sensor in SENSOR_OF.get(message, ()))

    @property
    def dropping(self) -> bool:
        """Whether any dropout is at work."""
        return "dropout" in self._active.values()

    def _change(self, fault: Fault, begins: bool) -> None:
        constants = self._sim.vehicle.constants
        sign = 1.0 if begins else -1.0
        if fault.kind == "bias":
            name = _BIASES[fault.sensor or ""]
            constants[name] = constants[name] + [sign * x for x in fault.value]
        elif fault.kind == "motor":
            constants["effectiveness"][fault.motor - 1] = fault.effectiveness if begins else 1.0
        elif fault.kind == "push":
            constants["push_n"] = constants["push_n"] + [sign * x for x in fault.force_n]
            constants["push_nm"] = constants["push_nm"] + [sign * x for x in fault.torque_nm]
        elif fault.kind == "ekf_reset":
            jump = [sign * x for x in fault.value]
            constants["position_bias"] = constants["position_bias"] + jump
            self._sim.autopilot.estimator_jumped(jump)
        elif fault.kind == "restart":
            if begins:
                self._sim.reboot()
        else:
            for sensor in ("gyro", "accel") if fault.sensor == "imu" else (fault.sensor or "",):
                self._active.pop(sensor, None)
                if begins:
                    self._active[sensor], self._spikes[sensor] = fault.kind, fault.value
            self._frozen.clear()
