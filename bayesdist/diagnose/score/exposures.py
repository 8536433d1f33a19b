"""Tests for deviations of single exposures: linear and second-order terms, trends, smooth fields.

**Linear terms that frames do not fit, and second order.**  Every exposure e has a statistic T_e for
the shift, rotation, scale and shears that are not parameters of its frame, or for second-order
terms on every chip, with all linear terms projected out.  T_e is a chi-square with the same
probability as Hotelling's statistic, using the covariance of the scores of the exposure's stars.
Each exposure deviates independently, so that the sum of the T_e is tested; this does not need the
covariance of hundreds of scores.  The polynomials, which are fitted to all exposures, make the T_e
slightly dependent.  The mean and variance of the sum are therefore those of a scaled chi-square
(Satterthwaite 1946).

**Correlation in time.**  `exposure_time_test` examines whether the deviations of exposures are
correlated in time, beyond the drift and a parabola.

**Smooth fields that differ from exposure to exposure.**  The sum of products of nearby stars within
exposures, minus that across exposures, is weighted according to the signal of a field with a given
correlation length.  It is a quadratic form of independent scores, so that its distribution is
approximated by a chi-square with the same skewness.  A few correlation lengths are tried.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from bayesdist.diagnose.correlated.exposure_time import correlation_p, fitted_deviations
from bayesdist.diagnose.correlated.neighbours import (
    ExposureProducts,
    ExposureScores,
    exposure_products,
    modes,
)
from bayesdist.diagnose.score.projection import Projection, contracted, weighted
from bayesdist.diagnose.score.result import POWER, Family, Outcome, outcome
from bayesdist.diagnose.score.sample import DetectionBlock, ScoredSample
from bayesdist.diagnose.statistics import (
    EfficientScore,
    add_over,
    chi_square_of,
    hotelling_p,
    independent_directions,
    squares_of,
    sums_over,
)
from bayesdist.infer.equations.priors import GaussianPriors
from bayesdist.model.frames import LINEAR_MATRICES, frame_names
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.distributions import chi2_isf, chi2_sf, norm_isf

EXPOSURES = Family(
    "exposures",
    "use a campaign, whose exposures have a hierarchy of deviations",
    "exposures deviate from each other in linear terms that their frames do not fit",
    "no deviations of single exposures are left in the residuals",
    held_by="exposures",
    denial="deviating exposures do not explain it",
)
SECOND_ORDER = Family(
    "second order of exposures",
    "calibrate exposures one by one, or take more of them, in whose mean such terms average out",
    "exposures differ in second-order terms",
    "exposures do not differ in second-order terms",
    held_by="second order",
    denial="terms of second order in single exposures do not explain it",
)
STARS_PER_DIRECTION = 4  # minimum per tested direction of an exposure
# scores times squared number of global parameters: beyond, an average replaces other exposures'
# scores
MAX_PRODUCTS = 1e10
# smallest remaining fraction of the information: deviations below it are absorbed by the frames
INDEPENDENT = 0.02
EXPOSURES_IN_TIME = Family(
    "exposures in time",
    "judge dates among those of the exposures, or add exposures at dates between and beyond them",
    "deviations of exposures are correlated in time",
    "deviations of exposures are not correlated in time",
    held_by="time",
)
EXPOSURE_FIELDS = Family(
    "fields of exposures",
    "calibrate exposures one by one, or take more of them, in whose mean such fields average out",
    "exposures differ by a smooth field that is new in each",
    "exposures do not differ by smooth fields",
    held_by="exposure fields",
)
LENGTHS = (0.08, 0.2, 0.5)  # correlation lengths that are tried, in longer half sides


@dataclass(frozen=True, eq=False)
class _Deviations:
    """Deviations of one exposure, with all parameters projected out."""

    score: Float  # (n,)
    information: Float  # (n, n) with all parameters projected out
    own: Float  # (n, n) with only the parameters of the exposure projected out
    cross: Float  # (n, G) with respect to the global parameters
    covariance: Float  # (n, n) covariance of the score, from those of single detections
    square: Float  # (n, n) mean square of the deviations over the detector
    of_own: Float  # (n, n) contribution of the exposure's stars to this covariance
    n_own: int  # number of stars of the exposure, and of all other exposures
    n_others: int

    @property
    def n_stars(self) -> float:
        """Effective number of stars that determine the covariance.

        Stars of other exposures are weighted by their contribution to it.  The contribution of the
        exposure's stars is measured as a fraction of the variance in each direction, because shifts
        and scales have different units.
        """
        fraction = float(np.trace(np.linalg.solve(self.covariance, self.of_own))) / len(self.score)
        return 1.0 / (fraction**2 / self.n_own + (1.0 - fraction) ** 2 / self.n_others)

    @property
    def statistic(self) -> float:
        """Chi-square with the same probability as Hotelling's statistic about zero."""
        n, t = len(self.score), float(self.score @ np.linalg.solve(self.covariance, self.score))
        return chi_square_of(hotelling_p(t, n, self.n_stars), n)

    def along(self, N: Float) -> _Deviations:
        """Deviations along directions N (n, q)."""
        return _Deviations(
            N.T @ self.score,
            N.T @ self.information @ N,
            N.T @ self.own @ N,
            N.T @ self.cross,
            N.T @ self.covariance @ N,
            N.T @ self.square @ N,
            N.T @ self.of_own @ N,
            self.n_own,
            self.n_others,
        )


