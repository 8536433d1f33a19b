"""Evaluation of a calibration: maps, error budget, margins and one verdict."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from bayesdist.assess.budget import ErrorBudget, budget_of
from bayesdist.assess.budget_surface import BudgetSurface, budget_surface
from bayesdist.assess.domain import WHOLE, EvaluationDomain, Region, in_region
from bayesdist.assess.drawn import DrawnErrors
from bayesdist.assess.maps import (
    RELATIVE,
    AreaMap,
    UncertaintyMap,
    area_map,
    uncertainty_map,
    with_local,
)
from bayesdist.assess.model import ErrorModel
from bayesdist.assess.requirements.margins import Margin, ValidityPeriod, judge, validity_period
from bayesdist.assess.requirements.requirement import Requirement
from bayesdist.assess.requirements.verdict import VERDICT_LEVELS, rests_on
from bayesdist.assess.terms.correlated import StructureErrors
from bayesdist.assess.terms.forms import Known
from bayesdist.assess.terms.given import Centroids, centroids_of
from bayesdist.assess.units import pixel_scale_of
from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.errors import InputError, required
from bayesdist.infer import LinearFit, Posterior, Solution
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.solution.transforms import gauge_free, gauge_free_matrix
from bayesdist.model import Chip
from bayesdist.model.grid import DEFAULT_GRID, mesh
from bayesdist.utils.arrays import Float
from bayesdist.utils.checks import Check, in_order, worst
from bayesdist.utils.random import restarted

VALIDITY_DRAWS = 1000  # number of draws for each epoch of a validity period
VALIDITY_EPOCHS = 40  # number of epochs of a validity curve
YEARS_AHEAD = 10.0  # years after the last epoch to which the budget surface extrapolates

ERRORS = "Errors"


@dataclass(frozen=True, eq=False)
class EvaluationSettings:
    """Epoch, grid and number of draws at which errors are evaluated.

    Parameters
    ----------
    grid : tuple of int
        Number of points along x and y of a chip.
    epoch : float or None
        Decimal years.
    draws : int
        Number of draws.
    years_ahead : float
        Years after the last epoch in which the end of a validity period is searched; 0 for none.
    scale_mas : float or None
        Size of a pixel in mas, if the user states it.
    single : bool
        True for errors of a position in a single exposure, False for the mean of the exposures.
    contained : sequence of (name, sigma_u, sigma_v)
        Errors that the residuals contain in addition to those of the centroids, in the unit of the
        solution.
    given : tuple of str
        Names of the errors that the user states.
    dates : ndarray
        Dates of the matches, decimal years; empty if unknown.
    field : Region
        Part of the detector that sees the sky, as returned by `check_region`. Errors are evaluated
        only there.
    """

    grid: tuple[int, int] = DEFAULT_GRID
    epoch: float | None = None
    draws: int = 4000
    years_ahead: float = 0.0
    scale_mas: float | None = None
    single: bool = False
    contained: Sequence[tuple[str, float, float]] = ()
    given: tuple[str, ...] = ()
    dates: Float = dataclasses.field(default_factory=lambda: np.zeros(0))
    field: Region = WHOLE

    def domain(self, errors: ErrorModel) -> EvaluationDomain:
        """Grid points within the field on all chips of the model of `errors`, at `self.epoch`."""
        model = errors.solution.solution.model
        return EvaluationDomain.of_chips(model, self.grid, epoch=self.epoch, region=self.field)

    def pixel_scale(self, errors: ErrorModel) -> float | None:
        """Size of a pixel in mas: the stated one, or that of the solution; None if unknown."""
        return pixel_scale_of(errors.solution.solution, scale_mas=self.scale_mas)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Errors of a calibration and the verdicts on its requirements.

    Parameters
    ----------
    settings : EvaluationSettings
        Settings of the evaluation.
    formal, maps : tuple of UncertaintyMap
        Uncertainty of each chip: formal errors of the least-squares solution, and all errors that
        neighbouring positions share.
    relative : tuple of UncertaintyMap
        Uncertainty of relative positions on each chip; empty unless gauge directions were given.
    areas : tuple of AreaMap
        Pixel area map of each chip.
    budget : ErrorBudget
        Error budget over the grid of all chips.
    surface : BudgetSurface or None
        Error budget at every position and epoch; None if stated errors contradict the residuals, or
        if the field is only a part of the detector.
    margins : tuple of Margin
        Verdict on each requirement, with its margin.
    validity : tuple of ValidityPeriod
        Periods in which requirements are met; empty if nothing depends on time.
    checks : tuple of Check
        All checks, sorted by group.
    """

    settings: EvaluationSettings
    formal: tuple[UncertaintyMap, ...]
    maps: tuple[UncertaintyMap, ...]
    relative: tuple[UncertaintyMap, ...]
    areas: tuple[AreaMap, ...]
    budget: ErrorBudget
    surface: BudgetSurface | None
    margins: tuple[Margin, ...]
    validity: tuple[ValidityPeriod, ...]
    checks: tuple[Check, ...]

    @property
    def verdict(self) -> tuple[str, tuple[str, ...]]:
        """Worst level of all checks and margins, and the reasons for it."""
        verdict_checks = (*self.checks, *(_of_margin(margin) for margin in self.margins))
        level = worst(verdict_checks)
        return level, tuple(
            check.text or check.name for check in verdict_checks if check.level == level != "pass"
        )


