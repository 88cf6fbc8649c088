"""Scenarios: what to fly, in what conditions, and what counts as well flown; resolved into both programs' configurations.

A scenario is a TOML file of `scenario/` (or a user's own) over the standard conditions, which are the defaults of the simulated
autopilot's own types; then changed by `--set`:
  vehicle.mass=+20%          the true vehicle against its file (mass, inertia, drag, thrust, motor_lag, or any key of the file)
  faults=[{kind = "motor", motor = 1, effectiveness = 0.8, t_s = 20}]
  wind.mean_m_s=5            also noise, link, start, params, path, flight, require: tables of the scenario
  limits.tilt_deg=30        also safety: tables of the companion; companion.control_hz=250: its own keys
  pid.ki=0.4                 any other table tunes the stage of that name
"""

import functools
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec

from mavquad import airframe, config
from mavquad.errors import ConfigError
from mavquad.paths import Path as FlightPath
from mavquad.settings import Companion
from sitl.config import Fault, Link, Noise, Sitl, Start, Wind

FOLDER = Path(__file__).resolve().parent / "scenario"
VEHICLE = {  # short names of what a vehicle can differ in from its file
    "mass": "body.mass_kg",
    "inertia": "body.inertia_kg_m2",
    "drag": "drag.linear_n_s_m",
    "thrust": "rotors.thrust_max_n",
    "motor_lag": "rotors.lag_s",
}
MOCAP_OBSERVERS = ("gsmo:source=mocap", "gsmo:source=mocap,torque=motors")  # rates without a gyro, torque unknown and known
PARAMS: dict[str, dict[str, float]] = {
    "px4": {},
    "ardupilot": {"GUID_OPTIONS": 8},
}  # as the companion asks for it: thrust as thrust
COMPANION_TABLES = ("limits", "safety")


class Flight(config.Section, frozen=True):
    """How far the flight goes and from when it is scored."""

    takeoff_m: float = 5.0
    score_from_s: float = 3.0  # after the engagement
    max_time_s: float = 240.0  # vehicle time after which the flight is given up

    def __post_init__(self) -> None:
        if self.score_from_s < 0.0 or self.max_time_s <= 0.0:
            raise ConfigError(
                f"flight.score_from_s = {self.score_from_s}, flight.max_time_s = {self.max_time_s}: expected >= 0 and > 0"
            )


class Require(config.Section, frozen=True):
    """What the flight must reach to be `ok`, beside landing. None: nothing."""

    rmse_m: float | None = None
    max_error_m: float | None = None
    misses: int | None = 0  # in lockstep; at a speed they depend on what else the machine does


class Scenario(config.Section, frozen=True):
    """One scenario."""

    about: str
    path: FlightPath
    flight: Flight = Flight()
    require: Require = Require()
    vehicle: dict[str, str | float | list[float]] = msgspec.field(default_factory=dict)
    start: Start = Start()
    wind: Wind = Wind()
    noise: Noise = Noise()
    link: Link = Link()
    faults: list[Fault] = msgspec.field(default_factory=list)
    params: dict[str, float] = msgspec.field(default_factory=dict)
    companion: dict[str, Any] = msgspec.field(default_factory=dict)  # over the companion's defaults


class Options(config.Section, frozen=True):
    """What a person chooses beside the scenario. None leaves the companion's own default."""

    seed: int = 1
    airframe: str = "x500"
    personality: Literal["px4", "ardupilot"] = "px4"
    attitude: Literal["ahrs", "mocap", "both"] = "ahrs"
    controller: str | None = None
    estimator: str | None = None
    compensator: str | None = None
    observers: list[str] | None = None
    loop: Literal["attitude", "rates"] | None = None
    signing_key: str = ""  # a file, for both programs


class Resolved(NamedTuple):
    """A scenario as the configurations of both programs."""

    scenario: Scenario
    sitl: Sitl
    companion: Companion


def names() -> list[str]:
    """The scenarios that come with mavquad."""
    return sorted(p.stem for p in FOLDER.glob("*.toml"))


