"""The offset between two lists of positions, found by vote over the differences of all pairs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import poisson

__all__ = ["Vote", "mean_spacing", "vote_offset"]

Float = NDArray[np.float64]

_BRIGHT = 600  # stars of each list that vote when magnitudes are known
_PATCHES = (400, 100, 25)  # detections of a patch in the middle that vote when they are not
_PAIRS = 1_000_000  # differences of a patch at most
_SURE = -8.0  # log10 of chance at which no further vote is held
_WIDTHS = (1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2)  # of a bin, in mean distances between stars
_RING = 5  # half-width in bins of the surroundings that count chance pairs


@dataclass(frozen=True, eq=False)
class Vote:
    """Best supported offset."""

    offset: Float  # (2,), to be added to the first positions
    width: float  # of the bin that won
    count: int  # pairs in that bin
    expected: float  # pairs there by chance
    log10_chance: float  # of the probability that chance puts as many into any bin
    voters: Float  # (n, 2), positions that took part
    voted: Float  # (m, 2), reference positions that took part


def vote_offset(
    positions: Float,
    reference: Float,
    mag: Float | None,
    reference_mag: Float | None,
    max_offset: float | None,
) -> Vote:
    """Offset that brings the most positions (N, 2) onto reference positions (M, 2).

    With magnitudes the brightest of both lists vote first.  If that is not clear, detections of a
    patch in the middle vote with all reference stars near it: smaller patches with larger
    surroundings, until the surroundings are the whole catalogue.  The vote returned is the least
    likely by chance, also over several widths of bins, so that neither the errors nor a small
    rotation need be known.  `max_offset` is the largest on either axis.
    """
    best: Vote | None = None
    for a, b in _electorates(positions, reference, mag, reference_mag):
        d = (b[None, :, :] - a[:, None, :]).reshape(-1, 2)
        if max_offset is not None:
            d = d[(np.abs(d) <= max_offset).all(axis=1)]
        if not len(d):
            continue
        spacing = mean_spacing(b)
        for width in _WIDTHS:
            offset, count, expected, chance = _peak(d, width * spacing)
            if best is None or chance < best.log10_chance:
                best = Vote(offset, width * spacing, count, expected, chance, a, b)
        if best is not None and best.log10_chance < _SURE:
            break
    return best or Vote(np.zeros(2), 1.0, 0, 0.0, 0.0, positions[:0], reference[:0])


def _electorates(
    positions: Float, reference: Float, mag: Float | None, reference_mag: Float | None
) -> Iterator[tuple[Float, Float]]:
    """Pairs of lists that may vote, the most promising first."""
    if mag is not None and reference_mag is not None:
        yield (
            positions[np.argsort(mag, kind="stable")[:_BRIGHT]],
            reference[np.argsort(reference_mag, kind="stable")[:_BRIGHT]],
        )
    middle = np.median(positions, axis=0)
    inner = np.argsort(((positions - middle) ** 2).sum(axis=1))
    near = np.argsort(((reference - middle) ** 2).sum(axis=1))
    for size in _PATCHES:
        a, b = positions[inner[:size]], reference[near[: _PAIRS // size]]
        yield a, b
        if len(b) == len(reference):
            return
    yield a, reference


def mean_spacing(points: Float) -> float:
    """Distance between neighbours if the points (N, 2) were a square grid; positive."""
    extent = np.ptp(points, axis=0)
    area = float(np.prod(np.maximum(extent, extent.max() * 1e-3)))
    return float(np.sqrt(area / len(points))) or 1.0


def _peak(d: Float, width: float) -> tuple[Float, int, float, float]:
    """Fullest bin of a histogram: mean difference, number, number by chance, log10 probability.

    The histogram is never built: only filled bins are counted.
    """
    best: tuple[int, Float] = (0, np.zeros(2))
    n_bins = 1
    for shift in ((0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (0.5, 0.5)):  # a peak may lie on an edge
        cell = np.floor(d / width + shift).astype(np.int64)
        cell -= cell.min(axis=0)
        rows = int(cell[:, 1].max()) + 1
        key = cell[:, 0] * rows + cell[:, 1]
        unique, counts = np.unique(key, return_counts=True)
        n_bins = max(n_bins, len(unique))
        k = int(np.argmax(counts))
        if counts[k] > best[0]:
            best = (int(counts[k]), np.median(d[key == unique[k]], axis=0))
    offset = best[1]
    away = np.abs(d - offset).max(axis=1)
    count = max(int((away < width / 2).sum()), best[0])
    ring = int((away < (_RING + 0.5) * width).sum()) - int((away < 1.5 * width).sum())
    expected = max(ring, 1) / ((2 * _RING + 1) ** 2 - 9)
    # as many trials as bins in all four grids
    chance = poisson.logsf(count - 1, expected) / np.log(10) + np.log10(4.0 * n_bins)
    return offset, count, expected, float(chance)
