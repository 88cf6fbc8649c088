"""The note's tables as rows: 8.1 exact start, 8.2 general start and robustness, 8.3 noise and torque; gaps and the fast tumble."""

import math
from collections.abc import Sequence

import numpy as np

from mavquad.estimate import lie, rate_baselines, rate_filters
from tools.papers import common
from tools.papers.common import Row
from tools.papers.geometric import setup
from tools.papers.geometric.runs import Config, run
from tools.papers.geometric.setup import IDENTITY, ZERO, Array, Truth, after, rms

GENERAL_Q = (0.3, -0.2, 0.1)  # rotation vector of the general start [rad]
GENERAL_W = (0.5, -0.4, 0.3)
AXIS = np.array([2.0, -1.0, 2.0]) / 3.0
NOISES_DEG = (0.0, 0.1, 0.5, 1.0)
FAST_W = (15.0, -10.0, 12.0)


def turned(phi: Sequence[float] | Array) -> tuple[float, float, float, float]:
    """Unit quaternion of a rotation vector."""
    angle = float(np.linalg.norm(phi))
    s = 0.5 * float(np.sinc(0.5 * angle / math.pi))
    return (math.cos(0.5 * angle), s * float(phi[0]), s * float(phi[1]), s * float(phi[2]))


def row(scenario: str, config: str, metric: str, unit: str, value: float, seed: int | None = None, **more: object) -> Row:
    return {**common.row(scenario, config, seed, metric, unit, value, None if seed is not None else "mean"), **more}


def exact_start(config: Config) -> list[Row]:
    """8.1: noise-free, torque known, exact start, t in [1, 20] s."""
    source = setup.truth()
    w, q = run(config, setup.stimulus(source), IDENTITY, ZERO)
    keep = after(source, 1.0)
    raw = (w - source.w)[keep]
    filtered = (rate_filters.low_pass(w, 5.0, source.h) - source.w)[keep]
    name = config.name
    rows = [row("8.1", name, "raw_rms", "rad/s", rms(raw)), row("8.1", name, "filt_rms", "rad/s", rms(filtered))]
    for i, axis in enumerate("xyz"):
        rows += [
            row("8.1", name, f"raw_rms_{axis}", "rad/s", rms(raw[:, i])),
            row("8.1", name, f"raw_max_{axis}", "rad/s", float(np.abs(raw[:, i]).max())),
            row("8.1", name, f"filt_rms_{axis}", "rad/s", rms(filtered[:, i])),
            row("8.1", name, f"filt_max_{axis}", "rad/s", float(np.abs(filtered[:, i]).max())),
        ]
    if config.family != "difference":
        rows += [
            row("8.1", name, "att_rms_deg", "deg", rms(setup.attitude_error_deg(source, q)[keep])),
            row("8.1", name, "norm_drift", "1", float(np.abs(np.linalg.norm(q, axis=1) - 1.0).max())),
        ]
    return rows


def general_start(config: Config) -> list[Row]:
    """8.2, first columns: rms over [5, 20] s from a wrong start, and three filters; then convergence."""
    source = setup.truth()
    stimulus = setup.stimulus(source)
    w, q = run(config, stimulus, turned(GENERAL_Q), GENERAL_W)
    keep = after(source, 5.0)
    followed = rate_filters.follow_model_run(setup.GYRO, w, source.a_half, 2.0, source.h)
    shown = {
        "raw_rms": w,
        "filt_rms": rate_filters.low_pass(w, 5.0, source.h),
        "mff_rms": followed,
        "zero_phase_rms": rate_filters.zero_phase(w, 5.0, source.h),
    }
    name = config.name
    rows = [row("8.2", name, metric, "rad/s", rms((x - source.w)[keep])) for metric, x in shown.items()]
    if config.family != "difference":
        rows.append(row("8.2", name, "att_rms_deg", "deg", rms(setup.attitude_error_deg(source, q)[keep])))
    for degrees in (170.0, 179.0):
        w, q = run(config, stimulus, turned(math.radians(degrees) * AXIS), ZERO)
        rows.append(row("8.2", name, f"t_{degrees:.0f}deg", "s", setup.settling_s(source, w, q)))
    w, q = run(config, stimulus, IDENTITY, tuple(3.0 * AXIS))
    rows.append(row("8.2", name, "t_3rads", "s", setup.settling_s(source, w, q)))
    return rows


