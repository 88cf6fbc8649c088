"""Scenarios: what to fly, in what conditions, and what counts as well flown; resolved into both programs' configurations.

A scenario is a TOML file of `scenario/` (or a user's own) laid over `scenario/_standard.toml`, then changed by `--set`:
  vehicle.mass=+20%          the true vehicle against its file (mass, inertia, drag, thrust, motor_lag, or any key of the file)
  wind.mean_m_s=5            also noise, link, start, params, path, flight, require: keys of the scenario
  pid.kp=1.2, limits.x=...   any other table belongs to the companion
"""

from pathlib import Path
from typing import Any, Literal, NamedTuple

from msgspec import field

from mavquad import airframe, config
from mavquad.errors import ConfigError

FOLDER = Path(__file__).resolve().parent / "scenario"
VEHICLE = {  # short names of what a vehicle can differ in from its file
    "mass": "body.mass_kg",
    "inertia": "body.inertia_kg_m2",
    "drag": "drag.linear_n_s_m",
    "thrust": "rotors.thrust_max_n",
    "motor_lag": "rotors.lag_s",
}


class Flight(config.Section, frozen=True):
    """How far the flight goes and from when it is scored."""

    takeoff_m: float
    score_from_s: float
    max_time_s: float

    def __post_init__(self) -> None:
        if not 0.5 <= self.takeoff_m <= 500.0:
            raise ConfigError(f"flight.takeoff_m = {self.takeoff_m}: expected 0.5 to 500 m")
        if self.score_from_s < 0.0 or self.max_time_s <= 0.0:
            raise ConfigError(
                f"flight.score_from_s = {self.score_from_s}, flight.max_time_s = {self.max_time_s}: expected >= 0 and > 0"
            )


class Require(config.Section, frozen=True):
    """What the flight must reach to be `ok`, beside landing without a miss."""

    rmse_m: float | None = None
    max_error_m: float | None = None
    misses: int = 0


class Scenario(config.Section, frozen=True):
    """One scenario. The tables of the simulated autopilot and of the companion are checked by their own types."""

    about: str
    path: dict[str, Any]
    flight: Flight
    start: dict[str, Any]
    wind: dict[str, Any]
    noise: dict[str, Any]
    link: dict[str, Any]
    require: Require = Require()
    vehicle: dict[str, str | float | list[float]] = field(default_factory=dict)
    params: dict[str, float] = field(default_factory=dict)
    faults: list[dict[str, Any]] = field(default_factory=list)
    companion: dict[str, Any] = field(default_factory=dict)


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


class Resolved(NamedTuple):
    """What `fly` writes into the run folder: the scenario, and a configuration for each program."""

    scenario: Scenario
    sitl: dict[str, Any]
    companion: dict[str, Any]


def names() -> list[str]:
    """The scenarios that come with mavquad."""
    return sorted(p.stem for p in FOLDER.glob("[!_]*.toml"))


def load(name_or_path: str, changes: list[str] | None = None) -> Scenario:
    """A scenario by name or by a path that ends in .toml, with `--set` changes applied. Raises ConfigError."""
    path = Path(name_or_path)
    if path.suffix != ".toml":
        path = FOLDER / f"{name_or_path}.toml"
        if name_or_path not in names():
            raise ConfigError(
                f"no scenario is called {name_or_path!r}; known: {', '.join(names())}; or give a path that ends in .toml"
            )
    data = _over(config.read(FOLDER / "_standard.toml"), config.read(path))
    for change in changes or []:
        data = _set(data, change)
    return config.convert(data, Scenario, str(path))


def resolve(scenario: Scenario, options: Options) -> Resolved:
    """Both programs' configurations as plain tables (see `sitl/config.py` and the companion's). Raises ConfigError."""
    overrides = [f"{VEHICLE.get(key, key)}={_text(change)}" for key, change in scenario.vehicle.items()]
    airframe.load(options.airframe, tuple(overrides))
    sitl = {
        "seed": options.seed,
        "personality": options.personality,
        "airframe": options.airframe,
        "overrides": overrides,
        "attitude_source": options.attitude,
        "start": scenario.start,
        "wind": scenario.wind,
        "noise": scenario.noise,
        "link": scenario.link,
        "faults": scenario.faults,
        "params": scenario.params,
    }
    chosen = {
        "airframe": options.airframe,
        "controller": options.controller,
        "estimator": options.estimator,
        "compensator": options.compensator,
        "observers": options.observers,
        "loop": options.loop,
        "takeoff_m": scenario.flight.takeoff_m,
        "path": scenario.path,
    }
    companion = _over({k: v for k, v in chosen.items() if v is not None}, scenario.companion)
    return Resolved(scenario, sitl, companion)


def _set(data: dict[str, Any], change: str) -> dict[str, Any]:
    """One --set, sent to the table it means."""
    key, equals, text = change.partition("=")
    first, dot, rest = key.strip().partition(".")
    if not (equals and dot and rest):
        raise ConfigError(f"--set {change}: expected TABLE.KEY=VALUE, e.g. vehicle.mass=+20% or wind.mean_m_s=5")
    if first == "vehicle":
        value = text.strip() if text.strip().endswith("%") else config.value(text)
        return {**data, "vehicle": {**data.get("vehicle", {}), rest: value}}
    if first in Scenario.__struct_fields__:
        return config.override({first: {}, **data}, change)
    tables = [*key.strip().split(".")[:-1]]
    empty: dict[str, Any] = {}
    for table in reversed(tables):
        empty = {table: empty}
    return config.override(_over(data, {"companion": empty}), f"companion.{change}")


def _over(base: dict[str, Any], top: dict[str, Any]) -> dict[str, Any]:
    """`base` with every key of `top` laid over it, table by table."""
    merged = dict(base)
    for key, value in top.items():
        below = merged.get(key)
        merged[key] = _over(below, value) if isinstance(below, dict) and isinstance(value, dict) else value
    return merged


def _text(change: str | float | list[float]) -> str:
    return change if isinstance(change, str) else repr(change)
