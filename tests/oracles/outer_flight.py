"""A vehicle to close an outer loop around, in the project's standard conditions, written apart from `sitl` and from the stages.

Point mass, an autopilot whose attitude answers as a second-order system after a delay, lagging rotors, drag against a gusty wind,
a link with delay both ways, streams at their standard rates with standard noise, an attitude that drifts.
"""

import itertools
import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from mavquad.setpoint.attitude import attitude, thrust_vector
from mavquad.signals import NAN3, Applied, Attitude, Demand, Imu, Position, Target

G = 9.80665


@dataclass(kw_only=True)
class World:
    """Defaults: the x500 in 4 m/s of wind with W20 6 m/s turbulence, 20 % heavier than its file says."""

    seconds: float = 32.0
    path: str = "circle"  # or rectangle, hover
    wn: float = 15.0
    zeta: float = 0.8
    attitude_delay_s: float = 0.02
    rotor_lag_s: float = 0.03
    link_s: float = 0.005  # each way
    mass: float = 1.2  # true over believed
    thrust: float = 1.0  # true specific thrust over believed (1: the hover thrust was learnt)
    mean: tuple[float, float] = (4.0, 0.0)
    gust: tuple[float, float, float] = (1.17, 1.17, 0.6)
    memory_s: tuple[float, float, float] = (9.0, 9.0, 1.2)
    p_sigma: float = 0.02
    v_sigma: float = 0.03
    gyro_sigma: float = 0.005
    accel_sigma: float = 0.05
    drift_rad: float = 0.0035
    v_bias: tuple[float, float] = (0.0, 0.0)
    position_ms: int = 20
    push: tuple[float, float] = (0.0, 0.0)  # start s, m/s^2 north
    seed: int = 1
    score_from_s: float = 6.0
    imu: bool = True
    rates: bool = False  # setpoints carry body rates, which the autopilot follows
    change: object = None  # (sample, rng) -> sample or None


@dataclass
class Record:
    """What happened: position error against the path, true and estimated disturbance, at each control step."""

    t: list[float] = field(default_factory=list)
    error: list[np.ndarray] = field(default_factory=list)
    f_true: list[np.ndarray] = field(default_factory=list)
    f: list[tuple] = field(default_factory=list)
    command: list[tuple] = field(default_factory=list)
    estimate: list = field(default_factory=list)
    lost: bool = False

    def rmse(self) -> float:
        e = np.array(self.error)
        return math.inf if self.lost or not len(e) else float(np.sqrt(np.mean(np.sum(e * e, axis=1))))

    def worst(self) -> float:
        return math.inf if self.lost else float(np.linalg.norm(np.array(self.error), axis=1).max())


def _leg(x: float) -> tuple[float, float, float, float]:
    """Smooth 0..1 with its three derivatives (seventh order)."""
    x = min(1.0, max(0.0, x))
    return (
        x**4 * (35 - 84 * x + 70 * x**2 - 20 * x**3),
        140 * x**3 * (1 - x) ** 3,
        420 * x**2 * (1 - x) ** 2 * (1 - 2 * x),
        840 * x * (1 - x) * (1 - 5 * x + 5 * x**2),
    )