def robustness(config: Config, seeds: Sequence[int]) -> list[Row]:
    """8.2, last columns: random signs, 20 and 50 % of the samples dropped; exact start, t >= 1 s."""
    source = setup.truth()
    keep = after(source, 1.0)
    rows = []
    for metric, change in (("flips", {"flips": True}), ("drop20", {"drop": 0.2}), ("drop50", {"drop": 0.5})):
        found = []
        for seed in seeds:
            w, _ = run(config, setup.stimulus(source, seed=seed, **change), IDENTITY, ZERO)
            found.append(rms((w - source.w)[keep]))
            rows.append(row("8.2", config.name, f"raw_rms_{metric}", "rad/s", found[-1], seed))
        rows.append(row("8.2", config.name, f"raw_rms_{metric}", "rad/s", float(np.mean(found))))
    return rows


def noise(config: Config, seeds: Sequence[int], noises_deg: Sequence[float] = NOISES_DEG) -> list[Row]:
    """8.3: white noise, torque known and unknown; exact start, t >= 1 s, all axes."""
    source = setup.truth()
    keep = after(source, 1.0)
    rows = []
    for torque, scale in (("known", 1.0), ("unknown", 0.0)):
        for noise_deg in noises_deg:
            used = seeds if noise_deg > 0.0 else seeds[:1]
            both = []
            for seed in used:
                w, _ = run(config, _noisy(source, noise_deg, seed, scale), IDENTITY, ZERO)
                filtered = rate_filters.low_pass(w, 5.0, source.h)
                both.append((rms((w - source.w)[keep]), rms((filtered - source.w)[keep])))
                for metric, value in zip(("raw_rms", "filt_rms"), both[-1], strict=True):
                    more = {"noise_deg": noise_deg, "torque": torque}
                    rows.append(row("8.3", config.name, metric, "rad/s", value, seed, **more))
            for metric, value in zip(("raw_rms", "filt_rms"), np.mean(both, axis=0).tolist(), strict=True):
                rows.append(row("8.3", config.name, metric, "rad/s", value, noise_deg=noise_deg, torque=torque))
    w, _ = run(config, setup.stimulus(source, torque_scale=1.2), IDENTITY, ZERO)
    rows.append(row("8.3", config.name, "raw_rms", "rad/s", rms((w - source.w)[keep]), noise_deg=0.0, torque="+20%"))
    return rows


def _noisy(source: Truth, noise_deg: float, seed: int, scale: float) -> setup.Stimulus:
    return setup.stimulus(source, noise_deg=noise_deg, seed=seed, torque_scale=scale)


def bias_law() -> list[Row]:
    """Below 8.3: the implicit relay with unknown torque is off by d/lambda."""
    source = setup.truth()
    keep = after(source, 1.0)
    rows = []
    for slope in (2.0, 5.0, 10.0, 20.0):
        config = setup.implicit(f"implicit relay lambda={slope:g}", "implicit-relay", 6.0, 6.0 * slope)
        w, _ = run(config, setup.stimulus(source, torque_scale=0.0), IDENTITY, ZERO)
        value = rms((w - source.w)[keep, 0])
        rows.append(row("8.3", config.name, "raw_rms_x", "rad/s", value, noise_deg=0.0, torque="unknown"))
    return rows


def maps(seeds: Sequence[int], starts: int = 20) -> list[Row]:
    """Below 8.2: what the map to the group is worth at 3 rad/s, over random starts (k1 = 4, k2 = 8)."""
    source = setup.truth()
    stimulus, keep = setup.stimulus(source), after(source, 5.0)
    configs = [
        setup.explicit("Cayley order 2", "relay", 2, 4.0, 8.0),
        setup.explicit("Cayley order 1", "relay", 1, 4.0, 8.0),
        setup.explicit("exp", "relay", 2, 4.0, 8.0, lie.EXP),
        setup.traditional("Euler + renorm", rate_baselines.EULER, False),
        setup.traditional("RK4 + renorm", rate_baselines.RK4, False),
    ]
    rows = []
    for config in configs:
        rng = np.random.default_rng(seeds[0])
        found = []
        for _ in range(starts):
            q0, w0 = turned(0.3 * _direction(rng)), tuple((0.5 * _direction(rng)).tolist())
            w, _ = run(config, stimulus, q0, w0)
            zero_phase = rate_filters.zero_phase(w, 5.0, source.h)
            followed = rate_filters.follow_model_run(setup.GYRO, w, source.a_half, 2.0, source.h)
            found.append([rms((x - source.w)[keep]) for x in (w, zero_phase, followed)])
        for metric, mean in zip(("raw_rms", "zero_phase_rms", "mff_rms"), np.mean(found, axis=0).tolist(), strict=True):
            rows.append(row("8.2", f"20 starts: {config.name}", metric, "rad/s", mean))
    return rows


