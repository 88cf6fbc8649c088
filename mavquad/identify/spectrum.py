"""Frequency responses from records flown in closed loop: local polynomial method, and Welch for comparison.

Source: Song et al. 2011 (paper 004), Eqs. (7)-(13); local polynomial method after Schoukens et al.

Deviations from the paper:
  Eqs. (10), (11)  densities carry Ts^2 and the window's power; this cancels in Eq. (12).
  Eq. (12)  H = G_yr G_ur^-1 from the injected excitation r, several inputs at once (joint input-output): G_uy/G_uu is biased
            when feedback makes u depend on the noise, and an unstable vehicle is always swept in closed loop.
  LPM       the response is a cubic of frequency where that leaves half of the bins free, the leakage a quadratic: with quadratics
            for both, as usual, the lightly damped closed loop of a helicopter bends more than they follow, which costs 4 % of u at
            0.8 rad/s, always to the same side.
  Eq. (13)  the coherence is the one equivalent to the estimated standard deviation, 1/(1 + dof sd^2).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mavquad.errors import LogError

SHORTEST_S = 20.0


class Record(NamedTuple):
    """One uninterrupted record on one clock, sampled every `dt_s`."""

    dt_s: float
    r: np.ndarray  # (N, m) injected excitation, exactly known
    u: np.ndarray  # (N, m) input as applied, after saturation
    y: np.ndarray  # (N, p) outputs


class Response(NamedTuple):
    """A measured frequency response of the sampled system, with its spread."""

    dt_s: float
    omega_rad_s: np.ndarray  # (K,)
    h: np.ndarray  # (K, p, m) complex
    sd: np.ndarray  # (K, p, m) standard deviation of the real and of the imaginary part, relative to |h|
    coherence: np.ndarray  # (K, p, m) equivalent coherence, 0..1
    covariance: np.ndarray | None = None  # (K, p, m, K, p, m) complex, of log h: neighbours share bins, outputs share the gust


def checked(records: Sequence[Record], limit: float = 1.0) -> list[str]:
    """Refuse records that cannot be used; return the warnings about the rest. Raises LogError."""
    if not records:
        raise LogError("no record to identify from: expected at least one sweep per input; record a sweep (mavquad fly sweep)")
    notes = []
    for i, record in enumerate(records):
        if record.dt_s != records[0].dt_s:
            raise LogError(f"record {i}: sampled every {record.dt_s:g} s, record 0 every {records[0].dt_s:g} s; use one rate")
        if not (len(record.r) == len(record.u) == len(record.y)):
            raise LogError(
                f"record {i}: r, u, y have {len(record.r)}, {len(record.u)}, {len(record.y)} samples; expected equal"
            )
        for name, column in (("r", record.r), ("u", record.u), ("y", record.y)):
            bad = int(np.count_nonzero(~np.isfinite(column)))
            if bad:
                raise LogError(f"record {i}: {bad} values of {name} are not finite; cut the record there")
        if len(record.r) * record.dt_s < SHORTEST_S:
            raise LogError(
                f"record {i}: {len(record.r) * record.dt_s:.1f} s long, needs {SHORTEST_S:g} s; record a longer sweep"
            )
        if np.all(np.ptp(record.r, axis=0) == 0.0):
            raise LogError(f"record {i}: the excitation never moves; inject a sweep")
        saturated = float(np.mean(np.abs(record.u) >= limit, axis=0).max())
        if saturated > 0.01:
            notes.append(
                f"record {i}: an input stands at its limit for {100 * saturated:.1f} % of the samples (warned above 1 %)"
            )
    return notes


def log_grid(lo_rad_s: float, hi_rad_s: float, count: int = 40) -> np.ndarray:
    """`count` frequencies (rad/s), evenly spaced in the logarithm."""
    return np.geomspace(lo_rad_s, hi_rad_s, count)


def lpm(records: Sequence[Record], omega_rad_s: np.ndarray) -> Response:
    """Local polynomial method: around each bin the response is a cubic of frequency, the leakage of every record a quadratic.

    The frequencies come back as the nearest bins of the first record. Raises LogError where the records cannot tell the inputs
    apart.
    """
    checked(records)
    dt_s = records[0].dt_s
    spectra = [_dft(record) for record in records]
    bin_rad_s = spectra[0][0][0]
    k0s = np.unique(np.maximum(np.rint(np.asarray(omega_rad_s) / bin_rad_s).astype(int), 1))
    widest = max(w[0] for w, _, _ in spectra)  # the coarsest bins set the width of the window
    centres, parts = [], []
    for k0 in k0s:
        centre = k0 * bin_rad_s
        half = max(5.0, 0.1 * centre / widest) * widest
        parts.append(_local(spectra, centre, half))
        centres.append(centre)
    return _assemble(dt_s, np.array(centres), parts, records[0].u.shape[1])


def welch(
    records: Sequence[Record], omega_rad_s: np.ndarray, windows_s: Sequence[float], *, overlap: float = 0.8, joint: bool = True
) -> Response:
    """Welch estimate at the given frequencies: Hann windows of several lengths, combined by inverse variance.

    `joint=False` takes the applied input for the excitation, Eq. (12) as printed. A window serves only above two of its periods.
    """
    checked(records)
    omega = np.asarray(omega_rad_s, dtype=float)
    dt_s = records[0].dt_s
    shape = (omega.size, records[0].y.shape[1], records[0].u.shape[1])
    total = np.zeros(shape, dtype=complex)
    weight = np.zeros(shape)
    miss = np.ones(shape)
    for window_s in windows_s:
        usable = np.flatnonzero(omega >= 4.0 * np.pi / window_s * (1.0 - 1e-9))
        if usable.size == 0:
            continue
        one = _welch_one(records, omega[usable], window_s, overlap, joint)
        w = 1.0 / np.maximum(one.sd * np.abs(one.h), 1e-300) ** 2
        total[usable] += w * one.h
        weight[usable] += w
        miss[usable] = np.minimum(miss[usable], 1.0 - one.coherence)
    used = np.flatnonzero(weight[:, 0, 0] > 0.0)
    if used.size == 0:
        raise LogError(
            f"Welch: no frequency lies above two periods of the longest window ({max(windows_s):g} s); use longer ones"
        )
    h = total[used] / weight[used]
    return Response(dt_s, omega[used], h, 1.0 / (np.sqrt(weight[used]) * np.abs(h)), 1.0 - miss[used])


def ordinary_coherence(x: np.ndarray, y: np.ndarray, dt_s: float, window_s: float = 10.0) -> tuple[np.ndarray, np.ndarray]:
    """Eq. (13) for one pair, (N,) each: frequencies (Hz) and coherence from Hann segments of `window_s`, overlapped by 3/4."""
    count = round(window_s / dt_s)
    if len(x) < 2 * count:
        raise LogError(f"coherence needs two segments of {window_s:g} s, got {len(x) * dt_s:.1f} s")
    from scipy import signal  # half a second to import: only where spectra are wanted

    f_hz, g2 = signal.coherence(x - np.mean(x), y - np.mean(y), fs=1.0 / dt_s, nperseg=count, noverlap=3 * count // 4)
    return f_hz, g2


def _dft(record: Record) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frequencies of the bins above DC, and the transforms of r and of [u y] there."""
    omega = 2.0 * np.pi * np.fft.rfftfreq(len(record.r), record.dt_s)[1:]
    z = np.hstack([record.u, record.y])
    return omega, np.fft.rfft(record.r, axis=0)[1:], np.fft.rfft(z, axis=0)[1:]


