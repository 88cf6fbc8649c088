"""The vehicle with its sensors and inner loops: one compiled call from one sampling instant to the next."""

import math
from typing import Any, NamedTuple

import numpy as np

from mavquad.airframe import Airframe
from mavquad.jit import kernel
from sitl import config, loops, plant, rotation, rotors, sensors, wind
from sitl.state import ARDUPILOT, CONSTANTS, PX4, SETPOINT, VEHICLE, Record

_BLOCK = 4096  # steps drawn at once
_GENERATORS = (  # one seeded generator per sensor, each with its columns of the block
    (sensors.GYRO, sensors.ACCEL),
    (sensors.ACCEL, sensors.DRIFT),
    (sensors.DRIFT, sensors.POSITION),
    (sensors.POSITION, sensors.MOCAP),
    (sensors.MOCAP, sensors.AIR),
    (sensors.AIR, sensors.COLUMNS),
)


class _Tuning(NamedTuple):
    """What the inner loops and sensors of a personality differ in."""

    number: int
    gyro_cutoff_hz: float
    rate_p: float
    rate_i: float
    rate_d: float
    velocity_bias_m_s: tuple[float, float, float]  # what its velocity is off the slope of its position
    position_delay_ms: tuple[int, int]  # constant within a run, drawn between these


TUNING = {
    "px4": _Tuning(PX4, 60.0, 28.0, 15.0, 0.3, (0.0, 0.0, 0.0), (0, 0)),
    "ardupilot": _Tuning(ARDUPILOT, 20.0, 22.0, 5.0, 0.5, (0.015, -0.012, 0.006), (8, 50)),
}


@kernel
def advance(vehicle, setpoint, constants, gusts, normals, steps):
    """`steps` periods of the loop: loops on what is known, the plant under their outputs, then the sensors again."""
    s, sp, c = vehicle[0], setpoint[0], constants[0]
    for _ in range(steps):
        n = normals[s.step % normals.shape[0]]
        loops.run(s, sp, c)
        if s.step % c.air_every == 0:
            air(s, c, gusts, n)
        plant.step(s, c)
        sensors.sense(s, c, n)


@kernel
def air(s, c, gusts, n):
    """The wind at the vehicle, held until the next sample: mean at this height, turbulence along it, gusts."""
    k = 1.0
    if c.profile:
        k = max(0.0, math.log(max(1e-9, -s.p_ned_m[2] / wind.FOOT_M) / 0.15) / math.log(20.0 / 0.15))
    north, east, down = k * c.mean_wind_m_s[0], k * c.mean_wind_m_s[1], 0.0
    if c.turbulent:
        wind.turbulence(c.F, c.B, c.C, s.turbulence, n[sensors.AIR : sensors.AIR + 7], s.gust)
        north += c.wind_to[0] * s.gust[0] - c.wind_to[1] * s.gust[1]
        east += c.wind_to[1] * s.gust[0] + c.wind_to[0] * s.gust[1]
        down = s.gust[2]
    t = s.step * c.dt_s
    for i in range(gusts.shape[0]):
        shape = wind.gust_shape(t, gusts[i, 0], gusts[i, 1])
        north += shape * gusts[i, 2]
        east += shape * gusts[i, 3]
    s.wind_ned_m_s[0], s.wind_ned_m_s[1], s.wind_ned_m_s[2] = north, east, down


