"""The error budget and the verdicts of a solution, for those who use single functions.

The results equal those of a run with the same stars, terms and seed; see
`bayesdist.assess.evaluation`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from bayesdist.assess.budget.budget import ErrorBudget, budget_of
from bayesdist.assess.checks import UNEXAMINED, assumption_checks, catalogue_checks
from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.evaluation import (
    EvaluationSettings,
    judged,
    request_checks,
    with_measured_centroids,
)
from bayesdist.assess.model import ErrorModel, diagnosed_error_model, error_model
from bayesdist.assess.requirements.margins import Margin, judge
from bayesdist.assess.requirements.requirement import Requirement, as_requirements
from bayesdist.assess.solution import place_of
from bayesdist.assess.terms.forms import ErrorTerm
from bayesdist.assess.terms.given import (
    Catalogue,
    UserTerm,
    names_catalogue,
    names_motions,
    require_catalogue,
    stated_names,
)
from bayesdist.assess.units import convert, pixel_scale_of
from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.errors import InputError, require_known
from bayesdist.infer import Posterior, Solution
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.posterior.checks import convergence_check
from bayesdist.model.grid import DEFAULT_GRID
from bayesdist.utils.arguments import takes
from bayesdist.utils.checks import Check, in_order
from bayesdist.utils.quantities import Epoch, Number, Random, value_in, year_of
from bayesdist.utils.streams import assessment_rng

EXPOSURES = ("mean", "single")
MISSING_TERMS = (
    "measured terms are missing (structure beyond the model, differences between exposures, noise "
    f"as it is observed): {UNEXAMINED.sentence}"
)


@takes(solution=Solution)
@one_thread
def error_budget(
    solution: Solution,
    *,
    diagnostics: Diagnostics | None = None,
    catalogue: Catalogue | None = None,
    terms: Sequence[ErrorTerm] = (),
    exposure: str = "mean",
    aligned: bool = False,
    grid: tuple[int, int] = DEFAULT_GRID,
    epoch: Epoch | None = None,
    chip: int | None = None,
    n_draws: int = 4000,
    rng: Random = 1,
    pixel_scale: Number | None = None,
) -> ErrorBudget:
    """Error budget of a solution over a grid on the detector, at an epoch.

    The parts of the model are combined by joint draws, for they are correlated; other terms are
    independent and added in quadrature.  Without `diagnostics` the measured terms are missing, and
    the notes of the budget say so.

    Parameters
    ----------
    solution : Posterior or LinearFit
        With `diagnostics` the posterior that they were made of.
    diagnostics : Diagnostics, optional
        Result of `diagnose`, which adds structure beyond the model, differences between exposures
        and the observed noise of the stars.
    catalogue : Catalogue, optional
        Error of the reference catalogue.
    terms : sequence of ErrorTerm
        Further errors, such as `UserTerm`; each gives one row or more.
    exposure : str
        'mean' for a position in the mean of the exposures; 'single' for one in a single exposure,
        which deviates as the diagnostics have found.
    aligned : bool
        True if the observer fits shift and rotation of the exposure, so that they are no errors.
    grid : tuple of int
        Points on x and y of each chip.
    epoch : float, Time or str, optional
        Decimal years or a date.  By default the latest date of the stars, if the model depends on
        time and `diagnostics` know the dates.
    chip : int, optional
        Chip number; all chips by default.
    n_draws : int
    rng : int or numpy.random.Generator
        Seed of a run; a generator is advanced.
    pixel_scale : float or Quantity, optional
        Size of one pixel in mas; that of the solution by default.

    Returns
    -------
    ErrorBudget
        In the unit of u, v.

    Raises
    ------
    InputError
        For an unknown chip, a missing epoch, a bad grid, fewer than two draws, a term whose unit
        needs a pixel scale that is not known, and diagnostics of another solution.

    Examples
    --------
    >>> from bayesdist.missions.wise import simulate_wise
    >>> matches, truth = simulate_wise(500, rng=np.random.default_rng(1))
    >>> model = bd.build_model(matches, order=2, size=(1016, 1016))
    >>> fit = bd.fit_linear(matches, model)
    >>> catalogue = bd.Catalogue("2MASS", 0.005, "pix")
    >>> budget = bd.error_budget(fit, catalogue=catalogue, grid=(5, 3), n_draws=100)
    >>> [row["name"] for row in budget.rows()]
    ['coefficients', '2MASS', 'total']
    >>> "the residuals were not examined" in budget.notes[0]
    True
    """
    stated = _stated_terms(catalogue, terms)
    settings = _settings(solution, diagnostics, stated, exposure, grid, epoch, n_draws, pixel_scale)
    errors = _error_model(solution, diagnostics, stated, settings, aligned=aligned, chip=chip)
    chips = None
    if chip is not None:
        chips = (place_of(solution.model, epoch=settings.epoch, chip=chip).chip.number,)
    domain = EvaluationDomain.of_chips(solution.model, grid, chips=chips, epoch=settings.epoch)
    budget = budget_of(errors.drawn(n_draws, assessment_rng(rng)), domain)
    notes = [MISSING_TERMS] if diagnostics is None else []
    notes += [check.sentence for check in _catalogue_checks(settings) if check.sentence]
    return replace(budget, notes=tuple(notes))


@takes(solution=Solution)
@one_thread
def check_requirements(
    solution: Solution,
    requirements: Requirement | Sequence[Requirement],
    *,
    diagnostics: Diagnostics | None = None,
    catalogue: Catalogue | None = None,
    terms: Sequence[ErrorTerm] = (),
    exposure: str = "mean",
    aligned: bool = False,
    grid: tuple[int, int] = DEFAULT_GRID,
    epoch: Epoch | None = None,
    chip: int | None = None,
    n_draws: int = 4000,
    rng: Random = 1,
    pixel_scale: Number | None = None,
    checks: Sequence[Check] = (),
) -> tuple[Margin, ...]:
    """Judge requirements on draws of the position error.

    Each draw is an error field over the grid: a draw of the solution minus its mean (all parts of
    the model jointly, so with the correlation between positions), plus a draw of every term: for a
    systematic term of the user one Gaussian offset of each axis for the whole field, for random and
    local ones an independent Gaussian error at every grid point.  The statistic of each field gives
    a distribution, and the fraction of draws at or under the limit is compared with the probability
    asked for.

    Without `diagnostics` every verdict is 'undecided': structure in the residuals would make the
    errors larger than stated, and quoted errors that are too large make them smaller.  Without an
    error of the reference catalogue nothing is 'met'.  With both, the verdict is that of
    `bayesdist run` for the same stars, terms and seed.

    The field is that of all chips: the same grid on each of them, so that each has the same weight.
    A draw of the solution and an offset are common to all chips.

    For a relative error the statistic is that of the differences between two positions, over all
    pairs of points.  Over a range of epochs the draws of everything are the same throughout, and
    that of the statistic is the largest over nine epochs and the breaks between them.

    Parameters
    ----------
    solution : Posterior or LinearFit
        With `diagnostics` the posterior that they were made of.
    requirements : Requirement or sequence of Requirement
    diagnostics : Diagnostics, optional
        What the residuals show, as of `diagnose`.
    catalogue : Catalogue, optional
        Error of the reference catalogue; a term that names a catalogue states it as well.
    terms : sequence of ErrorTerm
        Further errors, such as `UserTerm`.
    exposure : str
        'mean' for a position in the mean of the exposures; 'single' for one in a single exposure.
    aligned : bool
        True if shift and rotation of the exposure are the observer's to fit, as of `ErrorModel`:
        over all chips, even if one is judged.  Terms that are no polynomials stay as they are.
    grid : tuple of int
        Points on x and y of each chip.
    epoch : float, Time or str, optional
        Decimal years or a date, for requirements that name none.  By default the latest date of the
        stars, if the model depends on time and `diagnostics` know the dates.
    chip : int, optional
        Chip number, for requirements that name none; all chips by default.
    n_draws : int
    rng : int or numpy.random.Generator
        Seed of a run; a generator is advanced.
    pixel_scale : float or Quantity, optional
        Size of one pixel in mas; that of the solution by default.
    checks : sequence of Check
        Further reasons why the errors may not be as stated.

    Returns
    -------
    tuple of Margin
        In the order of the requirements.

    Raises
    ------
    InputError
        For a requirement without an epoch if the model depends on time, units that need a pixel
        scale that is not known, an unknown chip, a bad grid, a region without points of the grid, a
        magnitude without errors by magnitude, fewer than two draws, and diagnostics of another
        solution.

    Examples
    --------
    >>> from bayesdist.missions.wise import simulate_wise
    >>> matches, truth = simulate_wise(500, rng=np.random.default_rng(1))
    >>> model = bd.build_model(matches, order=4, size=(1016, 1016))
    >>> posterior = bd.sample(bd.fit_linear(matches, model), matches)
    >>> need, gaia = bd.Requirement("field-wide", "p95", 1.0), bd.Catalogue("Gaia", 0.001, "pix")
    >>> (margin,) = bd.check_requirements(posterior, [need], catalogue=gaia, grid=(5, 3))
    >>> margin.verdict, margin.reason.partition(";")[0]
    ('undecided', 'the residuals were not examined')
    >>> (margin,) = bd.check_requirements(
    ...     posterior,
    ...     [need],
    ...     diagnostics=bd.diagnose(posterior, matches),
    ...     catalogue=gaia,
    ...     grid=(5, 3),
    ... )
    >>> margin.verdict
    'met'
    """
    requirements = as_requirements(requirements)
    stated = _stated_terms(catalogue, terms)
    settings = _settings(solution, diagnostics, stated, exposure, grid, epoch, n_draws, pixel_scale)
    scale = pixel_scale_of(solution, chip, settings.scale_mas)
    requirements = [r.in_unit_of(solution.model.unit) for r in requirements]
    for r in requirements:
        convert(r.limit, r.unit, solution.model.unit, scale, where=r.where)
    errors = _error_model(solution, diagnostics, stated, settings, aligned=aligned, chip=chip)
    if not requirements:  # terms in units that need a scale are refused all the same
        return ()
    generator = assessment_rng(rng)
    drawn = errors.drawn(n_draws, generator)
    if diagnostics is None:
        doubts = (UNEXAMINED, *_sampling_checks(solution), *checks, *_catalogue_checks(settings))
        return judge(
            drawn,
            requirements,
            grid=grid,
            epoch=settings.epoch,
            chip=chip,
            pixel_scale=scale,
            checks=doubts,
        )
    assumed = assumption_checks(
        _posterior_of(solution, diagnostics),
        diagnostics,
        solution.model.time,
        catalogue_stated=_states(settings, names_catalogue),
        motions_stated=_states(settings, names_motions),
    )
    requested = request_checks(errors, diagnostics, settings)
    return judged(
        errors,
        diagnostics,
        requirements,
        settings,
        generator,
        checks=in_order((*checks, *assumed, *diagnostics.checks, *requested)),
        drawn=drawn,
        chip=chip,
    )


def _stated_terms(catalogue: Catalogue | None, terms: Sequence[ErrorTerm]) -> tuple[ErrorTerm, ...]:
    """The user's terms in the order of a run: those that are the same everywhere come last."""
    require_catalogue(catalogue)
    if catalogue is None:
        return tuple(terms)
    return (catalogue.term(), *terms)


