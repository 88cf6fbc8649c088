"""Ahead of every ordinary process: the scheduling class SCHED_FIFO of Linux."""

import os

from mavquad.errors import ConfigError

PRIORITY = 20  # of 1 to 99: above ordinary processes, below the kernel's own threads


def ask() -> None:
    """Run this process ahead of all ordinary ones. Raises ConfigError where that is not granted."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except (AttributeError, OSError) as error:
        reason = getattr(error, "strerror", None) or "this system has no SCHED_FIFO"
        raise ConfigError(
            f"--realtime: {reason}; run as root, allow it (`ulimit -r {PRIORITY}`, or rtprio in /etc/security/limits.conf),"
            " or leave --realtime away"
        ) from None
