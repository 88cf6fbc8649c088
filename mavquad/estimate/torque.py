"""Body torque from what the autopilot sends to its motors: the airframe's mixer forwards, behind the rotors' lag.

Rotor layout and numbering as `airframe.Rotors` states them (FRD: a rotor at (x, y) that lifts T gives the torque (-y T, x T);
one that turns counter-clockwise seen from above pushes the nose to the right).
"""

import math
from typing import NamedTuple

from mavquad.airframe import Airframe, Rotors
from mavquad.errors import ConfigError
from mavquad.signals import Vec3


class Mixer(NamedTuple):
    """Thrust of each motor to angular acceleration; one row per axis [rad/s^2 per N]."""

    rows: tuple[tuple[float, ...], ...]
    thrust_min_n: float
    thrust_max_n: float
    lag_s: float


class Spin(NamedTuple):
    """Thrust of each motor behind its lag, and the thrust asked for since; before the first sample t_us is -1."""

    t_us: int
    thrust_n: tuple[float, ...]
    asked_n: tuple[float, ...]


AT_REST = Spin(-1, (), ())


def gyro_ratios(inertia_kg_m2: Vec3) -> Vec3:
    """((J2-J3)/J1, (J3-J1)/J2, (J1-J2)/J3): Euler's equation needs no more of the inertia."""
    a, b, c = inertia_kg_m2
    return ((b - c) / a, (c - a) / b, (a - b) / c)


def mixer(airframe: Airframe) -> Mixer:
    """Raises ConfigError for a vehicle without rotors of a known layout."""
    rotors = airframe.rotors
    if rotors is None:
        raise ConfigError(
            f'airframe {airframe.name!r} has no [rotors]: its torque cannot be told from motor commands; set torque = "unknown"'
        )
    j = airframe.body.inertia_kg_m2
    places = _places(rotors)
    rows = (
        tuple(-y / j[0] for _, y, _ in places),
        tuple(x / j[1] for x, _, _ in places),
        tuple(spin * rotors.torque_per_thrust_m / j[2] for _, _, spin in places),
    )
    return Mixer(rows, rotors.thrust_min_n, rotors.thrust_max_n, rotors.lag_s)


def _places(rotors: Rotors) -> tuple[tuple[float, float, float], ...]:
    """(x forward, y right, +1 counter-clockwise / -1 clockwise) of each rotor."""
    a = rotors.arm_m
    if rotors.layout == "plus":
        return ((a, 0.0, -1.0), (0.0, a, 1.0), (-a, 0.0, -1.0), (0.0, -a, 1.0))
    d = a * math.sqrt(0.5)
    return ((d, d, 1.0), (-d, -d, 1.0), (d, -d, -1.0), (-d, d, -1.0))


def spin_up(m: Mixer, spin: Spin, t_us: int, command: tuple[float, ...]) -> tuple[Spin, Vec3] | None:
    """After one sample of motor commands: the thrusts, and the mean torque over inertia [rad/s^2] until the next sample.

    The thrust is linear in the command and follows it with a first-order lag; the next sample is expected after the same time
    as this one. None for a sample that is not enough finite commands.
    """
    n = len(m.rows[0])
    if len(command) < n or not all(math.isfinite(c) for c in command[:n]):
        return None
    asked = tuple(m.thrust_min_n + (m.thrust_max_n - m.thrust_min_n) * min(max(c, 0.0), 1.0) for c in command[:n])
    dt_s = 1e-6 * (t_us - spin.t_us)
    if spin.t_us < 0 or not 0.0 < dt_s < 1.0 or m.lag_s <= 0.0:
        thrust, coming = asked, asked
    else:
        left = math.exp(-dt_s / m.lag_s)
        thrust = tuple(u + left * (f - u) for f, u in zip(spin.thrust_n, spin.asked_n, strict=True))
        mean_left = m.lag_s / dt_s * (1.0 - left)
        coming = tuple(u + mean_left * (f - u) for f, u in zip(thrust, asked, strict=True))
    x, y, z = (sum(r * f for r, f in zip(row, coming, strict=True)) for row in m.rows)
    return Spin(t_us, thrust, asked), (x, y, z)