@dataclass(frozen=True, eq=False)
class _Meat:
    """Scores of the global parameters, summed by star."""

    by_star: Float  # (stars, G) sums over the detections of each star
    total: Float  # (G, G) sum of their squares, including the contribution of the priors

    @classmethod
    def of(cls, projection: Projection) -> _Meat:
        """Sum the scores of all stars."""
        sample, G = projection.sample, projection.n_global
        by_star = np.zeros((int(sample.star.max()) + 1, G))
        for block in sample.blocks:
            F = projection.functions.polynomials(block.rows)
            psi = projection.star_scores(F, block, block.moved(projection.following))
            add_over(by_star, sample.star[block.rows], psi)
        following = projection.following
        return cls(by_star, by_star.T @ by_star + following.T @ projection.precision @ following)

    def covariance(self, nuisance: Float, star: Int, own: Float) -> tuple[Float, Float]:
        """Covariances (n, n) of an exposure's scores due to its stars, and due to all other stars.

        `nuisance` (G, n) are the changes of the global parameters that imitate the deviations,
        `star` (N,) are the stars of the exposure's detections, and `own` (N, n) the scores of these
        detections before the parameters are projected out.
        """
        star_codes, of = np.unique(star, return_inverse=True)
        # a star counts once, in this exposure and in all others
        through = self.by_star[star_codes] @ nuisance
        star_scores = sums_over(of, own) - through
        other_stars = nuisance.T @ self.total @ nuisance - through.T @ through
        return star_scores.T @ star_scores, other_stars


def exposure_tests(projection: Projection, theta: Float, priors: GaussianPriors) -> list[Outcome]:
    """Test linear and second-order deviations of exposures, and their time dependence.

    `theta` (D,) and `priors` are those of the solution.  The tests are left out if there is a
    single exposure, or if fewer than two exposures have enough stars.  The first test is left out
    if the frames include all linear terms, the second for polynomials of order 1.
    """
    model = projection.sample.model
    names = [name for name in frame_names("affine") if name not in frame_names(model.frames)]
    if len({block.exposure for block in projection.sample.blocks}) < 2:
        return []
    by_order: list[list[_Deviations]] = [[], []]
    estimates: dict[int, Float] = {}
    for code, estimate, pair in _deviations(projection, names):
        if estimate.size:
            estimates[code] = estimate
        for deviations, part in zip(by_order, pair, strict=True):
            if part is not None:
                deviations.append(part)
    remedy = EXPOSURES.remedy
    if model.frames != "affine":
        remedy = f"set model.frames to 'affine', or {remedy}"
    families = replace(EXPOSURES, remedy=remedy), SECOND_ORDER
    out = [
        _summed(projection, family, deviations)
        for family, deviations in zip(families, by_order, strict=True)
        if len(deviations) > 1
    ]
    in_time = exposure_time_test(projection, estimates, theta, priors)
    return out if in_time is None else [*out, in_time]


