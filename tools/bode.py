"""Bode plots of measured responses with their spread and coherence, models drawn over the data."""

from collections.abc import Sequence

import numpy as np

from mavquad.identify.spectrum import Response
from tools import page

HZ = 2.0 * np.pi


def bode(
    title: str,
    response: Response,
    pair: tuple[int, int],
    models: Sequence[tuple[str, np.ndarray]] = (),
    coherence_floor: float = 0.5,
) -> list[str]:
    """Gain, phase and coherence of one output-input pair over frequency; `models` are (name, h (K,)) at the same frequencies."""
    i, j = pair
    keep = response.coherence[:, i, j] >= coherence_floor
    f, h, sd = response.omega_rad_s[keep] / HZ, response.h[keep, i, j], 2.0 * response.sd[keep, i, j]
    sd = np.minimum(sd, 0.99)
    phase = np.unwrap(np.angle(h))
    gain, turn, trust = [], [], []
    gain += page.band("+-2 sigma", f, _db(np.abs(h) * (1.0 - sd)), _db(np.abs(h) * (1.0 + sd)))
    gain.append(page.dots("measured", f, _db(np.abs(h))))
    turn += page.band("+-2 sigma", f, np.degrees(phase - sd), np.degrees(phase + sd))
    turn.append(page.dots("measured", f, np.degrees(phase)))
    for colour, (name, modelled) in enumerate(models, 1):
        wanted = modelled[keep]
        gain.append(page.line(name, f, _db(np.abs(wanted)), colour))
        turn.append(page.line(name, f, np.degrees(phase + np.angle(wanted / h)), colour))
    trust.append(page.line("coherence", response.omega_rad_s / HZ, response.coherence[:, i, j]))
    log = {"type": "log", "title": {"text": "Hz"}}
    unit = {"range": [0, 1.02], "title": {"text": "coherence"}}
    return [
        page.figure(title, gain, y="gain, dB", xaxis=log),
        page.figure("", turn, y="phase, deg", height=240, xaxis=log),
        page.figure("", trust, height=180, xaxis=log, yaxis=unit),
    ]


def _db(x: np.ndarray) -> np.ndarray:
    return 20.0 * np.log10(np.maximum(x, 1e-12))
