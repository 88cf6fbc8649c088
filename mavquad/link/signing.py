"""MAVLink 2 signing of a whole link: the key from a file, timestamps that never repeat, and what is refused.

A timestamp (10 us since 2015) is used once. The state file holds one that was reserved ahead, so a program that was killed begins
behind all it has ever used; and the last one of every stream heard, so that what was recorded once is never taken again.
The file is mapped into memory: what was written survives SIGKILL, and reservations outlive the kernel's write-back by far.

Taken without a signature: RADIO_STATUS and RADIO (a modem's own words; nothing here acts on them). SETUP_SIGNING carries a key: it
is refused whoever sends it, and belongs in no log.

Source: https://mavlink.io/en/guide/message_signing.html
"""

import mmap
import os
import re
import stat
import struct
from pathlib import Path

from mavquad import wire
from mavquad.errors import ConfigError
from mavquad.wire import Frame

KEY_BYTES = 32
UNSIGNED = frozenset((wire.ID["RADIO_STATUS"], wire.ID["RADIO"]))
SETUP_SIGNING = wire.ID["SETUP_SIGNING"]
_ZERO_US = 1_420_070_400_000_000  # 2015-01-01 in unix time
_AHEAD = 6_000_000  # a minute is reserved, again when half of it is left
_OLD = 6_000_000  # a stream never heard before may be a minute behind us
_END = (1 << 48) - (1 << 40)  # timestamps beyond (the year 2100) leave no room to go on
_LAST = _END + (1 << 39)  # a later one was never reserved
_MAGIC = b"MQSIGN1\0"
_HEAD, _SLOT = struct.Struct("<8sQ"), struct.Struct("<QQ")
_STREAMS = 64
_SIZE = _HEAD.size + _STREAMS * _SLOT.size
_HEX = re.compile(rb"\s*([0-9A-Fa-f]{64})\s*")


def read_key(path: str | Path) -> bytes:
    """The 32 bytes of a key file (as they are, or as 64 hex digits). Raises ConfigError; never says what the file holds."""
    if _HEX.fullmatch(str(path).encode()):
        raise ConfigError("the signing key looks like a key itself: give the name of a file that holds it, never the key")
    make = "make one: (umask 077; head -c 32 /dev/urandom > FILE)"
    try:
        with Path(path).open("rb") as stream:
            about = os.fstat(stream.fileno())
            data = stream.read(1024)
    except OSError as error:
        raise ConfigError(f"signing key {path}: cannot be read: {error.strerror}; {make}") from None
    if not stat.S_ISREG(about.st_mode):
        raise ConfigError(f"signing key {path}: not a plain file; {make}")
    if os.name == "posix" and (about.st_mode & 0o077 or about.st_uid != os.geteuid()):
        raise ConfigError(
            f"signing key {path}: mode {about.st_mode & 0o777:04o}, owner {about.st_uid}: others may read or change it;"
            f" expected 0600 and your own: chmod 600 {path}"
        )
    text = _HEX.fullmatch(data)
    key = bytes.fromhex(text[1].decode()) if text else data
    if len(key) != KEY_BYTES:
        raise ConfigError(f"signing key {path}: {len(data)} bytes; expected {KEY_BYTES}, or 64 hex digits; {make}")
    return key