def _summed(projection: Projection, family: Family, deviations: list[_Deviations]) -> Outcome:
    """Outcome for the sum of the statistics of all exposures."""
    T = sum(part.statistic for part in deviations)
    n = sum(len(part.score) for part in deviations)
    squares = [
        squares_of(part.score, part.own, part.covariance, part.square) for part in deviations
    ]
    apart = 0.0
    for part in deviations:
        alone = np.linalg.solve(part.information, part.own - part.information)
        apart += float(np.trace(alone @ alone))
    G = projection.n_global
    shared = sum(
        part.cross.T @ np.linalg.solve(part.information, part.cross) for part in deviations
    )
    together = projection.covariance[:G, :G] @ shared
    # mean n and variance 2 n (1 + ...) of the sum, as a scaled chi-square
    stretch = 1.0 + (float((together * together.T).sum()) - apart) / n
    dof = n / stretch
    T = T / stretch
    square, noise = (float(values) for values in np.mean(squares, axis=0))
    return outcome(
        family,
        T,
        dof,
        None,
        float(chi2_sf(T, dof)),
        square=square,
        noise=noise,
        unit=projection.sample.model.unit,
    )


def _deviations(
    projection: Projection, names: list[str]
) -> Iterator[tuple[int, Float, tuple[_Deviations | None, _Deviations | None]]]:
    """Iterate over exposures: code, estimates (m,) of linear deviations, and a pair of deviations.

    The pair contains the linear and the second-order deviations; either is None if it is not
    determined.  Exposures with too few stars are skipped.
    """
    meat, model = None, projection.sample.model
    if len(projection.sample) * projection.n_global**2 < MAX_PRODUCTS:
        meat = _Meat.of(projection)
    second = [k for k, powers in enumerate(model.basis().terms) if sum(powers) == 2]
    for blocks in projection.sample.blocks_by("exposure"):
        n = sum(int(projection.sample.used[block.rows].sum()) for block in blocks)
        chips = sorted({block.chip for block in blocks})
        columns = [(chip, axis, k) for chip in chips for axis in (0, 1) for k in second]
        if n < STARS_PER_DIRECTION * (len(names) + len(columns)):
            columns = []
        if n < STARS_PER_DIRECTION * len(names) or not (names or columns):
            continue
        fields = [
            np.concatenate(
                [_linear(block, names, model.origin), _second_order(block, columns)], axis=2
            )
            for block in blocks
        ]
        unprojected, deviations = _of_exposure(projection, blocks, fields, meat)
        unit, m = np.eye(len(unprojected)), len(names)
        linear, quadratic = unit[:, :m], unit[:, m:].copy()
        if m:  # second-order terms with all linear terms projected out
            S = deviations.information
            quadratic[:m] = -np.linalg.lstsq(S[:m, :m], S[:m, m:])[0]
        estimate = np.asarray(
            np.linalg.lstsq(deviations.own[:m, :m], deviations.score[:m])[0], float
        )
        pair = (
            _independent(deviations, unprojected, linear),
            _independent(deviations, unprojected, quadratic),
        )
        yield blocks[0].exposure, estimate, pair


def _independent(every: _Deviations, whole: Float, combinations: Float) -> _Deviations | None:
    """Deviations along combinations (n, q) that the parameters do not absorb.

    None if there are none.
    """
    N = independent_directions(
        combinations.T @ whole @ combinations,
        combinations.T @ every.information @ combinations,
        INDEPENDENT,
    )
    return every.along(combinations @ N) if N.shape[1] else None


def _linear(block: DetectionBlock, names: list[str], origin: tuple[float, float]) -> Float:
    """Changes (2, K, n) of the polynomial of a block due to unit linear deviations."""
    out = np.zeros((*block.effective.shape, len(names)))
    about = block.effective.copy()
    about[:, 0] -= origin
    for k, name in enumerate(names):
        if name in LINEAR_MATRICES:
            out[..., k] = LINEAR_MATRICES[name] @ about
        else:
            out["uv".index(name[-1]), 0, k] = 1.0
    return out


