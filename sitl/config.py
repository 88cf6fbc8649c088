"""sitl.toml: what the simulated autopilot is, what surrounds it and what goes wrong. Angles people write are in degrees."""

import math
from pathlib import Path
from typing import Any, Literal

import msgspec
from msgspec import field

from mavquad import airframe, config
from mavquad.airframe import Airframe, Vec3
from mavquad.errors import ConfigError

EPOCH_US = 1_700_000_000_000_000  # log time of simulation time 0

ORIGIN = (47.397742, 8.545594, 488.0)  # latitude, longitude in degrees, altitude in m of the local frame's (0, 0, 0)


def _bounds(where: str, value: float, low: float, high: float, unit: str) -> None:
    """Raises ConfigError unless low <= value <= high (and a number)."""
    if not low <= value <= high:
        raise ConfigError(f"{where} = {value}: expected {low:g} to {high:g} {unit}")


class Start(config.Section, frozen=True):
    """Where the vehicle stands at time 0; north-east of the origin, on the ground unless higher."""

    p_ned_m: Vec3 = (0.0, 0.0, 0.0)
    yaw_deg: float = 0.0

    def __post_init__(self) -> None:
        if not all(math.isfinite(x) for x in (*self.p_ned_m, self.yaw_deg)) or self.p_ned_m[2] > 0.0:
            raise ConfigError(f"start = {self}: expected finite numbers, p_ned_m[2] <= 0 (not below the ground)")


class Gust(config.Section, frozen=True):
    """A discrete gust in vehicle time: 1-cosine rise over a quarter of its duration, full speed, 1-cosine fall."""

    t_s: float
    duration_s: float
    speed_m_s: float
    from_deg: float = 0.0

    def __post_init__(self) -> None:
        _bounds("wind.gusts.duration_s", self.duration_s, 0.01, 1e4, "s")
        _bounds("wind.gusts.speed_m_s", self.speed_m_s, 0.0, 60.0, "m/s")
        _bounds("wind.gusts.t_s", self.t_s, 0.0, 1e6, "s")


class Wind(config.Section, frozen=True):
    """Mean wind (with a height profile: the speed is then the one at 20 ft), Dryden turbulence, gusts, rotor inflow."""

    mean_m_s: float = 0.0
    from_deg: float = 0.0
    profile: bool = False
    w20_m_s: float = 0.0
    turbulence_height_m: float = 5.0
    turbulence_airspeed_m_s: float | None = None  # None: the mean wind of W20 at that height, at least 1 m/s
    gusts: list[Gust] = field(default_factory=list)
    rotor_model: Literal["none", "P", "G"] = "none"
    rotor_disk_m2: float = 0.0507  # one 10 inch propeller
    air_density_kg_m3: float = 1.225

    def __post_init__(self) -> None:
        _bounds("wind.mean_m_s", self.mean_m_s, 0.0, 60.0, "m/s")
        _bounds("wind.w20_m_s", self.w20_m_s, 0.0, 60.0, "m/s")
        _bounds("wind.turbulence_height_m", self.turbulence_height_m, 0.1, 1000.0, "m")
        _bounds("wind.rotor_disk_m2", self.rotor_disk_m2, 1e-4, 10.0, "m^2")
        _bounds("wind.air_density_kg_m3", self.air_density_kg_m3, 0.1, 2.0, "kg/m^3")
        if self.turbulence_airspeed_m_s is not None:
            _bounds("wind.turbulence_airspeed_m_s", self.turbulence_airspeed_m_s, 1.0, 100.0, "m/s")


class Noise(config.Section, frozen=True):
    """One standard deviation per axis and sample, and constant biases. Position and velocity are white at 50 Hz."""

    position_m: float = 0.02
    velocity_m_s: float = 0.03
    attitude_deg: float = 0.2  # slow drift of the AHRS
    gyro_rad_s: float = 0.005
    accel_m_s2: float = 0.05
    mocap_deg: float = 0.2
    mocap_rate_hz: int = 100
    mocap_delay_ms: int = 0
    gyro_bias_rad_s: Vec3 = (0.0, 0.0, 0.0)
    accel_bias_m_s2: Vec3 = (0.0, 0.0, 0.0)
    velocity_bias_m_s: Vec3 | None = None  # None: as the personality has it
    position_delay_ms: int | None = None  # None: as the personality has it

    def __post_init__(self) -> None:
        for name in ("position_m", "velocity_m_s", "attitude_deg", "gyro_rad_s", "accel_m_s2", "mocap_deg"):
            _bounds(f"noise.{name}", getattr(self, name), 0.0, 100.0, "")
        if self.mocap_rate_hz not in (1, 2, 5, 10, 20, 25, 50, 100, 125, 250, 500):
            raise ConfigError(
                f"noise.mocap_rate_hz = {self.mocap_rate_hz}: expected 1, 2, 5, 10, 20, 25, 50, 100, 125, 250 or 500 Hz"
            )
        for name in ("mocap_delay_ms", "position_delay_ms"):
            _bounds(f"noise.{name}", getattr(self, name) or 0, 0, 200, "ms")


class Link(config.Section, frozen=True):
    """What the wire does to frames, each way, in vehicle time. Probabilities per frame."""

    delay_ms: float = 5.0
    jitter_ms: float = 0.0  # extra delay, uniform from 0 to this; order is kept
    loss: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0  # held back by `reorder_ms` and overtaken
    reorder_ms: float = 20.0
    corrupt: float = 0.0  # one byte of the frame changed
    silences: list[tuple[float, float]] = field(default_factory=list)  # [from_s, to_s] in vehicle time: nothing passes

    def __post_init__(self) -> None:
        for name in ("delay_ms", "jitter_ms", "reorder_ms"):
            _bounds(f"link.{name}", getattr(self, name), 0.0, 10_000.0, "ms")
        for name in ("loss", "duplicate", "reorder", "corrupt"):
            _bounds(f"link.{name}", getattr(self, name), 0.0, 1.0, "(a probability)")
        for start, stop in self.silences:
            if not 0.0 <= start < stop:
                raise ConfigError(f"link.silences: [{start}, {stop}]: expected 0 <= from < to, in seconds")


