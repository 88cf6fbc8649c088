"""What is at the end of its wire: for the autopilot, for other peers, or both."""

from typing import TYPE_CHECKING

from mavquad import wire
from mavquad.errors import WireError
from mavquad.wire import Frame
from sitl.links import Link
from sitl.services import Services

if TYPE_CHECKING:
    from sitl.simulation import Simulation


class Arrivals:
    """Hands frames to the services, or on to those whom they are addressed to."""

    def __init__(self, sim: "Simulation", services: Services) -> None:
        self._sim, self._services = sim, services

    def deliver(self, link: Link, arrived: Frame | bytes) -> None:
        """One frame that came from a peer (bytes, where the wire may have spoiled it); nobody hears it while the autopilot boots."""
        sim = self._sim
        if sim.silent:
            return
        if isinstance(arrived, bytes):
            frames, refused, rest = wire.split(arrived)
            link.refused += refused + len(rest)
        else:
            frames = [arrived]
        for frame in frames:
            reason = sim.signer.refuses(frame, sim.epoch_us + sim.t_us) if sim.signer else ""
            if reason:
                sim.refuse(reason)
            else:
                self._take(link, frame)

    def _take(self, link: Link, frame: Frame) -> None:
        sim = self._sim
        link.received += 1
        link.speakers.add((frame.system, frame.component))
        if frame.msgid not in wire.ID_SET:
            self._forward(link, frame, 0, 0)
            return
        try:
            m = wire.decode(frame)
        except WireError:
            link.refused += 1
            return
        system = component = 0
        if wire.SPECS[frame.msgid].addressed:
            system, component = m.target_system, getattr(m, "target_component", 0)
        ours = system in (0, sim.config.system) and component in (0, sim.config.component)
        if len(sim.links) > 1 and not (ours and system and component):
            self._forward(link, frame, system, component)
        handler = self._services.handlers.get(frame.msgid) if ours else None
        if handler is None:
            return
        if self._services.allowed(frame):
            handler(link, frame, m)
        else:
            sim.refuse("not from a listed system")
            self._services.deny(link, frame, m)

    def _forward(self, source: Link, frame: Frame, system: int, component: int) -> None:
        """To the links where the addressee was heard; to all others when it is for everybody."""
        for link in self._sim.links:
            heard = any(s == system and component in (0, c) for s, c in link.speakers)
            if link is not source and (system == 0 or heard):
                link.down.put(self._sim.t_us, frame.raw)
