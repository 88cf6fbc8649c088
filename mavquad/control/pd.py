"""PD with the feed-forward of `pid.py` and no integral: what a compensator is best seen against."""

from dataclasses import dataclass

from mavquad.airframe import Airframe
from mavquad.control import pid
from mavquad.control.pid import Gains, State, init, step

__all__ = ["Gains", "Params", "State", "gains", "init", "step"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Params:
    """wc = 0: from the airframe's attitude response."""

    wc_rad_s: float = 0.0
    damping: float = 1.0
    drag_feed_forward: float = 1.0
    accel_max_m_s2: float = 8.0


def gains(params: Params, airframe: Airframe) -> Gains:
    return pid.gains(
        pid.Params(
            wc_rad_s=params.wc_rad_s,
            damping=params.damping,
            integral=0.0,
            drag_feed_forward=params.drag_feed_forward,
            accel_max_m_s2=params.accel_max_m_s2,
        ),
        airframe,
    )
