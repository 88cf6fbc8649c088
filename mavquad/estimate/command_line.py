"""The commands of the last moments, by the time they were sent: what is acting now is what was sent one delay ago."""

from typing import NamedTuple

import numpy as np

from mavquad.jit import kernel


class Line(NamedTuple):
    t_us: np.ndarray  # (N,) newest first
    value: np.ndarray  # (N, m)


def init(value: np.ndarray, length: int = 40) -> Line:
    """As if `value` (m,) had been sent for ever."""
    return Line(
        np.full(length, np.iinfo(np.int64).min // 2, dtype=np.int64), np.tile(np.asarray(value, dtype=float), (length, 1))
    )


@kernel
def push(line: Line, t_us: int, value: np.ndarray) -> Line:
    """The line with one more command; the oldest falls out."""
    n, m = line.value.shape
    stamps, values = np.empty_like(line.t_us), np.empty_like(line.value)
    stamps[0] = t_us
    for j in range(m):
        values[0, j] = value[j]
    for i in range(1, n):
        stamps[i] = line.t_us[i - 1]
        for j in range(m):
            values[i, j] = line.value[i - 1, j]
    return Line(stamps, values)


@kernel
def index_at(line: Line, t_us: int) -> int:
    """Which command was in force at t_us: the newest sent at or before it, else the oldest there is."""
    n = line.t_us.shape[0]
    for i in range(n):
        if line.t_us[i] <= t_us:
            return i
    return n - 1
