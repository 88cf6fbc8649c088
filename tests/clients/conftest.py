"""The clients' own environment, and the simulated autopilot as a process for them to meet. Made and run by `make test-clients`."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ENVIRONMENT = ROOT / ".venv-clients"
PROGRAMS = Path(__file__).parent / "programs"


@pytest.fixture(scope="session")
def client_python():
    """The Python that has the clients."""
    python = ENVIRONMENT / "bin" / "python"
    if not python.exists():
        pytest.skip("no .venv-clients: run `make test-clients`, which installs the clients there")
    return python


@pytest.fixture(scope="session")
def node_mavlink():
    """The folder of node-mavlink."""
    folder = ENVIRONMENT / "node" / "node_modules" / "node-mavlink"
    if not folder.is_dir():
        pytest.skip("no node-mavlink in .venv-clients: `make test-clients` installs it where npm is there")
    return folder


class Sitl:
    """A running simulated autopilot: its port and its log."""

    def __init__(self, personality, folder, *words):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            sock.bind(("127.0.0.1", 0))
            self.port = sock.getsockname()[1]
        self.log = folder / "sitl.tlog"
        command = [sys.executable, "-P", "-m", "sitl", "--personality", personality, "--log", str(self.log), *words]
        self.process = subprocess.Popen(
            [*command, "--endpoint", f"udpin:127.0.0.1:{self.port}", "--max-time", "280"],
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )
        time.sleep(3.0)  # its kernels are loaded

    def stop(self):
        """End it and return its report."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
        out, _ = self.process.communicate(timeout=30)
        return json.loads(out)


@pytest.fixture
def sitl(tmp_path):
    """`sitl(personality, *words)` starts one; it ends with the test."""
    running = []

    def start(personality, *words):
        running.append(Sitl(personality, tmp_path, *words))
        return running[-1]

    yield start
    for one in running:
        one.stop()


@pytest.fixture
def program(client_python):
    """`program(name, *words)` runs one of the programs and returns what it printed as JSON."""

    def run(name, *words):
        done = subprocess.run(
            [client_python, PROGRAMS / name, *map(str, words)], capture_output=True, text=True, timeout=200, check=False
        )
        assert done.stdout.strip(), done.stderr
        return json.loads(done.stdout.strip().splitlines()[-1])

    return run
