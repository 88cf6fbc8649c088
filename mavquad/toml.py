"""Plain tables -> TOML text: numbers, texts, lists and tables, as configurations need; numbers survive to the last bit."""

import json
import re
from typing import Any

from mavquad.errors import ConfigError


def dumps(data: dict[str, Any]) -> str:
    """TOML of a dict of dicts. None is left out. Raises ConfigError for a value TOML has no word for."""
    return "".join(_table(data, ())).lstrip("\n")


def _table(table: dict[str, Any], path: tuple[str, ...]) -> list[str]:
    lines = [f"{_key(k)} = {value(v)}\n" for k, v in table.items() if v is not None and not isinstance(v, dict)]
    if path and (lines or not table):
        lines.insert(0, f"\n[{'.'.join(_key(k) for k in path)}]\n")
    for key, inner in table.items():
        if isinstance(inner, dict):
            lines.extend(_table(inner, (*path, key)))
    return lines


def _key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else _quoted(key)


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")  # as JSON, but DEL is refused by TOML


def value(what: Any) -> str:
    """One TOML value, on one line. Raises ConfigError for a value TOML has no word for."""
    if isinstance(what, bool):
        return str(what).lower()
    if isinstance(what, int | float):
        return repr(what)
    if isinstance(what, str):
        return _quoted(what)
    if isinstance(what, list | tuple):
        return f"[{', '.join(value(x) for x in what)}]"
    if isinstance(what, dict):
        return f"{{{', '.join(f'{_key(k)} = {value(v)}' for k, v in what.items() if v is not None)}}}"
    raise ConfigError(f"{what!r} ({type(what).__name__}) cannot be written as TOML; expected a number, text, list or table")
