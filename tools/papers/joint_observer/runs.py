"""One run of a configuration in a scenario with a seed, and its figures."""

import numpy as np

from tools.papers.joint_observer import cases, metrics
from tools.papers.joint_observer.flight import Run, fly


def flown(scenario: cases.Scenario, config: cases.Config, seed: int) -> tuple[Run, np.ndarray]:
    """The run and the disturbance (n,6) it met."""
    law, gains, aug = cases.design(scenario, config)
    disturbance, noise = cases.draws(scenario, config, seed)
    return fly(scenario.plant, law, gains, aug, cases.reference(scenario), disturbance, noise, cases.DT_S), disturbance


def measured(scenario: cases.Scenario, config: cases.Config, seed: int) -> dict[str, float]:
    """All figures of one run."""
    run, disturbance = flown(scenario, config, seed)
    return metrics.measure(scenario, run, disturbance)
