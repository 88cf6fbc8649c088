"""The only reader of wall time."""

import time

EPOCH_US = 1_700_000_000_000_000  # log time of simulation time zero, in lockstep


def wall_us() -> int:
    """Unix time in microseconds."""
    return time.time_ns() // 1000


def monotonic_s() -> float:
    """Seconds of a clock that never steps, for time-outs."""
    return time.monotonic()


def stamp() -> str:
    """Local date and time for a folder's name."""
    return time.strftime("%Y%m%d-%H%M%S")
