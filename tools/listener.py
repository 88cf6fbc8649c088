"""An independent listener: it hears every datagram of a flight on a socket of its own and judges each setpoint of the companion.

Decoded by pymavlink, judged by plain trigonometry: nothing of the companion's own gate or codec is used.
"""

import contextlib
import math
import socket
import threading
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavquad.setpoint.limits import Limits

_SETPOINT = dialect.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET
_SLACK = 1e-5  # of a float32


def wrong(message: Any, limits: Limits) -> str:
    """What is wrong with a SET_ATTITUDE_TARGET, or nothing."""
    values = (*message.q, message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate, message.thrust)
    if not all(math.isfinite(x) for x in values):
        return "not finite"
    w, x, y, z = message.q
    if abs(math.sqrt(w * w + x * x + y * y + z * z) - 1.0) > 10.0 * _SLACK:
        return "no unit quaternion"
    if math.acos(max(-1.0, 1.0 - 2.0 * (x * x + y * y))) > math.radians(limits.tilt_deg) + 1e-3:
        return f"tilt of more than {limits.tilt_deg:g} deg"
    rates = (message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate)
    if math.hypot(*rates) > math.radians(limits.rate_deg_s) * (1.0 + _SLACK):
        return f"rates of more than {limits.rate_deg_s:g} deg/s"
    if not limits.thrust_min - _SLACK <= message.thrust <= limits.thrust_max + _SLACK:
        return f"thrust outside {limits.thrust_min:g} to {limits.thrust_max:g}"
    return ""


class Listener:
    """`with Listener(limits, component) as ear`: give `ear.endpoint` as a --forward; afterwards ask `heard` and `bad`."""

    def __init__(self, limits: Limits, component: int) -> None:
        self.heard = 0
        self.bad: dict[str, int] = {}
        self._limits, self._component = limits, component
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8 << 20)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(0.1)
        self.endpoint = f"udpout:127.0.0.1:{self._socket.getsockname()[1]}"
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._listen, daemon=True)

    def __enter__(self) -> "Listener":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._thread.join()
        self._socket.close()

    def judge(self, data: bytes) -> None:
        """One datagram."""
        at = 0
        while at + 12 <= len(data):
            if data[at] != 0xFD:
                at += 1
                continue
            end = at + 12 + data[at + 1] + (13 if data[at + 2] & 1 else 0)
            if int.from_bytes(data[at + 7 : at + 10], "little") == _SETPOINT and data[at + 6] == self._component:
                self._setpoint(data[at:end])
            at = end

    def _setpoint(self, raw: bytes) -> None:
        self.heard += 1
        why = "not decodable"
        with contextlib.suppress(dialect.MAVError):
            parser = dialect.MAVLink(None)
            parser.robust_parsing = True
            why = wrong(parser.decode(bytearray(raw)), self._limits)
        if why:
            self.bad[why] = self.bad.get(why, 0) + 1

    def _listen(self) -> None:
        while True:
            try:
                data = self._socket.recv(65535)
            except TimeoutError:
                if self._done.is_set():
                    return
                continue
            self.judge(data)
