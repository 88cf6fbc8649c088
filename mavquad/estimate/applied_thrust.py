"""Which specific thrust acts on the vehicle at a vehicle time: what was sent, one measured delay ago, behind the rotors' lag.

Where the autopilot echoes its setpoint (ATTITUDE_TARGET) the echo counts instead: 100 ms of delay that nobody measured make
the vertical disturbance oscillate. The echo is a collective; its scale is learnt against what was sent.
"""

import math
from typing import NamedTuple

from mavquad.signals import Applied, Target

G_M_S2 = 9.80665
_REMEMBERED = 64  # setpoints
_ECHO_US = 150_000  # an echo older than this is not the present thrust
_SCALE_S = 2.0  # memory of the scale


class Thrust(NamedTuple):
    """What was sent as (vehicle time us, m/s^2), oldest first, and what came back."""

    sent: tuple[tuple[int, float], ...]
    delay_s: float
    echoed: float  # newest collective of ATTITUDE_TARGET
    echo_us: int  # 0: none yet
    scale: float  # specific thrust per collective; NaN: not known


NONE = Thrust((), 0.0, math.nan, 0, math.nan)


def remember(thrust: Thrust, applied: Applied) -> Thrust:
    """With the setpoint that is in force from applied.t_us on, and the delay as measured now."""
    size, delay_s = applied.thrust_m_s2, applied.delay_s
    sent = thrust.sent
    if math.isfinite(size) and size >= 0.0 and not (sent and sent[-1][0] >= applied.t_us):
        sent = (*sent[1 - _REMEMBERED :], (applied.t_us, size))
    if not math.isfinite(delay_s):
        delay_s = thrust.delay_s
    return thrust._replace(sent=sent, delay_s=min(1.0, max(0.0, delay_s)))


def hear(thrust: Thrust, target: Target) -> Thrust:
    """With the autopilot's echo of the setpoint it acts on."""
    u = target.thrust
    if not (math.isfinite(u) and 0.02 < u <= 1.0) or target.t_us <= thrust.echo_us:
        return thrust
    scale = thrust.scale
    if thrust.sent:
        ratio = sent_at(thrust, target.t_us) / u
        gap_s = 1e-6 * (target.t_us - thrust.echo_us)
        scale = ratio if not math.isfinite(scale) else scale + min(0.2, gap_s / _SCALE_S) * (ratio - scale)
    return thrust._replace(echoed=u, echo_us=target.t_us, scale=scale)


def sent_at(thrust: Thrust, t_us: int) -> float:
    """The setpoint that has arrived by t, going by the measured delay; gravity before the first."""
    latest = t_us - round(1e6 * thrust.delay_s)
    for sent_us, size in reversed(thrust.sent):
        if sent_us <= latest:
            return size
    return G_M_S2


def acting(thrust: Thrust, t_us: int, echo: bool) -> float:
    """Commanded specific thrust at t [m/s^2], before the rotors' lag."""
    if echo and thrust.echo_us and 0 <= t_us - thrust.echo_us <= _ECHO_US and math.isfinite(thrust.scale):
        return thrust.scale * thrust.echoed
    return sent_at(thrust, t_us)