def _second_order(block: DetectionBlock, columns: list[tuple[int, int, int]]) -> Float:
    """Changes (2, K, n) of the polynomial of a block due to unit second-order terms.

    Each column is a term: index of the chip, axis, and index of the polynomial function.
    """
    out = np.zeros((*block.effective.shape, len(columns)))
    for n, (chip, axis, k) in enumerate(columns):
        if chip == block.chip:
            out[axis, k, n] = 1.0
    return out


def _of_exposure(
    projection: Projection, blocks: list[DetectionBlock], fields: list[Float], meat: _Meat | None
) -> tuple[Float, _Deviations]:
    """Information before anything is projected out, and the deviations of one exposure.

    `fields` are the changes (2, K, n) of each block's polynomial due to unit deviations.
    """
    sample, model = projection.sample, projection.sample.model
    n, D = fields[0].shape[2], model.n_params
    unprojected, cross, score = np.zeros((n, n)), np.zeros((D, n)), np.zeros(n)
    square = np.zeros((n, n))
    area = model.basis().mean_squares
    for block, Z in zip(blocks, fields, strict=True):
        F = projection.functions.polynomials(block.rows)
        WZ = weighted(F, sample.curvature[:, block.rows], Z)
        unprojected += contracted(Z, WZ)
        cross[block.columns] += contracted(block.derivative, WZ)
        score += contracted(Z, (sample.score[:, block.rows] @ F.T)[..., None])[:, 0]
        square += contracted(Z, area[:, None] * Z) / len(blocks)
    rows = np.unique(np.concatenate([block.columns for block in blocks]))
    efficient = EfficientScore.of(
        projection.covariance, projection.score, cross[rows], unprojected, score, rows
    )
    by_global = cross[rows].T @ projection.following[rows]
    of_own, of_others = _covariances(projection, blocks, fields, efficient, meat)
    covariance = of_own + of_others
    n_own = sum(int(sample.used[block.rows].sum()) for block in blocks)
    n_others = max(int(sample.used.sum()) - n_own, 1)
    return unprojected, _Deviations(
        efficient.score,
        efficient.information,
        projection.with_global(efficient.information, by_global),
        by_global,
        (covariance + covariance.T) / 2,
        square,
        of_own,
        n_own,
        n_others,
    )


def _covariances(
    projection: Projection,
    blocks: list[DetectionBlock],
    fields: list[Float],
    left: EfficientScore,
    meat: _Meat | None,
) -> tuple[Float, Float]:
    """Covariances (n, n) of an exposure's scores due to its stars, and due to all other data.

    Without `meat`, the scores of the global parameters, the covariance due to other exposures is
    scaled by the average ratio of squared scores to their expectation.
    """
    sample = projection.sample
    # response of the global parameters, which other exposures also constrain, with those of
    # exposures following
    nuisance = left.gain[: projection.n_global]
    shared = projection.following @ nuisance
    by_others, psi = left.information.copy(), []
    for block, Z in zip(blocks, fields, strict=True):
        F = projection.functions.polynomials(block.rows)
        direct = Z - block.moved(left.gain)
        if meat is None:
            by_others -= contracted(direct, weighted(F, sample.curvature[:, block.rows], direct))
        else:
            direct += block.moved(shared)
        psi.append(projection.star_scores(F, block, direct))
    detection_scores = np.concatenate(psi)
    if meat is None:
        return detection_scores.T @ detection_scores, projection.score_ratio * by_others
    star = np.concatenate([sample.star[block.rows] for block in blocks])
    of_own, of_others = meat.covariance(nuisance, star, detection_scores)
    rows = np.unique(np.concatenate([block.columns for block in blocks]))
    P = projection.precision[np.ix_(rows, rows)]
    before, after = shared[rows], left.gain[rows]
    return of_own, of_others + after.T @ P @ after - before.T @ P @ before


