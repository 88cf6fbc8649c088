"""Airframes: plain numbers of one vehicle, read from `airframes/*.toml`. Each side computes its own mixer from them."""

import functools
import math
import os
from pathlib import Path
from typing import Literal

import msgspec

from mavquad import config
from mavquad.errors import ConfigError

Vec3 = tuple[float, float, float]
FOLDER = Path(__file__).resolve().parent / "airframes"
_FOLDER = str(FOLDER)


class Body(config.Section, frozen=True):
    """Mass and inertia about the centre of mass, body axes (FRD)."""

    mass_kg: float
    inertia_kg_m2: Vec3


class Rotors(config.Section, frozen=True):
    """Four rotors in one plane. Numbering: x: 1 front right, 2 rear left, 3 front left, 4 rear right (1, 2 turn CCW seen from
    above); plus: 1 front, 2 right, 3 rear, 4 left (2, 4 turn CCW)."""

    layout: Literal["x", "plus"]
    arm_m: float
    thrust_max_n: float
    torque_per_thrust_m: float
    lag_s: float
    thrust_min_n: float = 0.0


class Drag(config.Section, frozen=True):
    """Force against the air-relative body velocity: -(linear + quadratic |v|) v, per axis."""

    linear_n_s_m: Vec3 = (0.0, 0.0, 0.0)
    quadratic_n_s2_m2: Vec3 = (0.0, 0.0, 0.0)


class AttitudeResponse(config.Section, frozen=True):
    """The autopilot's answer from attitude setpoint to attitude: gain wn^2/(s^2 + 2 zeta wn s + wn^2) after a delay."""

    natural_frequency_rad_s: float
    damping: float
    delay_s: float = 0.0
    gain: float = 1.0

    @property
    def lag_s(self) -> float:
        """The first-order lag with the same slope of phase at low frequency, delay not included: 2 zeta/wn."""
        return 2.0 * self.damping / self.natural_frequency_rad_s


class ModelBounds(config.Section, frozen=True):
    """How wrong this vehicle's telemetry and model are at most: what the set-membership filter's guarantee rests on.

    e: largest error of what is measured. b: largest change per tick that the model does not know. Defaults: the design note of the
    ASMF, section 8; a vehicle's own come from a flight of it (`mavquad identify --bounds LOG`) and hold quantisation, delay and lag.
    """

    e_velocity_m_s: float = 0.06
    e_attitude_rad: float = math.radians(0.3)
    e_acceleration_m_s2: float = 0.35
    b_velocity_m_s: float = 0.004
    b_f_m_s2: float = 0.12
    b_attitude_rad: float = 0.01
    b_f_attitude_rad_s: float = 0.05
    tick_s: float = 0.02

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ConfigError(f"bounds.{name} = {value}: expected a finite value > 0")


class Airframe(config.Section, frozen=True):
    """One vehicle. `hover_thrust` is the collective 0..1 that carries it in still air."""

    name: str
    body: Body
    attitude: AttitudeResponse
    hover_thrust: float
    kind: Literal["quadrotor", "helicopter"] = "quadrotor"
    rotors: Rotors | None = None
    drag: Drag = Drag()
    bounds: ModelBounds = ModelBounds()
    hover_model: dict[str, float] = msgspec.field(default_factory=dict)  # of a helicopter: derivatives by their names

    def __post_init__(self) -> None:
        mass, inertia = self.body.mass_kg, self.body.inertia_kg_m2
        if not 0.01 <= mass <= 1000.0:
            raise ConfigError(f"body.mass_kg = {mass}: expected 0.01 to 1000 kg")
        if min(inertia) <= 0.0:
            raise ConfigError(f"body.inertia_kg_m2 = {list(inertia)}: every axis must be > 0")
        a, b, c = sorted(inertia)
        if c > a + b + 1e-12:
            raise ConfigError(
                f"body.inertia_kg_m2 = {list(inertia)}: no body has one axis above the sum of the two others ({a + b:.4g})"
            )
        if self.kind == "quadrotor":
            if self.rotors is None:
                raise ConfigError(
                    "[rotors] is missing: a quadrotor needs layout, arm_m, thrust_max_n, torque_per_thrust_m, lag_s"
                )
            self._check_rotors(self.rotors)
        if not 0.05 <= self.hover_thrust <= 0.95:
            raise ConfigError(f"hover_thrust = {self.hover_thrust}: expected 0.05 to 0.95 of full collective")
        if (
            self.attitude.natural_frequency_rad_s <= 0.0
            or self.attitude.damping <= 0.0
            or not 0.0 <= self.attitude.delay_s <= 1.0
        ):
            raise ConfigError(
                f"[attitude] = {self.attitude}: expected natural_frequency_rad_s > 0, damping > 0, delay_s 0 to 1"
            )

    def _check_rotors(self, r: Rotors) -> None:
        if (
            not 0.0 < r.arm_m <= 100.0
            or r.torque_per_thrust_m <= 0.0
            or not 0.0 <= r.lag_s <= 1.0
            or not 0.0 <= r.thrust_min_n < r.thrust_max_n
        ):
            raise ConfigError(
                f"[rotors] = {r}: expected arm_m 0 to 100, torque_per_thrust_m > 0, lag_s 0 to 1, 0 <= thrust_min_n < thrust_max_n"
            )
        bound = self.body.mass_kg * r.arm_m**2
        jx, jy, jz = self.body.inertia_kg_m2
        if max(jx, jy) > 0.5 * bound or jz > bound:
            raise ConfigError(
                f"body.inertia_kg_m2 = {[jx, jy, jz]}: impossible for {self.body.mass_kg} kg on arms of {r.arm_m} m:"
                f" at most m l^2/2 = {0.5 * bound:.4g} (roll, pitch) and m l^2 = {bound:.4g} (yaw)"
            )
        if 4.0 * r.thrust_max_n <= 1.1 * self.body.mass_kg * 9.80665:
            raise ConfigError(
                f"rotors.thrust_max_n = {r.thrust_max_n}: four of them must lift at least 1.1 times the weight"
                f" ({1.1 * self.body.mass_kg * 9.80665 / 4.0:.3g} N each)"
            )


def load(name_or_path: str, overrides: tuple[str, ...] = ()) -> Airframe:
    """An airframe by its name (one of ours) or by a path to a TOML file; overrides as in `config.override`."""
    named = not name_or_path.endswith(".toml")
    path = f"{_FOLDER}/{name_or_path}.toml" if named else name_or_path
    try:
        changed_ns = os.stat(path).st_mtime_ns
    except OSError:
        if named:
            known = ", ".join(sorted(p.stem for p in FOLDER.glob("*.toml")))
            raise ConfigError(
                f"no airframe is called {name_or_path!r}; known: {known}; or give a path that ends in .toml"
            ) from None
        changed_ns = 0
    return _loaded(path, changed_ns, tuple(overrides))


@functools.lru_cache(maxsize=64)
def _loaded(path: str, changed_ns: int, overrides: tuple[str, ...]) -> Airframe:
    """Once per file and changes, until the file changes: campaigns load the same few again and again."""
    data = config.read(Path(path))
    for assignment in overrides:
        data = config.override(data, assignment)
    return config.convert(data, Airframe, str(path))