def _settings(
    solution: Solution,
    diagnostics: Diagnostics | None,
    stated: Sequence[ErrorTerm],
    exposure: str,
    grid: tuple[int, int],
    epoch: Epoch | None,
    n_draws: int,
    pixel_scale: Number | None,
) -> EvaluationSettings:
    """Settings of an evaluation, as a run makes them of its configuration."""
    require_known(exposure, EXPOSURES, "exposure", where="exposure")
    if diagnostics is not None:
        _posterior_of(solution, diagnostics)  # refuses diagnostics of another solution
    scale_mas = None if pixel_scale is None else value_in(pixel_scale, "mas", "pixel_scale")
    year = None if epoch is None else year_of(epoch)
    dates = np.zeros(0) if diagnostics is None else diagnostics.dates
    if year is None and solution.model.time is not None and dates.size:
        year = float(dates[-1])
    scale = pixel_scale_of(solution, scale_mas=scale_mas)
    return EvaluationSettings(
        grid=grid,
        epoch=year,
        draws=n_draws,
        scale_mas=scale_mas,
        single=exposure == "single",
        contained=[
            (term.name, *term.sigma(solution.model.unit, scale))
            for term in stated
            if isinstance(term, UserTerm) and term.included_in_scatter
        ],
        given=stated_names(stated),
        dates=dates,
    )