def demand(w: World, t_us: int, start: float = 3.0) -> Demand:
    """Circle of 3 m at 2 m/s, a rectangle of 4 x 3 m flown corner to corner at 1 m/s, or a point, at 5 m height."""
    t = 1e-6 * t_us - start
    zero = np.zeros(3)
    p, v, a, j = zero, zero, zero, zero
    if w.path == "circle":
        ramp, rate = 4.0, 2.0 / 3.0
        x = min(1.0, max(0.0, t / ramp))
        s = rate * (ramp * (2.5 * x**4 - 3 * x**5 + x**6) + max(0.0, t - ramp))
        s1 = rate * (10 * x**3 - 15 * x**4 + 6 * x**5)
        s2 = rate * (30 * x**2 - 60 * x**3 + 30 * x**4) / ramp
        s3 = rate * (60 * x - 180 * x**2 + 120 * x**3) / ramp**2
        c, k = math.cos(s), math.sin(s)
        r = 3.0 * np.array([k, 1 - c, 0.0])
        r1, r2, r3 = 3.0 * np.array([c, k, 0.0]), 3.0 * np.array([-k, c, 0.0]), 3.0 * np.array([-c, -k, 0.0])
        p, v, a, j = r, r1 * s1, r2 * s1 * s1 + r1 * s2, r3 * s1**3 + 3 * r2 * s1 * s2 + r1 * s3
    elif w.path == "rectangle":
        corners, at = [(0, 0), (4, 0), (4, 3), (0, 3), (0, 0)], 0.0
        for first, last in itertools.pairwise(corners):
            way = np.array([last[0] - first[0], last[1] - first[1], 0.0])
            time = float(np.abs(way).sum()) * 2.1875  # 1 m/s at most
            s, s1, s2, s3 = _leg((t - at) / time)
            p, v, a, j = p + way * s, v + way * s1 / time, a + way * s2 / time**2, j + way * s3 / time**3
            at += time
    p = p + np.array([0.0, 0.0, -5.0])
    return Demand(t_us, *(tuple(map(float, x)) for x in (p, v, a, j)), 0.0, 0.0)