class _Part(NamedTuple):
    g: np.ndarray  # (m + p, m) response of [u; y] to r
    cov: np.ndarray  # (m, m) of the regressors
    s: np.ndarray  # (m + p, m + p) residual covariance
    dof: float
    share: np.ndarray | None = None  # (m, bins of all records) what every bin gives to g


def _local(spectra: list[tuple[np.ndarray, np.ndarray, np.ndarray]], centre: float, half: float) -> _Part:
    m = spectra[0][1].shape[1]
    rows, wanted, places, first = [], [], [], 0
    for i, (omega, r, z) in enumerate(spectra):
        inside = np.flatnonzero(np.abs(omega - centre) <= half * (1.0 + 1e-9))
        places.append(first + inside)
        first += omega.size
        s = ((omega[inside] - centre) / half)[:, None]
        transient = np.zeros((inside.size, 3 * len(spectra)))
        transient[:, 3 * i : 3 * i + 3] = s ** np.arange(3)
        rows.append(np.hstack([*(s**power * r[inside] for power in range(4)), transient]))
        wanted.append(z[inside])
    phi, target = np.vstack(rows), np.vstack(wanted)
    if phi.shape[0] < 2 * phi.shape[1]:
        phi = np.delete(phi, np.s_[3 * m : 4 * m], axis=1)
    dof = phi.shape[0] - phi.shape[1]
    scale = np.linalg.norm(phi, axis=0)
    if np.any(scale == 0.0) or dof < 1:
        raise LogError(
            f"at {centre:.2f} rad/s: {phi.shape[0]} bins for {phi.shape[1]} unknowns; longer records or more of them are needed"
        )
    q, upper = np.linalg.qr(phi / scale)
    diagonal = np.abs(np.diag(upper))
    if diagonal.min() < 1e-10 * diagonal.max():
        raise LogError(f"at {centre:.2f} rad/s the records cannot tell the {m} inputs apart: off-axis excitation is missing")
    theta = np.linalg.solve(upper, q.conj().T @ target)
    residual = target - (phi / scale) @ theta
    inverse = (np.linalg.inv(upper) / scale[:, None])[:m]
    g = (theta / scale[:, None])[:m].T
    share = np.zeros((m, first), dtype=complex)
    share[:, np.concatenate(places)] = inverse @ q.conj().T
    return _Part(g, inverse @ inverse.conj().T, residual.T @ residual.conj() / dof, float(dof), share)