def _error_model(
    solution: Solution,
    diagnostics: Diagnostics | None,
    stated: Sequence[ErrorTerm],
    settings: EvaluationSettings,
    *,
    aligned: bool,
    chip: int | None,
) -> ErrorModel:
    """All errors: of the solution, of what the diagnostics found, and of the user's terms."""
    scale = pixel_scale_of(solution, chip, settings.scale_mas)
    if diagnostics is None:
        return error_model(solution, stated, aligned=aligned, pixel_scale=scale)
    errors = diagnosed_error_model(
        _posterior_of(solution, diagnostics),
        diagnostics,
        # in the order of a run, whose sums are the same to the last bit
        sorted(stated, key=lambda term: isinstance(term, UserTerm)),
        hierarchy=None,
        catalogue="catalogue",
        single=settings.single,
        frames=False,
        structure_left=True,
        aligned=aligned,
        pixel_scale=scale,
    )
    return with_measured_centroids(errors, diagnostics, settings)


def _posterior_of(solution: Solution, diagnostics: Diagnostics) -> Posterior:
    """The solution, checked to be the posterior that was diagnosed.

    Raises InputError if it is another one.
    """
    where = "diagnostics"
    if not isinstance(diagnostics, Diagnostics):
        raise InputError(
            f"they are a {type(diagnostics).__name__}",
            where=where,
            do="give what bd.diagnose(posterior, matches) returned",
        )
    if not isinstance(solution, Posterior):
        raise InputError(
            f"they are those of a posterior, and the solution is a {type(solution).__name__}",
            where=where,
            do="give the posterior, or leave them out",
        )
    if solution.own_places or solution.model.gauge == "held":
        kind = "self-calibration" if solution.own_places else "campaign"
        raise InputError(
            f"the posterior is that of a {kind}, which has more errors than these",
            where=where,
            do="use the budget and the verdicts of its run",
        )
    correlated = diagnostics.correlated
    same = correlated is not None and correlated.model == solution.model
    sample = diagnostics.sample
    digests = solution.matches_digest, "" if sample.partial else sample.table.digest()
    other_stars = all(digests) and digests[0] != digests[1]
    if not same or sample.n_total != solution.n_stars or other_stars:
        raise InputError(
            "they are those of another solution",
            where=where,
            do="give bd.diagnose(posterior, matches) of this posterior",
        )
    return solution


def _states(settings: EvaluationSettings, names: Callable[[str], bool]) -> bool:
    """True if one of the terms that state an error has such a name."""
    return any(map(names, settings.given))


def _catalogue_checks(settings: EvaluationSettings) -> tuple[Check, ...]:
    return tuple(catalogue_checks(_states(settings, names_catalogue)))


def _sampling_checks(solution: Solution) -> tuple[Check, ...]:
    """Check of the convergence of draws; none for a fit."""
    return () if solution.convergence is None else (convergence_check(solution.convergence),)
