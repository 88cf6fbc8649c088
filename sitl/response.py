"""python -m sitl.response: measure how attitude answers to attitude setpoints, and fit what an airframe's [attitude] holds.

Setpoint to true attitude, without the link and without noise: steps of roll and pitch at hover, both ways, and the second-order
answer with a pure delay that is nearest to them in least squares.
"""

import argparse
import json
import math
import sys
from typing import NamedTuple

import numpy as np
from scipy import optimize

from mavquad.errors import MavquadError
from sitl import config, rotation
from sitl.simulation import Simulation
from sitl.state import ATTITUDE

_SETTLE_S, _WATCH_S = 2.0, 0.8


class Response(NamedTuple):
    """The fit, and what was seen: times to shares of the step, overshoot, rms of the fit's residual (share of the step)."""

    natural_frequency_rad_s: float
    damping: float
    delay_s: float
    t10_s: float
    t50_s: float
    t63_s: float
    t90_s: float
    overshoot: float
    residual: float


def step_answers(sitl: config.Sitl, step_rad: float) -> tuple[np.ndarray, np.ndarray]:
    """(times s, attitude over step: one row for each of roll +, roll -, pitch +, pitch -)."""
    rows = []
    for axis in (0, 1):
        for sign in (1.0, -1.0):
            simulation = Simulation(sitl)  # its autopilot sets the loops' gains
            vehicle = simulation.vehicle
            vehicle.state["p_ned_m"], vehicle.state["grounded"] = (0.0, 0.0, -100.0), 0
            setpoint = vehicle.setpoint
            setpoint["kind"], setpoint["R"], setpoint["thrust"] = ATTITUDE, rotation.IDENTITY, vehicle.constants["hover_thrust"]
            vehicle.run(round(_SETTLE_S * sitl.rate_hz))
            angles = [0.0, 0.0, 0.0]
            angles[axis] = sign * step_rad
            setpoint["R"] = rotation.from_euler(*angles)
            row = []
            for _ in range(round(_WATCH_S * sitl.rate_hz)):
                vehicle.run(1)
                row.append(rotation.to_euler(tuple(vehicle.state["R"].tolist()))[axis] / (sign * step_rad))
            rows.append(row)
    answers = np.array(rows)
    return np.arange(1, answers.shape[1] + 1) / sitl.rate_hz, answers


def second_order(t_s: np.ndarray, wn: float, zeta: float, delay_s: float) -> np.ndarray:
    """Unit step answer of wn^2/(s^2 + 2 zeta wn s + wn^2) after a delay."""
    t = np.maximum(0.0, t_s - delay_s)
    root = np.sqrt(complex(zeta * zeta - 1.0) + 1e-12)
    p, q = wn * (-zeta + root), wn * (-zeta - root)
    return np.real(1.0 + (q * np.exp(p * t) - p * np.exp(q * t)) / (p - q))


def measure(sitl: config.Sitl, step_deg: float = 10.0) -> Response:
    """The response of the simulated autopilot of `sitl`, noise and wind left out."""
    quiet = config.Noise(position_m=0.0, velocity_m_s=0.0, attitude_deg=0.0, gyro_rad_s=0.0, accel_m_s2=0.0)
    calm = config.Sitl(personality=sitl.personality, airframe=sitl.airframe, loop_hz=sitl.loop_hz, noise=quiet)
    t, answers = step_answers(calm, math.radians(step_deg))
    mean = answers.mean(axis=0)

    def residual(x: np.ndarray) -> np.ndarray:
        return second_order(t, *x) - mean

    fit = optimize.least_squares(residual, (15.0, 0.8, 0.02), bounds=((1.0, 0.2, 0.0), (100.0, 3.0, 0.2)))
    rms = float(np.sqrt(np.mean(residual(fit.x) ** 2)))
    wn, zeta, delay_s = (float(x) for x in fit.x)
    t10, t50, t63, t90 = (float(t[np.argmax(mean >= share)]) for share in (0.1, 0.5, 0.63, 0.9))
    return Response(wn, zeta, delay_s, t10, t50, t63, t90, float(mean.max() - 1.0), rms)


def main(argv: list[str] | None = None) -> int:
    """Print the response as JSON."""
    parser = argparse.ArgumentParser(prog="python -m sitl.response", description=__doc__)
    parser.add_argument("--airframe", default="x500")
    parser.add_argument("--personality", choices=("px4", "ardupilot"), default="px4")
    parser.add_argument("--step-deg", type=float, default=10.0)
    args = parser.parse_args(argv)
    try:
        found = measure(config.Sitl(airframe=args.airframe, personality=args.personality), args.step_deg)
    except MavquadError as error:
        print(f"sitl.response: {error}", file=sys.stderr)
        return 1
    print(json.dumps({name: round(value, 4) for name, value in found._asdict().items()}))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