def _welch_one(records: Sequence[Record], omega: np.ndarray, window_s: float, overlap: float, joint: bool) -> Response:
    dt_s = records[0].dt_s
    count = round(window_s / dt_s)
    step = max(1, round(count * (1.0 - overlap)))
    taper = np.hanning(count + 1)[:count]
    basis = np.exp(-1j * np.outer(omega, np.arange(count) * dt_s))  # direct DFT at the frequencies wanted
    m, p = records[0].u.shape[1], records[0].y.shape[1]
    grr = np.zeros((omega.size, m, m), dtype=complex)
    gzr = np.zeros((omega.size, m + p, m), dtype=complex)
    gzz = np.zeros((omega.size, m + p, m + p), dtype=complex)
    segments, span = 0, 0.0
    for record in records:
        z = np.hstack([record.u, record.y])
        excitation = record.r if joint else record.u
        span += len(z) * dt_s
        for start in range(0, len(z) - count + 1, step):
            part, ref = z[start : start + count], excitation[start : start + count]
            zf = basis @ (taper[:, None] * (part - part.mean(axis=0)))
            rf = basis @ (taper[:, None] * (ref - ref.mean(axis=0)))
            grr += rf[:, :, None] * rf[:, None, :].conj()
            gzr += zf[:, :, None] * rf[:, None, :].conj()
            gzz += zf[:, :, None] * zf[:, None, :].conj()
            segments += 1
    if segments == 0:
        raise LogError(f"Welch: no record holds a window of {window_s:g} s; record longer or use shorter windows")
    # Hann segments overlapped by 3/4 or more are worth about two independent ones per window length
    effective = min(float(segments), max(1.0, 2.0 * span / window_s))
    parts = []
    for k in range(omega.size):
        inverse = np.linalg.pinv(grr[k])
        g = gzr[k] @ inverse
        s = (gzz[k] - g @ gzr[k].conj().T) / segments * effective / max(effective - m, 1.0)
        parts.append(_Part(g, inverse.T * segments / effective, s, max(effective - m, 1.0)))
    return _assemble(dt_s, omega, parts, m)


def _assemble(dt_s: float, omega: np.ndarray, parts: list[_Part], m: int) -> Response:
    """H = G_y G_u^-1 and its spread: sd^2 = t S t^H [G_u^-T Cov G_u^-*]_jj / 2 with t = (-H_i, e_i)."""
    p = parts[0].g.shape[0] - m
    h = np.empty((omega.size, p, m), dtype=complex)
    sd = np.empty((omega.size, p, m))
    g2 = np.empty((omega.size, p, m))
    bins, noises = [], []
    for k, part in enumerate(parts):
        g_u, g_y = part.g[:m], part.g[m:]
        if np.linalg.cond(g_u) > 1e8:
            raise LogError(f"at {omega[k]:.2f} rad/s the applied inputs move as one: off-axis excitation is missing")
        back = np.linalg.inv(g_u)
        h[k] = g_y @ back
        spread = np.real(np.diag(back.T @ part.cov @ back.conj()))
        left = np.hstack([-h[k], np.eye(p)])  # (p, m + p): what is left of [u; y] for each output
        noise = np.maximum(np.real(np.diag(left @ part.s @ left.conj().T)), 0.0)
        sd[k] = np.sqrt(np.outer(noise, spread) / 2.0) / np.maximum(np.abs(h[k]), 1e-300)
        g2[k] = 1.0 / (1.0 + part.dof * sd[k] ** 2)
        if part.share is not None:
            bins.append(back.T @ part.share)
            noises.append(left @ _root(part.s))
    covariance = _covariance(h, np.array(bins), np.array(noises)) if bins else None
    return Response(dt_s, omega, h, sd, g2, covariance)


def _covariance(h: np.ndarray, bins: np.ndarray, noises: np.ndarray) -> np.ndarray:
    """(K, p, m, K, p, m) of log h, from what every bin gives, (K, m, bins), and what noise is on it, (K, p, m + p)."""
    k, m, _ = bins.shape
    p = noises.shape[1]
    flat, loud = bins.reshape(k * m, -1), noises.reshape(k * p, -1)
    by_bins = (flat @ flat.conj().T).reshape(k, 1, m, k, 1, m)
    by_noise = (loud @ loud.conj().T).reshape(k, p, 1, k, p, 1)
    one = 1.0 / np.where(np.abs(h) > 0.0, h, np.inf)
    return by_bins * by_noise * one[..., None, None, None] * one.conj()[None, None, None]


def _root(s: np.ndarray) -> np.ndarray:
    """The Hermitian square root: roots of covariances that are alike are alike too, as those by Cholesky or eigenvectors are not."""
    size, axes = np.linalg.eigh(s)
    return (axes * np.sqrt(np.maximum(size, 0.0))) @ axes.conj().T
