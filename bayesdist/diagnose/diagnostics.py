"""Diagnostics of a solution by its residuals: one value, made by a function of its arguments."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from bayesdist.data import MagnitudeErrors, Matches
from bayesdist.diagnose.checks import (
    coverage_checks,
    exposure_checks,
    holdout_checks,
    score_checks,
    structure_checks,
)
from bayesdist.diagnose.correlated import Discrepancy, DiscrepancyPriors, estimate_discrepancy
from bayesdist.diagnose.holdout.validation import HoldoutValidation
from bayesdist.diagnose.overlap import OverlapTest
from bayesdist.diagnose.periods import PeriodSettings, TimeVariation, time_variation
from bayesdist.diagnose.residuals.binned import BinnedSums
from bayesdist.diagnose.residuals.coverage import Coverage, coverage_of
from bayesdist.diagnose.residuals.epoch_shift import EpochShift, epoch_shift
from bayesdist.diagnose.residuals.misfit import (
    MAX_BINS,
    STARS_PER_BIN,
    Misfit,
    misfit_of,
    partitions_for,
    worst_misfit,
)
from bayesdist.diagnose.residuals.quoted import majority_sentence
from bayesdist.diagnose.residuals.sample import (
    StarSample,
    centroid_scatter,
    likelihood_shown,
    star_sample,
)
from bayesdist.diagnose.residuals.star_sums import StarSums, flagged_by_exposure, star_sums
from bayesdist.diagnose.score.result import ScoreTest
from bayesdist.diagnose.score.tests import score_tests
from bayesdist.infer import GaussianPriors, LinearFit, Posterior, Shards
from bayesdist.infer.catalogue.star_errors import StarCovariance, StarErrors, star_covariance
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.exposures.chip_offsets import Settling
from bayesdist.infer.stars.likelihood import Likelihood
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.checks import EITHER, Check
from bayesdist.utils.streams import restarted

if TYPE_CHECKING:
    from bayesdist.infer.selfcal import SelfCalibrationMode

Bins = tuple[int, int]

SHOWN = "shown"  # the partition that diagrams of mean residuals show

log = logging.getLogger("bayesdist")


@dataclass(frozen=True, eq=False)
class Diagnostics:
    """Misfit, score tests, correlated errors and further results by the residuals of a solution."""

    sums: StarSums  # of residuals over all stars
    # bins of each chip, by its number and the name of the partition
    partitions: Mapping[int, Mapping[str, Bins]]
    # structure that the solution leaves, of each chip or, where these share stars, of all
    misfits: tuple[Misfit, ...]
    coverage: tuple[Coverage, ...]  # the area of each chip that its stars cover
    sample: StarSample  # some stars, or all of them, and what residuals and probabilities of each
    majority: str = ""  # what it means that most pairs are false; empty where they are not
    epoch_shift: EpochShift | None = None  # error of the epochs; None without proper motions
    # scatter of residuals by magnitude, where stars have magnitudes
    centroid: MagnitudeErrors | None = None
    # (E,), stars of each exposure that are more likely false than not; None for one exposure
    flagged: Int | None = None
    score_tests: tuple[ScoreTest, ...] = ()
    # correlated errors; None where they have not been estimated
    correlated: Discrepancy | None = None
    # covariance of the parameters by errors of the catalogue, where these are known by star
    catalogue: StarCovariance | None = None
    # models of several periods compared, where that was asked for
    periods: TimeVariation | None = None
    # results of stars that were set aside before the fit, where there are any
    holdout: HoldoutValidation | None = None
    # two exposures far apart in time laid on each other, of a campaign
    overlap: OverlapTest | None = None

    @property
    def misfit(self) -> Misfit:
        """Worst of the misfits, its probability corrected for their number."""
        return worst_misfit(self.misfits)

    @property
    def shown(self) -> tuple[BinnedSums, ...]:
        """Sums of residuals that diagrams of their means show, one for each chip."""
        return tuple(self.sums.binned[c, bins[SHOWN]] for c, bins in self.partitions.items())

    @property
    def checks(self) -> tuple[Check, ...]:
        """Checks that a reader of the numbers has to know."""
        out = [
            *holdout_checks(self.holdout),
            *score_checks(self.score_tests, self.correlated),
            *structure_checks(self.misfits, self.correlated),
        ]
        out += [*coverage_checks(self.coverage), *exposure_checks(self.sample.by_exposure)]
        if self.epoch_shift is not None and self.epoch_shift.significant:
            text = self.epoch_shift.sentence
            out.append(Check("Fit", "Epochs of the exposures", level="warn", sentence=text))
        if self.majority:
            out.append(
                Check(
                    "Fit", "More false than true pairs", "", "none", "warn", self.majority, EITHER
                )
            )
        if self.periods is not None and self.periods.is_material:
            verdict = self.periods.verdict.rstrip(".")
            out.append(Check("Periods", "Differences of periods", level="warn", sentence=verdict))
        return tuple(out)


@one_thread
def diagnose_fit(
    fit: LinearFit,
    posterior: Posterior | None,
    stars: Matches,
    shards: Shards,
    table: Matches,
    *,
    eliminated: SelfCalibrationMode | None,
    centroid: MagnitudeErrors | Literal["residuals"] | None,
    things: str,
    known: bool,
) -> Diagnostics:
    """Diagnostics by residuals alone, of a posterior where there is one; nothing is estimated.

    `stars`: those that were fitted, with errors. `shards`: the same, as passes go over them.
    `table`: evenly spread ones of them, or all. `eliminated`: the solution with its stars, where
    places of stars were fitted too. `centroid`: errors of the centroids where the fit has found
    them; else they are the scatter of the residuals. `things`: what is true or false. `known`:
    whether an earlier calibration says where no stars are.
    """
    model, survey = fit.model, shards.survey
    shown = likelihood_shown(fit, posterior)
    partitions, sums = residual_sums(fit, shards, None if posterior is None else shown)
    several = len(model.chips) > 1
    sample = star_sample(table, len(stars), fit, posterior)
    if eliminated is None:
        misfits = misfits_of(fit, partitions, sums)
    else:
        from bayesdist.diagnose.selfcal.misfit import dithered_misfit

        misfits = (dithered_misfit(eliminated),)
        sample = replace(sample, taken=_taken(eliminated, sample.table.row))
    if centroid == "residuals":
        centroid = centroid_scatter(sample, n_params=model.n_params)
    return Diagnostics(
        sums=sums,
        partitions=partitions,
        misfits=misfits,
        coverage=tuple(
            coverage_of(
                sums.binned[chip.number, bins["cells"]],
                found.corners,
                chip,
                several=several,
                known=known,
            )
            for chip, bins, found in zip(
                model.chips, partitions.values(), survey.chips, strict=True
            )
        ),
        sample=sample,
        majority=majority_sentence(fit, posterior, quoted=survey.reference_sigma, things=things),
        epoch_shift=epoch_shift(table, fit),
        centroid=centroid,
    )


def residual_sums(
    fit: LinearFit, shards: Shards, solution: Likelihood | None
) -> tuple[dict[int, dict[str, Bins]], StarSums]:
    """Bins of each chip by the name of the partition, and sums of residuals in them.

    `shards` has all stars that were fitted; `solution` says where they lie and which are true, by
    default the fit.
    """
    partitions = {}
    for chip, found in zip(fit.model.chips, shards.survey.chips, strict=True):
        n = round(fit.n_used * found.n / len(shards))
        side = int(np.clip(np.sqrt(n / STARS_PER_BIN), 4, MAX_BINS))
        partitions[chip.number] = partitions_for(n) | {SHOWN: (side, side)}
    wanted = {chip: tuple(dict.fromkeys(bins.values())) for chip, bins in partitions.items()}
    clipped = fit.likelihood
    return partitions, shards.sum(star_sums, clipped, solution or clipped, wanted)


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
        found = misfit_of(binned, order=fit.model.order, unit=fit.unit)
        out.append(replace(found, chip=chip) if len(fit.model.chips) > 1 else found)
    return tuple(out)


def _taken(eliminated: SelfCalibrationMode, rows: Int) -> Float:
    """Fraction (N,) of the variance that places of stars take out of detections."""
    from bayesdist.diagnose.selfcal.scores import taken_by_stars

    own = eliminated.problem.rows
    taken = np.zeros(max(int(own.max(initial=-1)), int(rows.max(initial=-1))) + 1)
    taken[own] = taken_by_stars(eliminated)
    return taken[rows]


@one_thread
def diagnose(
    found: Diagnostics,
    fit: LinearFit,
    posterior: Posterior,
    stars: Matches,
    shards: Shards,
    *,
    rng: np.random.Generator,
    tested: Matches,
    discrepancy: DiscrepancyPriors,
    priors: GaussianPriors | None,
    match_radius: float | None,
    structure: bool,
    exposures: bool,
    settling: Settling | None,
    catalogue: StarErrors | None,
    eliminated: SelfCalibrationMode | None,
    periods: PeriodSettings | None,
) -> Diagnostics:
    """Diagnostics of a posterior, with what is estimated and tested.

    `found`: those by residuals, of `diagnose_fit`, and `stars`, `shards` and `eliminated` as there.
    `rng`: each result is made from its numbers from their beginning. `tested`: matches that the
    score tests look at. `discrepancy`: of the size of correlated errors. `priors`: those of the
    parameters that the posterior has. `match_radius`: within which the stars were matched, in the
    unit of u and v. `structure`: whether there is structure beyond the model; not where look-up
    tables were fitted to it. `exposures`: whether single exposures deviate; not where a hierarchy
    of them was fitted. `settling`: what was done to the shifts of single chips after sampling.
    `catalogue`: errors of the catalogue by code of the star. `periods`: that are compared.

    InputError where correlated errors cannot be estimated: no verdict could rest on anything then;
    DegenerateError for a period with too few pairs.
    """
    in_memory = stars if stars.in_memory else None
    shared = None
    if eliminated is not None:
        from bayesdist.diagnose.selfcal.correlated import selfcal_discrepancy
        from bayesdist.diagnose.selfcal.score import selfcal_score_tests

        estimated = selfcal_discrepancy(eliminated, rng=restarted(rng), priors=discrepancy)
        tests = selfcal_score_tests(
            eliminated, mag=stars.mag, colour=stars.colour, epoch=stars.epoch
        )
    else:
        estimated = estimate_discrepancy(
            shards,
            posterior,
            rng=restarted(rng),
            priors=discrepancy,
            parameter_priors=priors,
            sample=found.sample.table,
            stars=in_memory if catalogue is None else None,
            structure=structure,
            exposures=exposures,
            settling=settling,
        )
        tests = score_tests(tested, posterior, priors=priors, match_radius=match_radius)
        shared = catalogue_covariance(fit, in_memory, catalogue)
    return replace(
        found,
        flagged=flagged_by_exposure(shards, posterior) if len(fit.model.exposures) > 1 else None,
        score_tests=tests,
        correlated=estimated.stored,
        catalogue=shared,
        periods=None
        if periods is None
        else time_variation(fit, stars, periods, rng=restarted(rng)),
    )


def catalogue_covariance(
    fit: LinearFit, stars: Matches | None, errors: StarErrors | None
) -> StarCovariance | None:
    """Covariance of the parameters by the errors of the catalogue.

    It is computed for the linear fit, whose covariance has no noise of sampling: with hundreds of
    parameters a few thousand draws leave factors of several in the eigenvalues of theirs.
    Polynomials and drift are followed exactly, frames as far as they are correlated with these.

    `stars` have errors that contain the catalogue's, and codes. None where the catalogue has no
    errors, or the matches no codes.
    """
    if errors is None or stars is None or stars.star is None:
        return None
    log.info("diagnose: errors of the catalogue, one for each star in all of its exposures")
    return star_covariance(fit, stars, errors, frames=False)