class Fault(config.Section, frozen=True):
    """One thing that goes wrong, from t_s for duration_s of vehicle time (0: for good).

    kind          sensor                                        value
    nan, freeze,  gyro, accel, imu, attitude, position, mocap   -
      dropout
    bias          gyro [rad/s], accel [m/s^2], position [m]     three numbers
    spikes        gyro, accel, position (its velocity [m/s])    three numbers: their size, in 2 % of the samples
    motor         -                                             motor (1..4) and effectiveness 0..1
    push          -                                             force_n (world axes) and torque_nm (body axes)
    ekf_reset     -                                             value = the jump of the position, m
    restart       -                                             - (the autopilot boots again; motors stop)
    """

    kind: Literal["nan", "freeze", "dropout", "spikes", "bias", "motor", "push", "ekf_reset", "restart"]
    t_s: float
    duration_s: float = 0.0
    sensor: Literal["gyro", "accel", "imu", "attitude", "position", "mocap"] | None = None
    value: Vec3 = (0.0, 0.0, 0.0)
    motor: int = 0
    effectiveness: float = 1.0
    force_n: Vec3 = (0.0, 0.0, 0.0)
    torque_nm: Vec3 = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        _bounds("faults.t_s", self.t_s, 0.0, 1e6, "s")
        _bounds("faults.duration_s", self.duration_s, 0.0, 1e6, "s")
        if self.kind in ("nan", "freeze", "dropout", "spikes", "bias") and self.sensor is None:
            raise ConfigError(
                f'faults: kind = "{self.kind}" needs sensor = "gyro", "accel", "imu", "attitude", "position" or "mocap"'
            )
        if self.kind in ("bias", "spikes") and self.sensor not in ("gyro", "accel", "position"):
            raise ConfigError(
                f'faults: {self.kind} of {self.sensor!r} is not modelled; expected sensor = "gyro", "accel" or "position"'
            )
        if self.kind == "motor" and not (1 <= self.motor <= 4 and 0.0 <= self.effectiveness <= 1.5):
            raise ConfigError(
                f"faults: motor = {self.motor}, effectiveness = {self.effectiveness}: expected motor 1 to 4, effectiveness 0 to 1.5"
            )


class Sitl(config.Section, frozen=True):
    """The whole of sitl.toml."""

    seed: int = 1
    personality: Literal["px4", "ardupilot"] = "px4"
    airframe: str = "x500"
    overrides: list[str] = field(
        default_factory=list
    )  # what the true vehicle has against its file; the autopilot is tuned for the file
    loop_hz: Literal[500, 1000] | None = None  # None: 500 (px4) or 1000 (ardupilot, whose 200 Hz divide only this)
    control_period_ms: int | None = None  # None: 8 (px4) or 10 (ardupilot)
    attitude_source: Literal["ahrs", "mocap", "both"] = "ahrs"
    system: int = 1
    component: int = 1
    start: Start = Start()
    wind: Wind = Wind()
    noise: Noise = Noise()
    link: Link = Link()
    faults: list[Fault] = field(default_factory=list)
    battery_s: float = 0.0  # flight time of a full battery; 0 never ends
    params: dict[str, float] = field(default_factory=dict)
    accept_from: list[tuple[int, int]] = field(
        default_factory=list
    )  # (system, component; 0 any) whose setpoints and commands are taken; empty: everybody's
    signing_key: str = ""  # a file with the key of MAVLink 2 signing; empty: nothing is signed

    def __post_init__(self) -> None:
        if not 0 <= self.seed < 2**32:
            raise ConfigError(f"seed = {self.seed}: expected 0 to {2**32 - 1}")
        if not 1 <= self.period_ms <= 100 or self.period_ms % (1000 // self.rate_hz):
            raise ConfigError(
                f"control_period_ms = {self.period_ms}: expected 1 to 100 ms, a multiple of the loop's {1000 // self.rate_hz} ms"
            )
        for name in ("system", "component"):
            _bounds(name, getattr(self, name), 1, 255, "")

    @property
    def rate_hz(self) -> int:
        """How often plant and loops run."""
        return self.loop_hz or (500 if self.personality == "px4" else 1000)

    @property
    def period_ms(self) -> int:
        """The control period: what lockstep waits for."""
        if self.control_period_ms is not None:
            return self.control_period_ms
        return 8 if self.personality == "px4" else 10


def load(path: Path | None, changes: list[str]) -> Sitl:
    """A sitl.toml (or the defaults) with `--set KEY.KEY=VALUE` applied. Raises ConfigError."""
    defaults: dict[str, Any] = msgspec.to_builtins(Sitl())
    data = defaults
    if path is not None:
        given = config.read(path)
        config.convert(given, Sitl, str(path))
        data = {**defaults, **given}
        for name, table in defaults.items():
            if isinstance(table, dict):
                data[name] = {**table, **given.get(name, {})}
    for change in changes:
        data = config.override(data, change)
    return config.convert(data, Sitl, str(path) if path else "sitl")


def vehicles(sitl: Sitl) -> tuple[Airframe, Airframe]:
    """(the airframe the autopilot is tuned for, the true one). Raises ConfigError."""
    return airframe.load(sitl.airframe), airframe.load(sitl.airframe, tuple(sitl.overrides))
