"""What is wrong with a recorded flight, stream by stream: foreign axes, gaps, jitter, limits that were met. Each in one line."""

from collections.abc import Mapping

import numpy as np

from mavquad.identify import doubts, vehicle
from mavquad.identify.timebase import Held
from tools.identify_log import Flight

AXES = ("roll", "pitch", "yaw")
Span = tuple[float, float]


def foreign_axes(flight: Flight, motion: vehicle.Motion) -> dict[str, str]:
    """Streams whose signs are not those of NED and FRD, with what is wrong: told by what they are the derivative of."""
    air = motion.flying
    found: dict[str, str] = {}
    expected = "have the sender use NED and FRD, or convert the log"
    if flight.imu is not None and doubts.upside_down(motion.accel_m_s2[air, 2]):
        shown = float(np.median(motion.accel_m_s2[air, 2]))
        found["accelerometer"] = f"{flight.imu.source}.zacc shows {shown:+.1f} m/s^2 in flight, FRD shows -9.8; {expected}"
    turn = flight.attitude
    own = np.column_stack([np.interp(motion.t_s, turn.t_s, turn.rate_rad_s[:, i]) for i in range(3)])
    for i, axis in enumerate(AXES):
        for what, source, rates in (
            ("rate", f"{turn.source}.{axis}speed", own),
            ("gyro", f"{flight.imu.source}.{'xyz'[i]}gyro" if flight.imu else "", motion.gyro_rad_s),
        ):
            if source and doubts.against(rates[air, i], motion.euler_rad[air, i], motion.dt_s):
                found[f"{what} {axis}"] = f"{source} runs against the change of {turn.source}.{axis}; {expected}"
    if (there := flight.position) is not None:
        slow = np.arange(there.t_s[0], there.t_s[-1], 0.4)
        for i, axis in enumerate("xyz"):
            p, v = (np.interp(slow, there.t_s, column[:, i]) for column in (there.first, there.second))
            if doubts.against(v, p, 0.4):
                found["velocity"] = f"{there.source}.v{axis} runs against the change of {axis}; {expected}"
    return found


def recording(flight: Flight, fitted: Mapping[tuple[str, str], tuple[Span, ...]]) -> list[str]:
    """Gaps, jitter and limits in what was fitted, by axis and commands (in flight, where nothing was)."""
    spans = tuple(span for found in fitted.values() for span in found) or flight.flying
    notes: list[str] = []
    streams = [flight.attitude, *(s for s in (flight.target, flight.imu, flight.position) if s is not None)]
    for stream in streams:
        notes += doubts.rhythm(stream.source, stream.t_s, "ask for 50 or 100 Hz over a link that carries it", spans)
    if flight.motors is not None:
        notes += doubts.motors_at_limit(*flight.motors, spans)
    if flight.sent is not None and flight.target is not None:
        for i, axis in enumerate(AXES[:2]):
            mine = fitted.get((axis, flight.sent.source), ())
            pair = [Held(s.t_s, s.euler_rad[:, i]) for s in (flight.sent, flight.target)]
            notes += doubts.command_cut(axis, pair[0], pair[1], mine)
    return notes
