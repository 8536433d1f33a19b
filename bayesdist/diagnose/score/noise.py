"""Tests of the noise: is it described equally well in all parts of the data?

If a likelihood is correct, the mean square of its scores equals the mean curvature (information
identity).  Over all stars the ratio of their sums is one, or another constant if all errors are
wrong by the same factor.  The tests examine whether the ratio is the same in all parts of the data.
The scatter of a ratio is estimated from the squares themselves, whose distribution has longer tails
than that of Gaussian noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from bayesdist.diagnose.score.result import Family, Outcome, outcome, smallest_pattern
from bayesdist.diagnose.score.sample import ScoredSample
from bayesdist.diagnose.statistics import hotelling_p, squares_over
from bayesdist.model.grid import cell_index
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.distributions import chi2_sf

BY_POSITION = Family(
    "noise by position",
    "give errors that depend on position",
    "the noise differs from cell to cell",
    "the noise is described equally well from cell to cell",
    held_by="noise",
    explained_by="orders",
)
BY_MAGNITUDE = Family(
    "noise by magnitude",
    "give errors that depend on magnitude, as data.sigma = 'by_magnitude' does for matched stars, "
    "or finer ones if they already do",
    "the noise differs from bright to faint stars",
    "the noise is described equally well from bright to faint stars",
    held_by="noise",
)
BY_EXPOSURE = Family(
    "noise by exposure",
    "give each exposure its own errors, as outliers.jitter_by = 'exposure' does for matched stars, "
    "or leave out exposures",
    "the noise differs from exposure to exposure",
    "the noise is described equally well from exposure to exposure",
    held_by="noise",
)
BY_AXIS = Family(
    "noise by axis",
    "give separate errors sigma_u and sigma_v",
    "along the other axis, beside its errors",
    "the noise is described equally well along u and v",
    held_by="noise",
)
LARGEST_LEVERAGE = 0.5
STARS_PER_PART = 40  # minimum per part of the data; smaller parts are merged
STARS_PER_CELL = 60
STARS_PER_BIN = 150  # per bin of magnitude
MAX_CELLS = 8  # along each side of a chip
MAX_MAGNITUDES = 10


@dataclass(frozen=True, eq=False)
class _Squares:
    """Squared scores and curvatures of detections, in units of their errors."""

    # square, expected (2, N): along u and v
    square: Float
    expected: Float
    star: Int  # (N,)
    sigma: float  # typical standard deviation along an axis
    # degrees of freedom of the residuals divided by their number: the fit acts on all residuals
    # together and makes their squares scatter more than each shows by itself
    free: float
    unit: str

    @property
    def ratio(self) -> float:
        """Ratio of the sum of squares to the expected one."""
        return float(self.square.sum() / self.expected.sum())


def noise_tests(sample: ScoredSample) -> list[Outcome]:
    """Outcomes of the tests by position, magnitude, exposure and axis, as far as the data allow."""
    leverage = np.broadcast_to(sample.leverage, sample.score.shape)
    # residuals with a large leverage do not show their noise
    rows = np.flatnonzero(sample.used & (leverage.max(axis=0) < LARGEST_LEVERAGE))
    if len(rows) < STARS_PER_PART:
        return []
    variance = sample.variance[:, rows]
    square = sample.whole_score[:, rows] ** 2 * variance
    expected = sample.curvature[0::2, rows] * variance
    ratio = float(square.sum() / expected.sum())
    squares = _Squares(
        square,
        expected,
        np.unique(sample.star[rows], return_inverse=True)[1],
        float(np.sqrt(ratio * np.median(variance))),
        1.0 - float(leverage[:, rows].mean()),
        sample.model.unit,
    )
    parts = [(BY_POSITION, _cells(sample, rows))]
    if sample.mag is not None:
        n_stars = int(squares.star.max(initial=0)) + 1
        parts.append((BY_MAGNITUDE, _magnitudes(sample.mag[rows], n_stars)))
    parts.append((BY_EXPOSURE, sample.exposure[rows]))
    out = [_by_part(squares, family, code) for family, code in parts]
    return [result for result in (*out, _by_axis(squares)) if result is not None]


def _cells(sample: ScoredSample, rows: Int) -> Int:
    """Codes (n,) of coarse cells on each chip."""
    chip = sample.chip[rows]
    code = np.zeros(len(rows), np.int64)
    for c in np.unique(chip):
        on_chip = chip == c
        n = len(np.unique(sample.star[rows[on_chip]]))
        side = int(np.clip(np.sqrt(n / STARS_PER_CELL), 1, MAX_CELLS))
        at = rows[on_chip]
        iy, ix = np.divmod(cell_index(sample.X[at], sample.Y[at], (side, side)), side)
        # boustrophedon order, so that cells with few stars are merged with their neighbours
        code[on_chip] = c * MAX_CELLS**2 + iy * side + np.where(iy % 2, side - 1 - ix, ix)
    return code


def _magnitudes(mag: Float, n_stars: int) -> Int:
    """Codes (n,) of magnitude bins with equal numbers of detections."""
    n = int(np.clip(n_stars // STARS_PER_BIN, 1, MAX_MAGNITUDES))
    edges = np.quantile(mag, np.linspace(0, 1, n + 1)[1:-1])
    return np.searchsorted(np.unique(edges), mag)


def _joined(code: Int, star: Int) -> Int:
    """Codes, from 0, of parts merged with their successors until each has enough stars."""
    values, index = np.unique(code, return_inverse=True)
    pairs = np.unique(index * (int(star.max()) + 1) + star)
    count = np.bincount(pairs // (int(star.max()) + 1))
    out, total, part = np.zeros(len(values), np.int64), 0, 0
    for k, n in enumerate(count):
        out[k] = part
        total += n
        if total >= STARS_PER_PART:
            part, total = part + 1, 0
    if total:  # a remainder is merged with the part before it
        out[out == part] = max(part - 1, 0)
    return out[index]


def _by_part(squares: _Squares, family: Family, code: Int) -> Outcome | None:
    """Test for differences between parts of the data; None if there is only one part."""
    code = _joined(code, squares.star)
    m = int(code.max(initial=0)) + 1
    if m < 2:
        return None
    y, c = squares.square.mean(axis=0), squares.expected.mean(axis=0)
    expected = np.bincount(code, c)
    if (expected <= 0).any():
        return None
    ratio = np.bincount(code, y) / expected
    # detections of one star in one part are not independent and count once
    deviation = y - ratio[code] * c
    relative_variance = squares_over(squares.star, deviation, code, m) / (ratio * expected) ** 2
    n = np.bincount(code)
    pooled = float(relative_variance @ n**2) / n.sum() / n
    # the cube root of a mean of squares is nearly Gaussian (Wilson and Hilferty 1931)
    shape = squares.free / np.maximum(relative_variance, pooled)
    root = np.cbrt(ratio / squares.ratio) - 1.0 + 1.0 / (9.0 * shape)
    weight = 9.0 * shape
    root = root - np.average(root, weights=weight)
    T = float(weight @ root**2)
    # a change of the cube root of the variance is 2/3 of that of log(standard deviation)
    step = 1.5 * root * squares.sigma
    noise = float(np.average(0.25 / shape, weights=n)) * squares.sigma**2 * (m - 1) / m
    low, high = (
        squares.sigma * np.sqrt(extreme / squares.ratio) for extreme in (ratio.min(), ratio.max())
    )
    present = (
        f"{family.present}, from {low:.2g} to {high:.2g} {squares.unit} along an axis where errors "
        "are typical"
    )
    return outcome(
        replace(family, present=present),
        T,
        m - 1,
        None,
        float(chi2_sf(T, m - 1)),
        square=float(np.average(step**2, weights=n)),
        noise=noise,
        unit=squares.unit,
    )


def _by_axis(squares: _Squares) -> Outcome | None:
    """Test of the noise along u against that along v, by star."""
    ratio = squares.ratio
    deviation = squares.square - ratio * squares.expected
    d = np.bincount(squares.star, deviation[0] - deviation[1])
    n = len(d)
    if n < STARS_PER_PART:
        return None
    T = squares.free * float(d.sum() ** 2 / (d**2).sum())
    of_each = squares.square.sum(axis=1) / squares.expected.sum(axis=1)
    scale = np.sqrt(of_each / ratio)
    # standard deviations differ by half as much as variances, and each from the mean by half of
    # that
    noise = (
        squares.sigma
        * float(np.sqrt((d**2).sum() / squares.free))
        / (2 * ratio * squares.expected.sum())
    )
    larger = "u" if scale[0] > scale[1] else "v"
    return outcome(
        replace(BY_AXIS, present=f"the noise along {larger} is larger than {BY_AXIS.present}"),
        T,
        1,
        float(n - 1),
        hotelling_p(T, 1, n),
        square=(squares.sigma * float(scale[0] - scale[1]) / 2) ** 2,
        noise=noise**2,
        unit=squares.unit,
        smallest=partial(smallest_pattern, noise, 1, None),
    )