def _of_margin(margin: Margin) -> Check:
    """Margin in the form of a check."""
    name = margin.requirement.name
    sentence = f"{name}: {margin.verdict}: {margin.reason}"
    return Check("Requirements", name, level=VERDICT_LEVELS[margin.verdict], sentence=sentence)


@one_thread
def evaluate(
    errors: ErrorModel,
    diagnostics: Diagnostics,
    requirements: Sequence[Requirement],
    settings: EvaluationSettings,
    rng: np.random.Generator,
    *,
    fit: LinearFit,
    solution: Posterior,
    checks: Sequence[Check] = (),
    files: Sequence[Known] = (),
    null: Float | None = None,
) -> Evaluation:
    """Evaluate a calibration: maps, error budget, margins and validity periods.

    Parameters
    ----------
    errors : ErrorModel
        All errors of positions.
    diagnostics : Diagnostics
        Diagnostics of `solution`.
    requirements : sequence of Requirement
    settings : EvaluationSettings
    rng : numpy.random.Generator
        Every result restarts the generator, so that results do not depend on each other.
    fit : LinearFit
        Least-squares fit, for the maps of formal errors.
    solution : Posterior
        Posterior with all errors of the parameters in its draws.
    checks : sequence of Check
        Checks of the matching, the sampling, the fit and the catalogue.
    files : sequence of Known
        Differences between the files of the calibration and the solution.
    null : ndarray, shape (D, d), optional
        Directions of the parameters that the gauge determines. If given, the uncertainties of
        relative positions are mapped, too.

    Returns
    -------
    Evaluation

    Raises
    ------
    InputError
        If a requirement cannot be judged.
    """
    chips, grid, epoch = solution.model.chips, settings.grid, settings.epoch

    def uncertainty(of: Solution, chip: Chip) -> UncertaintyMap:
        uncertainty_of_chip = uncertainty_map(of, grid=grid, epoch=epoch, chip=chip.number)
        return _within_field(uncertainty_of_chip, chip, settings)

    requested = request_checks(errors, diagnostics, settings)
    all_checks = in_order((*checks, *diagnostics.checks, *requested))
    all_errors = drawn_errors(errors, diagnostics, settings, rng, files=files)
    surface = None
    # the interactive page shows averages over whole chips only
    if _contradiction(diagnostics, settings) is None and settings.field == WHOLE:
        years = _years(solution, diagnostics, epoch)
        surface = budget_surface(all_errors, grid, epoch=epoch, years=years)
    maps = [position_map(errors, solution, settings, chip) for chip in chips]
    budget = budget_of(all_errors, settings.domain(errors))
    margins = judged(
        errors, diagnostics, requirements, settings, rng, checks=all_checks, drawn=all_errors
    )
    del all_errors  # validity periods use fewer draws
    return Evaluation(
        settings=settings,
        formal=tuple(uncertainty(fit, chip) for chip in chips),
        maps=tuple(maps),
        relative=()
        if null is None
        else tuple(_relative(solution, diagnostics, null, chip, settings) for chip in chips),
        areas=tuple(area_map(solution, grid=grid, epoch=epoch, chip=c.number) for c in chips),
        budget=budget,
        surface=surface,
        margins=margins,
        validity=validity_of(errors, diagnostics, requirements, settings, rng),
        checks=all_checks,
    )


