"""The companion's trace: one row of numbers per control step, columns by name; `flight.trace` is a JSON line and then the rows."""

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mavquad.errors import LogError

Array = NDArray[np.float64]


class Trace(NamedTuple):
    """One row per control step of the companion, columns by name."""

    names: tuple[str, ...]
    rows: Array  # (n, len(names))

    def column(self, name: str) -> Array:
        """(n,)"""
        return self.rows[:, self.names.index(name)]

    def vector(self, prefix: str, parts: str = "ned") -> Array:
        """(n, 3) of `prefix_n`, `prefix_e`, `prefix_d` (or other parts)."""
        joint = "" if prefix.endswith(" ") else "_"
        return np.column_stack([self.column(f"{prefix}{joint}{part}") for part in parts])


def read_trace(path: Path) -> Trace:
    """A companion's `flight.trace`: a JSON line of names, then rows of float64; a cut last row is left out."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from None
    head, newline, body = data.partition(b"\n")
    try:
        names = tuple(json.loads(head))
    except ValueError:
        names = ()
    if not newline or not names:
        raise LogError(f"{path}: not a trace; expected a JSON line of column names, then rows of float64")
    whole = len(body) // (8 * len(names))
    return Trace(names, np.frombuffer(body, "<f8", whole * len(names)).reshape(whole, len(names)))
