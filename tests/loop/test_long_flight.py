"""Eighty minutes of vehicle time in lockstep (`make long`): past the 71.6 minutes at which SERVO_OUTPUT_RAW's stamp wraps."""

import argparse
import os
from pathlib import Path

import pytest

from mavquad import wire
from mavquad.link import tlog
from tools import flight, fly

MINUTES = float(os.environ.get("MAVQUAD_LONG_MINUTES", "80"))
WRAP_S = 2**32 * 1e-6


def children_kib():
    """Resident memory of this process's children by their program's name."""
    found = {}
    for status in Path("/proc").glob("[0-9]*/status"):
        try:
            fields = dict(line.split(":\t", 1) for line in status.read_text().splitlines() if ":\t" in line)
            if int(fields["PPid"]) == os.getpid():
                name = "sitl" if b"\0sitl\0" in (status.parent / "cmdline").read_bytes() else "companion"
                found[name] = int(fields["VmRSS"].split()[0])
        except (OSError, KeyError, ValueError):
            continue
    return found


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_memory_stays_flat_and_no_setpoint_is_missed_past_the_wrap_of_the_servo_stamp(tmp_path, capsys):
    parser = argparse.ArgumentParser()
    fly.add_arguments(parser)
    length_s = 60.0 * MINUTES
    words = [
        "hover",
        "--observer",
        "gsmo:torque=motors",
        "--set",
        f"path.duration_s={length_s}",
        "--set",
        f"flight.max_time_s={length_s + 120}",
    ]
    resolved = fly.resolve(parser.parse_args(words))
    flight.prepare(tmp_path / "run", resolved)
    seen = []

    def watch(t_s, _said):
        if t_s == t_s and (not seen or t_s - seen[-1][0] > 20.0):
            seen.append((t_s, children_kib()))

    flown = flight.fly(tmp_path / "run", flight.Pace(None), resolved.scenario.flight.max_time_s, watch)
    assert not flown.problems
    assert flown.sitl["landed"]
    assert flown.sitl["setpoint_misses"] == 0
    assert flown.sitl["sim_time_s"] > length_s
    early = [kib for t_s, kib in seen if 30.0 < t_s < 0.4 * length_s]
    late = [kib for t_s, kib in seen if 0.75 * length_s < t_s < length_s]
    for name in ("sitl", "companion"):
        low, high = max(kib[name] for kib in early), max(kib[name] for kib in late)
        with capsys.disabled():
            print(
                f"\n{name}: {low / 1024:.1f} MiB early, {high / 1024:.1f} MiB late, {flown.sitl['realtime_factor']} x real time"
            )
        assert high - low < 8 * 1024
    wrapped = last_us = 0
    servo = wire.ID["SERVO_OUTPUT_RAW"]
    with (tmp_path / "run" / "flight.tlog").open("rb") as stream:
        for _, frame in tlog.read(stream):
            if frame.msgid == servo:
                t_us = wire.decode(frame).time_usec
                wrapped += t_us < last_us
                last_us = t_us
    assert wrapped == (length_s > WRAP_S)
    counts = flown.companion["counts"]
    assert not [what for what in counts if "late" in what or "restart" in what], counts
