"""Vehicles, scenarios and configurations of the IADRC experiments (note sections 10, 11), as data."""

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from mavquad.control.iadrc import Body
from mavquad.errors import ConfigError
from mavquad.estimate import ekf, joint, leso
from tools.papers.joint_observer.augmented import AugmentedGains
from tools.papers.joint_observer.flight import AUGMENTED, ESO, Law
from tools.papers.joint_observer.plant import Plant

DT_S = 0.005
DEG = math.pi / 180.0
SIGMA = np.repeat([0.005, 0.03, 0.1 * DEG, 0.01], 3)  # p v eta w, one standard deviation per sample

_J = (0.0050, 0.0050, 0.0095)
QUAD = Body(0.4, 9.8, 0.05 / 0.4, _J, 0.002, 0.2575, 0.016, 0.05, 2.2, 0.03)
# The bench holds the vehicle: "gravity" is what its base thrust of 8 N carries, so that nothing but attitude moves.
BENCH = Body(2.85, 8.0 / 2.85, 0.0, (0.0552, 0.0552, 0.1165), 0.02, 0.2575, 0.016, 0.2, 6.0, 0.05)


class Scenario(NamedTuple):
    """What is flown, without noise: the vehicle, the law's settings, the reference."""

    name: str
    duration_s: float
    plant: Plant
    model: Body
    w0: tuple[float, ...]  # six channels
    wc: tuple[float, float, float, float]  # xy, z, roll/pitch, yaw


@dataclass(frozen=True, slots=True, kw_only=True)
class Config:
    """One variant of the controller."""

    name: str
    sensors: str = "p eta"  # what the filter is given
    use_ekf: bool = False
    q_velocity: float = 0.003
    q_rate: float = 0.003
    r_factor: float = 2.0  # sigma of p and eta as the filter takes it, in units of the true one
    g_xy: float = 0.0
    g_z: float = 0.0
    g_att: float = 0.0
    tau_f_s: float = 0.03
    form: str = "current"
    pattern: str = "binomial"
    order: int = 3
    feed: int = joint.J2
    states_from_ekf: bool = False
    w0_scale: tuple[float, float] | None = None  # w0 of z and of roll/pitch, instead of the scenario's
    law: dict[str, float | int | bool] = field(default_factory=dict)  # fields of Law that differ


ADRC = Config(name="ADRC")
IADRC_P = Config(name="IADRC-P", use_ekf=True, q_velocity=0.3, q_rate=1.0, g_z=0.6, g_att=0.3, tau_f_s=0.06)
IADRC_R = Config(name="IADRC-R", sensors="p v eta w", use_ekf=True, g_z=1.0, g_att=1.0, states_from_ekf=True)
SLOW = Config(name="slow J2 z3", use_ekf=True, q_velocity=0.1, q_rate=1.0, r_factor=20.0)
_NO_MODEL: dict[str, float | int | bool] = {"motor_model": False}

CONFIGS = (
    ADRC,
    replace(ADRC, name="ADRC-zoh", form="zoh"),
    IADRC_P,
    IADRC_R,
    replace(IADRC_R, name="IADRC-R gxy1", g_xy=1.0),
    replace(IADRC_R, name="IADRC-R zoh", form="zoh"),
    replace(IADRC_R, name="IADRC-R noFF", g_z=0.0, g_att=0.0),
    replace(IADRC_R, name="IADRC-R butter", pattern="butterworth"),
    replace(IADRC_R, name="GESO4-R", order=4, g_z=0.0, g_att=0.0),
    replace(IADRC_R, name="AUG18", law={"estimator": AUGMENTED}),
    replace(IADRC_R, name="INDI40", law={"indi_rad_s": 40.0}),
    replace(ADRC, name="PD", law={"cancel": False}),
    replace(ADRC, name="ADRC no motor model", law=_NO_MODEL),
    replace(IADRC_R, name="IADRC-R no motor model", law=_NO_MODEL),
    replace(ADRC, name="ADRC+FF raw", g_z=1.0, g_att=1.0),
    replace(SLOW, name="slow J1", feed=joint.J1),
    SLOW,
    replace(SLOW, name="slow J2 z3c", feed=joint.J2C, g_z=1.0, g_att=1.0),
)
BANDWIDTHS = tuple(
    replace(base, name=f"{base.name} w0 {z}/{att}", w0_scale=(z, att))
    for base, pairs in (
        (ADRC, ((14.0, 20.0), (27.0, 36.0), (35.0, 45.0), (45.0, 55.0))),
        (CONFIGS[6], ((30.0, 40.0), (40.0, 54.0), (55.0, 70.0))),
    )
    for z, att in pairs
)


