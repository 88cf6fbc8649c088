"""The only reader of wall time."""

import time

EPOCH_US = 1_700_000_000_000_000  # log time of simulation time zero, in lockstep


def wall_us() -> int:
    """Unix time in microseconds."""
    return time.time_ns() // 1000


class Clock:
    """Unix time in microseconds, from when it is made at `speed` times its pace: that of a simulated vehicle which does not wait for us."""

    def __init__(self, speed: float = 1.0) -> None:
        self.speed = speed
        self._began_us = wall_us()

    def us(self) -> int:
        """What it shows."""
        now_us = wall_us()
        return now_us if self.speed == 1.0 else self._began_us + round(self.speed * (now_us - self._began_us))


def monotonic_s() -> float:
    """Seconds of a clock that never steps, for time-outs."""
    return time.monotonic()


def stamp() -> str:
    """Local date and time for a folder's name."""
    return time.strftime("%Y%m%d-%H%M%S")
