"""The ADRC baseline's observer over MAVLink: one extended state observer per axis on the raw position; no filter, no feed-forward.

The machinery is the joint observer's (`joint_flight`) with both switched off, so that what differs between `adrc` and `iadrc` is
what the paper says: velocity comes from the observer, and the disturbance lags by 3/w0.
"""

import math
from dataclasses import dataclass

from mavquad.airframe import Airframe
from mavquad.errors import ConfigError
from mavquad.estimate import joint_flight
from mavquad.estimate.joint_flight import Gains, init, observe, step

__all__ = ["Gains", "Params", "gains", "init", "observe", "step", "uses"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Params:
    """Bandwidths of the observers; drag and echo as in the joint observer."""

    w0_xy_rad_s: float = 6.0
    w0_z_rad_s: float = 6.0
    drag: float = 1.0
    echo: bool = True
    thrust_lag_s: float = -1.0

    def __post_init__(self) -> None:
        for name in ("w0_xy_rad_s", "w0_z_rad_s"):
            if not (math.isfinite(getattr(self, name)) and 0.2 <= getattr(self, name) <= 30.0):
                raise ConfigError(f"leso.{name} = {getattr(self, name)}: expected 0.2 to 30 rad/s (w0*dt <= 0.6 at 50 Hz)")


def gains(params: Params, airframe: Airframe) -> Gains:
    return joint_flight.gains(
        joint_flight.Params(
            w0_xy_rad_s=params.w0_xy_rad_s,
            w0_z_rad_s=params.w0_z_rad_s,
            feedforward=0.0,
            use_filter=False,
            drag=params.drag,
            echo=params.echo,
            thrust_lag_s=params.thrust_lag_s,
            anchor_s=0.0,
        ),
        airframe,
    )


def uses(gains: Gains) -> tuple[str, ...]:
    """The kinds of samples that `observe` keeps."""
    return ("Attitude", "Imu", "Position", "Target")