def _latency(base: Config, samples: int, delayed: bool) -> Config:
    name = f"{base.name} latency {5 * samples}ms" + (" delayed u" if delayed else "")
    return replace(base, name=name, law={"latency": samples, "delayed_input": delayed})


LATENCIES = tuple(_latency(base, n, d) for base in (ADRC, IADRC_R) for n in (4, 8, 12) for d in (False, True))

_HEAVY = QUAD._replace(mass_kg=0.48, drag_1_s=0.1 / 0.48, inertia_kg_m2=(0.0065, 0.0065, 0.01235))
_PLANT = Plant(QUAD, 2e-5, 3.9e-6, False)
SCENARIOS = {
    "S1": Scenario("S1", 30.0, _PLANT, QUAD, (8.0, 8.0, 20.0, 27.0, 27.0, 12.0), (1.0, 2.5, 8.0, 3.0)),
    "S1-papergain": Scenario("S1-papergain", 30.0, _PLANT, QUAD, (2.0, 2.0, 20.0, 27.0, 27.0, 12.0), (0.4, 2.5, 2.0, 2.0)),
    "S3": Scenario(
        "S3", 22.0, Plant(_HEAVY, 2e-5, 3.9e-6, False), QUAD, (10.0, 10.0, 20.0, 27.0, 27.0, 12.0), (2.0, 2.5, 10.0, 3.0)
    ),
    "S4": Scenario(
        "S4", 45.0, Plant(BENCH, 6e-5, 1.2e-5, True), BENCH, (8.0, 8.0, 20.0, 27.0, 27.0, 12.0), (1.0, 2.5, 6.0, 3.0)
    ),
    "step15": Scenario("step15", 14.0, _PLANT, QUAD, (8.0, 8.0, 20.0, 27.0, 27.0, 12.0), (1.0, 2.5, 8.0, 3.0)),
}
SCENARIOS["S4-latency"] = SCENARIOS["S4"]._replace(name="S4-latency")


def configs(scenario: str) -> tuple[Config, ...]:
    """The rows of a scenario's table."""
    if scenario == "S4-latency":
        return LATENCIES
    if scenario == "step15":
        return (ADRC, replace(ADRC, name="ADRC unlimited u", law={"feed_applied": False}))
    return CONFIGS


def find(scenario: str, name: str) -> Config:
    """A configuration by its name."""
    return next(c for c in (*configs(scenario), *BANDWIDTHS) if c.name == name)


def times(scenario: Scenario) -> np.ndarray:
    """Sample times (n,)."""
    return DT_S * np.arange(round(scenario.duration_s / DT_S))


def reference(scenario: Scenario) -> np.ndarray:
    """Position and velocity wanted (n,6), NED."""
    t = times(scenario)
    out = np.zeros((t.size, 6))
    if scenario.name.startswith("S1"):
        out[:, 2] = -3.0
    elif scenario.name == "step15":
        out[:, 2] = -15.0
    elif scenario.name == "S3":
        out[:, 2] = -1.0
        corners_s = np.array([4.0, 8.0, 11.0, 15.0, 18.0])
        for axis, points in enumerate(([0.0, 4.0, 4.0, 0.0, 0.0], [0.0, 0.0, 3.0, 3.0, 0.0])):
            out[:, axis] = np.interp(t, corners_s, points)
            leg = np.searchsorted(corners_s, t, side="right") - 1
            speed = np.append(np.diff(points) / np.diff(corners_s), 0.0)
            out[:, 3 + axis] = np.where(leg >= 0, speed[leg], 0.0)
    return out


