"""What the set-membership compensators of quadrotors and helicopters share in flight."""

import math
from collections.abc import Iterable

from mavquad.errors import ConfigError
from mavquad.signals import Applied


def check(authority: float, delay_s: float) -> None:
    """Raises ConfigError for an authority or a delay that cannot be."""
    if not 0.0 <= authority <= 1.0:
        raise ConfigError(f"asmf.authority = {authority}: expected 0 to 1")
    if not (delay_s == -1.0 or 0.0 <= delay_s <= 0.3):
        raise ConfigError(f"asmf.delay_s = {delay_s}: expected 0 to 0.3 s, or -1 for the measured delay")


def measured_delay_s(applied: Applied) -> float:
    """The measured command delay; 0 where none is measured yet."""
    return applied.delay_s if math.isfinite(applied.delay_s) else 0.0


def finite(values: Iterable[float]) -> bool:
    """Whether every number is one."""
    return math.isfinite(sum(values))
