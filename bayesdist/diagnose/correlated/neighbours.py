"""Products of the scores of neighbouring stars: fine structure, and fields of single exposures.

For stars with independent errors, scores g and curvatures h, a displacement with the covariance
C(d) at the separation d gives

    sum g_i g_j = C(d) sum h_i h_j

on average over pairs i, j.

**Structure finer than the functions.**  For the functions that the stars can resolve, a pattern of
a few tens of pixels is hardly different from white noise, but neighbouring stars share it.  The
part that the functions resolve is subtracted from the scores first.  With its posterior mean f and
covariance S at the stars,

    C(d) sum h_i h_j = sum [(g_i - h_i f_i) (g_j - h_j f_j) + h_i h_j S_ij]

so that C is the covariance of the finer structure.  Remainders of smoother structure are the same
for pairs at slightly larger separations; only the difference to these is used.

**Fields of single exposures.**  A field that differs between exposures (atmosphere, changing focus)
displaces neighbours in one exposure together, and neighbours in different exposures independently.
A pattern of the detector affects both alike.  The difference of the ratios sum g_i g_j / sum h_i
h_j within and across exposures is therefore the covariance of a field of single exposures.  Terms
up to second order of each exposure are subtracted first, because they have separate tests and error
terms.  Products are summed over the cells of a grid by Fourier transforms, so that the time grows
with the number of stars rather than of pairs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import j0

from bayesdist.data.matches import Matches
from bayesdist.diagnose.correlated.information import scores_on_chips
from bayesdist.diagnose.correlated.priors import legendre_products
from bayesdist.infer.stars.likelihood import Likelihood
from bayesdist.infer.stars.stars import prepare
from bayesdist.model import DistortionModel
from bayesdist.model.basis import polynomial_terms
from bayesdist.model.grid import cell_index
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.random import matern

# of separations, in pixels; the last bin contains the pairs used for comparison
EDGES = np.array([0.0, 6.0, 12.0, 24.0, 48.0, 96.0])
MAX_PAIRS = 2_000_000
SHAPE = 0.3  # relative tolerance of the correlation at a separation, because patterns are periodic
# number of pairs over which the uncertainty of the resolved structure is averaged
MAX_COMPARED = 20_000
MIN_PAIRS = 50  # per bin; with fewer, the variance cannot be estimated
NODES, WEIGHTS = np.polynomial.legendre.leggauss(64)
SIDE = 32  # cells along the longer side of a chip
SECOND_ORDER = 2  # highest total order of the terms that are subtracted from each exposure
# of separations, in longer half sides of a chip
SEPARATION_EDGES = np.array([0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.65, 0.8])
LENGTHS = np.geomspace(0.06, 0.6, 6)  # correlation lengths that are tried, in longer half sides
MIN_STARS = 24  # per exposure and chip


@dataclass(frozen=True, eq=False)
class SharedVariance:
    """Covariance of displacements of neighbouring stars, on one axis of a chip."""

    separation: Float  # (b,) mean of each bin, in longer half sides of the chip
    apart: float  # mean separation of the pairs used for comparison
    # (b,) in excess of that of the comparison pairs, in the squared unit of u and v
    covariance: Float
    variance: Float  # (b,) variance of the covariance, from the scatter of the products
    bins: Int  # (b,) index of each bin in `EDGES`

    def raised(self, by: Float) -> SharedVariance:
        """Evidence with the covariances `by` in all bins of `EDGES` added."""
        return replace(self, covariance=self.covariance + by[self.bins] - by[-1])

    def of_field(self, length: float, cut: float = 0.0) -> Callable[[float], float]:
        """Log-likelihood of a Matern field as a function of its amplitude.

        `length` is the correlation length in half sides.  Only the part of the field at angular
        frequencies above `cut` (inverse half sides) is considered.
        """
        separation = np.append(self.separation, self.apart)
        at = matern(separation / length) - _below(cut, length, separation)
        at_unit = at[:-1] - at[-1]
        # The correlation of a pattern may differ from that of the field by SHAPE of its variance.
        # The tolerance does not grow beyond the most likely size: otherwise its growth alone would
        # favour smaller amplitudes.
        weight = at_unit / self.variance
        likely = max(float(weight @ self.covariance / max(weight @ at_unit, 1e-300)), 0.0)
        finer = float((1 + cut**2 * length**2 / 3) ** -1.5)

        def log_likelihood(amplitude: float) -> float:
            deviation = self.covariance - at_unit * amplitude**2
            tolerance = SHAPE * finer * min(amplitude**2, likely)
            variance = self.variance + tolerance**2
            return float(-0.5 * np.sum(deviation**2 / variance + np.log(variance / self.variance)))

        return log_likelihood


def _below(cut: float, length: float, separation: Float) -> Float:
    """Covariance, at given separations, of a unit-variance field at frequencies below `cut`.

    This is the integral of J0(k d) over the spectral density of the Matern field in two dimensions.
    """
    k, weight = (NODES + 1) * cut / 2, WEIGHTS * cut / 2
    k2 = 3 / length**2
    density = 3 * k * k2**1.5 * (k2 + k**2) ** -2.5
    return np.asarray(j0(np.outer(separation, k)) @ (weight * density))


def shared_variances(
    table: Matches, likelihood: Likelihood, model: DistortionModel
) -> dict[int, tuple[SharedVariance | None, SharedVariance | None]]:
    """Evidence of neighbouring stars on both axes of each chip, by the code of the chip.

    Nothing is subtracted from the scores.  The matches are those of the solution with this
    likelihood, or a part of them.  Pairs of matches of one star, or of stars in a tight group, are
    excluded because they share an error of the reference position.  The evidence is None for an
    axis with too few pairs.
    """
    return {
        code: chip.shared_variances()
        for code, chip in neighbour_scores(table, likelihood, model).items()
    }


@dataclass(frozen=True, eq=False)
class NeighbourScores:
    """Stars of one chip, with their scores along the axes of the polynomials."""

    X: Float  # X, Y (n,): scaled positions
    Y: Float
    score: Float  # (n, 2) gradient of the log-likelihood
    curvature: Float  # (n, 2, 2) minus its second derivatives
    # (n,) code of the star, or tight group of stars, that shares an error of the reference, from 0
    star: Int
    pairs: Int  # (p, 2) indices of neighbours that are different stars
    separation: Float  # (p,) in pixels
    half: float  # longer half side of the chip, in pixels

    def shared_variances(
        self, resolved: Float | None = None
    ) -> tuple[SharedVariance | None, SharedVariance | None]:
        """Evidence on both axes.

        `resolved` (draws, n, 2) are draws of the structure that the functions resolve.
        """
        single = len(self.star) == self.star.max(initial=-1) + 1
        of_stars = None if single else self.star[self.pairs]
        score, bins = self.score, _bins(self.separation)
        if resolved is not None:
            score = score - np.einsum("nab,nb->na", self.curvature, resolved.mean(axis=0))
        out = []
        for a in (0, 1):
            h = self.curvature[:, a, a]
            shared = _shared(score[:, a], h, self.pairs, self.separation, self.half, of_stars, bins)
            if shared is not None and resolved is not None:
                shared = shared.raised(self._uncertain(resolved[..., a], h, bins))
            out.append(shared)
        return out[0], out[1]

    def _uncertain(self, resolved: Float, h: Float, bins: Int) -> Float:
        """Mean covariance per bin of the resolved structure's uncertainty, from draws (d, n)."""
        selected = slice(None, None, max(1, len(self.pairs) // MAX_COMPARED))
        i, j = self.pairs[selected].T
        # divided by the number of draws, because the subtracted mean is that of the same draws
        deviation = (resolved - resolved.mean(axis=0)).T
        weight = h[i] * h[j]
        product = np.einsum("pd,pd->p", deviation[i], deviation[j]) / len(resolved)
        n = len(EDGES) - 1
        total, sums = (np.bincount(bins[selected], w, n) for w in (weight, weight * product))
        return np.asarray(sums / np.maximum(total, 1e-300))


def neighbour_scores(
    table: Matches, likelihood: Likelihood, model: DistortionModel
) -> dict[int, NeighbourScores]:
    """Scores of neighbouring stars of each chip, by its code.

    For the arguments see `shared_variances`.
    """
    stars, order = prepare(model, table)
    code = np.arange(len(order)) if table.error_codes is None else table.error_codes[order]
    g, h, chip = scores_on_chips(model, stars, likelihood)
    out = {}
    for c, model_chip in enumerate(model.chips):
        members = np.flatnonzero(chip == c)
        expected = (
            len(members) ** 2
            * np.pi
            * EDGES[-1] ** 2
            / (2 * model_chip.size[0] * model_chip.size[1])
        )
        members = members[:: max(1, round(float(np.sqrt(expected / MAX_PAIRS))))]
        at = (
            np.column_stack(
                [stars.X[members] * model_chip.size[0], stars.Y[members] * model_chip.size[1]]
            )
            / 2
        )
        pairs = cKDTree(at).query_pairs(EDGES[-1], output_type="ndarray")
        star = np.unique(code[members], return_inverse=True)[1]
        pairs = pairs[star[pairs[:, 0]] != star[pairs[:, 1]]]
        separation = np.linalg.norm(at[pairs[:, 0]] - at[pairs[:, 1]], axis=1)
        half = max(model_chip.size) / 2
        X, Y = stars.X[members], stars.Y[members]
        out[c] = NeighbourScores(X, Y, g[members], h[members], star, pairs, separation, half)
    return out


def _bins(separation: Float) -> Int:
    """Index of the bin of each separation."""
    return np.clip(np.searchsorted(EDGES, separation, side="right") - 1, 0, len(EDGES) - 2)


def _shared(
    g: Float,
    h: Float,
    pairs: Int,
    separation: Float,
    half: float,
    stars: Int | None,
    bins: Int,
) -> SharedVariance | None:
    """Excess covariance from pairs (p, 2) of detections, in bins (p,) of their separations.

    `stars` (p, 2) are the stars of the detections, or None if each star has one detection: several
    pairs of detections of the same two stars repeat one product of their errors.
    """
    i, j = pairs.T
    product, weight = g[i] * g[j], h[i] * h[j]
    if stars is not None and len(stars):
        first, second = np.sort(stars, axis=1).T
        keys = (first * (int(stars.max()) + 1) + second) * len(EDGES) + bins
        keys, of = np.unique(keys, return_inverse=True)
        bins = keys % len(EDGES)
        separation = np.bincount(of, separation) / np.bincount(of)
        product, weight = np.bincount(of, product), np.bincount(of, weight)
    count, total, together, distance = (
        np.bincount(bins, w, minlength=len(EDGES) - 1).astype(float)
        for w in (None, weight, product, separation)
    )
    # without informative pairs no comparison is possible
    if count[-1] < MIN_PAIRS or not (total > 0).all():
        return None
    mean = together / np.maximum(total, 1e-300)
    scatter = np.bincount(bins, (product - mean[bins] * weight) ** 2, minlength=len(count))
    variance = scatter / np.maximum(total, 1e-300) ** 2
    filled = np.flatnonzero(count[:-1] >= MIN_PAIRS)
    if not filled.size:
        return None
    distance = distance / np.maximum(count, 1) / half
    return SharedVariance(
        distance[filled],
        float(distance[-1]),
        mean[filled] - mean[-1],
        variance[filled] + variance[-1],
        filled,
    )


@dataclass(frozen=True, eq=False)
class ExposureScores:
    """Detections with their scores along the axes of the polynomials."""

    # X, Y (N,): scaled positions on the chip
    X: Float
    Y: Float
    gradient: Float  # (N, 2) of the log-likelihood
    curvature: Float  # (N, 2) minus its second derivatives along each axis
    # chip, exposure, star (N,): codes
    chip: Int
    exposure: Int
    star: Int


@dataclass(frozen=True, eq=False)
class ExposureProducts:
    """Covariance of displacements within exposures on a chip, minus that across exposures."""

    size: tuple[float, float]  # numbers of columns and rows of the chip
    covariance: Float  # (b,) in the squared unit of u and v, both axes together
    variance: Float  # (b,) variance of the covariance, from the scatter of the products
    bins: Int  # (b,) indices of the bins of `SEPARATION_EDGES` with enough pairs
    n_fields: float  # effective number of exposures, times two axes

    def expected(self, length: float) -> Float:
        """Covariance (b,) of a field of unit variance.

        `length` is its correlation length in half sides.
        """
        return _expected(self.size, length)[self.bins]

    def amplitude(self, length: float) -> tuple[float, float]:
        """Best-fitting variance of a field of this length, and its standard error without one."""
        expected = self.expected(length)
        weight = float(np.sum(expected**2 / self.variance))
        return float(np.sum(expected * self.covariance / self.variance)) / weight, weight**-0.5


def exposure_products(
    scores: ExposureScores, sizes: Iterable[tuple[float, float]]
) -> dict[int, ExposureProducts]:
    """Products of neighbours on each chip, by its code; chips with too few pairs are left out.

    `sizes` are the numbers of columns and rows of all chips.
    """
    good = (scores.curvature > 0).all(axis=1)
    out = {}
    for code, size in enumerate(sizes):
        rows = np.flatnonzero(good & (scores.chip == code))
        products = _of_chip(scores, rows, size)
        if products is not None:
            out[code] = products
    return out


def _of_chip(
    scores: ExposureScores, rows: Int, size: tuple[float, float]
) -> ExposureProducts | None:
    """Products on one chip; None if fewer than two exposures have enough stars."""
    if not rows.size:
        return None
    rows = rows[np.bincount(scores.exposure[rows])[scores.exposure[rows]] >= MIN_STARS]
    exposures, of = np.unique(scores.exposure[rows], return_inverse=True)
    if len(exposures) < 2:
        return None
    cells = _cells(size)
    at = cell_index(scores.X[rows], scores.Y[rows], cells)
    h = scores.curvature[rows]
    within, across = np.zeros((2, 4, len(SEPARATION_EDGES) - 1))
    residual = np.empty_like(h)
    for axis in (0, 1):
        g, followed = _without_low_orders(
            scores.X[rows], scores.Y[rows], scores.gradient[rows, axis], h[:, axis], of
        )
        residual[:, axis] = g
        # variance of the scores relative to their curvature
        ratio = float(np.sum(g**2) / max(h[:, axis].sum() - np.sum(followed**2), 1e-300))
        columns = np.column_stack([g, h[:, axis], g**2, np.ones(len(g)), np.sqrt(ratio) * followed])
        grids = _transformed(columns, of, at, len(exposures), cells)
        power = np.sum(np.abs(grids) ** 2, axis=0)
        pairs = _over_pairs(power, (columns**2).sum(axis=0), cells)
        # products within an exposure lack the part that the subtracted terms have absorbed
        pairs[0] += pairs[4:].sum(axis=0)
        within += pairs[:4]
        total = np.abs(grids[:, :4].sum(axis=0)) ** 2 - power[:4]
        across += _over_pairs(total, np.zeros(4), cells)
    across -= _same_stars(scores, rows, residual, size)
    return _excess(within, across, size, np.bincount(of).astype(float))


def _excess(
    within: Float, across: Float, size: tuple[float, float], number: Float
) -> ExposureProducts | None:
    """Products from sums (4, bins) over pairs; `number` (E,) counts the stars per exposure."""
    bins = np.flatnonzero((within[3] >= MIN_PAIRS) & (across[3] >= MIN_PAIRS))
    if not bins.size:
        return None
    (product, weight, squares, _), (other_product, other_weight, other_squares, _) = (
        sums[:, bins] for sums in (within, across)
    )
    return ExposureProducts(
        size,
        product / weight - other_product / other_weight,
        squares / weight**2 + np.maximum(other_squares, 0.0) / other_weight**2,
        bins,
        2.0 * float((number**2).sum() ** 2 / (number**4).sum()),
    )


def _cells(size: tuple[float, float]) -> tuple[int, int]:
    """Numbers of nearly square cells along columns and rows."""
    nx, ny = (max(1, round(SIDE * side / max(size))) for side in size)
    return nx, ny


def _without_low_orders(
    X: Float, Y: Float, g: Float, h: Float, exposure: Int
) -> tuple[Float, Float]:
    """Scores (N,) with terms up to second order of each exposure subtracted.

    The products of the rows of the second result (N, 6) are the covariance of the scores that is
    lost by this, if errors are as quoted.
    """
    phi = legendre_products(X, Y, polynomial_terms(SECOND_ORDER))
    remainder, followed = np.empty_like(g), np.empty_like(phi)
    order = np.argsort(exposure, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(exposure[order])) + 1):
        weighted = h[rows, None] * phi[rows]
        values, vectors = np.linalg.eigh(phi[rows].T @ weighted)
        root = vectors / np.sqrt(np.maximum(values, 1e-9 * values[-1]))
        followed[rows] = weighted @ root
        remainder[rows] = g[rows] - followed[rows] @ (root.T @ (phi[rows].T @ g[rows]))
    return remainder, followed


def _transformed(
    columns: Float, exposure: Int, cell: Int, n_exposures: int, cells: tuple[int, int]
) -> NDArray[np.complexfloating]:
    """Fourier transforms (E, columns, ...) of sums over the cells of each exposure."""
    nx, ny = cells
    at = exposure * (nx * ny) + cell
    grids = np.stack(
        [np.bincount(at, column, n_exposures * nx * ny) for column in columns.T], axis=1
    )
    grids = np.moveaxis(grids.reshape(n_exposures, ny, nx, -1), -1, 1)
    return np.asarray(scipy.fft.rfft2(grids, s=(2 * ny, 2 * nx)))


def _over_pairs(power: Float, own: Float, cells: tuple[int, int]) -> Float:
    """Sums (columns, bins) of products over pairs, from their power spectra (columns, ...).

    `own` (columns,) are the products of detections with themselves, which are excluded.
    """
    nx, ny = cells
    lags = scipy.fft.irfft2(power, s=(2 * ny, 2 * nx))
    lags[:, 0, 0] -= own
    return _binned(lags, cells) / 2


@lru_cache(maxsize=8)
def _separations(cells: tuple[int, int]) -> tuple[Float, Int]:
    """Separations (2 ny, 2 nx) of cells by lag, in longer half sides, and their bins.

    Random positions in cells of width w add sqrt(w^2 / 3) in quadrature to the separation of the
    cells.
    """
    width = 2.0 / max(cells)
    x, y = (np.minimum(np.arange(2 * n), 2 * n - np.arange(2 * n)) * width for n in cells)
    separation = np.sqrt(x**2 + y[:, None] ** 2 + width**2 / 3)
    return separation, np.searchsorted(SEPARATION_EDGES, separation, side="right") - 1


def _binned(lags: Float, cells: tuple[int, int]) -> Float:
    """Sums (n, bins) over lags (n, 2 ny, 2 nx)."""
    bins = _separations(cells)[1].ravel()
    n = len(SEPARATION_EDGES) - 1
    return np.stack([np.bincount(bins, lag.ravel(), n + 1)[:n] for lag in lags])


def _same_stars(scores: ExposureScores, rows: Int, g: Float, size: tuple[float, float]) -> Float:
    """Sums (4, bins) over pairs of detections of one star, which share a catalogue error."""
    out = np.zeros((4, len(SEPARATION_EDGES) - 1))
    order = np.argsort(scores.star[rows], kind="stable")
    star, h = scores.star[rows][order], scores.curvature[rows][order]
    g = g[order]
    half = np.array(size) / max(size)
    place = np.column_stack([scores.X[rows], scores.Y[rows]])[order] * half
    n = len(SEPARATION_EDGES) - 1
    for step in range(1, len(star)):
        pairs = np.flatnonzero(star[step:] == star[:-step])
        if not pairs.size:
            break
        i, j = pairs, pairs + step
        bins = (
            np.searchsorted(SEPARATION_EDGES, np.linalg.norm(place[i] - place[j], axis=1), "right")
            - 1
        )
        for axis in (0, 1):
            product = g[i, axis] * g[j, axis]
            values = product, h[i, axis] * h[j, axis], product**2, np.ones(len(i))
            out += [np.bincount(bins, value, n + 1)[:n] for value in values]
    return out


@lru_cache(maxsize=64)
def _expected(size: tuple[float, float], length: float) -> Float:
    """Covariance (bins,) of a field of unit variance without its terms up to second order."""
    nx, ny = cells = _cells(size)
    shape = 2 * ny, 2 * nx
    correlation = matern(_separations(cells)[0] / length)
    X, Y = np.meshgrid(_middles(nx), _middles(ny))
    phi = legendre_products(X.ravel(), Y.ravel(), polynomial_terms(SECOND_ORDER))
    phi = np.linalg.qr(phi)[0]
    low = scipy.fft.rfft2(phi.T.reshape(-1, ny, nx), s=shape)
    smooth = scipy.fft.irfft2(low * scipy.fft.rfft2(correlation), s=shape)[:, :ny, :nx]
    smooth = smooth.reshape(len(smooth), -1)
    # (1 - P) K (1 - P) = K - P K - K P + P K P
    lost = (phi @ (phi.T @ smooth.T)).T - 2 * smooth
    lost = scipy.fft.rfft2(lost.reshape(-1, ny, nx), s=shape)
    number = np.abs(scipy.fft.rfft2(np.ones((ny, nx)), s=shape)) ** 2
    number = scipy.fft.irfft2(number, s=shape)
    change = scipy.fft.irfft2((low.conj() * lost).sum(axis=0), s=shape)
    projected = number * correlation + change
    covariance, pairs = _binned(np.stack([projected, number]), cells)
    return np.asarray(covariance / np.maximum(pairs, 0.5))


@dataclass(frozen=True)
class Modes:
    """Properties of a field of unit variance without its terms up to second order.

    L are the eigenvalues of its covariance over a chip.
    """

    left: float  # mean square of the remaining field
    patches: float  # (sum L)^2 / sum L^2: degrees of freedom of the mean square
    # (sum L^2)^3 / (sum L^3)^2: of the chi-square with the skewness of a sum of products
    dof: float


@lru_cache(maxsize=64)
def modes(size: tuple[float, float], length: float) -> Modes:
    """Modes of a field over a chip; `length` is the correlation length in longer half sides."""
    side = 12  # the field is smooth: more cells hardly change the result
    nx, ny = (max(2, round(side * s / max(size))) for s in size)
    half = np.array(size) / max(size)
    X, Y = (Z.ravel() for Z in np.meshgrid(_middles(nx), _middles(ny)))
    place = np.column_stack([X, Y]) * half
    K = matern(np.linalg.norm(place[:, None] - place, axis=2) / length)
    phi = np.linalg.qr(legendre_products(X, Y, polynomial_terms(SECOND_ORDER)))[0]
    K -= phi @ (phi.T @ K)
    K -= (K @ phi) @ phi.T
    values = np.linalg.eigvalsh(K)
    total, second, third = values.sum(), (values**2).sum(), (values**3).sum()
    return Modes(float(total / len(values)), float(total**2 / second), float(second**3 / third**2))


def _middles(n: int) -> Float:
    """Centres of n cells from -1 to 1."""
    return (2 * np.arange(n) + 1.0) / n - 1