def draws(scenario: Scenario, config: Config, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Disturbance (n,6) and sensor noise (n,12; NaN where the filter is not given that sensor) of one seed."""
    t = times(scenario)
    noise = np.random.default_rng(seed).standard_normal((t.size, 12)) * SIGMA
    d = np.zeros((t.size, 6))
    if scenario.name.startswith("S1"):
        early = t < 10.0
        noise[early, 2] *= 6.0
        noise[early, 6] *= 3.0
        on = (t >= 15.0) & (t < 25.0)
        d[on, 2] = d[on, 3] = np.where(np.floor((t[on] - 15.0) / 2.0 + 1e-9) % 2 == 0, 2.0, -2.0)
    elif scenario.name == "S3":
        d[:, 0] = np.where(t >= 6.0, 0.8, 0.0)
        d[:, 1] = 0.5 * np.sin(2 * np.pi * 0.3 * t)
        d[:, 3] = 0.3 * np.sin(2 * np.pi * 0.7 * t)
        d[:, 4] = 0.3 * np.sin(2 * np.pi * 0.5 * t)
    elif scenario.name.startswith("S4"):
        rng = np.random.default_rng(seed + 1000)
        keep = math.exp(-DT_S / 0.5)
        on = np.flatnonzero((t >= 5.0) & (t < 20.0))
        for axis, mean in ((3, 0.5), (4, 0.3)):
            x = 0.5 * rng.standard_normal()
            for k, kick in zip(on, rng.standard_normal(on.size), strict=True):
                d[k, axis] = mean + x
                x = keep * x + 0.5 * math.sqrt(1.0 - keep * keep) * kick
        blow = (t >= 35.0) & (t < 35.05)
        d[blow, 3] += 31.4 * np.sin(np.pi * (t[blow] - 35.0 + 0.5 * DT_S) / 0.05)
    if scenario.plant.fixed:
        noise[:, :6] = np.nan if config.use_ekf else 0.0
    if config.use_ekf:
        for i, sensor in enumerate(("p", "v", "eta", "w")):
            if sensor not in config.sensors.split():
                noise[:, 3 * i : 3 * i + 3] = np.nan
    return d, noise


def design(scenario: Scenario, config: Config) -> tuple[Law, joint.JointGains, AugmentedGains]:
    """The gains of a configuration in a scenario."""
    body = scenario.model
    model = ekf.EkfModel(body.gravity_m_s2, body.drag_1_s, body.inertia_kg_m2, body.rate_drag_nm_s)
    sigma = SIGMA.copy()
    sigma[[0, 1, 2, 6, 7, 8]] *= config.r_factor
    filter_gains = ekf.gains(
        ekf.EkfParams(
            q_velocity=config.q_velocity,
            q_rate=config.q_rate,
            sigma_position_m=float(sigma[0]),
            sigma_velocity_m_s=float(sigma[3]),
            sigma_angle_rad=float(sigma[6]),
            sigma_rate_rad_s=float(sigma[9]),
        ),
        model,
    )
    w0 = list(scenario.w0)
    if config.w0_scale is not None:
        w0[2], w0[3], w0[4] = config.w0_scale[0], config.w0_scale[1], config.w0_scale[1]
    observers = leso.gains(
        leso.LesoParams(
            w0_rad_s=tuple(w0),
            dt_s=DT_S,
            feedforward=(config.g_xy,) * 2 + (config.g_z,) + (config.g_att,) * 3,
            tau_f_s=config.tau_f_s,
            order=config.order,
            form=config.form,
            pattern=config.pattern,
        )
    )
    wc = scenario.wc
    law = Law(
        body=body,
        wc_position=(wc[0], wc[0], wc[1]),
        wc_attitude=(wc[2], wc[2], wc[3]),
        command_filter_rad_s=20.0,
        tilt_max_rad=math.radians(35.0),
        estimator=ESO,
        states_from_ekf=config.states_from_ekf,
        cancel=True,
        feed_applied=True,
        motor_model=True,
        indi_rad_s=0.0,
        latency=0,
        delayed_input=False,
    )
    unknown = set(config.law) - set(Law._fields)
    if unknown:
        raise ConfigError(f"configuration {config.name}: unknown law settings {sorted(unknown)}")
    return (
        law._replace(**config.law),
        joint.JointGains(filter_gains, observers, config.use_ekf, config.feed),
        AugmentedGains(filter_gains, 10.0, 1.0),
    )
