"""Deviations of single exposures beyond linear terms: second order, and smooth fields.

The second-order terms of the exposures scatter with one size tau, similar to shift, rotation and
scale.  With free linear terms of the exposure, and all higher polynomial terms in common, its
information and score are small matrices, and the log-likelihood of tau is a sum over exposures.
Smooth deviations without low-order terms have an amplitude and a correlation length, which are
estimated from products of neighbouring stars within exposures (`exposure_products`).

The fit follows the mean of both over the exposures.  The error of the mean calibration depends on
the size of this mean, whereas a single exposure has its full deviation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from bayesdist.diagnose.correlated.information import (
    GroupCells,
    Information,
    scores_on_chips,
)
from bayesdist.diagnose.correlated.neighbours import (
    LENGTHS,
    SECOND_ORDER,
    ExposureProducts,
    ExposureScores,
    exposure_products,
    modes,
)
from bayesdist.diagnose.correlated.priors import (
    FINE,
    STRUCTURE_DOF,
    DiscrepancyPriors,
    StructureFunctions,
    legendre_products,
    log_half_t,
    log_widths,
)
from bayesdist.infer.exposures.hierarchy import MOST_OUTLYING
from bayesdist.infer.exposures.scatter import OUTLYING, OUTLYING_FRACTION
from bayesdist.infer.stars.likelihood import Likelihood
from bayesdist.infer.stars.stars import Stars
from bayesdist.model import Chip, DistortionModel
from bayesdist.model.basis import n_terms, polynomial_terms
from bayesdist.utils.arrays import Float, Int

STEPS = 40  # number of grid points in amplitude
ITERATIONS = 12  # of the scatter, to identify outlying exposures
WIDE = 30.0  # multiple of the resolution of the data that is practically a flat prior
# factor by which amplitudes extend beyond the prior median and the resolution of the data
RANGE = 10.0
SHAPE = 0.3  # relative tolerance of the correlation at a separation, compared with a Matern field
SINES = 10  # along each side of a chip; finer sines do not change the polynomials
QUADRATIC = polynomial_terms(SECOND_ORDER)[n_terms(SECOND_ORDER - 1) :]
STARS_PER_TERM = 2  # per exposure and chip; with fewer, its second-order terms are not estimated


@dataclass(frozen=True, eq=False)
class ExposureFields:
    """Draws of the size of deviations of single exposures, and of their effect on the fit."""

    theta: Float  # (n, D) error of the parameters, which follow the mean of the exposures
    # (n,) scatter of each second-order term of unit mean square, in the unit of u and v
    second_order: Float
    amplitude: Float  # (n,) rms of the smooth field per axis
    length: Float  # (n,) its correlation length in longer half sides of a chip
    n_exposures: int

    def facts(self, size: tuple[float, float]) -> dict[str, float]:
        """Median rms of both kinds over a chip, both axes together, for summaries.

        `size` contains the numbers of columns and rows of the chip.  Terms up to second order are
        excluded from the field.
        """
        second = float(np.sqrt(2 * len(QUADRATIC)) * np.median(self.second_order))
        by_length = np.array([modes(size, float(length)).left for length in LENGTHS])
        remaining = by_length[np.searchsorted(LENGTHS, self.length)]
        field = float(np.median(self.amplitude * np.sqrt(2 * remaining)))
        # without a field, for example for very few stars, its length is that of the prior
        weights = self.amplitude**2 if self.amplitude.any() else None
        length = float(np.average(self.length, weights=weights))
        length_pix = length * max(size) / 2
        return {"second_order": second, "field": field, "length_pix": length_pix}

    def functions(self, chip: Chip) -> StructureFunctions:
        """Sines of the field on a chip, with terms up to second order subtracted."""
        return StructureFunctions(SECOND_ORDER, chip.size, SINES)

    def coefficients(self, chip: Chip, rng: np.random.Generator) -> Float:
        """Draw coefficients (n, 2, m) of the functions for a future exposure."""
        functions, n = self.functions(chip), len(self.amplitude)
        low = rng.standard_normal((n, 2, len(QUADRATIC))) * self.second_order[:, None, None]
        lengths, of = np.unique(self.length, return_inverse=True)
        root = np.sqrt([functions.spectrum(length) for length in lengths])
        finer = np.sqrt([functions.finer(length) for length in lengths])
        sines = rng.standard_normal((n, 2, functions.n_sines)) * root[of][:, None]
        waves = rng.standard_normal((n, 2, 2 * FINE)) * finer[of][:, None, None]
        field = np.concatenate([sines, waves], axis=2) * self.amplitude[:, None, None]
        return np.concatenate([low, field], axis=2).astype(np.float32)

    def evaluate(self, chip: Chip, waves: Float, X: Float, Y: Float) -> Float:
        """Values (N, m) of these functions at scaled positions."""
        functions = self.functions(chip)
        sines = functions.evaluate(X, Y)[:, functions.n_terms :]
        finer = functions.evaluate_finer(waves, X, Y)
        return np.concatenate([legendre_products(X, Y, QUADRATIC), sines, finer], axis=1)


def exposure_fields(
    information: Information,
    working: Information,
    stars: ExposureScores | None,
    priors: DiscrepancyPriors,
    n: int,
    rng: np.random.Generator,
) -> ExposureFields | None:
    """Posterior draws of deviations of single exposures beyond linear terms.

    `information` includes the excess variance of the scores, `working` is that of the likelihood of
    the solution.  `stars` are all detections or a part of them, with the exposure of each; if it is
    None, no field is estimated.  Returns None for a single exposure.
    """
    model = working.model
    groups = working.sums.groups
    keys = np.column_stack([groups.exposure, groups.epoch])
    n_exposures = len(np.unique(keys, axis=0))
    if n_exposures < 2:
        return None
    pixel = model.pixel_size(working.theta)
    chips = [_Terms.of(information, working, code) for code in range(len(model.chips))]
    terms = [chip for chip in chips if chip is not None]
    pull, tau = _second_order_draws(terms, priors.higher_order * pixel, model.n_params, n, rng)
    sizes = [chip.size for chip in model.chips]
    products = {} if stars is None else exposure_products(stars, sizes)
    amplitude, length = np.zeros(n), np.full(n, LENGTHS[-1])
    if products:
        size = priors.structure * pixel
        amplitude, length = _field_draws(list(products.values()), size, n, rng)
        pull += _followed(working, amplitude, length, rng)
    return ExposureFields(pull @ working.covariance, tau, amplitude, length, n_exposures)


def detection_scores(
    model: DistortionModel, stars: Stars, likelihood: Likelihood, exposure: Int, star: Int
) -> ExposureScores:
    """Scores of detections in the order of `stars`, along the axes of the polynomials.

    `exposure` and `star` (N,) are their codes.
    """
    g, H, chip = scores_on_chips(model, stars, likelihood)
    h = np.einsum("naa->na", H)
    return ExposureScores(stars.X, stars.Y, g, h, chip, exposure, star)


@dataclass(frozen=True, eq=False)
class _Terms:
    """Second-order and higher terms of all exposures on one chip, along both axes.

    The first six are the second-order terms, which deviate in each exposure.  The mean of each term
    is free.
    """

    information: Float  # (E, t, t) with the linear terms of each exposure eliminated
    score: Float  # (E, t)
    # values (E, 6) and vectors (E, 6, 6): eigen-decomposition of the second-order information
    values: Float
    vectors: Float
    taken: Float  # (E, 6, D) information between each second-order term and the parameters
    loose: Float  # (E,) prior variance of the terms of an outlying exposure, otherwise 0

    @classmethod
    def of(cls, information: Information, working: Information, chip: int) -> _Terms | None:
        """Terms on a chip (by code) of the exposures with enough stars.

        None if these are fewer than two.
        """
        model, q = working.model, len(QUADRATIC)
        powers_of_terms = polynomial_terms(max(model.order, SECOND_ORDER))
        K = len(powers_of_terms)
        degree = np.array([sum(powers) for powers in powers_of_terms])
        linear, high = np.flatnonzero(degree < SECOND_ORDER), np.flatnonzero(degree >= SECOND_ORDER)
        second, higher = high[:q], high[q:]  # terms are sorted by degree
        chosen = np.concatenate([second, K + second, higher, K + higher])
        free = np.concatenate([linear, K + linear])
        S, s, responses = [], [], []
        for cells, plain in zip(information.groups(), working.groups(), strict=True):
            if cells.chip != chip or cells.count.sum() < STARS_PER_TERM * (len(free) + 2 * q):
                continue
            phi = legendre_products(cells.X, cells.Y, powers_of_terms)
            H = np.einsum("ba,cbd,de->cae", cells.frame, cells.curvature, cells.frame)
            N = np.block([[phi.T @ (H[:, a, b, None] * phi) for b in (0, 1)] for a in (0, 1)])
            r = (phi.T @ (cells.score @ cells.frame)).T.ravel()
            gain = np.linalg.lstsq(N[np.ix_(free, free)], N[np.ix_(free, chosen)])[0]
            projected = N[np.ix_(chosen, chosen)] - N[np.ix_(chosen, free)] @ gain
            S.append((projected + projected.T) / 2)
            s.append(r[chosen] - gain.T @ r[free])
            responses.append(_onto_parameters(plain, phi[:, second], model.n_params).T)
        if len(S) < 2:
            return None
        every_S = np.stack(S)
        values, vectors = np.linalg.eigh(every_S[:, : 2 * q, : 2 * q])
        return cls(
            every_S,
            np.stack(s),
            np.maximum(values, 0.0),
            vectors,
            np.stack(responses),
            np.zeros(len(S)),
        )

    def given(self, tau: float) -> _GivenScatter:
        """Posterior of all terms for a scatter `tau`."""
        variance = np.where(self.loose > 0, self.loose, tau**2)[:, None]
        width, q = variance / (1 + self.values * variance), self.values.shape[1]
        inverse = (self.vectors * width[:, None]) @ self.vectors.mT
        cross, score = self.information[:, :, :q], self.score[:, :q]
        mean = np.einsum("eab,eb->ea", inverse, score)
        M = (self.information - cross @ inverse @ cross.mT).sum(axis=0)
        M += 1e-9 * np.trace(M) / len(M) * np.eye(len(M))
        right = self.score.sum(axis=0) - np.einsum("etq,eq->t", cross, mean)
        factor = scipy.linalg.cholesky(M, lower=True)
        half = scipy.linalg.solve_triangular(factor, right, lower=True)
        log = 0.5 * (np.sum(score * mean) - np.log1p(self.values * variance).sum() + half @ half)
        log -= np.log(np.diag(factor)).sum()
        return _GivenScatter(self, float(log), width, mean, inverse @ cross.mT, factor, half)


@dataclass(frozen=True, eq=False)
class _GivenScatter:
    """Posterior of the second-order terms of all exposures for one scatter."""

    of: _Terms
    log_evidence: float
    width: Float  # (E, 6) variances along the eigenvectors, given the common terms
    mean: Float  # (E, 6) mean for common terms equal to 0
    follow: Float  # (E, 6, t) decrease of the mean with the common terms
    factor: Float  # (t, t) Cholesky factor of the precision of the common terms
    half: Float  # (t,) their score, multiplied by the inverse of that factor

    def squares(self) -> Float:
        """Expected squares (E, 6) of the terms."""
        common = scipy.linalg.solve_triangular(self.factor, self.half, trans=1, lower=True)
        spread = scipy.linalg.solve_triangular(
            self.factor, self.follow.reshape(-1, len(self.factor)).T, lower=True
        )
        mean = self.mean - self.follow @ common
        conditional = np.einsum("eak,ek,eak->ea", self.of.vectors, self.width, self.of.vectors)
        return np.asarray(mean**2 + conditional + (spread**2).sum(axis=0).reshape(mean.shape))

    def draws(self, n: int, rng: np.random.Generator) -> Float:
        """Draw the terms, shape (n, E, 6)."""
        common = scipy.linalg.solve_triangular(
            self.factor,
            self.half[:, None] + rng.standard_normal((len(self.half), n)),
            trans=1,
            lower=True,
        )
        noise = rng.standard_normal((n, *self.width.shape)) * np.sqrt(self.width)
        noise = np.einsum("eak,nek->nea", self.of.vectors, noise)
        return np.asarray(self.mean - np.einsum("eqt,tn->neq", self.follow, common) + noise)


def _onto_parameters(cells: GroupCells, values: Float, n_params: int) -> Float:
    """Information (D, 2 m) between the parameters and functions with values (C, m) on both axes."""
    out = np.zeros((n_params, 2 * values.shape[1]))
    turned = cells.curvature @ cells.frame
    for axis in (0, 1):
        part = slice(axis * values.shape[1], (axis + 1) * values.shape[1])
        pulled = turned[:, :, axis, None] * values[:, None]
        out[cells.columns, part] = cells.onto_parameters(pulled)
    return out


def _second_order_draws(
    chips: Sequence[_Terms], median: float, n_params: int, n: int, rng: np.random.Generator
) -> tuple[Float, Float]:
    """Pull (n, D) of the second-order terms on the fit, and draws (n,) of their scatter.

    The sign is reversed because the fit absorbs the terms.
    """
    pull, drawn = np.zeros((n, n_params)), np.zeros(n)
    if not chips:
        return pull, drawn
    eigenvalues = np.concatenate([terms.values.ravel() for terms in chips])
    eigenvalues = eigenvalues[eigenvalues > 1e-8 * eigenvalues.max()]
    resolved = float(np.median(eigenvalues)) ** -0.5
    chips = [_with_loose(terms, WIDE * resolved) for terms in chips]
    largest = max(
        float(np.sqrt(np.mean(terms.given(WIDE * resolved).squares()[terms.loose == 0])))
        for terms in chips
    )
    grid, log_prior = _amplitudes(median, resolved, largest)
    posteriors = [[terms.given(tau) for terms in chips] for tau in grid]
    log = log_prior + np.array(
        [sum(chip_posterior.log_evidence for chip_posterior in chip) for chip in posteriors]
    )
    weight = np.exp(log - log.max())
    grid_index = rng.permutation(
        np.repeat(np.arange(STEPS), rng.multinomial(n, weight / weight.sum()))
    )
    for k in np.unique(grid_index):
        rows = np.flatnonzero(grid_index == k)
        drawn[rows] = grid[k]
        for posterior in posteriors[k]:
            coefficients = posterior.draws(len(rows), rng)
            pull[rows] -= np.tensordot(coefficients, posterior.of.taken, axes=2)
    return pull, drawn


def _amplitudes(median: float, resolved: float, largest: float) -> tuple[Float, Float]:
    """Grid of amplitudes (STEPS,), and log prior weights for a sum over them.

    The grid extends beyond the prior median, the resolution of the data, and the largest size that
    the data suggest, where the likelihood is negligible: even two exposures have many terms and
    patches, whose scatter they determine.
    """
    grid = np.geomspace(
        min(median, resolved) / RANGE, RANGE * max(median, resolved, largest), STEPS
    )
    return grid, log_half_t(grid, median, STRUCTURE_DOF) + log_widths(grid, beyond=0.0)


def _with_loose(terms: _Terms, start: float) -> _Terms:
    """Terms with outlying exposures marked, the most outlying first.

    The odds are those of a scatter ten times as large as that of the others
    (`infer.exposures.scatter`).  If more than a fifth would be outlying, none are marked.
    """
    E, q = terms.values.shape
    loose = np.zeros(E)
    while (loose > 0).sum() <= MOST_OUTLYING * E:
        tight, tau = loose == 0, start
        for _ in range(ITERATIONS):  # iterate to the most probable scatter of the others
            posterior = replace(terms, loose=loose).given(tau)
            squares = posterior.squares()
            tau = float(np.sqrt(np.mean(squares[tight])))
        total, count = squares[tight].sum(), q * (tight.sum() - tight)
        other_variance = (total - np.where(tight, squares.sum(axis=1), 0.0)) / np.maximum(count, 1)
        common = scipy.linalg.solve_triangular(
            posterior.factor, posterior.half, trans=1, lower=True
        )
        cross = terms.information[:, :, :q]
        score = terms.score[:, :q] - np.einsum("etq,t->eq", cross, common)
        along = np.einsum("eqk,eq->ek", terms.vectors, score) ** 2
        evidence = []
        for times in (1.0, OUTLYING):
            variance = times**2 * other_variance[:, None]
            fit = along * variance / (1 + terms.values * variance)
            evidence.append(0.5 * (fit - np.log1p(terms.values * variance)).sum(axis=1))
        odds = evidence[1] - evidence[0] + np.log(OUTLYING_FRACTION / (1 - OUTLYING_FRACTION))
        odds[~tight] = -np.inf
        worst = int(np.argmax(odds))
        if odds[worst] <= 0:
            return replace(terms, loose=loose)
        loose[worst] = OUTLYING**2 * float(other_variance[worst])
        squared_terms = along[worst] / np.maximum(terms.values[worst], 1e-300) ** 2
        loose[worst] = max(loose[worst], float(np.mean(squared_terms[terms.values[worst] > 0])))
    return terms


def _field_draws(
    chips: Sequence[ExposureProducts], median: float, n: int, rng: np.random.Generator
) -> tuple[Float, Float]:
    """Draws (n,) of amplitude and correlation length of the field, from products of neighbours.

    The mean square of a field with few independent patches scatters in all bins together.
    """
    fits = np.array([[chip.amplitude(length) for chip in chips] for length in LENGTHS])
    resolved = float(np.sqrt(fits[..., 1].min()))
    largest = float(np.sqrt(max(fits[..., 0].max(), 0.0)))
    grid, log_prior = _amplitudes(median, resolved, largest)
    log = np.empty((len(LENGTHS), STEPS))
    for k, length in enumerate(LENGTHS):
        log[k] = sum(_log_likelihood(chip, grid, length) for chip in chips)
    log += log_prior
    weight = np.exp(log - log.max()).ravel()
    counts = rng.multinomial(n, weight / weight.sum())
    grid_index = rng.permutation(np.repeat(np.arange(len(counts)), counts))
    return grid[grid_index % STEPS], LENGTHS[grid_index // STEPS]


def _log_likelihood(chip: ExposureProducts, amplitude: Float, length: float) -> Float:
    """Log-likelihood of amplitudes (n,) of a field with a correlation length."""
    expected = amplitude[:, None] ** 2 * chip.expected(length)
    deviation = chip.covariance - expected
    variance = chip.variance + (SHAPE * expected) ** 2
    by_chance = 2.0 / (chip.n_fields * modes(chip.size, length).patches)
    # a diagonal matrix plus a matrix of rank 1
    common = 1 + by_chance * (expected**2 / variance).sum(axis=1)
    along = (deviation * expected / variance).sum(axis=1)
    chi2 = (deviation**2 / variance).sum(axis=1) - by_chance * along**2 / common
    return np.asarray(-0.5 * (chi2 + np.log(variance).sum(axis=1) + np.log(common)))


def _followed(
    working: Information, amplitude: Float, length: Float, rng: np.random.Generator
) -> Float:
    """Random pull (n, D) of fields of single exposures on the parameters.

    The data on the field of one exposure do not constrain the mean of all fields.
    """
    out = np.zeros((len(amplitude), working.model.n_params))
    lengths, of = np.unique(length, return_inverse=True)
    for cells in working.groups():
        functions = StructureFunctions(SECOND_ORDER, working.model.chips[cells.chip].size, SINES)
        sines = functions.evaluate(cells.X, cells.Y)[:, functions.n_terms :]
        pulled = _onto_parameters(cells, sines, working.model.n_params)[cells.columns]
        for k, one_length in enumerate(lengths):
            rows = np.flatnonzero(of == k)
            root = pulled * np.tile(np.sqrt(functions.spectrum(one_length)), 2)
            square, turn = np.linalg.eigh(root @ root.T)
            factor = turn * np.sqrt(np.maximum(square, 0.0))
            z = rng.standard_normal((len(rows), len(cells.columns)))
            out[np.ix_(rows, cells.columns)] += amplitude[rows, None] * (z @ factor.T)
    return out