def exposure_time_test(
    projection: Projection, estimates: Mapping[int, Float], theta: Float, priors: GaussianPriors
) -> Outcome | None:
    """Test of the deviations of exposures; None without a drift, and for too few dates.

    `estimates` are the linear deviations of exposures that are not parameters, by exposure code.
    Deviations that are parameters, with `priors` on their size, are taken from the solution
    `theta`.
    """
    sample = projection.sample
    model, time = sample.model, sample.model.time
    if time is None or sample.epoch is None:
        return None
    values = fitted_deviations(model, theta, priors)
    if values is not None:
        names, first = np.unique(
            [block.frame_exposure for block in sample.blocks], return_index=True
        )
        dates = np.array([sample.epoch[sample.blocks[k].rows.start] for k in first])
        values = values[names]
    elif estimates:
        codes, first = np.unique([block.exposure for block in sample.blocks], return_index=True)
        by_code = {
            int(code): sample.epoch[sample.blocks[k].rows.start]
            for code, k in zip(codes, first, strict=True)
        }
        dates = np.array([by_code[code] for code in estimates])
        values = np.stack(list(estimates.values()))
    else:
        return None
    p, correlation = correlation_p(values, dates, time.breaks)
    if correlation == 0.0:
        return None
    rms = float(np.sqrt(np.mean((values - values.mean(axis=0)) ** 2)))
    rms *= model.pixel_size(theta) * max(max(chip.size) for chip in model.chips) / 2
    family = EXPOSURES_IN_TIME
    return outcome(
        replace(family, present=f"{family.present} ({correlation:.2f} between successive ones)"),
        correlation,
        1.0,
        None,
        p,
        square=max(correlation, 0.0) * rms**2,
        noise=0.0,
        unit=model.unit,
        smallest=partial(_smallest, rms, values.size),
    )


def _smallest(rms: float, n: int, level: float) -> float:
    """Rms of the correlated part of n deviations that is detected with the power `POWER`."""
    needed = (norm_isf(level) - norm_isf(POWER)) / np.sqrt(n)
    return float(rms * np.sqrt(min(needed, 1.0)))


def exposure_field_test(sample: ScoredSample) -> Outcome | None:
    """Test for fields of single exposures; None if fewer than two exposures have enough stars."""
    if len({block.exposure for block in sample.blocks}) < 2:
        return None
    scores = ExposureScores(
        sample.X, sample.Y, *sample.uncorrelated, sample.chip, sample.exposure, sample.star
    )
    chips = exposure_products(scores, [chip.size for chip in sample.model.chips])
    if not chips:
        return None
    tried = [_tried(list(chips.values()), length) for length in LENGTHS]
    p, statistic, dof, variance, error, length = min(tried)
    # both axes together, without terms up to second order; the contribution of noise is subtracted
    remaining = 2 * modes(next(iter(chips.values())).size, length).left
    size = np.sqrt(remaining * max(variance, 0.0))

    def smallest(level: float) -> float:
        limit = _deviate(level / len(LENGTHS), dof)
        return float(np.sqrt(remaining * error * max(limit - _deviate(POWER, dof), 0.0)))

    half = max(max(chip.size) for chip in sample.model.chips) / 2
    family = EXPOSURE_FIELDS
    present = f"{family.present}, over some {length * half:.2g} pix"
    return outcome(
        replace(family, present=present),
        statistic,
        dof,
        None,
        min(1.0, len(LENGTHS) * p),
        square=size**2,
        noise=0.0,
        unit=sample.model.unit,
        smallest=smallest,
    )


def _tried(
    chips: list[ExposureProducts], length: float
) -> tuple[float, float, float, float, float, float]:
    """Probability, chi-square, its degrees of freedom, variance of the field, its error, length."""
    fits = np.array([chip.amplitude(length) for chip in chips])
    weight = fits[:, 1] ** -2
    variance, error = float(fits[:, 0] @ weight / weight.sum()), float(weight.sum() ** -0.5)
    dof = sum(chip.n_fields * modes(chip.size, length).dof for chip in chips)
    T = max(dof + variance / error * np.sqrt(2 * dof), 0.0)
    return float(chi2_sf(T, dof)), T, dof, variance, error, length


def _deviate(level: float, dof: float) -> float:
    """Standardised chi-square that is exceeded with the probability `level`."""
    return float((chi2_isf(level, dof) - dof) / np.sqrt(2 * dof))
