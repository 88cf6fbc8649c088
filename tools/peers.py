"""Other people's simulators and readers for `mavquad bench`: short programs, run by the Python of an environment of their own.

`make bench` builds that environment from requirements-peers.txt in `.venv-peers` beside the project; MAVQUAD_PEERS names another.
Each program ends with one line of JSON.
"""

import json
import os
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from mavquad.errors import ConfigError

_BESIDE = Path(__file__).resolve().parent.parent / ".venv-peers"
_LONGEST_S = 600.0

ROTORPY = """
import json, time
import numpy as np
from rotorpy.vehicles.crazyflie_params import quad_params
from rotorpy.vehicles.multirotor import Multirotor
v = Multirotor(quad_params)
s = {k: np.array(x, dtype=float) for k, x in v.initial_state.items()}
u = {"cmd_motor_speeds": np.full(4, quad_params["rotor_speed_max"] * 0.6)}
rates, n = [], 100
for _ in range(6):
    t = time.process_time()
    for _ in range(n): s = v.step(s, u, 0.002)
    rates.append(n / (time.process_time() - t))
print(json.dumps(rates[1:]))
"""

CRAZYFLOW = """
import json, os, sys, time, warnings
worlds, steps, devices, integrator = int(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), sys.argv[4]
os.environ["XLA_FLAGS"] = f"--xla_force_host_platform_device_count={devices}"
os.environ["JAX_PLATFORMS"] = "cpu"
warnings.simplefilter("ignore")
import jax
import numpy as np
from crazyflow.control import Control
from crazyflow.dynamics import Dynamics
from crazyflow.sim import Sim
from crazyflow.sim.sharding import world_mesh
mesh = world_mesh(jax.devices()) if devices > 1 else None
sim = Sim(n_worlds=worlds, n_drones=1, dynamics=Dynamics.first_principles, control=Control.attitude, integrator=integrator,
          freq=500, attitude_freq=500, device="cpu", mesh=mesh)
command = np.zeros((worlds, 1, 4), dtype=np.float32)  # roll, pitch, yaw, collective
command[..., 1], command[..., 3] = 0.1, 1.1 * 9.81 * float(np.ravel(sim.data.params.mass)[0])
rates = []
for _ in range(8):
    t = time.perf_counter()
    sim.attitude_control(command)
    sim.step(steps)
    jax.block_until_ready(sim.data)
    rates.append(worlds * steps / (time.perf_counter() - t))
assert float(sim.data.states.pos[-1, 0, 2]) > 0.01, "it does not fly"
print(json.dumps(rates[1:]))  # the first compiles
"""

FASTTLOGPARSER = """
import json, resource, sys, time
import fasttlogparser
t = time.process_time()
tables, _ = fasttlogparser.parseTLog(sys.argv[1])
messages = sum(len(next(iter(columns.values()))) for columns in tables.values())
spent = time.process_time() - t
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
print(json.dumps({"messages": messages, "cpu_s": spent, "runs": 1, "peak_bytes": peak}))
"""


def run(peer: str, program: str, *words: object) -> Any:
    """What a program of the peer's printed. Raises ConfigError with the reason and the remedy where it is missing or fails."""
    home = Path(os.environ.get("MAVQUAD_PEERS") or _BESIDE)
    python = home / "bin" / "python"
    if not python.exists():
        raise ConfigError(f"{peer} is not installed: `make bench` brings it (or name an environment in MAVQUAD_PEERS)")
    command = [str(python.absolute()), "-c", program, *map(str, words)]
    try:
        with tempfile.TemporaryDirectory() as folder:  # MuJoCo leaves a log where it runs
            done = subprocess.run(command, capture_output=True, text=True, timeout=_LONGEST_S, cwd=folder)
    except subprocess.TimeoutExpired:
        raise ConfigError(f"{peer} gave no answer in {_LONGEST_S:.0f} s") from None
    if done.returncode:
        last = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
        missing = last.startswith("ModuleNotFoundError")
        raise ConfigError(f"{peer} is missing in {home}: `make bench` brings it" if missing else f"{peer} failed: {last}")
    return json.loads(done.stdout.strip().splitlines()[-1])  # MuJoCo warns on stdout
