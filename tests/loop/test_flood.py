"""A flood of junk at a companion in flight, over real UDP."""

import json
import multiprocessing
import os
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from mavquad import wire
from mavquad.link.flood import Guard
from mavquad.link.tlog import read

SETPOINT = wire.ID["SET_ATTITUDE_TARGET"]
FLOOD_S = 10.0


def pair():
    ours, friend, stranger = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(3))
    for sock in (ours, friend, stranger):
        sock.bind(("127.0.0.1", 0))
    ours.setblocking(False)
    return ours, friend, stranger


def waiting(sock):
    found = []
    while True:
        try:
            found.append(sock.recvfrom(100)[0])
        except BlockingIOError:
            return found


def test_while_the_guard_is_up_the_kernel_keeps_strangers_out():
    ours, friend, stranger = pair()
    guard = Guard(ours)
    assert not guard.saw(499, friend.getsockname(), 10.0)
    assert not guard.saw(400, friend.getsockname(), 10.3)  # slower than a flood
    assert not guard.saw(499, None, 10.6)  # nobody to listen to yet
    assert guard.saw(499, friend.getsockname(), 10.7)
    for sock, data in ((friend, b"a"), (stranger, b"x"), (friend, b"b")):
        sock.sendto(data, ours.getsockname())
    assert waiting(ours) == [b"a", b"b"]
    assert not guard.saw(0, friend.getsockname(), 12.8)  # lifted: strangers are seen again
    stranger.sendto(b"x", ours.getsockname())
    assert waiting(ours) == [b"x"]
    assert guard.saw(500, friend.getsockname(), 12.9)  # and it goes up again where they still come
    assert guard.raised == 2
    for sock in (ours, friend, stranger):
        sock.close()


def _flood(port, seconds, sent):
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.connect(("127.0.0.1", port))
    junk, end, n = os.urandom(60), time.monotonic() + seconds, 0
    while time.monotonic() < end:
        for _ in range(200):
            sock.send(junk)
        n += 200
    sent.value = n


def _resident_mb(pid):
    return int(re.search(r"VmRSS:\s+(\d+)", Path(f"/proc/{pid}/status").read_text())[1]) / 1024.0


@pytest.mark.slow
def test_a_flood_does_not_slow_the_control(tmp_path):
    config = tmp_path / "companion.toml"
    config.write_text('observers = []\n[path]\nname = "hover"\nduration_s = 25.0\n')
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    words = ["--endpoint", f"udpin:127.0.0.1:{port}", "--config", str(config), "--run", str(tmp_path), "--engage"]
    companion = subprocess.Popen(
        [sys.executable, "-m", "mavquad", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    sitl = subprocess.Popen([sys.executable, "-m", "sitl", "--endpoint", f"udpout:127.0.0.1:{port}"], stderr=subprocess.DEVNULL)
    try:
        while not any(" engaged: " in line for line in [companion.stderr.readline()]):
            assert companion.poll() is None
        time.sleep(6.0)
        before_mb, sent = _resident_mb(companion.pid), multiprocessing.Value("q", 0)
        flooder = multiprocessing.Process(target=_flood, args=(port, FLOOD_S, sent))
        begun_us = time.time_ns() // 1000
        flooder.start()
        flooder.join()
        ended_us, after_mb = time.time_ns() // 1000, _resident_mb(companion.pid)
        companion.send_signal(signal.SIGINT)
        stdout, _ = companion.communicate(timeout=30.0)
    finally:
        sitl.kill()
        companion.kill()
        sitl.wait()
    with (tmp_path / "flight.tlog").open("rb") as stream:
        stamps = np.array([t_us for t_us, frame in read(stream) if frame.msgid == SETPOINT])
    calm = np.sum((stamps > begun_us - 5_000_000) & (stamps < begun_us)) / 5.0
    flooded = np.sum((stamps > begun_us) & (stamps < ended_us)) / (1e-6 * (ended_us - begun_us))
    floods = json.loads(stdout)["refused"]["floods"]
    print(
        f"\n{sent.value / FLOOD_S:.0f} datagrams/s of junk for {FLOOD_S:.0f} s: setpoints {calm:.1f} -> {flooded:.1f} Hz, "
        f"memory {before_mb:.1f} -> {after_mb:.1f} MB, guard up {floods} times"
    )
    assert flooded >= 0.8 * calm
    assert abs(after_mb - before_mb) < 5.0
    assert floods >= 1
