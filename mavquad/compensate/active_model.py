"""Correct a nominal command by the estimated model error: f is cancelled, once, as far as bounds and authority allow.

Source: Song et al. 2011 (paper 004), section 3.2, Eqs. (27)-(38), carried over to a quadrotor by the design note of the ASMF,
sections 5 and 8. The paper's own rule for matrices (weighted least squares, vertex search) is in `matching.py`.

Deviations from the paper:
  Eqs. (27), (28)  on a quadrotor the commanded acceleration matches f exactly; nothing is left for least squares to share out.
  Eqs. (36)-(38)   the worst vertex of the bounds is max-min, jumps between far corners and adds chatter: `vertex` is kept for
                   comparison and refused in flight. `centre` (default) takes the ellipsoid's centre, `minmax` the middle of the
                   published interval, which makes the largest error left over least.
  no text          the bounds act on the gain: what is known badly is corrected gently; a lost guarantee takes authority away.
"""

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

from mavquad import linalg, quat
from mavquad.errors import ConfigError
from mavquad.jit import kernel

Vec3 = tuple[float, float, float]

G_M_S2 = 9.80665
MODES = ("centre", "minmax", "vertex")


@dataclass(frozen=True, slots=True, kw_only=True)
class Params:
    mode: Literal["centre", "minmax", "vertex"] = "centre"
    horizontal_max_m_s2: float = 7.5
    vertical_max_m_s2: float = 6.0
    attitude_tau_s: float = 0.133  # of the autopilot's answer
    f_attitude_max_rad_s: float = 1.0
    ramp_s: float = 2.0  # correction from 0 to 1 after the start
    off_s: float = 0.5  # and from 1 to 0 where authority is taken away
    half_width_m_s2: float = math.inf  # of f when all is well; beyond twice this the correction shrinks (inf: never)

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise ConfigError(f"active_model.mode = {self.mode!r}: expected one of {', '.join(MODES)}")
        for name in ("horizontal_max_m_s2", "vertical_max_m_s2", "attitude_tau_s", "f_attitude_max_rad_s", "half_width_m_s2"):
            if not getattr(self, name) > 0.0:
                raise ConfigError(f"active_model.{name} = {getattr(self, name)}: expected > 0")
        if self.ramp_s < 0.0 or self.off_s < 0.0:
            raise ConfigError(f"active_model: ramp_s {self.ramp_s} and off_s {self.off_s} must be >= 0")


class Gains(NamedTuple):
    horizontal_max_m_s2: float
    vertical_max_m_s2: float
    tau_s: float
    f_attitude_max_rad_s: float
    ramp_s: float
    off_s: float
    half_width_m_s2: float


def gains(params: Params, *, in_flight: bool) -> Gains:
    """Raises ConfigError where mode `vertex` is to fly."""
    if in_flight and params.mode == "vertex":
        raise ConfigError('active_model.mode = "vertex" is for comparison on paper and never flies; use "centre"')
    return Gains(
        params.horizontal_max_m_s2,
        params.vertical_max_m_s2,
        params.attitude_tau_s,
        params.f_attitude_max_rad_s,
        params.ramp_s,
        params.off_s,
        params.half_width_m_s2,
    )


@kernel
def gain_of_bounds(gains: Gains, half_width_m_s2: float) -> float:
    """min(1, 2 e_f0/half-width): wide bounds (a sensor lost) mean a gentle correction."""
    if not half_width_m_s2 > 0.0:
        return 1.0
    return min(1.0, 2.0 * gains.half_width_m_s2 / half_width_m_s2)


@kernel
def ramped(gains: Gains, authority: float, wanted: float, dt_s: float) -> float:
    """Authority dt later: up at 1/ramp, down at 1/off per second."""
    up = 1.0 if gains.ramp_s <= 0.0 else dt_s / gains.ramp_s
    down = 1.0 if gains.off_s <= 0.0 else dt_s / gains.off_s
    return linalg.clip(wanted, authority - down, authority + up)


@kernel
def limited(gains: Gains, a_ned_m_s2: Vec3) -> Vec3:
    """An acceleration within the horizontal circle and the vertical span."""
    horizontal = math.hypot(a_ned_m_s2[0], a_ned_m_s2[1])
    shrink = 1.0 if horizontal <= gains.horizontal_max_m_s2 else gains.horizontal_max_m_s2 / horizontal
    vertical = linalg.clip(a_ned_m_s2[2], -gains.vertical_max_m_s2, gains.vertical_max_m_s2)
    return (shrink * a_ned_m_s2[0], shrink * a_ned_m_s2[1], vertical)


@kernel
def attitude_for(a_ned_m_s2: Vec3, yaw_rad: float) -> Vec3:
    """(roll, pitch, specific thrust) that give the acceleration at this heading: R e3 T = g e3 - a."""
    push = (-a_ned_m_s2[0], -a_ned_m_s2[1], G_M_S2 - a_ned_m_s2[2])
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    forward, right = c * push[0] + s * push[1], -s * push[0] + c * push[1]
    thrust = linalg.norm(push)
    if not thrust > 0.0:
        return (0.0, 0.0, 0.0)
    return (math.asin(linalg.clip(-right / thrust, -1.0, 1.0)), math.atan2(forward, push[2]), thrust)


@kernel
def acceleration_of(attitude: Vec3, yaw_rad: float) -> Vec3:
    """The inverse of `attitude_for`: g e3 - R e3 T of (roll, pitch, specific thrust)."""
    push = quat.rotate(quat.from_euler(attitude[0], attitude[1], yaw_rad), (0.0, 0.0, attitude[2]))
    return (-push[0], -push[1], G_M_S2 - push[2])


@kernel
def correct(
    gains: Gains, a_wanted: Vec3, yaw_rad: float, f: Vec3, f_attitude_rad_s: tuple[float, float], authority: float
) -> Vec3:
    """The acceleration to command (NED) so that v' = a_wanted: f and the attitude's own error are taken off, times authority."""
    a = limited(gains, linalg.axpy(-authority, f, a_wanted))
    attitude = attitude_for(a, yaw_rad)
    f_max = gains.f_attitude_max_rad_s
    roll = attitude[0] - authority * gains.tau_s * linalg.clip(f_attitude_rad_s[0], -f_max, f_max)
    pitch = attitude[1] - authority * gains.tau_s * linalg.clip(f_attitude_rad_s[1], -f_max, f_max)
    return acceleration_of((roll, pitch, attitude[2]), yaw_rad)
