"""Diagnostics of a solution from its residuals, and the functions that compute them."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np

from bayesdist.data import MagnitudeErrors, Matches
from bayesdist.diagnose.checks import (
    coverage_checks,
    displaced_group,
    exposure_checks,
    holdout_checks,
    input_checks,
    outlying_checks,
    score_checks,
    structure_checks,
)
from bayesdist.diagnose.correlated import Discrepancy, DiscrepancyPriors, estimate_discrepancy
from bayesdist.diagnose.holdout.validation import HoldoutValidation
from bayesdist.diagnose.overlap import OverlapTest
from bayesdist.diagnose.periods import PeriodSettings, TimeVariation, time_variation
from bayesdist.diagnose.residuals.binned import BinnedSums, Coverage, coverage_of
from bayesdist.diagnose.residuals.misfit import (
    SHOWN,
    Bins,
    EpochShift,
    Misfit,
    epoch_shift,
    explained_by_false_matches,
    majority_sentence,
    misfits_by_star,
    residual_sums,
    worst_misfit,
)
from bayesdist.diagnose.residuals.stars import (
    SAMPLE,
    StarSample,
    StarSums,
    centroid_scatter,
    dates_of,
    flagged_by_exposure,
    likelihood_shown,
    star_sample,
)
from bayesdist.diagnose.score.result import ScoreTest
from bayesdist.diagnose.score.tests import score_tests
from bayesdist.errors import InputError
from bayesdist.infer import Compute, GaussianPriors, LinearFit, Posterior, Shards, fit_linear
from bayesdist.infer.catalogue.star_covariance import StarCovariance, star_covariance
from bayesdist.infer.catalogue.star_errors import StarErrors
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.exposures.hierarchy import Settling
from bayesdist.infer.posterior.checks import ChiSquare
from bayesdist.infer.stars.loading import opened
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.checks import EITHER, Check, warnings_of
from bayesdist.utils.quantities import Number, Random, takes, value_in
from bayesdist.utils.random import assessment_rng, restarted

INSIDE = 0.5  # of the match radius: matches that end within it may have been cut at another radius

log = logging.getLogger("bayesdist")


@dataclass(frozen=True, eq=False)
class Diagnostics:
    """Results of all diagnostics from the residuals of a solution.

    They include the misfit, score tests and correlated errors.  Create them with `diagnose`, and
    pass them to `error_budget` and `check_requirements` so that verdicts take the residuals into
    account.  The printed form gives the number of tests, the significant findings and the warnings.

    Parameters
    ----------
    sums : StarSums
        Sums of the residuals of all stars.
    partitions : mapping
        Numbers of bins (nx, ny) of each partition, by chip number and name of the partition.
    misfits : tuple of Misfit
        Structure in the residuals, per chip; a single item for all chips if these share stars.
    coverage : tuple of Coverage
        Area of each chip that the stars cover.
    sample : StarSample
        All stars, or a sample if there are very many, with residuals and probabilities.
    chi_square : ChiSquare
        Chi-square of the fit with the quoted errors.
    input_checks : tuple of Check
        Other checks of the fit, the frames, the quoted errors and the matching.
    dates : ndarray, shape (T,)
        Distinct dates of the stars in decimal years, ascending; empty without dates.
    majority : str
        Sentence saying that most pairs are false; empty if they are not.
    epoch_shift : EpochShift or None
        Error of the epochs; None without proper motions.
    centroid : MagnitudeErrors or None
        Scatter of the residuals by magnitude; None without magnitudes.
    flagged : ndarray of int, shape (E,), or None
        Number of stars of each exposure that are more likely false than true; None for one
        exposure.
    score_tests : tuple of ScoreTest
        Results of the score tests.
    correlated : Discrepancy or None
        Correlated errors beyond the model; None if they have not been estimated.
    catalogue : StarCovariance or None
        Covariance of the parameters due to errors of the catalogue; None if these are unknown.
    periods : TimeVariation or None
        Comparison of the models of several periods; None if it was not requested.
    holdout : HoldoutValidation or None
        Results for stars that were set aside before the fit; None without such stars.
    overlap : OverlapTest or None
        Comparison of two exposures far apart in time; None unless the run is a campaign.

    Examples
    --------
    >>> from bayesdist.missions.wise import simulate_wise
    >>> matches, truth = simulate_wise(500, rng=np.random.default_rng(1))
    >>> model = bd.build_model(matches, order=4, size=(1016, 1016))
    >>> posterior = bd.sample(bd.fit_linear(matches, model), matches, target_ess=100)
    >>> diagnostics = bd.diagnose(posterior, matches)
    >>> diagnostics.correlated.structure_rms < 0.1  # pixels
    True
    """

    sums: StarSums
    partitions: Mapping[int, Mapping[str, Bins]]
    misfits: tuple[Misfit, ...]
    coverage: tuple[Coverage, ...]
    sample: StarSample
    chi_square: ChiSquare
    input_checks: tuple[Check, ...]
    dates: Float
    majority: str = ""
    epoch_shift: EpochShift | None = None
    centroid: MagnitudeErrors | None = None
    flagged: Int | None = None
    score_tests: tuple[ScoreTest, ...] = ()
    correlated: Discrepancy | None = None
    catalogue: StarCovariance | None = None
    periods: TimeVariation | None = None
    holdout: HoldoutValidation | None = None
    overlap: OverlapTest | None = None

    def __repr__(self) -> str:
        warnings = warnings_of((*self.checks_of_input, *self.checks))
        significant = sum(test.significant for test in self.score_tests)
        n_tests = len(self.score_tests)
        tests = f"{significant} of {n_tests} tests of the residuals found something"
        if not n_tests:
            tests = "the residuals were not tested"
        elif not significant:
            tests = f"{n_tests} tests of the residuals found nothing"
        head = f"Diagnostics of {self.sample.n_total} stars: {tests}"
        rms = None if self.correlated is None else self.correlated.structure_rms
        if self.correlated is not None and rms is not None:
            head += f"; structure beyond the model {rms:.2g} {self.correlated.model.unit} rms"
        if self.holdout is not None:
            head += f"; {self.holdout.verdict}"
        return "\n".join([head, *(f"  - {text}" for text in warnings)])

    @property
    def misfit(self) -> Misfit:
        """Worst of the misfits, corrected for their number."""
        return worst_misfit(self.misfits)

    @property
    def shows_structure(self) -> bool:
        """True if the residuals significantly contain structure that the model does not have."""
        tests = any(test.significant and test.held_by == "structure" for test in self.score_tests)
        return tests or any(misfit.significant for misfit in self.misfits)

    @property
    def shown(self) -> tuple[BinnedSums, ...]:
        """Sums of residuals for maps of their means, one per chip."""
        return tuple(self.sums.binned[c, bins[SHOWN]] for c, bins in self.partitions.items())

    @property
    def checks_of_input(self) -> tuple[Check, ...]:
        """Checks of the fit and its matching, taking the results of the tests into account."""
        findings = [
            test.name for test in self.score_tests if test.warned and test.held_by != "noise"
        ]
        of_group = displaced_group(self.score_tests)
        if any(misfit.significant for misfit in self.misfits) and not of_group:
            findings.append("structure in the residuals")
        if self.correlated is not None and self.correlated.facts.get("exposures_outlying"):
            findings.append("exposures that deviate far more than the others")
        if self.majority:
            findings.append("more false than true pairs")
        return self.chi_square.check(findings, displaced=of_group), *self.input_checks

    @property
    def checks(self) -> tuple[Check, ...]:
        """Checks of the results that a reader of the numbers needs to know."""
        out = [
            *holdout_checks(self.holdout),
            *score_checks(self.score_tests, self.correlated),
            *structure_checks(self.misfits, self.correlated, self.score_tests),
        ]
        out += [*coverage_checks(self.coverage), *exposure_checks(self.sample.by_exposure)]
        out += outlying_checks(self.correlated)
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


class FittedStars(Protocol):
    """Diagnostics of a solution that includes the positions of its stars.

    They replace the general diagnostics, which take the positions as known.
    """

    def misfits(self) -> tuple[Misfit, ...]:
        """Structure in the residuals, per chip; a single item if the chips share stars."""

    def absorbed(self, rows: Int) -> Float:
        """Fraction (N,) of the variance of detections that the fitted positions absorb.

        Parameters
        ----------
        rows : ndarray of int, shape (N,)
            Rows of the detections in the fitted matches.
        """

    def discrepancy(self, *, rng: np.random.Generator, priors: DiscrepancyPriors) -> Discrepancy:
        """Correlated errors beyond the model."""

    def score_tests(self, stars: Matches) -> tuple[ScoreTest, ...]:
        """Score tests of the residuals; `stars` are the fitted matches."""


@takes(matches=Matches, fit=LinearFit, compute=Compute)
def diagnose(
    posterior: Posterior,
    matches: Matches,
    *,
    fit: LinearFit | None = None,
    rng: Random = 1,
    priors: GaussianPriors | None = None,
    match_radius: Number | None = None,
    discrepancy: DiscrepancyPriors | None = None,
    compute: Compute | None = None,
) -> Diagnostics:
    """Examine the residuals of a posterior for effects that the model lacks, and for wrong errors.

    Correlated errors beyond the model (structure over the detector, differences between exposures)
    are estimated with priors on their size, targeted tests search for effects that the model may
    lack, and the scatter of the stars is compared with their quoted errors.  `bayesdist run`
    computes the same diagnostics: the same stars, settings and seed give the same numbers.

    Parameters
    ----------
    posterior : Posterior
        Posterior from `sample`.
    matches : Matches
        The N stars that were given to `sample`, with the same errors.
    fit : LinearFit, optional
        Fit that the sampler started from.  The default is a fit with the default rejection limits;
        pass the fit if it was made with other limits.
    rng : int or numpy.random.Generator
        Seed of the run.  A generator is restarted from its initial state.
    priors : GaussianPriors, optional
        Priors of the parameters, as given to `sample`; flat by default.
    match_radius : float or Quantity, optional
        Radius within which the stars were matched, in the unit of u and v; by default that of the
        posterior's mixture.
    discrepancy : DiscrepancyPriors, optional
        Prior medians of the sizes of effects that the model may lack.
    compute : Compute, optional
        Settings for parallel computation; one process with threads by default.

    Returns
    -------
    Diagnostics

    Raises
    ------
    InputError
        If `posterior` is not a posterior, or that of a campaign or a self-calibration; if the
        matches or the fit do not belong to it; if the radius is not positive; or if the seed is
        invalid.

    Examples
    --------
    >>> from bayesdist.missions.wise import simulate_wise
    >>> matches, truth = simulate_wise(500, rng=np.random.default_rng(1))
    >>> model = bd.build_model(matches, order=2, size=(1016, 1016))
    >>> fit = bd.fit_linear(matches, model)
    >>> posterior = bd.sample(fit, matches, seed=1, target_ess=100)
    >>> diagnostics = bd.diagnose(posterior, matches, fit=fit, rng=1)
    >>> any(test.significant for test in diagnostics.score_tests)  # order 4 is needed
    True
    """
    _refuse_other_posterior(posterior, matches, fit)
    matches = matches.with_star_codes()
    rng = assessment_rng(rng)
    priors = priors or GaussianPriors.none(posterior.model)
    circle = posterior.mixture.match_radius
    radius = circle if match_radius is None else _radius(match_radius, matches.unit)
    with opened(posterior.model, matches, compute) as shards:
        fit = fit or fit_linear(shards, posterior.model, priors=priors)
        table = matches.sample(SAMPLE)
        by_residuals = diagnose_fit(
            fit,
            posterior,
            matches,
            shards,
            table,
            eliminated=None,
            centroid="residuals",
            known=priors.joint is not None,
            match_radius=radius,
            in_circle=circle is not None and matches.has_nominal,
            matched_before=True,
        )
        return diagnose_posterior(
            by_residuals,
            fit,
            posterior,
            matches,
            shards,
            rng=rng,
            tested=table,
            discrepancy=discrepancy or DiscrepancyPriors(),
            priors=priors,
            match_radius=radius,
            structure=True,
            exposures=True,
            settling=None,
            catalogue=None,
            eliminated=None,
            periods=None,
        )


def _refuse_other_posterior(posterior: Posterior, matches: Matches, fit: LinearFit | None) -> None:
    """Raise InputError unless the posterior is one of these matches, without joint exposures."""
    if not isinstance(posterior, Posterior):
        raise InputError(
            f"a {type(posterior).__name__} has no posterior to examine",
            where="diagnose",
            do="give what bd.sample returned",
        )
    if posterior.own_places or posterior.model.gauge == "held":
        kind = "self-calibration" if posterior.own_places else "campaign"
        raise InputError(
            f"the posterior is that of a {kind}, which is more than its stars and its model",
            where="diagnose",
            do="use the diagnostics of its run",
        )
    if posterior.n_stars != len(matches):
        raise InputError(
            f"the posterior was made from {posterior.n_stars} stars, and these are {len(matches)}",
            where="diagnose",
            do="give the matches that were given to bd.sample",
        )
    digests = posterior.matches_digest, matches.digest()
    if all(digests) and digests[0] != digests[1]:
        raise InputError(
            "the posterior was made from other stars",
            where="diagnose",
            do="give the matches that were given to bd.sample",
        )
    if fit is not None and fit.model != posterior.model:
        raise InputError(
            "the fit and the posterior have different models",
            where="diagnose",
            do="give the fit that was given to bd.sample, or leave out fit",
        )


def _radius(value: Number, unit: str) -> float:
    """Radius in the unit of u and v, from a number or a Quantity."""
    radius = value_in(value, unit, "match_radius")
    if not (np.isfinite(radius) and radius > 0):
        raise InputError(
            f"the match radius is {radius:g} {unit}",
            do="give a positive number, or leave it out",
        )
    return radius


@one_thread
def diagnose_fit(
    fit: LinearFit,
    posterior: Posterior | None,
    stars: Matches,
    shards: Shards,
    table: Matches,
    *,
    eliminated: FittedStars | None,
    centroid: MagnitudeErrors | Literal["residuals"] | None,
    known: bool,
    match_radius: float | None,
    in_circle: bool,
    matched_before: bool,
    error_scale: str = "",
    rows: str = "stars",
    chooser: str = "least-squares fit",
) -> Diagnostics:
    """Diagnostics from residuals alone; nothing is estimated or tested against alternatives.

    Parameters
    ----------
    fit : LinearFit
        The least-squares fit.
    posterior : Posterior or None
        Posterior, if one was sampled; its residuals are then used.
    stars : Matches
        Fitted stars, with errors.
    shards : Shards
        The same stars, for passes over the data.
    table : Matches
        Evenly spread sample of the stars, or all of them.
    eliminated : FittedStars or None
        Diagnostics with the positions of stars eliminated, if these were fitted.
    centroid : MagnitudeErrors, 'residuals' or None
        Centroid errors, if the fit estimated them; with 'residuals' they are the scatter of the
        residuals.
    known : bool
        True if an earlier calibration covers the area without stars.
    match_radius, in_circle, matched_before, error_scale, rows, chooser
        See `input_checks`.

    Returns
    -------
    Diagnostics
    """
    model, survey = fit.model, shards.survey
    shown = likelihood_shown(fit, posterior)
    partitions, sums = residual_sums(fit, shards, None if posterior is None else shown)
    several = len(model.chips) > 1
    sample = star_sample(table, len(stars), fit, posterior)
    if eliminated is None:
        misfits = misfits_by_star(fit, stars, partitions, sums, shown)
    else:
        misfits = eliminated.misfits()
        sample = replace(sample, taken=eliminated.absorbed(sample.table.row))
    if centroid == "residuals":
        centroid = centroid_scatter(sample, n_params=model.n_params)
    sigma, pair_word = survey.reference_sigma, "pairs" if rows == "stars" else rows
    majority = majority_sentence(fit, posterior, quoted=sigma, things=pair_word)
    checks = input_checks(
        fit,
        table,
        reference_sigma=sigma,
        match_radius=match_radius,
        in_circle=in_circle,
        majority=majority,
        error_scale=error_scale,
        matched_before=matched_before,
        rows=rows,
        chooser=chooser,
    )
    return Diagnostics(
        sums=sums,
        partitions=partitions,
        misfits=misfits,
        coverage=tuple(
            coverage_of(
                sums.binned[chip.number, bins["cells"]],
                chip_survey.corners,
                chip,
                several=several,
                known=known,
            )
            for chip, bins, chip_survey in zip(
                model.chips, partitions.values(), survey.chips, strict=True
            )
        ),
        sample=sample,
        chi_square=ChiSquare(
            fit.chi2,
            fit.dof,
            in_circle,
            explained_by_false_matches(posterior, sigma),
            eliminated is None,
            "" if match_radius is None else _radius_doubt(sample, match_radius),
            match_radius is not None and not table.has_nominal,
        ),
        input_checks=tuple(checks),
        dates=dates_of(stars if stars.in_memory else table),
        majority=majority,
        epoch_shift=epoch_shift(table, fit),
        centroid=centroid,
    )


def _radius_doubt(sample: StarSample, match_radius: float) -> str:
    """Clause on a match radius that no residual comes near; empty if one does."""
    largest = float(np.hypot(*sample.residual.T).max(initial=0.0))
    if largest > INSIDE * match_radius:
        return ""
    unit = sample.table.unit
    return (
        f"the match radius is stated as {match_radius:.3g} {unit}, and no residual is larger than "
        f"{largest:.3g}: if the matches were cut there, their errors are wrong, and "
        "outliers.match_radius has to be that radius"
    )


@one_thread
def diagnose_posterior(
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
    eliminated: FittedStars | None,
    periods: PeriodSettings | None,
) -> Diagnostics:
    """Add estimates of correlated errors, and tests, to the diagnostics of a posterior.

    Parameters
    ----------
    found : Diagnostics
        Diagnostics from residuals, from `diagnose_fit`.
    fit, posterior, stars, shards, eliminated
        See `diagnose_fit`.
    rng : numpy.random.Generator
        Source of random numbers; it is restarted for each result.
    tested : Matches
        Matches for the score tests.
    discrepancy : DiscrepancyPriors
        Priors on the size of correlated errors.
    priors : GaussianPriors or None
        Priors of the parameters of the posterior.
    match_radius : float or None
        Radius within which the stars were matched, in the unit of u and v.
    structure : bool
        True to estimate structure beyond the model; False if look-up tables were fitted to it.
    exposures : bool
        True to estimate linear deviations of single exposures; False if a hierarchy of them was
        fitted.
    settling : Settling or None
        Transformation of the shifts of single chips that was applied after sampling.
    catalogue : StarErrors or None
        Errors of the catalogue by star code.
    periods : PeriodSettings or None
        Periods to compare.

    Returns
    -------
    Diagnostics

    Raises
    ------
    InputError
        If correlated errors cannot be estimated, because no verdict would be justified.
    DegenerateError
        If a period has too few pairs.
    """
    in_memory = stars if stars.in_memory else None
    shared = None
    if eliminated is not None:
        estimated = eliminated.discrepancy(rng=restarted(rng), priors=discrepancy)
        tests = eliminated.score_tests(stars)
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
    """Covariance of the parameters due to the errors of the catalogue.

    It is computed for the linear fit, because the covariance of the fit has no sampling noise: with
    hundreds of parameters, a few thousand draws leave factors of several in the eigenvalues of
    theirs.  Polynomials and drift are exact, frames follow according to their correlation with
    these.  `stars` must have codes and errors that include those of the catalogue.  Returns None if
    the catalogue has no errors, or if the matches have no codes.
    """
    if errors is None or stars is None or stars.star is None:
        return None
    log.info("diagnose: errors of the catalogue, one for each star in all of its exposures")
    return star_covariance(fit, stars, errors, frames=False)
