"""The only sockets and ports: bytes in and out of UDP, TCP and serial lines.

udpin:HOST:PORT   listens, and answers whoever spoke (port 0: any free one)
udpout:HOST:PORT  speaks to one address
tcp:HOST:PORT     a client
serial:DEVICE:BAUD
"""

import contextlib
import select
import socket
from typing import Any

from mavquad.errors import LinkError

Address = tuple[str, int]
_BUFFER = 4 << 20
_PEERS = 16  # addresses that are answered
_SPIN = 500  # tries, about a millisecond
_DOUBT, _AGAIN = 4, 64
NOWHERE: Address = ("", 0)


class Patience:
    """How long to try before sleeping. Whoever mostly answers at once is cheaper waited for than slept on; but where the cores are
    taken, trying only keeps the other side from them: after some tries in vain it is done now and then."""

    def __init__(self) -> None:
        self._vain = self._calls = 0

    def tries(self) -> range:
        """For the next wait."""
        self._calls += 1
        return range(_SPIN if self._vain < _DOUBT or self._calls % _AGAIN == 0 else 0)

    def learn(self, came: bool) -> None:
        """Whether it was worth it."""
        self._vain = 0 if came else self._vain + 1


class UdpEndpoint:
    """A datagram socket. `peers` are the addresses that have spoken (udpin) or the one spoken to (udpout)."""

    def __init__(self, sock: socket.socket, peer: Address | None = None) -> None:
        self.sock = sock
        sock.setblocking(False)
        for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):
            sock.setsockopt(socket.SOL_SOCKET, option, _BUFFER)
        self.fixed = peer is not None
        self._patience = Patience()
        self.peers: list[Address] = [peer] if peer else []

    @property
    def name(self) -> str:
        host, port = self.sock.getsockname()[:2]
        return f"udp {host}:{port}"

    def send(self, data: bytes, to: Address | None = None) -> None:
        """Send to one address, or to all peers. A peer that is not there yet is no error."""
        for peer in [to] if to is not None else self.peers:
            with contextlib.suppress(BlockingIOError, ConnectionRefusedError, OSError):
                self.sock.sendto(data, peer)

    def receive(self, timeout_s: float) -> list[tuple[bytes, Address]]:
        """All datagrams that wait, after at most timeout_s for the first. A long wait (lockstep) begins with a short spin."""
        got: list[tuple[bytes, Address]] = []
        tries = self._patience.tries() if timeout_s >= 0.2 else range(0)
        for _ in tries:
            try:
                got.append(self._first())
                break
            except (BlockingIOError, InterruptedError, ConnectionRefusedError):
                continue
        if tries:
            self._patience.learn(bool(got))
        if not got and not select.select([self.sock], [], [], max(0.0, timeout_s))[0]:
            return []
        while len(got) < 256:
            try:
                got.append(self._first())
            except (BlockingIOError, InterruptedError):
                break
            except ConnectionRefusedError:  # an earlier datagram met a closed port
                continue
        return got

    def _first(self) -> tuple[bytes, Address]:
        data, address = self.sock.recvfrom(65535)
        if not self.fixed and len(self.peers) < _PEERS and address not in self.peers:
            self.peers.append(address)
        return data, address

    def answer(self, address: Address) -> None:
        """Send to this address, too, whatever others have spoken: the autopilot is there."""
        if address not in self.peers:
            self.peers = [address, *self.peers[: _PEERS - 1]]

    def close(self) -> None:
        self.sock.close()


class StreamEndpoint:
    """A TCP client: bytes without borders."""

    def __init__(self, sock: socket.socket, name: str) -> None:
        self.sock = sock
        sock.setblocking(False)
        self.name = name

    def send(self, data: bytes, to: Address | None = None) -> None:
        view = memoryview(data)
        while view:
            try:
                view = view[self.sock.send(view) :]
            except BlockingIOError:
                select.select([], [self.sock], [], 0.1)
            except OSError as error:
                raise LinkError(
                    f"{self.name}: the other side closed the connection: {error}; start it again and reconnect"
                ) from None

    def receive(self, timeout_s: float) -> list[tuple[bytes, Address]]:
        if not select.select([self.sock], [], [], max(0.0, timeout_s))[0]:
            return []
        try:
            data = self.sock.recv(65535)
        except BlockingIOError:
            return []
        except OSError as error:
            raise LinkError(f"{self.name}: {error}; start the other side again and reconnect") from None
        if not data:
            raise LinkError(f"{self.name}: the other side closed the connection; start it again and reconnect")
        return [(data, NOWHERE)]

    def close(self) -> None:
        self.sock.close()


class SerialEndpoint:
    """A serial line."""

    def __init__(self, port: Any, name: str) -> None:
        self.port = port
        self.name = name

    def send(self, data: bytes, to: Address | None = None) -> None:
        self.port.write(data)

    def receive(self, timeout_s: float) -> list[tuple[bytes, Address]]:
        self.port.timeout = max(0.0, timeout_s)
        data = self.port.read(1)
        if data:
            data += self.port.read(self.port.in_waiting)
        return [(data, NOWHERE)] if data else []

    def close(self) -> None:
        self.port.close()


Endpoint = UdpEndpoint | StreamEndpoint | SerialEndpoint
_HELP = "expected udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD"


def open_endpoint(text: str) -> Endpoint:
    """An endpoint by its name. Raises LinkError that says what to do where it cannot be opened."""
    scheme, _, rest = text.partition(":")
    where, _, last = rest.rpartition(":")
    if scheme not in ("udpin", "udpout", "tcp", "serial") or not where or not last.isdigit():
        raise LinkError(f"endpoint {text!r}: {_HELP}")
    number = int(last)
    if scheme == "serial":
        import serial  # pyserial: only where a serial line is asked for

        try:
            return SerialEndpoint(serial.Serial(where, number, timeout=0), text)
        except (serial.SerialException, OSError, ValueError) as error:
            raise LinkError(
                f"{text}: {error}; check the device's name, that it is plugged in and that you may read it"
            ) from None
    if number > 65535:
        raise LinkError(f"endpoint {text!r}: port {number} is above 65535; {_HELP}")
    try:
        if scheme == "tcp":
            return StreamEndpoint(socket.create_connection((where, number), timeout=5.0), text)
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            sock.bind((where, number) if scheme == "udpin" else ("", 0))
            peer = (socket.gethostbyname(where), number) if scheme == "udpout" else None
        except OSError:
            sock.close()
            raise
        return UdpEndpoint(sock, peer)
    except OSError as error:
        advice = {
            "udpin": "is another program listening there? choose another port, or port 0 for any free one",
            "udpout": "check the host's name",
            "tcp": "is the other side listening?",
        }[scheme]
        raise LinkError(f"{text}: {error.strerror or error}; {advice}") from None
