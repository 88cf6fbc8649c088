"""Further links beside the one to the autopilot: a ground station or a monitor sees and says what it would on a link of its own.

Whatever passes between the autopilot and us, both ways, is copied as it is, so every system keeps its own sequence numbers; what others
send to our port is not. What comes from a further link goes to the autopilot as it is, but for what is meant for us alone and for what
claims to be the autopilot or us.
"""

from mavquad.errors import LinkError
from mavquad.link.endpoint import Address, Endpoint
from mavquad.link.signing import SETUP_SIGNING
from mavquad.wire import Frame, split


class Relay:
    """One further link. A broken one is let go, and said: no ground station brings a companion down."""

    def __init__(self, endpoint: Endpoint, name: str) -> None:
        self.endpoint, self.name = endpoint, name
        self.broken = ""
        self._rest = b""

    def copy(self, data: bytes) -> None:
        """What passes on the autopilot's link."""
        if not self.broken:
            try:
                self.endpoint.send(data)
            except LinkError as error:
                self.broken = str(error)

    def heard(self) -> list[tuple[list[Frame], Address]]:
        """Frames that have come from there, without waiting; an address says which link they came by."""
        if self.broken:
            return []
        try:
            arrived = self.endpoint.receive(0.0)
        except LinkError as error:
            self.broken = str(error)
            return []
        out = []
        for data, address in arrived:
            frames, _, rest = split(self._rest + data)
            self._rest = rest if not hasattr(self.endpoint, "peers") else b""
            out.append((frames, (f"{self.name} {address[0]}", address[1])))
        return out

    def close(self) -> None:
        self.endpoint.close()


def passes(frame: Frame, own: tuple[int, int], autopilot: tuple[int, int], addressee: tuple[int, int]) -> bool:
    """Whether a frame from a further link goes on to the autopilot; addressee: its target system and component, 0 for all."""
    if frame.msgid == SETUP_SIGNING:  # it carries a key
        return False
    return (frame.system, frame.component) not in (own, autopilot) and addressee != own
