"""Parts of `mavquad bench`: one module each, with `measure(seconds) -> list[Row]`; its docstring's first line says what it measures."""

import statistics
import time
from collections.abc import Callable
from typing import NamedTuple


class Row(NamedTuple):
    """One figure of one contestant."""

    what: str  # the task
    who: str  # ours, or the peer by name
    value: float  # NaN: not measured
    unit: str
    note: str = ""


def cpu_s(work: Callable[[], object], repeats: int = 5) -> float:
    """The median CPU time of a call; call it once before where the first run compiles."""
    spent = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        spent.append(time.process_time() - start)
    return statistics.median(spent)
