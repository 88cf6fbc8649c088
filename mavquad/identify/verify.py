"""Time-domain check of a hover model on records that were not used to fit it.

Source: Song et al. 2011 (paper 004), section 4.2, Eq. (39) and Fig. 7.

Deviations from the paper:
  Eq. (39)  is right only when the record starts in trim and A has no eigenvalue near zero: the start of every segment is found
            by least squares instead. Segments are short (3 s): an unstable model leaves any record.
"""

from typing import NamedTuple

import numpy as np

from mavquad.errors import LogError
from mavquad.identify.fit import discretized
from mavquad.identify.models import Model
from mavquad.identify.spectrum import Record

TIC_ACCEPTED = 0.25


class Check(NamedTuple):
    """How a model predicts: per output, over all segments."""

    fit_pct: np.ndarray  # (p,) 100 (1 - |e| / |y - mean y|)
    tic: np.ndarray  # (p,) rms(e) / (rms(y) + rms(predicted)): 0 perfect, accepted below 0.25
    predicted: np.ndarray  # (S L, p) one segment after another
    measured: np.ndarray  # (S L, p)


def check(
    model: Model, record: Record, *, segment_s: float = 3.0, start_s: float = 2.0, states: np.ndarray | None = None
) -> Check:
    """Predict `record` in segments of `segment_s` and compare.

    Each segment starts from the least squares estimate over its first `start_s`, or from `states` (N, n) where the truth is known.
    Raises LogError where the record is shorter than one segment.
    """
    length = round(segment_s / record.dt_s)
    count = len(record.y) // length
    if count < 1:
        raise LogError(f"verification: the record lasts {len(record.y) * record.dt_s:.1f} s, one segment is {segment_s:g} s")
    y = record.y[: count * length].reshape(count, length, -1)
    u = record.u[: count * length].reshape(count, length, -1)
    ad, bd = discretized(model.a, model.b, record.dt_s)
    forced = _run(ad, bd, model.c, u, np.zeros((count, len(ad))))
    if states is None:
        x0 = _starts(ad, model.c, y - forced, min(length, round(start_s / record.dt_s)))
    else:
        x0 = states[: count * length : length]
    predicted = (forced + _run(ad, bd, model.c, np.zeros_like(u), x0)).reshape(count * length, -1)
    measured = record.y[: count * length]
    return Check(fit_pct(measured, predicted), tic(measured, predicted), predicted, measured)


def trim_state(model: Model, u0: np.ndarray) -> np.ndarray:
    """Eq. (39): the state at rest under a constant input u0 (m,)."""
    return -np.linalg.solve(model.a, model.b @ u0)


def fit_pct(measured: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """Per column, 100 for a perfect prediction, 0 for one no better than the mean."""
    error = np.linalg.norm(measured - predicted, axis=0)
    return 100.0 * (1.0 - error / np.maximum(np.linalg.norm(measured - measured.mean(axis=0), axis=0), 1e-300))


def tic(measured: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """Theil's inequality coefficient per column: 0 perfect, 1 the worst."""

    def rms(x: np.ndarray) -> np.ndarray:
        return np.sqrt(np.mean(x * x, axis=0))

    return rms(measured - predicted) / np.maximum(rms(measured) + rms(predicted), 1e-300)


def _run(ad: np.ndarray, bd: np.ndarray, c: np.ndarray, u: np.ndarray, x0: np.ndarray) -> np.ndarray:
    """Outputs (S, L, p) of all segments side by side."""
    x, y = x0, np.empty((*u.shape[:2], len(c)))
    for k in range(u.shape[1]):
        y[:, k] = x @ c.T
        x = x @ ad.T + u[:, k] @ bd.T
    return y


def _starts(ad: np.ndarray, c: np.ndarray, free: np.ndarray, steps: int) -> np.ndarray:
    """x0 (S, n) by least squares of the free response over the first `steps`, every output scaled to its own size."""
    scale = 1.0 / np.maximum(np.std(free, axis=(0, 1)), 1e-12)
    rows, power = [], np.eye(len(ad))
    for _ in range(steps):
        rows.append(scale[:, None] * (c @ power))
        power = ad @ power
    observed = (free[:, :steps] * scale).reshape(len(free), -1)
    x0, *_ = np.linalg.lstsq(np.vstack(rows), observed.T, rcond=None)
    return x0.T
