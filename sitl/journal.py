"""What waits for the log: records by stamp, until nothing older can come any more."""

from collections.abc import Callable
from operator import itemgetter

from mavquad.link.tlog import STAMP

Record = Callable[[int, bytes], None]
_by_stamp = itemgetter(0)


class Journal:
    """`record(t_us, data)` is given records of a tlog in the order of their stamps, up to t_us; nothing at all where it is None."""

    def __init__(self, record: Record | None) -> None:
        self._record = record
        self._sent: list[tuple[int, bytes]] = []  # and the truth: stamp and whole records
        self._heard: list[tuple[int, bytes]] = []

    @property
    def kept(self) -> bool:
        """Whether there is a log."""
        return self._record is not None

    def sent(self, t_us: int, records: bytes) -> None:
        """Whole records of one stamp: frames of ours, or the truth. Of one stamp they come before what was heard."""
        if self._record is not None:
            self._sent.append((t_us, records))

    def heard(self, t_us: int, raw: bytes) -> None:
        """A frame of somebody else."""
        if self._record is not None:
            self._heard.append((t_us, stamped(t_us, raw)))

    def flush(self, until_us: int) -> None:
        """Hand over what is stamped before until_us."""
        waiting = self._sent + self._heard
        if self._record is None or not waiting:
            return
        waiting.sort(key=_by_stamp)
        ready = [records for t_us, records in waiting if t_us < until_us]
        if not ready:
            return
        self._record(waiting[len(ready) - 1][0], b"".join(ready))
        if len(ready) == len(waiting):
            self._sent, self._heard = [], []
        else:
            self._sent = [entry for entry in self._sent if entry[0] >= until_us]
            self._heard = [entry for entry in self._heard if entry[0] >= until_us]


def stamped(t_us: int, raw: bytes) -> bytes:
    """The record of a frame."""
    return t_us.to_bytes(STAMP, "big") + raw
