"""How noisy a stream is, from its own samples: what changes faster than any vehicle moves."""

from typing import NamedTuple

import numpy as np

from mavquad.errors import LogError


class Noise(NamedTuple):
    """Of one column of a stream."""

    white: float  # 1 sigma of what differs from sample to sample
    slow: float  # 1 sigma of what is left after the best parabola over half a second: white and coloured together
    step: float  # smallest difference between two values sent: the quantisation, 0 where none shows


def noise(t_s: np.ndarray, value: np.ndarray) -> Noise:
    """White noise by third differences, all noise by local parabolas. Raises LogError below 50 samples."""
    if len(value) < 50:
        raise LogError(f"{len(value)} samples are too few to tell the noise from; needs 50")
    white = float(np.median(np.abs(np.diff(value, 3))) / 0.6745 / np.sqrt(20.0))  # third differences: 1 9 9 1
    period = float(np.median(np.diff(t_s)))
    n = max(5, round(0.5 / period)) | 1
    blocks = value[: len(value) // n * n].reshape(-1, n)
    s = np.linspace(-1.0, 1.0, n)
    basis, _ = np.linalg.qr(np.column_stack([np.ones(n), s, s * s]))
    left = blocks - blocks @ basis @ basis.T
    slow = float(np.sqrt(np.median(np.sum(left**2, axis=1)) / (n - 3)))
    apart = np.diff(np.unique(value))
    smallest = float(apart.min()) if apart.size else 0.0
    regular = apart.size > 10 and float(np.median(apart)) < 3.0 * smallest
    return Noise(white, slow, smallest if regular else 0.0)
