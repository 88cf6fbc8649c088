"""Scenarios and configurations of the paper's experiments, by the names the rows carry."""

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from mavquad.control import adrc, attitude_mpc, mpc
from mavquad.errors import ConfigError
from mavquad.estimate import extended_state_kf as eskf
from tools.papers.quad_in_wind import loop, plant
from tools.papers.quad_in_wind.dryden import Dryden, dryden

HEIGHT_M = 3.048
YAW_START = 0.5


class Scenario(NamedTuple):
    """One flight condition: noise variances per sample, wind, vehicle, delay of the outer command."""

    r_position: float = 0.01
    r_velocity: float = 0.01
    r_angle: float = 0.001
    r_rate: float = 0.001
    w20_m_s: float = 10.0  # 0: still air
    mean_wind: bool = False
    model: int = plant.MODEL_P
    motor_lag_s: float = 0.0
    delay_steps: int = 0
    predict: bool = False
    q_default: tuple[float, float] = (0.3, 1.0)  # growth of f for the default filter, position and angle
    start_ned_m: tuple[float, float, float] = (0.0, 0.0, -0.5)
    steps: int = 4000
    slew_m_s3: float = 0.0
    noise: bool = True  # False: measured exactly, the filters keep their R

    @property
    def wind(self) -> Dryden | None:
        return dryden(self.w20_m_s, HEIGHT_M) if self.w20_m_s > 0.0 else None


def _same(variance: float) -> Scenario:
    return Scenario(variance, variance, variance, variance)


_S2 = Scenario(1e-4, 2.5e-3, 1e-5, 1e-4, mean_wind=True, model=plant.MODEL_G, motor_lag_s=0.03, q_default=(0.03, 2.0))
SCENARIOS: dict[str, Scenario] = {
    "S1-A": Scenario(),
    "S1-B": _same(1e-4),
    **{f"S1-var1e-{n}": _same(10.0**-n) for n in (6, 5, 4, 3, 2, 1)},
    "S1-W5-A": Scenario(w20_m_s=5.0),
    "S1-W5": _same(1e-4)._replace(w20_m_s=5.0),
    "S1-W15-A": Scenario(w20_m_s=15.0),
    "S1-W15": _same(1e-4)._replace(w20_m_s=15.0),
    "S1-calm": _same(1e-4)._replace(w20_m_s=0.0, noise=False),
    "S2": _S2,
    "S2-W15": _S2._replace(w20_m_s=15.0),
    "S2-60ms": _S2._replace(delay_steps=6),
    "S2-60ms-predicted": _S2._replace(delay_steps=6, predict=True),
    "S2-60ms-predicted-W15": _S2._replace(delay_steps=6, predict=True, w20_m_s=15.0),
    "S2-100ms": _S2._replace(delay_steps=10),
    "S2-100ms-predicted": _S2._replace(delay_steps=10, predict=True),
    "S3": _same(1e-4)._replace(steps=2000, start_ned_m=(-2.5, 1.5, -0.5), slew_m_s3=200.0),
}


class Config(NamedTuple):
    """One controller with its observer."""

    preset: str = "paper"
    omega: float = 1.0
    q: tuple[float, float] | None = (1.0, 0.005)  # None: the scenario's own default
    fading: str = "constant"
    table_r: bool = False  # R of the paper's Table 1, whatever the noise
    position_only: bool = False
    posterior: bool = False
    integral: bool = True
    compensate_position: bool = True
    compensate_angles: bool = True
    printed_targets: bool = False
    estimator: int = loop.FILTER
    first_order_prediction: bool = False
    constrained: bool = False  # where the scenario has limits to plan for: quadratic programs


_TUNED = Config(preset="default", q=(0.1, 1.0), fading="none", posterior=True)
_DEFAULT = Config(preset="default", q=None, fading="none", posterior=True, integral=False, constrained=True)
CONFIGS: dict[str, Config] = {
    "default": _DEFAULT,
    "PB": Config(),
    "PA": Config(omega=60.0),
    "PB-printed-targets": Config(printed_targets=True),
    "PB-table-R": Config(table_r=True),
    "PB-per-step-delta": Config(fading="per-step"),
    "PB-no-position-compensation": Config(compensate_position=False),
    "PB-no-compensation": Config(compensate_position=False, compensate_angles=False),
    "PB-position-only": Config(position_only=True),
    "KF": Config(fading="none"),
    "KF-tuned-q": Config(fading="none", q=(0.1, 1.0)),
    "ADRC": Config(estimator=loop.HAN),
    "LADRC": Config(estimator=loop.LINEAR),
    "tuned": _TUNED,
    "tuned-ESKF": _TUNED._replace(q=(1.0, 0.005), fading="constant"),
    "tuned-no-position-compensation": _TUNED._replace(compensate_position=False),
    "tuned-no-compensation": _TUNED._replace(compensate_position=False, compensate_angles=False),
    "default-position-only": _DEFAULT._replace(position_only=True),
    "default-no-compensation": _DEFAULT._replace(compensate_position=False, compensate_angles=False),
    "default-first-order-prediction": _DEFAULT._replace(first_order_prediction=True),
    "closed": _DEFAULT._replace(constrained=False),
    "closed-integral": _DEFAULT._replace(constrained=False, integral=True),
    "default-integral": _DEFAULT._replace(integral=True),
    "default-integral-only": _DEFAULT._replace(compensate_position=False, integral=True),
}


