"""Against a flood: while one lasts the kernel itself drops every datagram that is not from the autopilot's address.

A datagram that Python must look at costs microseconds, one that a socket filter drops almost nothing (Linux; elsewhere nothing is
done, and all are looked at). Strangers are seen again, counted and kept, as soon as the guard is lifted.
"""

import contextlib
import ctypes
import socket
import struct

from mavquad.link.endpoint import Address

_ATTACH, _DETACH = 26, 27  # SO_ATTACH_FILTER, SO_DETACH_FILTER of Linux
_MANY, _WITHIN_S = 500, 0.25  # datagrams of strangers that make a flood
_LIFT_S = 2.0  # a guard lasts so long, then it is seen whether the flood does
_LOAD_HALF, _LOAD_WORD, _EQUAL, _RETURN = 0x28, 0x20, 0x15, 0x06  # classic BPF, absolute addressing
_NET = 0x1_0000_0000 - 0x100000  # SKF_NET_OFF: counted from the IP header; plain offsets count from the UDP header


class Guard:
    """The guard of one socket, up or not; `raised` counts how often it had to be."""

    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock
        self._strangers = self.raised = 0
        self._since_s = self._until_s = 0.0

    def saw(self, strangers: int, address: Address | None, now_s: float) -> bool:
        """After each reading of the socket: datagrams that were not from `address`, our autopilot. True where it goes up."""
        if self._until_s and now_s >= self._until_s:
            with contextlib.suppress(OSError):
                self._sock.setsockopt(socket.SOL_SOCKET, _DETACH, 0)
            self._until_s = 0.0
        if now_s - self._since_s > _WITHIN_S:
            self._since_s, self._strangers = now_s, 0
        self._strangers += strangers
        if self._strangers < _MANY or address is None or self._until_s:
            return False
        self._until_s = now_s + _LIFT_S
        try:
            _attach(self._sock, address)
        except OSError:  # a kernel that has no such filters
            return False
        self.raised += 1
        return True


def _attach(sock: socket.socket, address: Address) -> None:
    host = struct.unpack("!I", socket.inet_aton(address[0]))[0]
    program = b"".join(
        struct.pack("HBBI", *word)
        for word in (
            (_LOAD_HALF, 0, 0, 0),  # source port
            (_EQUAL, 0, 3, address[1]),
            (_LOAD_WORD, 0, 0, _NET + 12),  # source address
            (_EQUAL, 0, 1, host),
            (_RETURN, 0, 0, 0xFFFF_FFFF),
            (_RETURN, 0, 0, 0),
        )
    )
    text = ctypes.create_string_buffer(program)
    sock.setsockopt(socket.SOL_SOCKET, _ATTACH, struct.pack("HP", len(program) // 8, ctypes.addressof(text)))
