"""The same, led by coverage: atheris, where it is installed. It looks for bytes that reach lines which none reached before.

Example: python -m tests.fuzz.guided -max_total_time=60      (libFuzzer's own options)
"""

import io
import sys
import tempfile
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["mavquad.wire", "mavquad.link.tlog", "mavquad.config", "mavquad.toml"]):
    from mavquad import config, wire
    from mavquad.link import tlog

from mavquad.errors import ConfigError, LogError, WireError
from mavquad.settings import Companion

_SCRATCH = Path(tempfile.mkdtemp()) / "x.toml"


def one(data: bytes) -> None:
    """A stream of frames, a log or a settings file, as the first byte says."""
    if not data:
        return
    kind, data = data[0] % 3, data[1:]
    if kind == 0:
        frames, refused, rest = wire.split(data)
        assert sum(len(frame.raw) for frame in frames) + refused + len(rest) == len(data)
        for frame in frames:
            try:
                wire.decode(frame)
            except WireError:
                assert frame.msgid not in wire.ID_SET
    elif kind == 1:
        try:
            for _ in tlog.read(io.BytesIO(data)):
                continue
        except LogError:
            return
    else:
        _SCRATCH.write_bytes(data)
        try:
            config.load(_SCRATCH, Companion)
        except ConfigError:
            return


if __name__ == "__main__":
    atheris.Setup(sys.argv, one)
    atheris.Fuzz()
