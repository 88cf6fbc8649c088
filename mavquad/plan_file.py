"""`plan.toml` beside a flight's log: everything that decided the flight, so that it can be replayed to the last bit.

The companion's whole configuration with every default filled in, the airframe's numbers, the versions of what computes, and the
processor features the kernels were compiled for.
"""

import platform
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from llvmlite import binding

import mavquad
from mavquad import config, toml
from mavquad.airframe import Airframe
from mavquad.errors import ConfigError
from mavquad.settings import Companion

PACKAGES = ("numpy", "numba", "llvmlite", "osqp", "pymavlink")  # whose version can change a bit of a result


class Plan(NamedTuple):
    """What a plan.toml says; `here` is empty where this machine and its versions are those of the flight, else what differs."""

    companion: Companion
    airframe: Airframe
    here: tuple[str, ...]


def beside(log: Path) -> Path:
    """The plan of a flight's log: plan.toml beside flight.tlog, plan-2.toml beside flight-2.tlog."""
    return log.with_name(f"plan{log.stem.removeprefix('flight')}.toml" if log.stem.startswith("flight") else "plan.toml")


def made_by() -> dict[str, str]:
    """Versions and processor of this program as it runs."""
    features = binding.get_host_cpu_features()
    return {
        "mavquad": mavquad.__version__,
        "python": platform.python_version(),
        **{name: metadata.version(name) for name in PACKAGES},
        "machine": platform.machine(),
        "cpu": binding.get_host_cpu_name(),
        "cpu_features": " ".join(sorted(name for name, there in features.items() if there)),
    }


def write(path: Path, companion: Companion, airframe: Airframe) -> None:
    """A new plan.toml. Raises ConfigError where it cannot be written."""
    data: dict[str, Any] = {
        "made_by": made_by(),
        "companion": msgspec.to_builtins(companion),
        "airframe": msgspec.to_builtins(airframe),
    }
    try:
        path.write_text(toml.dumps(data), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from None


def read(path: Path) -> Plan:
    """A plan.toml. Raises ConfigError that names what is wrong with it."""
    data = config.read(path)
    missing = [name for name in ("made_by", "companion", "airframe") if not isinstance(data.get(name), dict)]
    if missing:
        raise ConfigError(f"{path}: there is no [{missing[0]}]; expected the plan.toml of a flight's run folder")
    then, now = data["made_by"], made_by()
    here = tuple(f"{key}: {then.get(key, 'unknown')} then, {now[key]} now" for key in now if then.get(key) != now[key])
    companion = config.convert(data["companion"], Companion, f"{path} [companion]")
    return Plan(companion, config.convert(data["airframe"], Airframe, f"{path} [airframe]"), here)
