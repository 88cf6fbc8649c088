"""A flight as a monitor would hear it, made by formula: a PX4 vehicle 1/1 and its companion 1/191, both directions."""

import math
from collections.abc import Iterator

from mavquad import wire

EPOCH_US = 1_700_000_000_000_000
OFFBOARD, LOITER = 6 << 16, 3 << 24 | 4 << 16
QUATERNION_ID = wire.ID["ATTITUDE_QUATERNION"]


def frames(seconds: float = 12.0, boot_ms: int = 5000) -> Iterator[tuple[int, bytes]]:
    """(t_us, raw) in order: rates granted at 1 s, OFFBOARD at 3 s, setpoints until 9 s, disturbance of 0.8 m/s2 north."""
    seq = {1: 0, 191: 0}

    def frame(component: int, name: str, *fields: object) -> bytes:
        seq[component] = (seq[component] + 1) & 0xFF
        return wire.encode(name, fields, seq=seq[component], system=1, component=component)

    for k in range(round(100 * seconds)):
        t, t_us = 0.01 * k, EPOCH_US + 10_000 * k
        ms = boot_ms + 10 * k
        roll, rate = 0.1 * math.sin(t), 0.1 * math.cos(t)
        q = (math.cos(roll / 2), math.sin(roll / 2), 0.0, 0.0)
        flying = 3.0 <= t < 9.0
        if k % 100 == 0:
            yield t_us, frame(1, "HEARTBEAT", 2, 12, 209 if t >= 2.0 else 81, OFFBOARD if flying else LOITER, 4, 3)
            yield t_us, frame(1, "SYS_STATUS", 0, 0, 0, 200, 16200, 900, 87 - k // 100, 0, 0, 0, 0, 0, 0, 0, 0, 0)
            yield t_us, frame(1, "EXTENDED_SYS_STATE", 0, 2 if t >= 2.0 else 1)
            yield t_us, frame(191, "HEARTBEAT", 18, 8, 0, 0, 4, 3)
        if k == 90:
            for msgid, interval_us in ((QUATERNION_ID, 10_000.0), (wire.ID["HIGHRES_IMU"], 1_000.0)):
                yield t_us, frame(191, "COMMAND_LONG", 1, 1, 511, 0, float(msgid), interval_us, 0.0, 0.0, 0.0, 0.0, 0.0)
        if k in (92, 93):
            yield t_us, frame(1, "COMMAND_ACK", 511, 0 if k == 92 else 2, 0, 0, 1, 191)
        if k == 200:
            yield t_us, frame(191, "COMMAND_LONG", 1, 1, 400, 0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            yield t_us, frame(1, "COMMAND_ACK", 400, 0, 0, 0, 1, 191)
        if k in (300, 900):
            words = "mavquad engaged: setpoints are flown" if k == 300 else "mavquad released: landing by the autopilot"
            yield t_us, frame(191, "STATUSTEXT", 6 if k == 300 else 4, words, 0, 0)
        yield t_us, frame(1, "ATTITUDE_QUATERNION", ms, *q, rate, 0.0, 0.0, (0.0,) * 4)
        if k % 2 == 0:
            yield t_us, frame(1, "LOCAL_POSITION_NED", ms, 3.0 * math.cos(t), 3.0 * math.sin(t), -5.0, 0.0, 0.0, 0.0)
            yield (
                t_us,
                frame(1, "POSITION_TARGET_LOCAL_NED", ms, 1, 0, 3.0 * math.cos(t), 3.0 * math.sin(t) + 0.25, -5.0, *(0.0,) * 8),
            )
        if k % 20 == 0:
            ns = 10_000_000 * k + 1
            yield t_us, frame(191, "TIMESYNC", 0, ns, 1, 1)
            yield t_us + 4_000, frame(1, "TIMESYNC", ns + 2_000_000, ns, 1, 191)
            north = 0.8 + 0.1 * math.sin(2.0 * t)
            yield (
                t_us + 4_000,
                frame(191, "DEBUG_FLOAT_ARRAY", 1000 * ms, "disturb", 2, padded(0.75, 0.0, -0.1, 0.01, 0.0, 0.0, 0.042, 0.41)),
            )
            yield t_us + 4_000, frame(191, "DEBUG_FLOAT_ARRAY", 1000 * ms, "rates", 3, padded(rate + 0.02, 0.0, 0.0, *q))
            asmf = (north, 0.0, -0.1, north - 0.3, -0.3, -0.4, north + 0.3, 0.3, 0.2, 0.0, 0.0, 0.3, 1.0, 0.0, 2.0, 1.0)
            yield t_us + 4_000, frame(191, "DEBUG_FLOAT_ARRAY", 1000 * ms, "asmf", 4, padded(*asmf))
        if flying:
            yield t_us + 5_000, frame(191, "SET_ATTITUDE_TARGET", ms, 1, 1, 7, q, 0.0, 0.0, 0.0, 0.41, (0.0,) * 3)
            yield t_us + 8_000, frame(1, "ATTITUDE_TARGET", ms + 8, 0, q, 0.0, 0.0, 0.0, 0.41)


def padded(*values: float) -> tuple[float, ...]:
    """The 58 values of a DEBUG_FLOAT_ARRAY."""
    return values + (0.0,) * (58 - len(values))


def log_bytes(seconds: float = 12.0) -> bytes:
    """The same as a tlog."""
    return b"".join(t_us.to_bytes(8, "big") + raw for t_us, raw in frames(seconds))
