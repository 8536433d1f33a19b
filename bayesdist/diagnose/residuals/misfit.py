"""Does the model describe the stars?  Structure in the residuals, wrong errors, and wrong epochs.

The posterior is conditional on the model.  If the model lacks structure, its uncertainty does not
include that structure, and no requirement can be called met.

Quoted errors may be far too small, and matches may be mostly false; there is a warning for each.
Jitter compensates for errors that are a few times too small.  If they are far smaller, the
differences between stars would be lost in the jitter.  All errors are therefore multiplied by the
factor that the residuals show.

If the epochs are wrong, residuals correlate with the proper motions of the stars:

    r_i = -mu_i dt        mu_i the proper motion of star i, dt the same for all

The part of both sides that the model can absorb, a polynomial of the model's order on each chip of
each exposure, is subtracted.  A scan of dt finds the smallest median residual, which is robust
against false matches and fast stars.  A reweighted fit that starts there gives dt and, from the
scores of single stars, its error.  Errors s_i of the motions would bias dt towards 0.  Only stars
with well known motions are therefore used, and for these

    dt = -sum w r mu / sum w (mu^2 - s^2)
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import legendre

from bayesdist.data.magnitude_errors import MAD_TO_SIGMA
from bayesdist.data.matches import Matches
from bayesdist.diagnose.residuals.binned import BinnedResiduals, BinnedSums
from bayesdist.diagnose.residuals.stars import StarSums, star_bins, star_sums
from bayesdist.diagnose.score.sample import ScoredSample, scored_sample
from bayesdist.diagnose.statistics import squares_over
from bayesdist.infer.posterior import Posterior
from bayesdist.infer.solution.linear import LinearFit
from bayesdist.infer.solution.solution import Solution
from bayesdist.infer.stars.likelihood import Likelihood
from bayesdist.infer.stars.shards import Shards
from bayesdist.infer.stars.stars import prepare
from bayesdist.model import Chip
from bayesdist.model.basis import polynomial_terms
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.checks import (
    CHI2_TOO_LARGE,
    EPOCH_SHIFT,
    FALSE_MAJORITY,
    QUOTED_ERRORS,
    STRUCTURE,
    STRUCTURE_SEEN,
    WIDENED_ERRORS,
)
from bayesdist.utils.distributions import chi2_ppf, chi2_sf
from bayesdist.utils.text import p_words, size_of

Bins = tuple[int, int]

SHOWN = "shown"  # name of the partition that is plotted as a map of mean residuals
STARS_PER_BIN = 25
MAX_BINS = 32  # along each side
LOW_QUANTILE = 0.1  # of the chi-squares of the matches
# fraction of false matches above which they broaden the residuals of least squares
FALSE_FRACTION = 0.02


@dataclass(frozen=True)
class Misfit:
    """Structure in binned residuals."""

    # probability of so much structure by chance, for the most significant of three partitions
    # (cells, columns, rows), multiplied by three, and by the number of chips for the worst of
    # several chips
    p_value: float
    partition: str  # name of that partition
    # rms of the mean residual over that partition, with the noise subtracted (both axes together);
    # weighted by precision if the noisiest cells would hide significant structure
    structure: float
    unit: str
    chip: Chip | None = None  # None if the detector has a single chip
    # fraction of the patterns over the partitions that can be detected; below 1 if fitted stars
    # absorb some
    power: float = 1.0

    @property
    def significant(self) -> bool:
        """True if the structure is significant."""
        return not STRUCTURE.met_by(self.p_value)

    @property
    def underpowered(self) -> bool:
        """True if most structure would not have been detected."""
        return not STRUCTURE_SEEN.met_by(self.power)

    @property
    def sentence(self) -> str:
        """Meaning and consequence of the structure, as a clause."""
        return f"{self.finding}, so that errors are larger than the posterior says"

    @property
    def finding(self) -> str:
        """Meaning of the structure, as a clause."""
        part = "the detector" if self.chip is None else f"chip {self.chip.name}"
        size = size_of(self.structure, self.unit, 2).replace("\u202f", " ")
        return (
            f"the residuals hold structure that the model does not describe ({size} rms in "
            f"{self.partition} of {part}, {p_words(self.p_value)})"
        )


def partitions_for(n: int) -> dict[str, tuple[int, int]]:
    """Partitions of the detector that `misfit_of` tests, for `n` stars.

    Returns the number of bins in x and y by name.
    """
    side = int(np.clip(np.sqrt(n / STARS_PER_BIN), 3, MAX_BINS))
    strips = int(np.clip(n / STARS_PER_BIN, 3, 2 * MAX_BINS))
    return {"cells": (side, side), "columns": (strips, 1), "rows": (1, strips)}


def misfit_of(sums: Mapping[str, BinnedSums], *, order: int | None = None, unit: str) -> Misfit:
    """Test residuals for structure over the detector.

    `sums` are those of the residuals of stars that were not rejected, for each of `partitions_for`.
    `order` is the order of the polynomial that was fitted to the residuals on both axes; `unit` is
    the unit of the residuals.
    """
    misfits = []
    for name, partition_sums in sums.items():
        absorbed = _absorbed(partition_sums, order)
        p, structure = _test(partition_sums.residuals(), absorbed, partition_sums.covariance)
        misfits.append(Misfit(p, name, structure, unit))
    return worst_misfit(misfits)


def worst_misfit(found: Sequence[Misfit]) -> Misfit:
    """Most significant of several chips or partitions, corrected for their number."""
    # many p-values underflow to zero: then the larger structure is the worse one
    worst = min(found, key=lambda m: (m.p_value, -m.structure))
    return replace(worst, p_value=min(1.0, len(found) * worst.p_value))


def residual_sums(
    fit: LinearFit, shards: Shards, solution: Likelihood | None
) -> tuple[dict[int, dict[str, Bins]], StarSums]:
    """Bins of each chip by the name of the partition, and sums of residuals in them.

    `shards` contains all fitted stars.  `solution` provides the residuals and the probabilities of
    true matches; it is the fit by default.
    """
    partitions = {}
    for chip, chip_survey in zip(fit.model.chips, shards.survey.chips, strict=True):
        n = round(fit.n_used * chip_survey.n / len(shards))
        side = int(np.clip(np.sqrt(n / STARS_PER_BIN), 4, MAX_BINS))
        partitions[chip.number] = partitions_for(n) | {SHOWN: (side, side)}
    wanted = {chip: tuple(dict.fromkeys(bins.values())) for chip, bins in partitions.items()}
    clipped = fit.likelihood
    return partitions, shards.sum(star_sums, clipped, solution or clipped, wanted)


def misfits_by_star(
    fit: LinearFit,
    stars: Matches,
    partitions: Mapping[int, Mapping[str, Bins]],
    sums: StarSums,
    shown: Likelihood,
) -> tuple[Misfit, ...]:
    """Structure in the residuals of each chip; detections of one star count as one.

    `partitions` and `sums` are those of `residual_sums`.  They are used directly if each star has
    one detection, or if the stars are not in memory.
    """
    code = stars.error_codes if stars.in_memory else None
    if code is None or len(distinct := np.unique(code)) == len(stars):
        return misfits_of(fit, partitions, sums)
    used = fit.n_used * len(distinct) / len(stars)
    by_star = {
        chip.number: partitions_for(round(used * (stars.chip_number == chip.number).mean()))
        for chip in fit.model.chips
    }
    wanted = {chip: tuple(dict.fromkeys(bins.values())) for chip, bins in by_star.items()}
    binned = star_bins(stars, code, fit.model, shown, wanted)
    return misfits_of(fit, by_star, replace(sums, binned=binned))


def misfits_of(
    fit: LinearFit, partitions: Mapping[int, Mapping[str, Bins]], sums: StarSums
) -> tuple[Misfit, ...]:
    """Structure in the residuals of each chip.

    `partitions` and `sums` are those of `residual_sums`.
    """
    out = []
    for chip, bins in zip(fit.model.chips, partitions.values(), strict=True):
        binned = {
            name: sums.binned[chip.number, size] for name, size in bins.items() if name != SHOWN
        }
        misfit = misfit_of(binned, order=fit.model.order, unit=fit.unit)
        out.append(replace(misfit, chip=chip) if len(fit.model.chips) > 1 else misfit)
    return tuple(out)


def _absorbed(sums: BinnedSums, order: int | None) -> float:
    """Degrees of freedom, on both axes, that the polynomial removes from means over these bins.

    A term removes from the bins what remains of it after averaging over them: nothing if it
    oscillates within a bin, like all terms that vary along a column in the partition into columns.
    """
    if order is None:
        return 0.0
    passed_y, passed_x = (_passed(n, order) for n in sums.count.shape)
    return 2.0 * sum(passed_x[i] * passed_y[j] for i, j in polynomial_terms(order))


def _passed(n: int, order: int) -> Float:
    """Mean square of each Legendre polynomial averaged over n equal bins, relative to its own."""
    means = bin_means(n, order)
    return (2 * np.arange(order + 1) + 1) * np.mean(means**2, axis=1)


def bin_means(n: int, order: int) -> Float:
    """Means (order + 1, n) of each Legendre polynomial over n equal bins."""
    edges = np.linspace(-1.0, 1.0, n + 1)
    integrals = [legendre.Legendre.basis(k).integ()(edges) for k in range(order + 1)]
    return np.asarray(np.diff(integrals, axis=1) * n / 2)


def _test(cells: BinnedResiduals, absorbed: float, covariance: Float | None) -> tuple[float, float]:
    """P-value of the mean residuals, and the rms of the structure.

    `covariance` (ny, nx) is that of the means of u and v if their errors are correlated.
    """
    good = cells.count >= 5
    n = cells.count[good]
    # the square of a t variable is larger than that of a normal variable
    shrink = np.sqrt((n - 3) / (n - 1))
    mean = np.stack([cells.mean_u[good], cells.mean_v[good]])
    sem = np.stack([cells.sem_u[good], cells.sem_v[good]]) / shrink
    sem = np.maximum(sem, np.finfo(float).tiny ** 0.25)  # residuals may be equal to the last bit
    total = float(((mean / sem) ** 2).sum())
    if covariance is not None:
        # Hotelling's square of a bin, whose mean is (n - 1) / (n - 4) times that of a chi-square
        mixed = covariance[good]
        (u, v), (uu, vv) = mean, (shrink * sem) ** 2
        square = (vv * u**2 - 2 * mixed * u * v + uu * v**2) / (uu * vv - mixed**2)
        total = float((square * (n - 4) / (n - 1)).sum())
    dof = max(mean.size - absorbed * n.size / cells.count.size, 1.0)
    p = float(chi2_sf(total, dof))
    excess = (mean**2 - sem**2).sum(axis=0).mean() if n.size else 0.0
    if excess <= 0 and not STRUCTURE.met_by(p):  # hidden by the noisiest cells: weight by precision
        excess = 2 * (total - dof) / (1 / sem**2).sum()
    return p, float(np.sqrt(max(excess, 0.0)))


def error_scale(fit: LinearFit, table: Matches) -> float:
    """Factor on all errors that makes small residuals consistent with them; 1 if it is not large.

    A low quantile of chi-square is compared with its expectation, because most matches may be
    false.  `table` contains the matches or a part of them.
    """
    stars, _ = prepare(fit.model, table)
    residual = stars.residuals_along_axes(np.asarray(fit.mean))
    quantile = np.quantile(stars.chi2(residual), LOW_QUANTILE)
    factor = float(np.sqrt(quantile / chi2_ppf(LOW_QUANTILE, 2)))
    return 1.0 if QUOTED_ERRORS.met_by(factor) else factor


def error_scale_sentence(factor: float, sigma: float, unit: str, *, by_magnitude: bool) -> str:
    """Warning that errors were multiplied, and what may help instead, as a clause.

    `sigma` is the median error after the multiplication; `by_magnitude` is True if errors can be
    estimated as a function of magnitude.
    """
    do = "check their unit and the order of the model"
    if by_magnitude:
        do += ', or set data.sigma = "by_magnitude"'
    return (
        f"the residuals scatter {factor:.3g} times as widely as the quoted errors say (median "
        f"{sigma / factor:.3g} {unit}), and all errors were multiplied by that: {do}"
    )


def explained_by_false_matches(posterior: Posterior | None, quoted: float) -> bool:
    """True if a posterior finds false matches, and correct quoted errors for the true ones.

    `quoted` is the typical quoted error per axis, in the unit of u and v.
    """
    if posterior is None or not {"f", "j"} <= set(posterior.hyper) or quoted <= 0:
        return False
    jitter = float(np.sqrt(np.mean(posterior.hyper["j"] ** 2)))
    right = 1.0 + (jitter / quoted) ** 2 <= CHI2_TOO_LARGE.value
    return right and float(posterior.hyper["f"].mean()) > FALSE_FRACTION


def majority_sentence(
    fit: LinearFit,
    posterior: Posterior | None = None,
    *,
    quoted: float | None = None,
    things: str = "pairs",
) -> str:
    """Warning that most pairs are false, as a clause; empty if they are not.

    Rejection and mixture both assume that true matches cluster.  If most matches are false, a
    chance alignment or their mean may have been fitted, and the posterior then belongs to a wrong
    mode.  If the outliers of a mixture have a different shape than the false matches, the solution
    may take all pairs as true with large errors; a large jitter indicates that.

    `quoted` is the typical quoted error per axis, in the unit of u and v; `things` is the word for
    the matches.
    """
    if posterior is not None and "f" in posterior.hyper:
        fraction = float(posterior.hyper["f"].mean())
        if not FALSE_MAJORITY.met_by(fraction):
            return (
                f"the mixture takes {100 * fraction:.0f} % of the {things} for false ones: with "
                "more false than true ones the solution may rest on chance alignments"
            )
    if posterior is not None and quoted and "j" in posterior.hyper:
        jitter = float(posterior.hyper["j"].mean())
        if jitter > WIDENED_ERRORS.value * quoted:
            return (
                f"the mixture adds {jitter:.3g} {posterior.unit} to the errors of all {things}, "
                f"{jitter / quoted:.2g} times the quoted one: either that is far too small, or "
                f"most {things} are false ones that were taken for true"
            )
    share = fit.n_rejected / fit.n_rows
    if not FALSE_MAJORITY.met_by(share):
        return (
            f"the fit left out {100 * share:.0f} % of the {things}: most of them are "
            "false, the quoted errors are far too small or the order of the model is too low, and "
            "the solution may rest on chance alignments"
        )
    return ""


SAMPLE = 20_000  # largest number of detections that are used
MIN_STARS = 30  # stars with motions
FARTHEST = 60.0  # largest shift in the scan, years
STEPS = 481  # number of steps in the scan, a quarter of a year each
MAX_ITERATIONS = 30
# largest error of a motion, relative to the scatter of motions; larger errors are often quoted too
# small
WELL_KNOWN = 0.2
BIWEIGHT = 4.685  # robust standard deviations beyond which a star has no weight (Tukey)


@dataclass(frozen=True)
class EpochShift:
    """An error of the epochs that explains residuals."""

    years: float  # from the epoch of the reference positions to that of the exposures
    sigma: float  # its standard error
    # before, after: robust scatter of the residuals per axis without and with the shift, in `unit`,
    # for stars with well known motions
    before: float
    after: float
    unit: str  # of u and v
    significant: bool  # True if it exceeds five standard errors and reduces the scatter

    @property
    def sentence(self) -> str:
        """Interpretation of the shift, and remedy."""
        when = "after" if self.years > 0 else "before"
        return (
            f"the residuals go with the proper motions of the stars: the exposures were taken "
            f"{abs(self.years):.2f} +- {self.sigma:.2f} years {when} the epoch that the reference "
            f"positions have (the scatter falls from {self.before:.2g} to {self.after:.2g} "
            f"{self.unit}); check the epochs of the exposures (data.epoch or a column) and of the "
            "catalogue (column ref_epoch, or data.catalogue_epoch)"
        )


def epoch_shift(table: Matches, solution: Solution) -> EpochShift | None:
    """Error of the epochs according to the residuals.

    Every k-th row is used if the table has more than `SAMPLE` rows.  Returns None without proper
    motions, or with too few.
    """
    if table.pm_u is None or table.pm_v is None:
        return None
    sample = scored_sample(table.sample(SAMPLE), solution)
    motion = sample.motion
    if motion is None:
        return None
    moving = np.any(motion != 0, axis=0)  # zero on both axes means that no motion was measured
    if moving.sum() < MIN_STARS:
        return None
    error = np.zeros_like(motion) if sample.motion_sigma is None else sample.motion_sigma
    well_known = moving & (error < WELL_KNOWN * _scatter(motion[:, moving])).all(axis=0)
    if well_known.sum() < MIN_STARS:
        return None
    residual, P = _left_over(sample, well_known * sample.inlier, sample.residual, motion)
    grid = np.linspace(-FARTHEST, FARTHEST, STEPS)
    known_residual, moved = residual[:, well_known], P[:, well_known]
    sizes = [float(np.median(np.abs(known_residual + dt * moved))) for dt in grid]
    dt = float(grid[int(np.argmin(sizes))])
    before = _scatter(residual[:, well_known])
    weight = information = np.zeros(0)
    for _ in range(MAX_ITERATIONS):
        scale = np.sqrt(_scatter((residual + dt * P)[:, well_known]) ** 2 + (dt * error) ** 2)
        if not (scale > 0).all():
            return None
        z2 = (((residual + dt * P) / scale) ** 2).sum(axis=0) / (2 * BIWEIGHT**2)
        single = np.where(well_known & (z2 < 1), (1 - np.minimum(z2, 1)) ** 2, 0.0)
        weight = single / scale**2
        residual, P = _left_over(sample, single, sample.residual, motion)
        information = (weight * (P**2 - error**2)).sum()
        if not information > 0:
            return None
        new = -float((weight * residual * P).sum() / information)
        if abs(new - dt) < 1e-6:
            break
        dt = new
    corrected = residual + dt * P
    # a star has one motion in all of its detections, and the error of the motion is in both factors
    _, star = np.unique(motion, axis=1, return_inverse=True)
    score = (weight * (corrected * P - dt * error**2)).sum(axis=0)
    sigma = float(np.sqrt(squares_over(star.ravel(), score)[0]) / information)
    after = _scatter(corrected[:, well_known])
    is_significant = abs(dt) > EPOCH_SHIFT.value * sigma and after < before
    return EpochShift(dt, sigma, before, after, sample.model.unit, bool(is_significant))


def _scatter(values: Float) -> float:
    """Robust standard deviation about the median of each axis, both axes together."""
    middle = np.median(values, axis=1, keepdims=True)
    return MAD_TO_SIGMA * float(np.median(np.abs(values - middle)))


def _left_over(sample: ScoredSample, weight: Float, *fields: Float) -> Iterator[Float]:
    """Vectors (2, N) minus polynomials on each chip of each exposure."""
    out = [field.copy() for field in fields]
    for rows in _together(sample):
        basis = sample.model.basis().evaluate_scaled(sample.X[rows], sample.Y[rows])
        w = np.sqrt(weight[rows])
        if (w > 0).sum() < 2 * basis.shape[1]:  # too few for a polynomial: only a shift
            basis = basis[:, :1]
        for field in out:
            coefficients = np.linalg.lstsq(w[:, None] * basis, (w * field[:, rows]).T)[0]
            field[:, rows] -= (basis @ coefficients).T
    yield from out


def _together(sample: ScoredSample) -> list[Int]:
    """Indices of the rows of each chip and exposure."""
    keys = np.column_stack([sample.chip, sample.exposure])
    code = np.unique(keys, axis=0, return_inverse=True)[1].ravel()
    return np.split(np.argsort(code, kind="stable"), np.cumsum(np.bincount(code))[:-1])