def _direction(rng: np.random.Generator) -> Array:
    x = rng.standard_normal(3)
    return x / np.linalg.norm(x)


def gaps(config: Config) -> list[Row]:
    """Largest rate error from t = 8 s on where 0.2, 1 or 3 s of samples are missing, and until 2 s after."""
    source = setup.truth()
    rows = []
    for torque, scale in (("known", 1.0), ("unknown", 0.0)):
        for length_s in (0.2, 1.0, 3.0):
            stimulus = setup.stimulus(source, torque_scale=scale, gap_s=(8.0, length_s))
            w, _ = run(config, stimulus, IDENTITY, ZERO)
            inside = after(source, 8.0) & ~after(source, 8.0 + length_s + 2.0)
            peak = float(np.linalg.norm(w - source.w, axis=1)[inside].max())
            rows.append(row("gap", config.name, f"peak_{length_s:g}s", "rad/s", peak, torque=torque))
    return rows


def coloured(source: Truth, tau_s: float, noise_deg: float, seed: int) -> setup.Stimulus:
    """Samples whose noise fades with tau_s instead of being white; torque unknown."""
    stimulus = setup.stimulus(source, torque_scale=0.0)
    every = round(stimulus.period / source.h)
    left = math.exp(-stimulus.period / tau_s)
    white = math.radians(noise_deg) * np.random.default_rng(seed).standard_normal((len(source.t) // every + 1, 3))
    phi = white.copy()
    for k in range(1, len(phi)):
        phi[k] = left * phi[k - 1] + math.sqrt(1.0 - left * left) * white[k]
    return stimulus._replace(samples=setup.turned_by(source.q, np.repeat(phi, every, axis=0)[: len(source.t)]))


def coloured_noise(config: Config, seeds: Sequence[int]) -> list[Row]:
    """Beside 8.3: noise that can be predicted, and is partly taken for motion; torque unknown, t >= 1 s."""
    source = setup.truth()
    keep = after(source, 1.0)
    rows = []
    for noise_deg in (0.1, 0.5):
        for tau_s in (0.05, 0.2, 1.0):
            found = [
                rms((run(config, coloured(source, tau_s, noise_deg, seed), IDENTITY, ZERO)[0] - source.w)[keep])
                for seed in seeds
            ]
            more = {"noise_deg": noise_deg, "tau_s": tau_s, "torque": "unknown"}
            rows.append(row("8.3", f"coloured: {config.name}", "raw_rms", "rad/s", float(np.mean(found)), **more))
    return rows


def tumble_configurations() -> list[Config]:
    """G2 and its order-1 kin with the sample held or moved along, the maps at order 1, and the better observers."""
    held = setup.explicit("order 1, held", "relay", 1, 4.0, 8.0)
    held = held._replace(gains=held.gains._replace(hold=True))
    sat = [
        setup.explicit(f"sat order 1, {word}", "sat", 1, 4.0, 20.0, group_map)
        for word, group_map in (("Cayley", lie.CAYLEY), ("exp", lie.EXP), ("Euler + renorm", lie.EULER))
    ]
    named = setup.configurations()
    listed = ("G2", "G5", "G7", "G8", "G9", "B1c", "B2a", "B2b", "online", "online-J")
    return [held, named["G1"]._replace(name="order 1, moved"), *sat, *(named[name] for name in listed)]


def tumble(config: Config, seeds: Sequence[int]) -> list[Row]:
    """The paper's torque on a body that starts at (15, -10, 12) rad/s; exact start, t >= 1 s."""
    source = setup.truth(FAST_W)
    keep = after(source, 1.0)
    rows = []
    for torque, scale in (("known", 1.0), ("unknown", 0.0)):
        for noise_deg in (0.0, 0.1, 0.5):
            if noise_deg > 0.0 and torque == "known":
                continue
            found = []
            for seed in seeds if noise_deg > 0.0 else seeds[:1]:
                w, _ = run(config, _noisy(source, noise_deg, seed, scale), IDENTITY, FAST_W)
                error = (w - source.w)[keep]
                found.append([rms(error), float(np.abs(error).max()), *np.sqrt(np.mean(error**2, axis=0)).tolist()])
            more = {"noise_deg": noise_deg, "torque": torque}
            names = ("raw_rms", "raw_max", "raw_rms_x", "raw_rms_y", "raw_rms_z")
            for metric, value in zip(names, np.mean(found, axis=0).tolist(), strict=True):
                rows.append(row("tumble", config.name, metric, "rad/s", value, **more))
    return rows
