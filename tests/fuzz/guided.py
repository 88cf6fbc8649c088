"""The same, led by coverage: atheris, where it is installed. It looks for bytes that reach lines which none reached before.

Example: python -m tests.fuzz.guided -max_total_time=60      (libFuzzer's own options)
"""

import io
import sys
import tempfile
import types
from pathlib import Path

import atheris

from mavquad import autopilot_words, config, delayed, lifecycle, messages, pipeline, samples, strangers, toml, tunables, wire
from mavquad.errors import ConfigError, LogError, WireError
from mavquad.link import signals, tlog
from mavquad.settings import Companion
from tests.fuzz import targets

_LED = (
    wire,
    tlog,
    config,
    toml,
    pipeline,
    messages,
    lifecycle,
    samples,
    signals,
    autopilot_words,
    strangers,
    delayed,
    tunables,
)
_SCRATCH = Path(tempfile.mkdtemp())
_TOML = _SCRATCH / "x.toml"
STREAM, LOG, SETTINGS, PX4, ARDUPILOT = range(5)


def one(data: bytes) -> None:
    """A stream of frames, a log, a settings file or what a companion in flight hears, as the first byte says."""
    if not data:
        return
    kind, data = data[0] % 5, data[1:]
    if kind == STREAM:
        stream(data)
    elif kind == LOG:
        try:
            for _ in tlog.read(io.BytesIO(data)):
                continue
        except LogError:
            return
    elif kind == SETTINGS:
        _TOML.write_bytes(data)
        try:
            config.load(_TOML, Companion)
        except ConfigError:
            return
    else:
        targets.heard(data, kind == ARDUPILOT)


def stream(data: bytes) -> None:
    """No byte is lost, and what is found is decoded."""
    frames, refused, rest = wire.split(data)
    assert sum(len(frame.raw) for frame in frames) + refused + len(rest) == len(data)
    for frame in frames:
        try:
            wire.decode(frame)
        except WireError:
            assert frame.msgid not in wire.ID_SET


def led() -> None:
    """Watch which lines of these modules are reached: plain functions only, kernels are compiled from theirs."""
    for module in _LED:
        for thing in vars(module).values():
            if isinstance(thing, types.FunctionType) and thing.__module__ == module.__name__:
                atheris.instrument_func(thing)


def seeds() -> Path:
    """A folder of good inputs to begin with: every message, pieces of a log, a settings file."""
    folder = _SCRATCH / "seeds"
    folder.mkdir()
    known = sorted(targets.pipeline_ids(targets.engaged(False).plan))
    good = [bytes([LOG]) + targets.LOG[:2000], bytes([SETTINGS]) + targets.TOMLS["companion"][0].encode()]
    for raw in targets.BANK:
        msgid = int.from_bytes(raw[7:10], "little")
        good.append(bytes([STREAM]) + raw)
        if msgid in known:
            said = targets.piece(known.index(msgid), 8, raw[10 : 10 + raw[1]])
            good += [bytes([kind, state]) + 3 * said for kind in (PX4, ARDUPILOT) for state in range(4)]
    for number, data in enumerate(good):
        (folder / str(number)).write_bytes(data)
    return folder


if __name__ == "__main__":
    led()
    atheris.Setup([*sys.argv, str(seeds())], one)
    atheris.Fuzz()