@one_thread
def position_map(
    errors: ErrorModel, solution: Posterior, settings: EvaluationSettings, chip: Chip
) -> UncertaintyMap:
    """Map of all errors that neighbouring positions share, at the epoch and grid of the settings.

    Parameters
    ----------
    errors : ErrorModel
    solution : Posterior
        Posterior with all errors of the parameters in its draws.
    settings : EvaluationSettings
    chip : Chip

    Returns
    -------
    UncertaintyMap
    """
    shared = uncertainty_map(solution, grid=settings.grid, epoch=settings.epoch, chip=chip.number)
    with_structure = with_local(shared, errors.structure_sigma(_domain(solution, chip, settings)))
    return _within_field(with_structure, chip, settings)


@one_thread
def drawn_errors(
    errors: ErrorModel,
    diagnostics: Diagnostics,
    settings: EvaluationSettings,
    rng: np.random.Generator,
    *,
    files: Sequence[Known] = (),
    n: int | None = None,
) -> DrawnErrors:
    """Draws of all errors, including those of the centroids and of files.

    `errors`, `diagnostics`, `settings`, `rng`, `files`: see `evaluate`. `n`: number of draws; that
    of the settings by default.
    """
    model = with_measured_centroids(errors, diagnostics, settings).with_terms(*files)
    return model.drawn(n or settings.draws, restarted(rng))


def with_measured_centroids(
    errors: ErrorModel, diagnostics: Diagnostics, settings: EvaluationSettings
) -> ErrorModel:
    """Error model with the errors of centroids by magnitude, from the scatter of the residuals."""
    centroids = None
    with suppress(InputError):  # see `request_checks`
        centroids = centroids_of(diagnostics, settings.contained)
    return errors.with_terms(Centroids(centroids))


@one_thread
def judged(
    errors: ErrorModel,
    diagnostics: Diagnostics,
    requirements: Sequence[Requirement],
    settings: EvaluationSettings,
    rng: np.random.Generator,
    *,
    checks: Sequence[Check] = (),
    drawn: DrawnErrors | None = None,
    chip: int | None = None,
) -> tuple[Margin, ...]:
    """Judge requirements, and list the assumptions that each margin rests on.

    `errors`, `diagnostics`, `requirements`, `settings`, `rng`: see `evaluate`. `checks`: all
    checks; failed ones can make a verdict undecided. `drawn`: result of `drawn_errors`. `chip`:
    chip number for requirements that name none; all chips by default. Raises InputError for a
    requirement that cannot be judged.
    """
    if not requirements:
        return ()
    contradiction = _contradiction(diagnostics, settings)
    if contradiction is not None and any(r.magnitude is not None for r in requirements):
        raise contradiction
    if drawn is None:
        drawn = drawn_errors(errors, diagnostics, settings, rng)
    margins = judge(
        drawn,
        requirements,
        grid=settings.grid,
        epoch=settings.epoch,
        chip=chip,
        pixel_scale=settings.pixel_scale(errors),
        checks=checks,
    )
    return tuple(
        replace(
            _where_stars_are(margin, diagnostics, settings.grid),
            rests_on=rests_on(
                errors.solution.solution.model,
                diagnostics,
                margin.epoch,
                given=settings.given,
                aligned=errors.of_new_exposure,
                single=settings.single,
                dates=settings.dates,
            ),
        )
        for margin in margins
    )


def validity_of(
    errors: ErrorModel,
    diagnostics: Diagnostics,
    requirements: Sequence[Requirement],
    settings: EvaluationSettings,
    rng: np.random.Generator,
) -> tuple[ValidityPeriod, ...]:
    """Validity periods of the requirements at a single epoch, with fewer draws than their margins.

    `errors`, `diagnostics`, `requirements`, `settings`, `rng`: see `evaluate`. The result is empty
    if nothing depends on time.
    """
    epoch = diagnostics.sample.table.epoch
    if errors.solution.solution.model.time is None or not requirements or not settings.years_ahead:
        return ()
    last = float(np.max(required(epoch, "a model with drift needs the epochs of its matches")))
    n = min(VALIDITY_DRAWS, settings.draws)
    drawn = drawn_errors(errors, diagnostics, settings, rng, n=n)
    return tuple(
        validity_period(
            drawn,
            r,
            np.linspace(last, last + settings.years_ahead, VALIDITY_EPOCHS),
            grid=settings.grid,
            pixel_scale=settings.pixel_scale(errors),
        )
        for r in requirements
        if r.epochs is None
    )


