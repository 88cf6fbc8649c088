"""TOML -> frozen typed structures. An unknown key, a wrong type or an impossible value names file, key, value, what is allowed.

Types are msgspec Structs declared with `class X(Section)`; their `__post_init__` raises ConfigError for impossible values.
"""

import difflib
import functools
import math
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import msgspec

from mavquad.errors import ConfigError

T = TypeVar("T")
_UNKNOWN = re.compile(r"unknown field `(?P<key>[^`]+)`(?: - at `\$\.?(?P<at>[^`]*)`)?")


class Section(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A TOML table."""


def read(path: Path) -> dict[str, Any]:
    """The plain tables of a TOML file. Raises ConfigError where it is missing or is no TOML."""
    try:
        return _copy(_parsed(path, path.stat().st_mtime_ns))
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from None


@functools.lru_cache(maxsize=64)
def _parsed(path: Path, changed_ns: int) -> dict[str, Any]:
    """A file is parsed once, until it changes: a campaign reads the same few ten thousand times."""
    return tomllib.loads(path.read_text(encoding="utf-8"))


def convert(data: dict[str, Any], kind: type[T], source: str) -> T:
    """Plain tables as `kind`. Raises ConfigError that names source, key, value and what is allowed; nan and inf never are."""
    for key, number in _not_finite(data):
        raise ConfigError(f"{source}: {key} = {number}: expected a finite number")
    try:
        return msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{source}: {_explain(str(error), data, kind)}") from None
    except ConfigError as error:
        raise ConfigError(f"{source}: {error}") from None


def _not_finite(data: Any, at: str = "") -> Iterator[tuple[str, float]]:
    """(key, number) of each nan and inf: no limit holds against them."""
    if isinstance(data, float) and not math.isfinite(data):
        yield at, data
    elif isinstance(data, dict):
        for key, inner in data.items():
            yield from _not_finite(inner, f"{at}.{key}" if at else str(key))
    elif isinstance(data, list | tuple):
        for i, inner in enumerate(data):
            yield from _not_finite(inner, f"{at}[{i}]")


def load(path: Path, kind: type[T]) -> T:
    """A TOML file as `kind`."""
    return convert(read(path), kind, str(path))


def override(data: dict[str, Any], assignment: str) -> dict[str, Any]:
    """A copy of `data`, new where it differs, with one `a.b=VALUE` applied: a number, a TOML value, or a change `+20%` / `-5%` of what is there."""
    dotted, equals, text = assignment.partition("=")
    keys = dotted.strip().split(".")
    if not equals or not all(keys):
        raise ConfigError(f"--set {assignment}: expected KEY.KEY=VALUE, e.g. body.mass_kg=+20%")
    data = dict(data)
    table: Any = data
    for i, key in enumerate(keys[:-1]):
        if not isinstance(table.get(key), dict):
            raise ConfigError(f"--set {assignment}: there is no [{'.'.join(keys[: i + 1])}]{_nearest(key, table)}")
        table[key] = table = dict(table[key])
    last = keys[-1]
    percent = re.fullmatch(r"([+-]\d+(?:\.\d+)?)%", text.strip())
    if percent:
        factor = 1.0 + float(percent[1]) / 100.0
        old = table.get(last)
        if isinstance(old, list):
            table[last] = [factor * x for x in old]
        elif isinstance(old, int | float):
            table[last] = factor * old
        else:
            raise ConfigError(
                f"--set {assignment}: {dotted} is {old!r}, not a number to change by {text}{_nearest(last, table)}"
            )
    else:
        table[last] = value(text)
    return data


def value(text: str) -> Any:
    """A TOML value, or the text itself where it is none (so that names need no quotes)."""
    try:
        return tomllib.loads(f"x = {text}")["x"]
    except tomllib.TOMLDecodeError:
        return text.strip()


def _copy(data: Any) -> Any:
    if isinstance(data, dict):
        return {k: _copy(v) for k, v in data.items()}
    return [_copy(item) for item in data] if isinstance(data, list) else data


def _nearest(key: str, names: Any) -> str:
    near = difflib.get_close_matches(key, list(names), n=1, cutoff=0.5)
    return f'; did you mean "{near[0]}"?' if near else f"; known: {', '.join(sorted(names)) or 'nothing'}"


def _explain(text: str, data: dict[str, Any], kind: Any) -> str:
    found = _UNKNOWN.search(text)
    if found:
        at = found["at"] or ""
        for part in filter(None, at.split(".")):
            kind = _struct_of(get_type_hints(kind).get(part)) or kind
        fields = getattr(kind, "__struct_fields__", ())
        place = f" in [{at}]" if at else ""
        return f'unknown key "{found["key"]}"{place}{_nearest(found["key"], fields)}'
    where = re.search(r" - at `\$\.?([^`]*)`", text)
    if where:
        got: Any = data
        for part in filter(None, re.split(r"[.\[\]]+", where[1])):
            kind = _inside(kind, part)
            try:
                got = got[int(part)] if isinstance(got, list) else got[part]
            except (KeyError, IndexError, ValueError, TypeError):
                return text.replace("$.", "").replace("$", "the top level")
        if "enum" in text and get_args(kind):
            return f"{where[1]} = {got!r}{_nearest(str(got), [str(name) for name in get_args(kind)])}"
        return f"{where[1]} = {got!r}: {text[: where.start()]}" if where[1] else text[: where.start()]
    return text


def _inside(hint: Any, part: str) -> Any:
    """The type of one field, item or value of a type; None where that is not plain."""
    struct = _struct_of(hint)
    if struct is not None and get_origin(hint) not in (list, tuple, dict):
        return get_type_hints(struct).get(part)
    return get_args(hint)[-1] if get_origin(hint) in (list, dict) else None


def _struct_of(hint: Any) -> Any:
    if isinstance(hint, type) and issubclass(hint, msgspec.Struct):
        return hint
    for arg in getattr(hint, "__args__", ()):
        if isinstance(arg, type) and issubclass(arg, msgspec.Struct):
            return arg
    return None
