"""Which specific thrust acts on the vehicle at a vehicle time: what was sent, one measured delay ago, behind the rotors' lag.

Where the autopilot echoes its setpoint (ATTITUDE_TARGET) the echo counts instead: 100 ms of delay that nobody measured make
the vertical disturbance oscillate. The echo is a collective; its scale is learnt against what was sent. Kernels work on an item of a
record that holds FIELDS.
"""

import math
from typing import Any

import numpy as np

from mavquad.jit import kernel

G_M_S2 = 9.80665
_REMEMBERED = 64  # setpoints
_ECHO_US = 150_000  # an echo older than this is not the present thrust
_SCALE_S = 2.0  # memory of the scale

FIELDS = [
    ("sent_us", "i8", _REMEMBERED),  # a ring of what was sent: vehicle time,
    ("sent_m_s2", "f8", _REMEMBERED),  # specific thrust
    ("sent_count", "i8"),  # ever
    ("delay_s", "f8"),
    ("echoed", "f8"),  # newest collective of ATTITUDE_TARGET
    ("echo_us", "i8"),  # 0: none yet
    ("scale", "f8"),  # specific thrust per collective; NaN: not known
]


def start(record: np.ndarray) -> None:
    """Nothing sent, nothing echoed."""
    record["echoed"] = record["scale"] = math.nan


@kernel
def remember(s: Any, t_us: int, thrust_m_s2: float, delay_s: float) -> None:
    """The setpoint that is in force from t_us on, and the delay as measured now."""
    newer = s.sent_count == 0 or s.sent_us[(s.sent_count - 1) % _REMEMBERED] < t_us
    if newer and math.isfinite(thrust_m_s2) and thrust_m_s2 >= 0.0:
        s.sent_us[s.sent_count % _REMEMBERED] = t_us
        s.sent_m_s2[s.sent_count % _REMEMBERED] = thrust_m_s2
        s.sent_count += 1
    if math.isfinite(delay_s):
        s.delay_s = min(1.0, max(0.0, delay_s))


@kernel
def hear(s: Any, t_us: int, collective: float) -> None:
    """The autopilot's echo of the setpoint it acts on."""
    if not (math.isfinite(collective) and 0.02 < collective <= 1.0) or t_us <= s.echo_us:
        return
    if s.sent_count > 0:
        ratio = sent_at(s, t_us) / collective
        gap_s = 1e-6 * (t_us - s.echo_us)
        s.scale = ratio if not math.isfinite(s.scale) else s.scale + min(0.2, gap_s / _SCALE_S) * (ratio - s.scale)
    s.echoed, s.echo_us = collective, t_us


@kernel
def sent_at(s: Any, t_us: int) -> float:
    """The setpoint that has arrived by t, going by the measured delay; gravity before the first."""
    latest = t_us - round(1e6 * s.delay_s)
    for k in range(min(s.sent_count, _REMEMBERED)):
        i = (s.sent_count - 1 - k) % _REMEMBERED
        if s.sent_us[i] <= latest:
            return s.sent_m_s2[i]
    return G_M_S2


@kernel
def acting(s: Any, t_us: int, echo: bool) -> float:
    """Commanded specific thrust at t [m/s^2], before the rotors' lag."""
    if echo and s.echo_us > 0 and 0 <= t_us - s.echo_us <= _ECHO_US and math.isfinite(s.scale):
        return s.scale * s.echoed
    return sent_at(s, t_us)
