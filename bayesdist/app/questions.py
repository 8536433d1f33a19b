"""Answers of a run to its user: calibration, budget, map, WCS, positions on the sky, summary.

`Run` has them as methods, whose docstrings describe the arguments.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy.table import Table

from bayesdist.app.products import product_of_run, with_facts_of_run
from bayesdist.app.run import Positions, Run
from bayesdist.assess import ErrorBudget, Margin, UncertaintyMap
from bayesdist.assess.budget import budget_of, place_budget
from bayesdist.assess.evaluation import position_map
from bayesdist.assess.requirements.verdict import VERDICT_LEVELS
from bayesdist.calibration.calibration import Calibration, calibration_of_exposure
from bayesdist.calibration.chip_map import chosen_chip
from bayesdist.calibration.sky_positions import sky_distribution
from bayesdist.calibration.sky_table import pixel_columns, position_column
from bayesdist.errors import InputError
from bayesdist.report.html import (
    RunSummary,
    budget_rows,
    margin_rows,
    summary_html,
    summary_text,
)
from bayesdist.utils.quantities import Number, Random, value_in, values_in, year_of
from bayesdist.utils.text import number, with_mas

if TYPE_CHECKING:
    from astropy.coordinates import SkyCoord
    from astropy.table import QTable

    from bayesdist.calibration.wcs import CalibrationWCS
    from bayesdist.report.run_plots import RunPlots


def calibration_of_run(run: Run) -> Calibration:
    """Calibration of the detector as it is written to files, with all errors of positions."""
    correlated = run.diagnostics.correlated
    return with_facts_of_run(
        product_of_run(run).calibration,
        run.config,
        run.tables.tables,
        run.evaluation.budget.rows(),
        None if correlated is None else correlated.facts,
    )


def budget_of_run(
    run: Run,
    *,
    at: Positions | None,
    to: Positions | None,
    chip: int | None,
    epoch: Any,
    magnitude: Number | None,
) -> ErrorBudget:
    """Error budget over the detector, of some positions, or of separations."""
    if to is not None and (at is None or len(_pairs(at, "at")) != 1):
        raise InputError(
            "a separation is measured from one position", where="budget", do="give at=(x, y)"
        )
    if magnitude is not None:
        magnitude = value_in(magnitude, "mag", "magnitude", where="budget")
    date = None if epoch is None else year_of(epoch)
    if at is None:
        if date is None and magnitude is None:
            return run.evaluation.budget
        domain = run.evaluation_settings.domain(run.error_model)
        domain = replace(domain, magnitude=magnitude)
        return budget_of(run.drawn_errors, domain if date is None else domain.at(date))
    points = [*_pairs(at, "at"), *([] if to is None else _pairs(to, "to"))]
    x, y = zip(*points, strict=True)
    return place_budget(
        run.drawn_errors,
        x,
        y,
        chip=_chip_number(run, chip),
        epoch=run.epoch if date is None else date,
        magnitude=magnitude,
        relative=to is not None,
    )


def map_of_run(run: Run, chip: int | None, epoch: Any) -> UncertaintyMap:
    """Map of the position uncertainty over a chip."""
    number = _chip_number(run, chip)
    date = None if epoch is None else year_of(epoch)
    if date is None:
        return next(item for item in run.evaluation.maps if item.chip == number)
    settings = replace(run.evaluation_settings, epoch=date)
    chip_of_map = next(item for item in run.model.chips if item.number == number)
    return position_map(run.error_model, run.solution, settings, chip_of_map)


def plots_of_run(run: Run) -> RunPlots:
    """Plots of a run."""
    from bayesdist.report.run_plots import RunPlots  # matplotlib is only loaded for plots

    return RunPlots(run)


def wcs_of_run(
    run: Run, chip: int | None, exposure: str | None, epoch: Any, **sky: Any
) -> CalibrationWCS:
    """World coordinate system of a chip with its errors, as in APE 14."""
    date = _date(run, exposure, epoch)
    if exposure is None:
        return run.calibration.wcs(chip, epoch=date, **sky)
    plain = run.calibration
    of_exposure = calibration_of_exposure(
        run.solution,
        exposure,
        epoch=date,
        plane=replace(plain.plane, note=""),
        detector=plain.detector,
        filter=plain.filter,
        scale=None if plain.scale is None else (plain.scale, plain.scale_from),
    )
    of_exposure = replace(
        of_exposure,
        further=plain.further,
        before=plain.before,
        after=plain.after,
        pixel_mas=plain.pixel_mas,
    )
    return of_exposure.wcs(chip, **sky)


def positions_on_sky(
    run: Run, table: Any, draws: int | None, rng: Random, **options: Any
) -> QTable | SkyCoord:
    """Positions on the sky of a table of pixels, with all errors that the run knows."""
    if run.model.time is not None:
        options = {"epoch": run.epoch} | options
    positions = run.calibration.to_sky(table, **options)
    if draws is None:
        return positions
    rows = Table(positions)
    origin = positions.meta["pixel_origin"]
    x, y, _, _ = pixel_columns(rows, options.get("columns"), origin, "table")
    centroids = options.get("centroids")
    if centroids is not None:
        centroids = tuple(position_column(rows, name, "table") for name in centroids)
    chip = options.get("chip")
    if chip is None and "chip" in positions.colnames:
        chip = np.asarray(positions["chip"])
    return sky_distribution(
        run.calibration,
        x,
        y,
        n_draws=draws,
        rng=rng,
        chip=chip,
        epoch=options.get("epoch"),
        point=options.get("point"),
        centroids=centroids,
    )


def text_of_run(run: Run) -> str:
    """Representation of a run as text: verdicts, warnings, a few facts."""
    return summary_text(_summary(run))


def html_of_run(run: Run) -> str:
    """Representation of a run in a notebook."""
    return summary_html(_summary(run))


def _summary(run: Run) -> RunSummary:
    """Content of the representations of a run: verdicts, warnings, a few facts."""
    evaluation, fit, config = run.evaluation, run.fit, run.config
    convergence = run.posterior.convergence
    scale_mas = config.detector.scale_mas
    largest = max(float(np.nanmax(chip_map.per_axis)) for chip_map in evaluation.maps)
    exposures = len(run.placed.exposures)
    state = f"yes, R-hat {convergence.rhat_max:.3f}, ESS {convergence.ess_bulk_min:.0f}"
    facts = [
        (run.kind.words.rows.capitalize(), f"{fit.n_rows}, {fit.n_used} used in the fit"),
        ("Exposures", str(exposures)),
        ("Model", f"order {fit.model.order}, {fit.model.n_params} parameters"),
        ("Converged", state if run.converged else f"NO: {'; '.join(convergence.reasons)}"),
        ("Largest uncertainty per axis", with_mas(largest, fit.unit, scale_mas)),
    ]
    if run.errors.by_magnitude is not None:
        facts.insert(1, ("Errors", "estimated from the residuals by magnitude"))
    if run.folder is not None:
        facts.append(("Folder", str(run.folder)))
    not_shown = [
        f"{m.requirement.name}: not shown: {m.reason}"
        for m in run.margins
        if m.verdict == "not shown"
    ]
    return RunSummary(
        title=config.detector_title or "calibration",
        verdict_level=_level(run),
        headline=_headline(run),
        warnings=(*run.warnings, *not_shown),
        facts=facts,
        margins_rows=margin_rows(run.margins),
        budget_rows=budget_rows(evaluation.budget, scale_mas=scale_mas),
    )


def _level(run: Run) -> str:
    """Level of the worst margin or check; 'note' if all is well and nothing was required."""
    level = run.evaluation.verdict[0] if run.converged else "fail"
    return "note" if level == "pass" and not run.margins else level


def _headline(run: Run) -> str:
    """Verdict in words, with the number of requirements that each verdict is given to."""
    if not run.converged:
        return "Not converged: no number of this run can be relied on"
    if not run.margins:
        return "No requirement was given"
    verdicts = [margin.verdict for margin in run.margins]
    if len(verdicts) == 1:
        return _verdict_words(run, run.margins[0])
    counts = [(verdicts.count(name), name) for name in reversed(VERDICT_LEVELS)]
    return f"{len(verdicts)} requirements: " + ", ".join(
        f"{count} {name}" for count, name in counts if count
    )


def _verdict_words(run: Run, margin: Margin) -> str:
    """Verdict on a requirement with value, limit and probability."""
    asked, row = margin.requirement, margin_rows([margin])[0]
    statistic = f"{asked.statistic} {asked.scope}".strip()
    scale_mas = run.config.detector.scale_mas
    value = f"{row['Value']} {margin.unit}"
    if margin.unit == "pix" and scale_mas is not None:
        value += f" ({number(margin.value * scale_mas, 3)} mas)"
    qualifier = " by the known errors alone" if margin.verdict == "undecided" else ""
    return (
        f"{margin.verdict.upper()}: {asked.name}: {statistic} {value}, "
        f"limit {asked.limit:g} {asked.unit}, {margin.probability_words}{qualifier}"
    )


def _chip_number(run: Run, number: int | None) -> int:
    """Number of a chip of the model; it has to be given if there are several."""
    numbers = [chip.number for chip in run.model.chips]
    return chosen_chip(numbers, number, where=str(run.folder or "the run"))


def _date(run: Run, exposure: str | None, epoch: Any) -> float | None:
    """Decimal year of a calibration; None if the model does not depend on time."""
    date = None if epoch is None else year_of(epoch)
    if run.model.time is None:
        return None
    if date is not None:
        return date
    stars = run.sample
    if exposure in stars.exposure_names and stars.epoch is not None:
        rows = stars.exposure == stars.exposure_names.index(exposure)
        if rows.any():
            return float(stars.epoch[rows].mean())
    return run.epoch


def _pairs(positions: Positions, name: str) -> list[tuple[float, float]]:
    """Positions (x, y) as a list of pairs; a single position becomes a list with one pair."""
    try:
        pairs = np.atleast_2d(np.asarray(_without_unit(positions, name), float))
    except (TypeError, ValueError):
        pairs = np.zeros((0, 0))
    if pairs.ndim != 2 or pairs.shape[1] != 2:
        raise InputError(
            f"{name} is {positions!r}, which is not a position",
            where="budget",
            do="give (x, y), or a list of such pairs",
        )
    return [(float(x), float(y)) for x, y in pairs]


def _without_unit(positions: Any, name: str) -> Any:
    """Positions as plain numbers; those with a unit other than the pixel are refused."""
    several = isinstance(positions, list | tuple)
    if several and not any(hasattr(value, "to_value") for value in positions):
        return [_without_unit(value, name) for value in positions]
    if several or hasattr(positions, "to_value"):
        return values_in(positions, "pix", name, where="budget")
    return positions