def load(name_or_path: str, changes: list[str] | None = None) -> Scenario:
    """A scenario by name or by a path that ends in .toml, with `--set` changes applied. Raises ConfigError."""
    path = Path(name_or_path)
    if path.suffix != ".toml":
        path = FOLDER / f"{name_or_path}.toml"
        if not path.is_file():
            raise ConfigError(
                f"no scenario is called {name_or_path!r}; known: {', '.join(names())}; or give a path that ends in .toml"
            )
    changed_ns = path.stat().st_mtime_ns if path.is_file() else 0
    return config.convert(_changed(path, changed_ns, tuple(changes or ())), Scenario, str(path))


@functools.lru_cache(maxsize=64)
def _changed(path: Path, changed_ns: int, changes: tuple[str, ...]) -> dict[str, Any]:
    """The tables of a scenario with these changes, for nobody to alter: the flights of a campaign begin with the same ones."""
    if changes:
        return _set(_changed(path, changed_ns, changes[:-1]), changes[-1])
    standard = msgspec.to_builtins(Scenario(about="", path=FlightPath()))
    return _over({**standard, "companion": _companion_tables()}, config.read(path))


def resolve(scenario: Scenario, options: Options) -> Resolved:
    """Both programs' configurations. Raises ConfigError."""
    overrides = [f"{VEHICLE.get(key, key)}={_text(change)}" for key, change in scenario.vehicle.items()]
    airframe.load(options.airframe, tuple(overrides))
    sitl = Sitl(
        seed=options.seed,
        personality=options.personality,
        airframe=options.airframe,
        overrides=overrides,
        attitude_source=options.attitude,
        start=scenario.start,
        wind=scenario.wind,
        noise=scenario.noise,
        link=scenario.link,
        faults=scenario.faults,
        params={**PARAMS[options.personality], **scenario.params},
        signing_key=options.signing_key,
    )
    if options.observers is None and options.attitude != "ahrs":
        options = msgspec.structs.replace(options, observers=[*MOCAP_OBSERVERS])
    chosen = {name: getattr(options, name) for name in ("controller", "estimator", "compensator", "observers", "loop")}
    companion = _over(
        {
            "airframe": options.airframe,
            "takeoff_m": scenario.flight.takeoff_m,
            "seed": options.seed,
            "path": msgspec.to_builtins(scenario.path),
            "link": {"signing_key": options.signing_key},
        },
        {**scenario.companion, **{name: value for name, value in chosen.items() if value is not None}},
    )
    return Resolved(scenario, sitl, config.convert(companion, Companion, "the companion's configuration"))


def _set(data: dict[str, Any], change: str) -> dict[str, Any]:
    """One --set, sent to the table it means."""
    key, equals, text = change.partition("=")
    first, dot, rest = key.strip().partition(".")
    if equals and key.strip() == "faults":  # a list of tables: as a whole
        return config.override(data, change)
    if not (equals and dot and rest):
        raise ConfigError(f"--set {change}: expected TABLE.KEY=VALUE, e.g. vehicle.mass=+20% or wind.mean_m_s=5")
    if first == "vehicle":
        value = text.strip() if text.strip().endswith("%") else config.value(text)
        return {**data, "vehicle": {**data["vehicle"], rest: value}}
    if first in COMPANION_TABLES:
        return config.override(data, f"companion.{change}")
    if first in Scenario.__struct_fields__:
        return config.override(data, change)
    return config.override(_over(data, {"companion": {"tune": {first: {}}}}), f"companion.tune.{change}")


def _companion_tables() -> dict[str, Any]:
    """The companion's own defaults where --set may change them by a percentage."""
    defaults = msgspec.to_builtins(Companion())
    return {name: defaults[name] for name in COMPANION_TABLES}


def _over(base: dict[str, Any], top: dict[str, Any]) -> dict[str, Any]:
    """`base` with every key of `top` laid over it, table by table."""
    merged = dict(base)
    for key, value in top.items():
        below = merged.get(key)
        merged[key] = _over(below, value) if isinstance(below, dict) and isinstance(value, dict) else value
    return merged


def _text(change: str | float | list[float]) -> str:
    return change if isinstance(change, str) else repr(change)
