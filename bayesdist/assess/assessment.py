"""Error budget and verdicts of a solution, as functions for users.

The results equal those of a run with the same stars, terms and seed; see
`bayesdist.assess.evaluation`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from bayesdist.assess.budget import ErrorBudget, budget_of
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
from bayesdist.assess.requirements.verdict import UNEXAMINED, assumption_checks, catalogue_checks
from bayesdist.assess.solution import place_of
from bayesdist.assess.terms.catalogue import (
    Catalogue,
    CatalogueSystematics,
    fraction_of_bright,
    require_catalogue,
)
from bayesdist.assess.terms.forms import ErrorTerm
from bayesdist.assess.terms.given import (
    UserTerm,
    names_catalogue,
    names_motions,
    stated_names,
)
from bayesdist.assess.units import convert, pixel_scale_of
from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.errors import InputError, require_known
from bayesdist.infer import Posterior, Solution
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.posterior.checks import convergence_check
from bayesdist.model.grid import DEFAULT_GRID
from bayesdist.utils.checks import Check, in_order
from bayesdist.utils.quantities import Epoch, Number, Random, takes, value_in, year_of
from bayesdist.utils.random import assessment_rng

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

    The rows of the model are combined by joint draws because they are correlated. Other terms are
    independent and added in quadrature. Without `diagnostics` the measured terms are missing, and
    the notes of the budget say so.

    Parameters
    ----------
    solution : Posterior or LinearFit
        With `diagnostics`, the posterior from which they were computed.
    diagnostics : Diagnostics, optional
        Result of `diagnose`, which adds structure beyond the model, differences between exposures
        and the observed noise of the stars.
    catalogue : Catalogue, optional
        Error of the reference catalogue.
    terms : sequence of ErrorTerm
        Further errors, such as `UserTerm`; each contributes one or more rows.
    exposure : str
        'mean' for a position in the mean of the exposures; 'single' for a position in a single
        exposure, which deviates as measured by the diagnostics.
    aligned : bool
        True if the observer fits shift and rotation of the exposure, so that they are not errors.
    grid : tuple of int
        Number of points along x and y of each chip.
    epoch : float, Time or str, optional
        Decimal years or a date. By default the latest date of the stars, if the model depends on
        time and `diagnostics` contain the dates.
    chip : int, optional
        Chip number; all chips by default.
    n_draws : int
        Number of draws, at least 2.
    rng : int or numpy.random.Generator
        Seed as in a run, or a generator, which is advanced.
    pixel_scale : float or Quantity, optional
        Size of one pixel in mas; that of the solution by default.

    Returns
    -------
    ErrorBudget
        In the unit of u, v.

    Raises
    ------
    InputError
        If the chip is unknown, the epoch is missing, the grid is invalid, `n_draws` is less than
        two, the unit of a term needs a pixel scale that is unknown, or the diagnostics belong to
        another solution.

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
    stated = _stated_terms(catalogue, terms, diagnostics, epoch)
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

    Each draw is an error field over the grid. It is the sum of a draw of the solution minus its
    mean and a draw of every term. The solution is drawn jointly, so that the correlation between
    positions is included. A systematic term of the user contributes one Gaussian offset per axis
    for the whole field; random and local terms contribute an independent Gaussian error at every
    grid point. The statistic of each field gives a distribution. The fraction of draws that do not
    exceed the limit is compared with the required probability.

    Without `diagnostics` every verdict is 'undecided': structure in the residuals would make the
    errors larger than stated, and overestimated quoted errors would make them smaller. Without an
    error of the reference catalogue no verdict is 'met'. With both, the verdict is that of
    `bayesdist run` for the same stars, terms and seed.

    The field covers all chips with the same grid on each, so that each chip has the same weight.
    A draw of the solution and an offset are common to all chips.

    For a relative error, the statistic is that of the differences between two positions, over all
    pairs of points. Over a range of epochs, the same draws are used throughout, and the statistic
    of each draw is its maximum over nine epochs and the breaks between them.

    Parameters
    ----------
    solution : Posterior or LinearFit
        With `diagnostics`, the posterior from which they were computed.
    requirements : Requirement or sequence of Requirement
    diagnostics : Diagnostics, optional
        Result of `diagnose`.
    catalogue : Catalogue, optional
        Error of the reference catalogue; it can also be stated by a term that names a catalogue.
    terms : sequence of ErrorTerm
        Further errors, such as `UserTerm`.
    exposure : str
        'mean' for a position in the mean of the exposures; 'single' for one in a single exposure.
    aligned : bool
        True if the observer fits shift and rotation of the exposure; see `ErrorModel`. They are
        fitted over all chips, even if only one chip is judged. Errors that are independent between
        stars are unchanged.
    grid : tuple of int
        Number of points along x and y of each chip.
    epoch : float, Time or str, optional
        Decimal years or a date, for requirements that name none. By default the latest date of the
        stars, if the model depends on time and `diagnostics` contain the dates.
    chip : int, optional
        Chip number, for requirements that name none; all chips by default.
    n_draws : int
        Number of draws, at least 2.
    rng : int or numpy.random.Generator
        Seed as in a run, or a generator, which is advanced.
    pixel_scale : float or Quantity, optional
        Size of one pixel in mas; that of the solution by default.
    checks : sequence of Check
        Further reasons why the errors may differ from those stated.

    Returns
    -------
    tuple of Margin
        In the order of the requirements.

    Raises
    ------
    InputError
        If a requirement has no epoch although the model depends on time, a unit needs a pixel scale
        that is unknown, the chip is unknown, the grid is invalid, a region contains no grid points,
        a magnitude is given but no errors by magnitude are known, `n_draws` is less than two, or
        the diagnostics belong to another solution.

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
    stated = _stated_terms(catalogue, terms, diagnostics, epoch)
    settings = _settings(solution, diagnostics, stated, exposure, grid, epoch, n_draws, pixel_scale)
    scale = pixel_scale_of(solution, chip, settings.scale_mas)
    requirements = [r.in_unit_of(solution.model.unit) for r in requirements]
    for r in requirements:
        convert(r.limit, r.unit, solution.model.unit, scale, where=r.where)
    errors = _error_model(solution, diagnostics, stated, settings, aligned=aligned, chip=chip)
    if not requirements:  # units of terms have been checked nevertheless
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


def _stated_terms(
    catalogue: Catalogue | None,
    terms: Sequence[ErrorTerm],
    diagnostics: Diagnostics | None,
    epoch: Epoch | None,
) -> tuple[ErrorTerm, ...]:
    """The user's terms in the order of a run: the catalogue first, then the other terms."""
    require_catalogue(catalogue)
    if catalogue is None:
        return tuple(terms)
    dates, bright = np.zeros(0), 1.0
    if isinstance(diagnostics, Diagnostics):
        dates, bright = diagnostics.dates, fraction_of_bright(diagnostics.sample.table)
    if not dates.size and epoch is not None:
        dates = np.array([year_of(epoch)])
    return (catalogue.term(dates, bright), *terms)


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
    """Settings of an evaluation, equal to those that a run makes from its configuration."""
    require_known(exposure, EXPOSURES, "exposure", where="exposure")
    if diagnostics is not None:
        _posterior_of(solution, diagnostics)  # raises if they belong to another solution
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
    """Errors of the solution, errors measured by the diagnostics, and the user's terms."""
    scale = pixel_scale_of(solution, chip, settings.scale_mas)
    if diagnostics is None:
        return error_model(solution, stated, aligned=aligned, pixel_scale=scale)
    errors = diagnosed_error_model(
        _posterior_of(solution, diagnostics),
        diagnostics,
        # the order of a run, so that sums are identical to the last bit
        sorted(stated, key=lambda term: isinstance(term, UserTerm | CatalogueSystematics)),
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
    """Return the solution if it is the posterior that was diagnosed.

    Raises InputError if the diagnostics belong to another solution.
    """
    location = "diagnostics"
    if not isinstance(diagnostics, Diagnostics):
        raise InputError(
            f"they are a {type(diagnostics).__name__}",
            where=location,
            do="give what bd.diagnose(posterior, matches) returned",
        )
    if not isinstance(solution, Posterior):
        raise InputError(
            f"they are those of a posterior, but the solution is a {type(solution).__name__}",
            where=location,
            do="give the posterior, or leave out the diagnostics",
        )
    if solution.own_places or solution.model.gauge == "held":
        kind = "self-calibration" if solution.own_places else "campaign"
        raise InputError(
            f"the posterior is that of a {kind}, which has more errors than these",
            where=location,
            do="use the budget and the verdicts of its run",
        )
    correlated = diagnostics.correlated
    same_model = correlated is not None and correlated.model == solution.model
    sample = diagnostics.sample
    digests = solution.matches_digest, "" if sample.partial else sample.table.digest()
    other_stars = all(digests) and digests[0] != digests[1]
    if not same_model or sample.n_total != solution.n_stars or other_stars:
        raise InputError(
            "they are those of another solution",
            where=location,
            do="give bd.diagnose(posterior, matches) of this posterior",
        )
    return solution


def _states(settings: EvaluationSettings, names: Callable[[str], bool]) -> bool:
    """True if one of the terms that state an error has a name that `names` accepts."""
    return any(map(names, settings.given))


def _catalogue_checks(settings: EvaluationSettings) -> tuple[Check, ...]:
    return tuple(catalogue_checks(_states(settings, names_catalogue)))


def _sampling_checks(solution: Solution) -> tuple[Check, ...]:
    """Check of the convergence of the draws; empty for a linear fit."""
    return () if solution.convergence is None else (convergence_check(solution.convergence),)