def request_checks(
    errors: ErrorModel, diagnostics: Diagnostics, settings: EvaluationSettings
) -> Iterator[Check]:
    """Checks for requests that cannot be met: errors of single exposures, contradicting terms."""
    linear = None if diagnostics.correlated is None else diagnostics.correlated.linear
    measured = errors.of_new_exposure or (linear is not None and bool(linear.kinds))
    if settings.single and not measured:
        yield Check(
            ERRORS,
            "Errors of single exposures",
            level="warn",
            sentence="errors of a single exposure are asked for, and how single exposures deviate "
            "is not known here, so that they are errors in their mean",
        )
    error = _contradiction(diagnostics, settings)
    if error is not None:
        sentence = (
            f"{error.where}: {error.cause}, so that no budget of single positions can be made"
        )
        yield Check(ERRORS, "Terms within the scatter", level="warn", sentence=sentence)


def _contradiction(diagnostics: Diagnostics, settings: EvaluationSettings) -> InputError | None:
    """Error about a term that exceeds the residuals that are stated to contain it, else None."""
    try:
        centroids_of(diagnostics, settings.contained)
    except InputError as error:
        return error
    return None


def _where_stars_are(margin: Margin, diagnostics: Diagnostics, grid: tuple[int, int]) -> Margin:
    """Change a verdict from met to undecided if it is judged on pixels without stars."""
    for coverage in diagnostics.coverage:
        if margin.verdict == "met" and margin.requirement.reaches_beyond(coverage, grid):
            return replace(margin, verdict="undecided", reason=coverage.sentence)
    return margin


def _years(
    solution: Posterior, diagnostics: Diagnostics, epoch: float | None
) -> tuple[float, float] | None:
    """First and last epoch of the budget surface; None if there is no drift or no epochs."""
    epochs = diagnostics.sample.table.epoch
    if solution.model.time is None or epochs is None:
        return None
    years = [*epochs, epoch]
    return float(min(years)), float(max(years)) + YEARS_AHEAD


def _domain(solution: Posterior, chip: Chip, settings: EvaluationSettings) -> EvaluationDomain:
    return EvaluationDomain.of_chips(
        solution.model, settings.grid, chips=(chip.number,), epoch=settings.epoch
    )


def _relative(
    solution: Posterior,
    diagnostics: Diagnostics,
    null: Float,
    chip: Chip,
    settings: EvaluationSettings,
) -> UncertaintyMap:
    """Uncertainty of relative positions on a chip, including structure that the model omits."""
    local, correlated = None, diagnostics.correlated
    if correlated is not None and correlated.structure:
        S = gauge_free_matrix(solution.model, np.asarray(solution.mean, float), null)
        # only the distortion of the detector, without frames of exposures
        local = StructureErrors(correlated.moved(S)).sigma(_domain(solution, chip, settings))
    gauge_free_map = uncertainty_map(
        gauge_free(solution, null), grid=settings.grid, epoch=settings.epoch, chip=chip.number
    )
    return _within_field(replace(with_local(gauge_free_map, local), kind=RELATIVE), chip, settings)


def _within_field(
    found: UncertaintyMap, chip: Chip, settings: EvaluationSettings
) -> UncertaintyMap:
    """Map with NaN at positions of a chip that see no sky."""
    if settings.field == WHOLE:
        return found
    inside = in_region(settings.field, chip.size, *mesh(found.x, found.y))
    inside = inside.reshape(found.sigma_u.shape)
    return replace(
        found,
        sigma_u=np.where(inside, found.sigma_u, np.nan),
        sigma_v=np.where(inside, found.sigma_v, np.nan),
        correlation=np.where(inside, found.correlation, np.nan),
    )