class Vehicle:
    """State, setpoint and constants of one vehicle, and the noise it is given. Deterministic in its configuration."""

    mav_type = 2

    def __init__(self, sitl: config.Sitl) -> None:
        self.tuned, self.true = tuned, true = config.vehicles(sitl)
        self.dt_us = 1_000_000 // sitl.rate_hz
        self.t_us = 0  # vehicle time
        self.constants = Record(CONSTANTS)
        self.setpoint = Record(SETPOINT)
        self.state = Record(VEHICLE)
        self._gusts = wind.gust_table(sitl.wind.gusts)
        self._generators, self._normals = self._noise(sitl.seed)
        self._fill_body(sitl, true)
        self._fill_sensors(sitl)
        self._fill_air(sitl, true)
        self._fill_tuning(sitl, tuned)
        self._stand(sitl)

    def quaternion(self) -> tuple[float, ...]:
        """True attitude (w, x, y, z)."""
        return rotation.to_quaternion(tuple(self.state["R"].tolist()))

    def run(self, steps: int) -> None:
        """Move on by a number of loop periods."""
        while steps > 0:
            now = self.at_once(steps)
            self.actuate(now)
            self.passed(now)
            steps -= now

    def at_once(self, steps: int) -> int:
        """How many of these steps the normals drawn last for."""
        return min(steps, self._left)

    def passed(self, steps: int) -> None:
        """That many steps were made, at most `at_once`."""
        self.t_us += steps * self.dt_us
        self._left -= steps
        if not self._left:
            self._draw()

    @property
    def arrays(self) -> tuple[Any, ...]:
        """What its kernel `advance` works on."""
        return self.state.array, self.setpoint.array, self.constants.array, self._gusts, self._normals

    def actuate(self, steps: int) -> None:
        """That many steps, at most `at_once`."""
        advance(self.state.array, self.setpoint.array, self.constants.array, self._gusts, self._normals, steps)

    def _noise(self, seed: int) -> tuple[list[np.random.Generator], np.ndarray]:
        """The generators, and room for what is drawn at once."""
        generators = [np.random.default_rng([seed, 1 + i]) for i in range(len(_GENERATORS))]
        return generators, np.zeros((_BLOCK, sensors.COLUMNS))

    def _draw(self) -> None:
        self._left = _BLOCK
        for generator, (first, last) in zip(self._generators, _GENERATORS, strict=True):
            self._normals[:, first:last] = generator.standard_normal((_BLOCK, last - first))

    def _fill_body(self, sitl: config.Sitl, true: Airframe) -> None:
        c, geometry = self.constants, rotors.geometry(true)
        assert true.rotors is not None
        c["dt_s"] = 1e-6 * self.dt_us
        c["ground_d_m"] = sitl.start.p_ned_m[2]
        c["mass_kg"], c["inertia_kg_m2"] = true.body.mass_kg, true.body.inertia_kg_m2
        c["x_m"], c["y_m"], c["spin"], c["torque_per_thrust_m"] = geometry
        c["thrust_max_n"], c["lag_s"] = true.rotors.thrust_max_n, true.rotors.lag_s
        c["drag_linear"], c["drag_quadratic"] = true.drag.linear_n_s_m, true.drag.quadratic_n_s2_m2
        c["effectiveness"] = 1.0

    def _fill_air(self, sitl: config.Sitl, true: Airframe) -> None:
        c, w = self.constants, sitl.wind
        towards = math.radians(w.from_deg + 180.0)
        c["wind_to"] = math.cos(towards), math.sin(towards)
        c["mean_wind_m_s"] = w.mean_m_s * math.cos(towards), w.mean_m_s * math.sin(towards)
        c["profile"], c["turbulent"] = w.profile, w.w20_m_s > 0.0
        c["air_every"] = round(wind.SAMPLE_S * sitl.rate_hz)
        c["rotor_model"] = rotors.MODELS[w.rotor_model]
        c["air_density"], c["rotor_disk_m2"] = w.air_density_kg_m3, w.rotor_disk_m2
        if w.w20_m_s > 0.0:
            airspeed = w.turbulence_airspeed_m_s or wind.mean_at(w.w20_m_s, w.turbulence_height_m)
            d = wind.dryden(w.w20_m_s, w.turbulence_height_m, self._span_m(true), airspeed)
            c["F"], c["B"], c["C"] = d.F, d.B, d.C
            self.state["turbulence"] = d.P0 @ np.random.default_rng([sitl.seed, 0]).standard_normal(7)

    def _span_m(self, true: Airframe) -> float:
        """What turbulence sees of the vehicle."""
        assert true.rotors is not None
        return 2.0 * true.rotors.arm_m

    def _fill_sensors(self, sitl: config.Sitl) -> None:
        c, n, dt = self.constants, sitl.noise, 1.0 / sitl.rate_hz
        c["gyro_sigma"], c["accel_sigma"] = n.gyro_rad_s, n.accel_m_s2
        tuning = TUNING[sitl.personality]
        c["gyro_bias"], c["accel_bias"] = n.gyro_bias_rad_s, n.accel_bias_m_s2
        c["velocity_bias"] = tuning.velocity_bias_m_s if n.velocity_bias_m_s is None else n.velocity_bias_m_s
        keep = math.exp(-dt / sensors.DRIFT_S)
        c["drift_keep"], c["drift_draw"] = keep, math.radians(n.attitude_deg) * math.sqrt(1.0 - keep * keep)
        self.state["drift_rad"] = math.radians(n.attitude_deg) * np.random.default_rng([sitl.seed, 99]).standard_normal(3)
        c["position_sigma"], c["velocity_sigma"] = n.position_m, n.velocity_m_s
        c["altitude_m"] = config.ORIGIN[2]
        c["nav_every"] = sitl.rate_hz // 50
        low, high = tuning.position_delay_ms
        drawn = int(np.random.default_rng([sitl.seed, 97]).integers(low, high + 1)) if low < high else low
        c["nav_delay"] = round(1e-3 * (drawn if n.position_delay_ms is None else n.position_delay_ms) * sitl.rate_hz)
        c["mocap_sigma"] = math.radians(n.mocap_deg)
        c["mocap_every"], c["mocap_delay"] = sitl.rate_hz // n.mocap_rate_hz, round(1e-3 * n.mocap_delay_ms * sitl.rate_hz)
        wn = 2.0 * math.pi * tuning.gyro_cutoff_hz
        c["filter_b"], c["filter_a"] = wn * wn * dt, math.sqrt(2.0) * wn * dt

    def _fill_tuning(self, sitl: config.Sitl, tuned: Airframe) -> None:
        c = self.constants
        assert tuned.rotors is not None
        tuning = TUNING[sitl.personality]
        c["personality"] = tuning.number
        c["tuned_inertia"], c["tuned_thrust_max_n"] = tuned.body.inertia_kg_m2, tuned.rotors.thrust_max_n
        c["idle"] = tuned.rotors.thrust_min_n / tuned.rotors.thrust_max_n
        c["allocation"], c["hover_thrust"] = rotors.allocation(tuned), tuned.hover_thrust
        c["rate_p"], c["rate_i"] = (tuning.rate_p, tuning.rate_p, 6.0), (tuning.rate_i, tuning.rate_i, 3.0)
        c["rate_d"] = tuning.rate_d, tuning.rate_d, 0.0
        c["position_every"] = sitl.rate_hz // 100
        c["accel_max"] = 20.0

    def _stand(self, sitl: config.Sitl) -> None:
        """On the ground, at rest, sensors settled: the first instant is as good as any later one."""
        s, start = self.state, sitl.start
        R = rotation.from_euler(0.0, 0.0, math.radians(start.yaw_deg))
        s["p_ned_m"], s["grounded"] = start.p_ned_m, 1
        for name in ("R", "ahrs_R", "wanted_R", "target_R", "shaped_R"):
            s[name] = R
        s["past"][:, :3], s["past_R"][:] = start.p_ned_m, R
        s["ahrs_q_wxyz"] = rotation.to_quaternion(R)
        self.setpoint["yaw_rad"] = math.radians(start.yaw_deg)
        for name in ("p_ned_m", "v_ned_m_s", "a_ned_m_s2"):
            self.setpoint[name] = math.nan
        self._draw()
        sense_now(s.array, self.constants.array, np.random.default_rng([sitl.seed, 98]).standard_normal(sensors.COLUMNS))


@kernel
def sense_now(vehicle, constants, normals):
    """Sample the sensors without moving."""
    sensors.sense(vehicle[0], constants[0], normals)
