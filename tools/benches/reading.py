"""reading a tlog: find frames, check CRC, columns of every message; beside pymavlink and fasttlogparser.

The log is made here: a million messages of eleven kinds in usual proportions, 64 MB. Every contestant runs in a process of its own; its peak
memory is the process's own, the interpreter and its libraries included. fasttlogparser lives among the peers (tools/peers.py).
"""

import json
import math
import random
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from mavquad import wire
from mavquad.errors import ConfigError
from tools import peers
from tools.benches import Row

MESSAGES = 1_000_000
_PEERS = ("ours, columns", "ours, first run", "ours, streaming", "pymavlink", "fasttlogparser")
_SHARE = {"pymavlink": 0.02, "ours, streaming": 0.1}  # of the log, for the slow ones
MIX = (  # name, how many of 23
    ("ATTITUDE", 4),
    ("ATTITUDE_QUATERNION", 4),
    ("HIGHRES_IMU", 4),
    ("SERVO_OUTPUT_RAW", 2),
    ("LOCAL_POSITION_NED", 2),
    ("ATTITUDE_TARGET", 2),
    ("RAW_IMU", 1),
    ("GLOBAL_POSITION_INT", 1),
    ("SET_ATTITUDE_TARGET", 1),
    ("VFR_HUD", 1),
    ("ODOMETRY", 1),
)


def make_log(path: Path, messages: int = MESSAGES, seed: int = 1) -> None:
    """A tlog of random but valid messages, a millisecond apart."""
    rng = random.Random(seed)
    names = [name for name, n in MIX for _ in range(n)]
    pool = []
    for i in range(256 * len(names)):
        name = names[i % len(names)]
        payload = rng.randbytes(wire.spec(name).length)
        payload = payload[: len(payload) - rng.choice((0, 0, 0, 1, 4, 16))]  # some are trimmed by the sender
        head = bytes([len(payload), 0, 0, i & 0xFF, 1, 1]) + wire.ID[name].to_bytes(3, "little") + payload
        crc = wire.mcrf4xx(head + bytes([wire.spec(name).crc_extra]))
        pool.append(b"\xfd" + head + crc.to_bytes(2, "little"))
    with path.open("wb") as stream:
        for block in range(0, messages, 10_000):
            rows = range(block, min(messages, block + 10_000))
            stream.write(b"".join((1_700_000_000_000_000 + 1000 * k).to_bytes(8, "big") + pool[k % len(pool)] for k in rows))


def measure(seconds: float) -> list[Row]:
    """Messages a second of CPU time, and peak memory over the file's size, of each contestant in one run."""
    messages = MESSAGES if seconds >= 5.0 else 100_000
    rows, rates = [], {}
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "bench.tlog"
        make_log(log, messages)
        size = log.stat().st_size
        what = f"{messages / 1e6:g} M messages, {size / 1e6:.0f} MB"
        for who in _PEERS:
            part = log
            if who in _SHARE:
                part = Path(folder) / "part.tlog"
                make_log(part, round(_SHARE[who] * messages))
            told = _child(who, part)
            if isinstance(told, str):
                rows.append(Row(what, who, math.nan, "M messages/s", told))
                continue
            rates[who] = told.messages / told.cpu_s
            rows.append(Row(what, who, rates[who] / 1e6, "M messages/s", f"median of {told.runs}" if told.runs > 1 else ""))
            if part is log:
                rows.append(Row(what, who, told.peak_bytes / size, "x file size", f"peak {told.peak_bytes / 1e6:.0f} MB"))
    for peer in ("pymavlink", "fasttlogparser"):
        if peer in rates:
            rows.append(Row("ours, columns, over", peer, rates["ours, columns"] / rates[peer], "times"))
    return rows


def _child(who: str, log: Path) -> "Told | str":
    """What a contestant's own process measured, or why it could not."""
    if who == "fasttlogparser":
        try:
            return Told(**peers.run(who, peers.FASTTLOGPARSER, log))
        except ConfigError as problem:
            return str(problem)
    command = [sys.executable, "-P", "-m", "tools.benches.reading", who, str(log)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        return done.stderr.strip().splitlines()[-1] if done.stderr.strip() else f"exit code {done.returncode}"
    return Told(**json.loads(done.stdout))


class Told(NamedTuple):
    messages: int
    cpu_s: float  # the median
    runs: int
    peak_bytes: int


def contest(who: str, path: Path) -> Told:
    """Read a log in this process as one contestant would."""
    import resource

    spent, messages, runs = [], 0, 1 if who in (*_SHARE, "ours, first run") else 6
    for _ in range(runs):
        start = time.process_time()
        if who == "pymavlink":
            messages = _pymavlink(path)
        elif who == "ours, streaming":
            messages = _streaming(path)
        else:
            messages = _columns(path)
        spent.append(time.process_time() - start)
    spent = spent[1:] or spent  # ours: the first run loads the compiled kernels
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    return Told(messages, statistics.median(spent), len(spent), peak)


def _columns(path: Path) -> int:
    from mavquad.link.columns import Log

    return sum(len(rows) for rows in Log(path).everything().values())


def _streaming(path: Path) -> int:
    from mavquad.link import tlog

    with path.open("rb") as stream:
        return sum(wire.decode(frame) is not None for _, frame in tlog.read(stream))


def _pymavlink(path: Path) -> int:
    from pymavlink import mavutil

    log, messages = mavutil.mavlink_connection(str(path), dialect="ardupilotmega"), 0
    try:
        while log.recv_msg() is not None:
            messages += 1
    finally:
        log.close()
    return messages


if __name__ == "__main__":
    print(json.dumps(contest(sys.argv[1], Path(sys.argv[2]))._asdict()))
