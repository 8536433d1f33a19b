"""Error model of a run, and the positions, date and random numbers of its assessment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bayesdist.app.config import Config
from bayesdist.app.kinds.errors import ExposureScatter
from bayesdist.app.kinds.fit_data import FitData
from bayesdist.app.kinds.fitted import StoredLookupTables
from bayesdist.app.kinds.matched import Matched
from bayesdist.assess import Requirement, pixel_scale_of
from bayesdist.assess.evaluation import EvaluationSettings
from bayesdist.assess.model import ErrorModel, diagnosed_error_model, error_model
from bayesdist.assess.terms.forms import GIVEN, MEASURED, ErrorTerm
from bayesdist.assess.terms.local import LocalErrors, interpolation_term
from bayesdist.assess.terms.parameters import ExposureVariation
from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.infer import Posterior
from bayesdist.infer.solution.solution import Solution
from bayesdist.model import LookupTable
from bayesdist.utils import streams


def assessment_rng(config: Config) -> np.random.Generator:
    """Random number generator of the assessment, in its initial state."""
    return streams.assessment_rng(config.sampler.seed)


def assessment_epoch(data: FitData, config: Config) -> float | None:
    """Epoch of the assessment in decimal years.

    By default it is the date from which a product is to be used, or the latest date of the stars if
    that is later, because errors of a drift grow with time.  None if the model does not depend on
    time.
    """
    if config.assess.epoch is not None or data.model.time is None:
        return config.assess.epoch
    return max((data.last_epoch, *config.products.useafter_years()))


def evaluation_settings(data: FitData, config: Config) -> EvaluationSettings:
    """Settings of the evaluation of errors, including the dates of the stars."""
    return replace(rehearsal_settings(data, config), dates=data.dates)


def rehearsal_settings(data: FitData, config: Config) -> EvaluationSettings:
    """Settings of an evaluation without the dates of the stars, which only verdicts mention."""
    measured = data.fitted.scatter is not None or data.fitted.solved is not None
    return EvaluationSettings(
        grid=config.assess.grid,
        epoch=assessment_epoch(data, config),
        draws=config.assess.draws,
        years_ahead=config.assess.years_ahead,
        scale_mas=config.detector.scale_mas,
        single=config.assess.exposure == "single",
        # centroid errors estimated by the fit include no other errors
        contained=() if measured else config.held_in_residuals(data.model.unit),
        given=tuple(block.name for block in config.budget if block.stated),
        field=config.field,
    )


def idle_dates(config: Config, requirements: Sequence[Requirement], where: str = "") -> str:
    """Sentence on dates without effect because the model does not depend on time; empty if none.

    Such dates may document when the data were taken and are therefore not refused. `where` is the
    file of the requirements if it is not the configuration.
    """
    if config.campaign is not None or config.time() is not None:
        return ""
    named = [f"of {r.where}" for r in requirements if r.epoch is not None]
    if config.assess.epoch is not None and not where:
        named.insert(0, "assess.epoch")
    if not named:
        return ""
    file = f"{where}: " if where else ""
    return (
        f"{file}nothing in the model depends on time, so that the dates given change nothing "
        f"({', '.join(named)})"
    )


def errors_of_fit(solution: Solution, data: FitData, config: Config) -> ErrorModel:
    """Error model of a solution alone, without terms derived from residuals."""
    scale = pixel_scale_of(solution, scale_mas=config.detector.scale_mas)
    return error_model(solution, _given_terms(solution, data, config), pixel_scale=scale)


def errors_of_run(
    posterior: Posterior, found: Diagnostics, data: FitData, config: Config
) -> ErrorModel:
    """Error model of a posterior, including terms derived from residuals."""
    fitted, joint = data.fitted, data.fitted.scatter is not None
    terms = _given_terms(posterior, data, config)
    if fitted.scatter is not None:
        terms.insert(0, _variation(posterior, fitted.scatter, data.matched))
    return diagnosed_error_model(
        posterior,
        found,
        terms,
        hierarchy=fitted.linear if joint else None,
        catalogue=data.matched.catalogue_name,
        aligned=joint,  # errors of a new exposure after its user fits shift and rotation
        single=not joint and config.assess.exposure == "single",
        frames=fitted.solved is not None,  # exposures overlap partly
        structure_left=not fitted.tables.position_sigma,  # otherwise included in the table errors
        pixel_scale=pixel_scale_of(posterior, scale_mas=config.detector.scale_mas),
    )


def _given_terms(solution: Solution, data: FitData, config: Config) -> list[ErrorTerm]:
    """Terms given by the user, and those of tables if exposures were fitted jointly."""
    tables = () if data.fitted.scatter is None else _table_terms(solution, data, config)
    return [*config.linear_terms(solution), *tables, *config.user_terms(solution.model.unit)]


def _variation(solution: Solution, scatter: ExposureScatter, matched: Matched) -> ExposureVariation:
    """Deviation of a new exposure from the measured scatter, including velocity aberration."""
    return ExposureVariation(
        solution.model,
        np.asarray(solution.mean, float),
        scatter.kinds,
        scatter.tau,
        aberration=matched.aberration(scatter, solution),
    )


def _table_terms(solution: Solution, data: FitData, config: Config) -> tuple[LocalErrors, ...]:
    """Terms for the errors of the tables, and for the distortion between their nodes."""
    stored, block = data.fitted.tables, config.tables
    epoch = assessment_epoch(data, config)
    between = interpolation_term(stored.between, solution, grid=config.assess.grid, epoch=epoch)
    if not stored.position_sigma:
        return between
    source = MEASURED
    if block.detector is not None:
        of_detector = f"{GIVEN}: errors of the detector's tables in {block.detector}"
        source = of_detector if block.method == "none" else f"{MEASURED}, and {of_detector}"
    name = "look-up tables"
    tables = LocalErrors.on_grid(name, stored.position_sigma, solution.model, source)
    return (tables, *between)


def published_tables(stored: StoredLookupTables, *, held: bool) -> tuple[LookupTable, ...]:
    """Look-up tables with the errors that apply to their user.

    These are the errors at the nodes and the distortion between them, added in quadrature.  The
    same distortion affects the values at the nodes, which are averages over their surroundings.  It
    is added to the tables fitted in this run; `held` is True if the detector's tables are from
    another run.
    """
    out = []
    for table in stored.tables:
        between = stored.between.get(table.chip)
        if table.sigma is not None and between is not None and bool(table.filter) == held:
            total = np.sqrt(table.sigma**2 + between.left.mean[:, None, None])
            table = replace(table, sigma=total)
        out.append(table)
    return tuple(out)