class Memory:
    """The state file of one program: a reserved timestamp and the last one of each stream heard. Without a path: kept nowhere."""

    def __init__(self, path: Path | None = None) -> None:
        self.path = path
        self._fd = -1
        self._slots: dict[tuple[int, int, int], int] = {}
        self._map: mmap.mmap | bytearray = bytearray(_SIZE)
        self.last: dict[tuple[int, int, int], int] = {}
        self.reserved = 0
        if path is not None:
            self._open(path)

    def reserve(self, timestamp: int) -> None:
        """Nothing up to this one will be used by a program that starts later."""
        first, self.reserved = not self.reserved, timestamp
        _HEAD.pack_into(self._map, 0, _MAGIC, timestamp)
        if first and isinstance(self._map, mmap.mmap):
            self._map.flush()  # later ones are written back long before they are reached

    def heard(self, stream: tuple[int, int, int], timestamp: int) -> bool:
        """Remember a stream's last timestamp. False where there is no place for one more stream."""
        slot = self._slots.get(stream)
        if slot is None:
            if len(self._slots) == _STREAMS:
                return False
            slot = self._slots[stream] = len(self._slots)
        self.last[stream] = timestamp
        system, component, link = stream
        _SLOT.pack_into(self._map, _HEAD.size + slot * _SLOT.size, 1 << 24 | system << 16 | component << 8 | link, timestamp)
        return True

    def close(self) -> None:
        """Leave the file to the next program."""
        if isinstance(self._map, mmap.mmap):
            self._map.flush()
            self._map.close()
            self._map = bytearray(_SIZE)
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def _open(self, path: Path) -> None:
        try:
            self._fd = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
            if os.name == "posix":
                import fcntl

                fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            about = os.fstat(self._fd)
            if os.name == "posix" and (about.st_mode & 0o022 or about.st_uid != os.geteuid()):
                self.close()
                raise ConfigError(
                    f"signing state {path}: mode {about.st_mode & 0o777:04o}, owner {about.st_uid}: others may turn its time back;"
                    f" expected 0600 and your own: chmod 600 {path}, or give another file"
                )
            old = os.read(self._fd, _SIZE)
            if old and (len(old) != _SIZE or not old.startswith(_MAGIC) or _HEAD.unpack_from(old)[1] > _LAST):
                self.close()
                raise ConfigError(f"{path}: {len(old)} bytes that are no signing state; move it away or give another file")
            os.ftruncate(self._fd, _SIZE)
            self._map = mmap.mmap(self._fd, _SIZE)
            self._map[: len(_MAGIC)] = _MAGIC
        except BlockingIOError:
            self.close()
            raise ConfigError(f"{path}: another program signs with it now; stop that one or give another state file") from None
        except OSError as error:
            self.close()
            raise ConfigError(f"signing state {path}: cannot be kept: {error.strerror}; give another state file") from None
        if old:
            self.reserved = _HEAD.unpack_from(old)[1]
            for at in range(_HEAD.size, _SIZE, _SLOT.size):
                packed, timestamp = _SLOT.unpack_from(old, at)
                if packed:
                    stream = (packed >> 16 & 0xFF, packed >> 8 & 0xFF, packed & 0xFF)
                    self._slots[stream], self.last[stream] = (at - _HEAD.size) // _SLOT.size, timestamp


class Signer:
    """One program's signatures. `offset_us` makes unix time of the clock that is handed in."""

    def __init__(self, key: bytes, memory: Memory, offset_us: int = 0) -> None:
        self._key, self.memory, self.offset_us = key, memory, offset_us
        self._last = memory.reserved

    def __repr__(self) -> str:
        return "Signer(key not shown)"

    def sign(self, raw: bytes, now_us: int, link_id: int = 0) -> bytes:
        """A signed copy of one frame of ours, with a timestamp never used before."""
        stamp = max(self._last + 1, self._clock(now_us))
        self._last = stamp
        if stamp > self.memory.reserved - _AHEAD // 2:
            self.memory.reserve(stamp + _AHEAD)
        return wire.sign(raw, self._key, link_id, stamp)

    def refuses(self, frame: Frame, now_us: int, new: bool = True) -> str:
        """ "" where the frame may be taken, else why not. Not `new`: only the signature counts, not when it was made."""
        if frame.msgid == SETUP_SIGNING:
            return "a key sent over the link"
        if not wire.is_signed(frame):
            return "" if frame.msgid in UNSIGNED else "unsigned"
        signed = wire.verify(frame, self._key)
        if signed is None:
            return "badly signed"
        if not new:
            return ""
        link_id, stamp = signed
        stream = (frame.system, frame.component, link_id)
        before = self.memory.last.get(stream)
        if before is None and stamp < max(self._last, self._clock(now_us)) - _OLD:
            return "signed long ago"
        if stamp >= _END or (before is not None and stamp <= before):
            return "signed before, sent again" if stamp < _END else "signed in a far future"
        if not self.memory.heard(stream, stamp):
            return "more signed streams than there is room for"
        self._last = max(self._last, stamp)
        return ""

    def close(self) -> None:
        """Leave the state file to the next program."""
        self.memory.close()

    def _clock(self, now_us: int) -> int:
        return min(max(0, now_us + self.offset_us - _ZERO_US) // 10, _END - _AHEAD)


def open_signer(key: str | Path, state: Path | None) -> Signer:
    """A signer from its key file and its state file (None: nothing is kept). Raises ConfigError."""
    return Signer(read_key(key), Memory(state))