def pick(table: Mapping[str, object], name: str, kind: str) -> None:
    if name not in table:
        raise ConfigError(f'no {kind} "{name}"; known: {", ".join(table)}')


def leso_gain(omega_o_rad_s: float, dt_s: float) -> np.ndarray:
    """Observer gain with a triple pole at exp(-omega dt), as a schedule of one row (1,6)."""
    b = 1.0 - math.exp(-omega_o_rad_s * dt_s)
    l3 = b**3 / dt_s**2
    return np.array([[3.0 * b, (3.0 * b * b - 0.5 * b**3) / dt_s, l3, 0.0, 0.0, 0.0]])


def _schedule(q: float, r_first: float, r_second: float, p0: float, fading: str) -> np.ndarray:
    params = eskf.KfParams(q_per_step=q, r_first=r_first, r_second=r_second, p0=p0, fading=fading)  # type: ignore[arg-type]
    return eskf.schedule(eskf.gains(params))[0]


@lru_cache(maxsize=64)
def flight(config: Config, scenario: Scenario) -> loop.Flight:
    """The compiled loop's constants for one configuration in one scenario."""
    quad = plant.Quad(model=scenario.model, motor_lag_s=scenario.motor_lag_s)
    weight = quad.mass_kg * plant.G
    attitude = attitude_mpc.gains("default" if config.preset == "default" else "paper")
    natural = math.sqrt(attitude.roll[0])
    damping = 0.5 * attitude.roll[1] / natural
    if config.first_order_prediction:  # the design note's lag of 0.1 s, as one slow pole
        natural, damping = 200.0, 10.0
    else:  # the motors' lag added to the attitude loop's own
        natural = 2.0 * damping / (2.0 * damping / natural + scenario.motor_lag_s)
    params = mpc.MpcParams(
        response_rad_s=natural,
        response_damping=damping,
        preset=config.preset,  # type: ignore[arg-type]
        mass_kg=quad.mass_kg,
        u_min_n=0.2 * weight,
        u_max_n=3.6 * quad.t_max_n,
        integral=config.integral,
        compensate=config.compensate_position,
        omega=config.omega,
        gravity_m_s2=plant.G,
    )
    r = (0.01, 0.01, 0.001, 0.001) if config.table_r else scenario[:4]
    if config.position_only:  # the rate weighs nothing
        r = (r[0], 1e9, r[2], 1e9)
    q = config.q or scenario.q_default
    if config.estimator == loop.LINEAR:
        k_position, k_angle = leso_gain(10.0, loop.DT), leso_gain(40.0, loop.DT)
    else:
        k_position = _schedule(q[0], r[0], r[1], 1.0, config.fading)
        k_angle = _schedule(q[1], r[2], r[3], 0.5, config.fading)
    default = config.preset == "default"
    return loop.Flight(
        quad=quad,
        mpc=mpc.gains(params),
        attitude=attitude,
        han=adrc.gains(adrc.HanParams(h_s=loop.DT)),
        han_yaw=adrc.gains(adrc.HanParams(h_s=loop.DT, k_error=20.0, k_rate=8.0)),
        estimator=config.estimator,
        posterior=config.posterior,
        k_position=k_position,
        k_angle=k_angle,
        compensate_angles=config.compensate_angles,
        lead_s=0.5 * loop.DT if default else 0.0,
        printed_targets=config.printed_targets,
        delay_steps=scenario.delay_steps,
        predict=scenario.predict,
        slew_m_s3=scenario.slew_m_s3,
    )


def disturbances(scenario: Scenario, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Noise (steps,12) and wind (steps,5) of a seed: position and velocity noise, angles, then the wind."""
    from tools.papers.quad_in_wind.dryden import realise

    rng = np.random.default_rng(seed)
    n = scenario.steps
    first = rng.standard_normal((n, 6)) * np.sqrt(np.repeat([scenario.r_position, scenario.r_velocity], 3))
    second = rng.standard_normal((n, 6)) * np.sqrt(np.repeat([scenario.r_angle, scenario.r_rate], 3))
    noise = np.hstack([first, second])
    if not scenario.noise:
        noise = np.zeros_like(noise)
    wind = np.zeros((n, 5))
    conditions = scenario.wind
    if conditions is not None:
        wind = realise(conditions, rng, n, loop.DT)
        if scenario.mean_wind:
            wind[:, 0] += conditions.mean_m_s
    return noise, wind