def fly(w: World, estimator, e_gains, controller, c_gains) -> Record:
    """One flight; the plant runs at 250 Hz, the control at 125 Hz on the stamps of the attitude stream."""
    rng = np.random.default_rng(w.seed)
    e, c = estimator.init(e_gains), controller.init(c_gains)
    h = 0.004
    p, v = [0.0, 0.0, -5.0], [0.0, 0.0, 0.0]
    tilt, turn = [0.0, 0.0], [0.0, 0.0]  # horizontal part of the thrust axis, and its rate
    thrust = G
    gust = [s * x for s, x in zip(w.gust, rng.standard_normal(3), strict=True)]
    keep = [math.exp(-h / m) for m in w.memory_s]
    kick = [s * math.sqrt(1 - k * k) for s, k in zip(w.gust, keep, strict=True)]
    drift, drift_keep = [0.0, 0.0], math.exp(-h / 20.0)
    aim = (0.0, 0.0, G)  # thrust axis (horizontal part) and specific thrust, as the autopilot acts on it
    sent_q, sent_thrust = (1.0, 0.0, 0.0, 0.0), G
    waiting_attitude, uplink, downlink = (
        deque([((0.0, 0.0), (math.nan, math.nan))] * max(1, round(w.attitude_delay_s / h))),
        deque(),
        deque(),
    )
    felt, f_true = (0.0, 0.0, -G), np.zeros(3)
    record = Record()
    kicks = rng.standard_normal((round(w.seconds / h) + 1, 5))
    accel = [0.0, 0.0, 0.0]
    rates_aim = (math.nan, math.nan)
    for k in range(1, round(w.seconds / h)):
        t_us = 4000 * k
        while uplink and uplink[0][0] <= t_us:
            _, aim, rates_aim = uplink.popleft()
        waiting_attitude.append((aim[:2], rates_aim))
        (goal, rates_goal) = waiting_attitude.popleft()
        n = kicks[k]
        for i in range(2):
            if w.rates and math.isfinite(rates_goal[0]):
                turn[i] += h * 2.0 * w.zeta * w.wn * (rates_goal[i] - turn[i])  # the inner loop alone
            else:
                turn[i] += h * (w.wn * w.wn * (goal[i] - tilt[i]) - 2.0 * w.zeta * w.wn * turn[i])
            tilt[i] += h * turn[i]
            drift[i] = drift_keep * drift[i] + w.drift_rad * math.sqrt(1 - drift_keep**2) * n[3 + i]
        for i in range(3):
            gust[i] = keep[i] * gust[i] + kick[i] * n[i]
        thrust += h / w.rotor_lag_s * (aim[2] - thrust)
        up = (tilt[0], tilt[1], math.sqrt(max(0.04, 1.0 - tilt[0] ** 2 - tilt[1] ** 2)))
        air = (v[0] - w.mean[0] - gust[0], v[1] - w.mean[1] - gust[1], v[2] - gust[2])
        speed = math.sqrt(air[0] ** 2 + air[1] ** 2 + air[2] ** 2)
        shove = w.push[1] if w.push[0] and t_us > 1e6 * w.push[0] else 0.0
        for i in range(3):
            drag = -((0.5, 0.5, 0.3)[i] + 0.03 * speed) / (2.0 * w.mass) * air[i]
            push = drag + (shove if i == 0 else 0.0)
            accel[i] = push - w.thrust * thrust * up[i] + (G if i == 2 else 0.0)
            f_true[i] = push - (w.thrust - 1.0) * thrust * up[i]
            p[i] += h * v[i] + 0.5 * h * h * accel[i]
            v[i] += h * accel[i]
        if not all(map(math.isfinite, p)) or abs(p[0]) + abs(p[1]) + abs(p[2]) > 200.0:
            record.lost = True
            return record
        told_up = (up[0] + drift[0], up[1] + drift[1], up[2])
        q, _ = attitude(told_up, 0.0)
        noise = rng.standard_normal(12)
        omega = (-turn[1] + w.gyro_sigma * noise[0], turn[0] + w.gyro_sigma * noise[1], w.gyro_sigma * noise[2])
        said = [Attitude(t_us, q, omega)]
        if w.imu:
            true_q, _ = attitude(up, 0.0)
            felt = np.array([accel[0], accel[1], accel[2] - G])
            said.insert(0, Imu(t_us, tuple(_back(true_q, felt) + w.accel_sigma * noise[3:6]), omega))
        if (t_us // 1000) % w.position_ms == 0:
            place = tuple(p[i] + w.p_sigma * noise[6 + i] for i in range(3))
            said.append(Position(t_us, place, tuple(v[i] + (*w.v_bias, 0.0)[i] + w.v_sigma * noise[9 + i] for i in range(3))))
            said.append(Target(t_us, sent_q, NAN3, 0.5735 * aim[2] / G, 7))
        downlink += [(t_us + round(1e6 * w.link_s), sample) for sample in said]
        while downlink and downlink[0][0] <= t_us:
            sample = downlink.popleft()[1]
            if w.change is not None:
                sample = w.change(sample, rng)
                if sample is None:
                    continue
            e = estimator.observe(e_gains, e, sample)
            if not isinstance(sample, Attitude) or sample.t_us % 8000:
                continue
            now = sample.t_us
            e, estimate = estimator.step(e_gains, e, Applied(now, sent_q, sent_thrust, NAN3, 2 * w.link_s), now)
            if not math.isfinite(estimate.p_ned_m[0]):
                continue
            c, command = controller.step(c_gains, c, estimate, demand(w, now), lambda at: demand(w, at), 0.008)
            vector = thrust_vector(command.a_ned_m_s2, math.radians(40.0), 0.2 * G, 1.8 * G)
            sent_q, sent_thrust = attitude(vector, 0.0)
            axis = (vector[0] / sent_thrust, vector[1] / sent_thrust)
            rates = (command.omega_rad_s[1], -command.omega_rad_s[0])
            uplink.append((t_us + round(1e6 * w.link_s), (*axis, sent_thrust), rates))
            if 1e-6 * t_us > w.score_from_s:
                record.t.append(1e-6 * now)
                record.error.append(np.array(p) - demand(w, t_us).p_ned_m)
                record.f_true.append(f_true.copy())
                record.f.append(estimate.f_ned_m_s2)
                record.command.append(command.a_ned_m_s2)
                record.estimate.append(estimate)
    return record


def _back(q, v: np.ndarray) -> np.ndarray:
    """A world vector in body axes, by the rotation matrix."""
    w, x, y, z = q
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return R.T @ v
