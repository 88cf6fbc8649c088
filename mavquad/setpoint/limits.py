"""The last gate before the wire. It knows no controller and trusts none.

Whatever comes in, what goes out is finite, a unit quaternion, and inside tilt, rate, thrust and slew. A value that is not finite
is replaced by the last one sent; every intervention sets a bit.
"""

import math
from typing import NamedTuple

from mavquad import config, quat
from mavquad.errors import ConfigError
from mavquad.jit import kernel
from mavquad.signals import Quat, Setpoint, Sticks, Vec3

NOT_FINITE, TILT, RATE, THRUST, TURN, THRUST_SLEW, STICK = 1, 2, 4, 8, 16, 32, 64
STICK_SLEW_PER_S = 20.0  # of half the travel


class Limits(config.Section, frozen=True):
    """[limits] of a companion file."""

    tilt_deg: float = 40.0
    rate_deg_s: float = 200.0  # of body rates sent
    turn_deg_s: float = 400.0  # of the attitude sent, from one setpoint to the next
    thrust_min: float = 0.08  # collective; never 0 in flight: no attitude authority without thrust
    thrust_max: float = 0.95
    thrust_slew_per_s: float = 8.0

    def __post_init__(self) -> None:
        for key, most in (("tilt_deg", 60.0), ("rate_deg_s", 720.0), ("turn_deg_s", 2000.0), ("thrust_slew_per_s", 100.0)):
            if not 0.0 < getattr(self, key) <= most:
                raise ConfigError(f"limits.{key} = {getattr(self, key)}: expected 0 to {most:g}")
        if not 0.0 <= self.thrust_min < self.thrust_max <= 1.0:
            raise ConfigError(
                f"limits.thrust_min = {self.thrust_min}, limits.thrust_max = {self.thrust_max}: expected 0 <= min < max <= 1"
            )


class Gains(NamedTuple):
    cos_tilt: float
    tilt_rad: float
    rate_rad_s: float
    turn_rad_s: float
    thrust_min: float
    thrust_max: float
    thrust_slew_per_s: float


def gains(limits: Limits) -> Gains:
    tilt = math.radians(limits.tilt_deg)
    return Gains(
        math.cos(tilt),
        tilt,
        math.radians(limits.rate_deg_s),
        math.radians(limits.turn_deg_s),
        limits.thrust_min,
        limits.thrust_max,
        limits.thrust_slew_per_s,
    )


@kernel
def apply_kernel(
    gains: Gains, last_q: Quat, last_thrust: float, q_wxyz: Quat, omega_rad_s: Vec3, thrust: float, dt_s: float
) -> tuple[Quat, Vec3, float, int]:
    """(attitude, rates, thrust, bits) that may be sent dt after (last_q, last_thrust)."""
    bits = 0
    n = quat.norm(q_wxyz)
    if not (0.5 < n < 2.0):  # also NaN, zero and infinite
        q_wxyz, bits = last_q, bits | NOT_FINITE
    else:
        q_wxyz = (q_wxyz[0] / n, q_wxyz[1] / n, q_wxyz[2] / n, q_wxyz[3] / n)
    if not math.isfinite(thrust):
        thrust, bits = last_thrust, bits | NOT_FINITE
    if not (dt_s > 0.0):
        dt_s = 0.0
    elif dt_s > 0.1:
        dt_s = 0.1

    # turn: no faster than turn_rad_s from what was sent last
    step = quat.log(quat.mul(quat.conj(last_q), q_wxyz))
    angle = math.sqrt(step[0] * step[0] + step[1] * step[1] + step[2] * step[2])
    most = gains.turn_rad_s * dt_s
    if angle > most:
        k = most / angle
        q_wxyz = quat.mul(last_q, quat.exp((k * step[0], k * step[1], k * step[2])))
        bits |= TURN

    # tilt, after the turn (the short way between two leans bows outwards): keep its direction and shorten it; cos(tilt) = 1 - 2 (x^2 + y^2)
    lean = math.sqrt(q_wxyz[1] * q_wxyz[1] + q_wxyz[2] * q_wxyz[2])
    if 1.0 - 2.0 * lean * lean < gains.cos_tilt:
        upright = math.sqrt(q_wxyz[0] * q_wxyz[0] + q_wxyz[3] * q_wxyz[3])
        s = math.sin(0.5 * gains.tilt_rad) / lean
        if upright > 1e-9:
            c = math.cos(0.5 * gains.tilt_rad) / upright
            q_wxyz = (c * q_wxyz[0], s * q_wxyz[1], s * q_wxyz[2], c * q_wxyz[3])
        else:  # exactly upside down: no heading to keep
            q_wxyz = last_q
        bits |= TILT

    wx, wy, wz = omega_rad_s
    if not (math.isfinite(wx) and math.isfinite(wy) and math.isfinite(wz)):
        wx, wy, wz, bits = 0.0, 0.0, 0.0, bits | NOT_FINITE
    size = math.sqrt(wx * wx + wy * wy + wz * wz)
    if size > gains.rate_rad_s:
        k = gains.rate_rad_s / size
        wx, wy, wz, bits = k * wx, k * wy, k * wz, bits | RATE

    step_max = gains.thrust_slew_per_s * dt_s
    if thrust > last_thrust + step_max:
        thrust, bits = last_thrust + step_max, bits | THRUST_SLEW
    elif thrust < last_thrust - step_max:
        thrust, bits = last_thrust - step_max, bits | THRUST_SLEW
    if thrust > gains.thrust_max:
        thrust, bits = gains.thrust_max, bits | THRUST
    elif thrust < gains.thrust_min:
        thrust, bits = gains.thrust_min, bits | THRUST
    return (q_wxyz, (wx, wy, wz), thrust, bits)


def sticks(last: Sticks | None, wanted: Sticks, dt_s: float) -> tuple[Sticks, int]:
    """A helicopter's sticks that may be sent dt after `last` (None: none yet): finite, -1..1, STICK_SLEW_PER_S; and the bits."""
    bits, out = 0, []
    most = STICK_SLEW_PER_S * dt_s if dt_s > 0.0 else 0.0  # also NaN; a tenth of a second is the whole travel
    for i, value in enumerate(wanted):
        before = last[i] if last is not None else 0.0
        if not math.isfinite(value):
            value, bits = before, bits | NOT_FINITE
        slewed = min(before + most, max(before - most, value)) if last is not None else value
        given = min(1.0, max(-1.0, slewed))
        bits |= STICK if given != value else 0
        out.append(given)
    return (out[0], out[1], out[2], out[3]), bits


def apply(gains: Gains, last: Setpoint, wanted: Setpoint, dt_s: float) -> tuple[Setpoint, int]:
    """The setpoint that may be sent dt after `last`, and the bits of what was changed."""
    q, w, thrust, bits = apply_kernel(gains, last.q_wxyz, last.thrust, wanted.q_wxyz, wanted.omega_rad_s, wanted.thrust, dt_s)
    return Setpoint(q, w, thrust, wanted.type_mask), bits
