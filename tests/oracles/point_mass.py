"""A small vehicle to close an outer loop around: a point mass under a thrust vector that follows its setpoint late.

The attitude answers as an autopilot's P-over-rate loop does, after a delay; the link delays both ways; the wind gusts; telemetry
is sampled, noisy, and its velocity is off by a constant. It shares no code with `sitl`.
"""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from mavquad import paths, quat
from mavquad.setpoint.attitude import attitude, thrust_vector
from mavquad.signals import NAN3, Applied, Attitude, Position, Target

G = 9.80665


@dataclass(kw_only=True, frozen=True)
class World:
    """Everything that can be wrong with a real vehicle and that a controller has to bear."""

    seconds: float = 18.0
    radius_m: float = 3.0
    speed_m_s: float = 2.0
    attitude_p: float = 6.0  # 1/s
    rate_p: float = 20.0  # 1/s
    delay_s: float = 0.03  # in the autopilot
    down_s: float = 0.01  # link, each way
    up_s: float = 0.01
    drag: float = 0.25  # 1/s
    drag2: float = 0.015  # 1/m
    wind: tuple[float, float] = (4.0, 2.0)
    gust: float = 1.0  # m/s, 1 sigma, memory 1.5 s
    bias: tuple[float, float] = (0.02, -0.02)  # of the velocity told
    p_sigma: float = 0.003
    v_sigma: float = 0.01
    mass: float = 1.0  # true over believed
    rates: bool = False  # the autopilot uses body rates beside the attitude
    seed: int = 1
    score_from_s: float = 7.0


def path(w: World) -> paths.Plan:
    """A circle (or an ellipse of equal axes), sped up at 2 m/s^2; a point where there is no speed."""
    if w.speed_m_s <= 0.0:
        return paths.plan(paths.Path(name="hover"))
    return paths.plan(paths.Path(name="circle", radius_m=w.radius_m, speed_m_s=w.speed_m_s, turns=50.0, accel_m_s2=2.0))


def fly(w: World, estimator, e_gains, controller, c_gains, change=None, log=None) -> tuple[float, float]:
    """(rms, largest) 3-D error against the truth, in metres; `change(t_us, sample)` may spoil samples."""
    rng = np.random.default_rng(w.seed)
    e, c = estimator.init(e_gains), controller.init(c_gains)
    p, v, tilt, turn = np.array([0.0, 0.0, -5.0]), np.zeros(3), np.zeros(2), np.zeros(2)
    gust, thrust, q = np.zeros(3), G * w.mass, (1.0, 0.0, 0.0, 0.0)
    wanted, wanted_rate, wanted_thrust = np.zeros(2), np.zeros(2), G * w.mass
    applied_q, applied_thrust = q, G
    down, up = deque(), deque()
    errors = []
    plan, start = path(w), (0.0, 0.0, -5.0)

    def demand(at_us):
        return paths.demand(plan, 1_000_000, start, 0.0, at_us)

    round_trip = w.down_s + w.up_s
    for ms in range(2, round(1000 * w.seconds), 2):
        t_us = 1000 * ms
        while up and up[0][0] <= t_us:
            _, wanted, wanted_rate, wanted_thrust = up.popleft()
        # the vehicle
        rate = w.attitude_p * (wanted - tilt) + (wanted_rate if w.rates else 0.0)
        turn = turn + 2e-3 * w.rate_p * (rate - turn)
        tilt = tilt + 2e-3 * turn
        thrust += 2e-3 / 0.03 * (wanted_thrust - thrust)
        keep = math.exp(-2e-3 / 1.5)
        gust = keep * gust + w.gust * math.sqrt(1.0 - keep * keep) * rng.standard_normal(3) * (1.0, 1.0, 0.5)
        air = v - (w.wind[0], w.wind[1], 0.0) - gust
        up_axis = np.array([tilt[0], tilt[1], math.sqrt(max(0.1, 1.0 - tilt @ tilt))])
        a = np.array([0.0, 0.0, G]) - thrust / w.mass * up_axis - (w.drag + w.drag2 * float(np.linalg.norm(air))) * air / w.mass
        p, v = p + 2e-3 * v + 2e-6 * a, v + 2e-3 * a
        q, _ = attitude(tuple(up_axis), 0.0)
        # telemetry
        said = []
        if ms % 4 == 0:
            slope = (turn[0] * up_axis[2], turn[1])
            said.append(Attitude(t_us, q, (-slope[1], slope[0], 0.0)))
        if ms % 20 == 0:
            told = v + np.array((*w.bias, 0.0))
            noise = rng.standard_normal(6)
            said.append(Position(t_us, tuple(p + w.p_sigma * noise[:3]), tuple(told + w.v_sigma * noise[3:])))
            said.append(Target(t_us, q, NAN3, 0.5 * wanted_thrust / G, 7))
        for sample in said:
            down.append((t_us + round(1e6 * w.down_s), sample))
        while down and down[0][0] <= t_us:
            _, sample = down.popleft()
            sample = change(t_us, sample) if change else sample
            if sample is None:
                continue
            e = estimator.observe(e_gains, e, sample)
            if isinstance(sample, Attitude) and sample.t_us % 8000 == 0:
                now = sample.t_us
                applied = Applied(now, applied_q, applied_thrust, NAN3, round_trip)
                e, estimate = estimator.step(e_gains, e, applied, now)
                if not math.isfinite(estimate.p_ned_m[0]):
                    continue
                c, command = controller.step(c_gains, c, estimate, demand(now), demand, 0.008)
                vector = thrust_vector(command.a_ned_m_s2, math.radians(40.0), 0.2 * G, 1.8 * G)
                applied_q, applied_thrust = attitude(vector, 0.0)
                axis = np.array(vector) / applied_thrust
                rates = np.zeros(2)
                if math.isfinite(command.omega_rad_s[0]):
                    world = quat.rotate(applied_q, command.omega_rad_s)
                    rates = np.cross(world, axis)[:2]
                arrives = t_us + round(1e6 * (w.up_s + w.delay_s))
                up.append((arrives, axis[:2], rates, applied_thrust))
                if log is not None:
                    log.append((1e-6 * now, p.copy(), demand(t_us).p_ned_m, estimate, command, a + 0.0))
        if 1e-3 * ms > w.score_from_s and ms % 10 == 0:
            errors.append(float(np.linalg.norm(p - demand(t_us).p_ned_m)))
        if not np.all(np.isfinite(p)) or abs(p[2]) > 100.0:
            return math.inf, math.inf
    return math.sqrt(float(np.mean(np.square(errors)))), max(errors)
