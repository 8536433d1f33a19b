"""Simulated fields: a dense catalogue with a gradient, and frames somewhere in it at any roll."""

from __future__ import annotations

import numpy as np

from bayesdist.data import ReferenceCatalog
from bayesdist.data.detections import Detections
from bayesdist.data.exposures import Exposure, ExposureLog

FRAME = (4096.0, 4146.0)  # two chips of 2048 rows, and a gap of 50 between them
GAP = (2048.5, 2098.5)
ZERO_POINT = 25.3


def positions(rng, n, side, gradient=1.2):
    """Places in a square, denser to the left, and magnitudes."""
    t = rng.uniform(0, 1, n)
    u = -np.log(1 - t * (1 - np.exp(-gradient))) / gradient if gradient else t
    mag = -6 - np.minimum(rng.exponential(1.5, n), 9.0)
    return np.column_stack([u, rng.uniform(0, 1, n)]) * side, mag


def distortion(p, size):
    """What a start may leave: quadratic and cubic, up to `size` at the edges."""
    q = (p - np.array(FRAME) / 2) / 2048
    return size * np.column_stack([q[:, 0] ** 2 - q[:, 0] * q[:, 1] ** 2,
                                   q[:, 1] ** 3 - 0.7 * q[:, 0] * q[:, 1]])  # fmt: skip


def frame(rng, uv, mag, roll, centre, *, junk=0.2, left=1.0, sigma=0.03, seen=0.85, scatter=0.3):
    """Positions, magnitudes and true rows (-1: junk) of what a frame shows; roll in radians."""
    c, s = np.cos(roll), np.sin(roll)
    d = uv - centre
    xy = np.column_stack([c * d[:, 0] + s * d[:, 1], -s * d[:, 0] + c * d[:, 1]])
    xy += np.array(FRAME) / 2
    inside = ((xy > 0.5) & (xy < FRAME)).all(axis=1) & ((xy[:, 1] < GAP[0]) | (xy[:, 1] > GAP[1]))
    rows = np.flatnonzero(inside & (rng.random(len(uv)) < seen))
    p = xy[rows]
    p = p + distortion(p, left) + rng.normal(0, sigma, p.shape)
    m = mag[rows] + rng.normal(0, scatter, len(rows)) + ZERO_POINT
    extra = int(junk * len(rows))
    y = np.where(rng.random(extra) < 0.5, rng.uniform(0.5, GAP[0], extra),
                 rng.uniform(GAP[1], FRAME[1], extra))  # fmt: skip
    false = np.column_stack([rng.uniform(0.5, FRAME[0], extra), y])
    order = rng.permutation(len(p) + extra)
    bright = rng.choice(m, extra) if len(m) else m
    return (
        np.concatenate([p, false])[order],
        np.concatenate([m, bright])[order],
        np.concatenate([rows, np.full(extra, -1)])[order],
    )


def start(x, y, chip, epoch):
    """Chip 1 lies above chip 2."""
    return np.column_stack([x, y + np.where(chip == 1, GAP[1], 0.0)])


def campaign(rng, n, *, stars=5000, side=6000.0, motion=0.01, **options):
    """Catalogue, lists, log, and the true rows of each list."""
    uv, mag = positions(rng, stars, side)
    pm = rng.normal(0, motion, (2, stars))
    catalog = ReferenceCatalog(
        u=uv[:, 0], v=uv[:, 1], mag=mag, pm_u=pm[0], pm_v=pm[1], epoch=2004.5,
        sigma_u=np.full(stars, 0.01), sigma_v=np.full(stars, 0.02),
        sigma_pm_u=np.full(stars, 0.003), sigma_pm_v=np.full(stars, 0.004),
        star=1000 + np.arange(stars), source="standard",
    )  # fmt: skip
    lists, log, truth, rolls = [], [], [], []
    for k in range(n):
        epoch = 2002.5 + 11.0 * k / max(n - 1, 1)
        roll = rng.uniform(0, 2 * np.pi)
        centre = side / 2 + rng.uniform(-400, 400, 2)
        p, m, rows = frame(rng, uv + pm.T * (epoch - 2004.5), mag, roll, centre, **options)
        chip = np.where(p[:, 1] > GAP[0], 1, 2)
        lists.append(
            Detections(
                p[:, 0],
                p[:, 1] - np.where(chip == 1, GAP[1], 0.0),
                exposure_names=(f"e{k}",),
                chip=chip,
                mag=m,
                source=f"e{k}.parquet",
            )
        )
        log.append(Exposure(f"e{k}", epoch, "F606W" if k % 2 else "F814W", vafactor=1 + 1e-5 * k))
        truth.append(rows)
        rolls.append(np.degrees(roll))
    return catalog, tuple(lists), ExposureLog(tuple(log)), truth, rolls
