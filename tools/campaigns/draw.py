"""Drawn parameters: a table of one distribution stands where a value would, in any depth; the same seed draws the same.

  {uniform = [low, high]}  {normal = [mean, sigma]}  {log_uniform = [low, high]}  {choice = [a, b, c]}

beside it `low` and `high` (redrawn until inside), `percent = true` (a change of what is there, as `--set ...=+20%`) and `digits`
(default 6 significant). A table of a list with `probability = 0.3` is there in so many of the flights.
"""

import math
import zlib
from typing import Any

import numpy as np

from mavquad.errors import ConfigError

_KINDS = ("uniform", "normal", "log_uniform", "choice")
_BESIDE = ("low", "high", "percent", "digits")
_TRIES = 1000


def draw(where: str, value: Any, *key: int | str) -> Any:
    """`value` with every distribution in it drawn. A function of `where` and `key` alone. Raises ConfigError."""
    words = [zlib.crc32(str(part).encode()) for part in (where, *key)]
    return _drawn(where, value, np.random.default_rng(words))


def _drawn(where: str, value: Any, rng: np.random.Generator) -> Any:
    if isinstance(value, list):
        items = [_drawn(f"{where}[{i}]", item, rng) for i, item in enumerate(value)]
        return [item for item in items if item is not None]
    if not isinstance(value, dict):
        return value
    kinds = [kind for kind in _KINDS if kind in value]
    if kinds:
        return _one(where, kinds[0], value, rng)
    there = rng.random() < _number(where, value.get("probability", 1.0))
    inside = {name: _drawn(f"{where}.{name}", item, rng) for name, item in value.items() if name != "probability"}
    return inside if there else None


def _one(where: str, kind: str, table: dict[str, Any], rng: np.random.Generator) -> Any:
    unknown = [name for name in table if name != kind and name not in _BESIDE]
    numbers = table[kind]
    if unknown or not isinstance(numbers, list) or len(numbers) < 1 or (kind != "choice" and len(numbers) != 2):
        raise ConfigError(
            f"draw.{where} = {table}: expected one of {', '.join(_KINDS)} with a list (two numbers, or the choices),"
            f" and beside it only {', '.join(_BESIDE)}"
        )
    if kind == "choice":
        return numbers[int(rng.integers(len(numbers)))]
    a, b = (_number(where, x) for x in numbers)
    low, high = _number(where, table.get("low", -math.inf)), _number(where, table.get("high", math.inf))
    if (kind != "normal" and not a <= b) or (kind == "log_uniform" and a <= 0.0) or (kind == "normal" and b < 0.0):
        raise ConfigError(f"draw.{where} = {table}: expected low <= high (above 0 for log_uniform), or a mean and a sigma >= 0")
    for _ in range(_TRIES):
        x = _sample(kind, a, b, rng)
        if low <= x <= high:
            x = float(f"{x:.{int(table.get('digits', 6))}g}")
            return f"{x:+g}%" if table.get("percent") else x
    raise ConfigError(f"draw.{where} = {table}: {_TRIES} draws and none from {low:g} to {high:g}; widen low and high")


def _sample(kind: str, a: float, b: float, rng: np.random.Generator) -> float:
    if kind == "uniform":
        return float(rng.uniform(a, b))
    if kind == "normal":
        return float(rng.normal(a, b))
    return math.exp(rng.uniform(math.log(a), math.log(b)))


def _number(where: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ConfigError(f"draw.{where}: {value!r} is no number")
    return float(value)
