"""Linear ADRC over MAVLink, the baseline: the paper's Eq. (31) on the plain observer's estimate, nothing known of lag or delay.

The law is that of `iadrc_flight` with prediction, quickening and jerk feed-forward off; velocity, acceleration and drag of the
path are fed forward as there. Bandwidth: what an attitude lag leaves to a loop that does not know it, as `pid` has it.
"""

import math
from dataclasses import dataclass

from mavquad.airframe import Airframe
from mavquad.control import iadrc_flight, pid
from mavquad.control.iadrc_flight import Gains, init, step
from mavquad.errors import ConfigError

__all__ = ["Gains", "Params", "gains", "init", "step"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Params:
    """0: from the airframe's attitude response."""

    wc_rad_s: float = 0.0
    drag_feed_forward: float = 1.0
    tilt_max_deg: float = 39.0  # below the gate's 40: less is lost upwind
    loop: str = "attitude"

    def __post_init__(self) -> None:
        if not (math.isfinite(self.wc_rad_s) and 0.0 <= self.wc_rad_s <= 20.0):
            raise ConfigError(f"adrc.wc_rad_s = {self.wc_rad_s}: expected 0 (from the airframe) to 20 rad/s")


def gains(params: Params, airframe: Airframe) -> Gains:
    wc = params.wc_rad_s or pid.bandwidth(airframe)
    return iadrc_flight.gains(
        iadrc_flight.Params(
            wc_xy_rad_s=wc,
            wc_z_rad_s=wc,
            quicken=1.0,
            predict=False,
            jerk_feed_forward=0.0,
            drag_feed_forward=params.drag_feed_forward,
            tilt_max_deg=params.tilt_max_deg,
            loop=params.loop,
        ),
        airframe,
    )
