"""Look-up tables of a campaign: fitted together with the polynomial, or taken from another run."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial

import numpy as np

from bayesdist.app.artefacts.parts import StoredLookupTables
from bayesdist.app.artefacts.stars import ErrorLaw
from bayesdist.app.config import Config
from bayesdist.data import centroid_errors, with_measured_motions
from bayesdist.data.matches import Matches
from bayesdist.diagnose.tables import BetweenNodes, measured_between
from bayesdist.errors import InputError
from bayesdist.infer import LinearFit, fit_by_magnitude, fit_linear, residuals
from bayesdist.infer.nodes import (
    Iteration,
    TableFit,
    corrected_matches,
    fit_with_tables,
    held_sigma,
    on_the_chips,
)
from bayesdist.kinds.campaign.inputs import Inputs
from bayesdist.kinds.campaign.matched import affine_model_of
from bayesdist.kinds.campaign.reference import held_tables
from bayesdist.model import LookupTable, corrected
from bayesdist.model.grid import grid_pixels, mesh
from bayesdist.utils.arrays import Float

MIN_SCATTER_RATIO = 2.0  # ratio of scatters above which centroid errors cannot explain them
MIN_EXPLAINED = 0.5  # fraction of the variance of the scatters explained by the dates
MIN_EXPOSURES = 5  # exposures: a parabola in time has three parameters
SIGMA_OF_MEDIAN = 1.4826  # standard deviation in units of the median absolute deviation


def refuse_outrun_stars(inputs: Inputs, fit: LinearFit, pairs: Matches) -> None:
    """Refuse a catalogue without proper motions if residuals grow with the time from its epoch.

    The mean square residual of moving stars is a parabola in time.
    """
    if inputs.catalog.pm_u is not None or pairs.epoch is None:
        return
    size = np.abs(residuals(fit, pairs))
    names = range(len(pairs.exposure_names))
    rows = [np.flatnonzero(pairs.exposure == k) for k in names]
    rows = [star_rows for star_rows in rows if len(star_rows)]
    if len(rows) < MIN_EXPOSURES:
        return
    date = np.array([pairs.epoch[star_rows[0]] for star_rows in rows])
    scatter = np.array([SIGMA_OF_MEDIAN * np.median(size[star_rows]) for star_rows in rows])
    if np.ptp(date) == 0 or scatter.max() < MIN_SCATTER_RATIO * scatter.min():
        return
    at = (date - date.mean()) / np.ptp(date)
    curve = np.polynomial.Polynomial.fit(at, scatter**2, 2).convert()
    unexplained = np.var(scatter**2 - curve(at)) / np.var(scatter**2)
    if unexplained > 1.0 - MIN_EXPLAINED or curve.coef[2] <= 0:
        return
    low, high = int(np.argmin(scatter)), int(np.argmax(scatter))
    raise InputError(
        f"has no proper motions, and the exposures span {np.ptp(date):.1f} years: residuals "
        f"scatter by {scatter[low]:.2g} {fit.unit} in {date[low]:.1f} and by {scatter[high]:.2g} "
        f"{fit.unit} in {date[high]:.1f}",
        where=inputs.catalog.source,
        do="give it columns pm_u and pm_v, or calibrate exposures of one epoch",
    )


log = logging.getLogger("bayesdist")

ROUGH_ITERATIONS = 1  # iterations of the tables that are used only to estimate star errors


def fit_tables(pairs: Matches, inputs: Inputs) -> tuple[StoredLookupTables, TableFit | None]:
    """Fit the configured look-up tables, and combine them with those held fixed.

    The tables of the detector are fitted unless they are taken from another run, in which case the
    tables of the filter are fitted.  The linear part of each exposure is free.

    Returns
    -------
    stored : StoredLookupTables
        Fitted and fixed tables.
    fit : TableFit or None
        None if no tables are fitted.
    """
    config, filter = inputs.config, inputs.filter
    model = affine_model_of(config, pairs)
    block, grid = config.tables, config.assess.grid
    held = held_tables(block, config.chips(), inputs.base)
    if block.method == "none":
        if not held:
            return StoredLookupTables(), None
        placed = on_the_chips(corrected_matches(held, pairs), model)
        if inputs.has_quoted_errors:
            fit = fit_linear(placed, model)
        else:
            errors = errors_with_catalogue(placed, inputs)
            fit = fit_linear(errors.applied(placed), model)
            pairs = errors.applied(pairs)
        between = measured_between(pairs, fit, held, filter=filter, fitted=False)
        of_nodes = _on_the_grid(held, fit, "", grid, partial(_held_variance, held))
        return _stored(held, of_nodes, between), None
    rough = None
    if not inputs.has_quoted_errors:
        pairs, rough = _with_errors(pairs, inputs, held)
    table_fit = fit_with_tables(
        pairs,
        model,
        filter=filter if held else "",
        beneath=held,
        method=block.method,
        step=block.step,
        max_iterations=block.max_iterations,
        start=rough,
        report=_log_iteration,
    )
    has_covariance = bool(table_fit.posteriors)
    variance = (
        table_fit.shift_variance if has_covariance else partial(_held_variance, table_fit.tables)
    )
    between = measured_between(
        pairs,
        table_fit.solution,
        table_fit.tables,
        filter=table_fit.filter,
        posteriors=table_fit.posteriors,
        mixture=table_fit.mixture,
    )
    of_nodes = _on_the_grid(table_fit.tables, table_fit.solution, table_fit.filter, grid, variance)
    return _stored(table_fit.tables, of_nodes, between), table_fit


def errors_with_catalogue(pairs: Matches, inputs: Inputs) -> ErrorLaw:
    """Centroid errors by magnitude, which are added to each star's error of the catalogue.

    Each exposure is fitted by itself (`fit_by_magnitude`), and the errors of the catalogue are
    subtracted from the scatter (`centroid_errors`). Only stars with a measured motion are used: an
    assumed motion makes the error of a star many times that of the others of its magnitude.
    """
    stars = with_measured_motions(pairs, inputs.catalog)
    fit, _, total = fit_by_magnitude(stars, affine_model_of(inputs.config, stars))
    refuse_outrun_stars(inputs, fit, stars.with_errors(total))
    return ErrorLaw(by_magnitude=centroid_errors(stars, total), with_catalogue=True)


def _with_errors(
    pairs: Matches, inputs: Inputs, held: tuple[LookupTable, ...]
) -> tuple[Matches, TableFit]:
    """Pairs with errors by magnitude that exclude the table pattern, and a rough fit of the tables.

    Without tables the residuals scatter twice as much as the centroids.  With errors from that
    scatter the tables would be smoothed too much, and the errors of the tables would be twice too
    large.  The smoothness of the rough tables hardly matters, because it hardly affects the
    scatter.
    """
    model, block = affine_model_of(inputs.config, pairs), inputs.config.tables
    rough = fit_with_tables(
        errors_with_catalogue(pairs, inputs).applied(pairs),
        model,
        filter=inputs.filter if held else "",
        beneath=held,
        method=block.method,
        step=block.step,
        max_iterations=ROUGH_ITERATIONS,
        report=_log_iteration,
    )
    errors = errors_with_catalogue(rough.corrected(pairs), inputs)
    return errors.applied(pairs), rough


def _stored(
    tables: Sequence[LookupTable], of_nodes: Mapping[int, Float], between: Sequence[BetweenNodes]
) -> StoredLookupTables:
    """Tables in the order of their file: those of the detector first, by chip number."""
    return StoredLookupTables(
        tuple(sorted(tables, key=lambda table: (table.filter != "", table.chip))),
        dict(sorted(of_nodes.items())),
        {
            chip_between.chip: chip_between
            for chip_between in sorted(between, key=lambda chip_between: chip_between.chip)
        },
    )


def _log_iteration(one: Iteration) -> None:
    log.info(
        "fit: tables, iteration %d: moved %.2g px, residuals %.4f px",
        one.number,
        one.moved,
        one.rms,
    )


def _on_the_grid(
    tables: Sequence[LookupTable],
    fit: LinearFit,
    filter: str,
    grid: tuple[int, int],
    variance: Callable[..., Float],
) -> dict[int, Float]:
    """Position errors (ny, nx, 2) on the grid of the assessment, by chip.

    ``variance(x, y, chip=)`` returns the variance (n, 2) of the shift by the tables at pixels x and
    y.
    """
    out = {}
    for chip in fit.model.chips:
        x, y = mesh(*grid_pixels(chip.size, grid))
        px, py = corrected(tables, x, y, chip=chip.number, filter=filter)
        J = fit.model.slopes(fit.mean, px, py, chip=chip.number)
        sigma = np.sqrt(np.einsum("nab,nb->na", J**2, variance(x, y, chip=chip.number)))
        out[chip.number] = sigma.reshape(grid[1], grid[0], 2)
    return out


def _held_variance(tables: Sequence[LookupTable], x: Float, y: Float, *, chip: int) -> Float:
    """Variance (n, 2) of the shift by tables that have no covariance or are held fixed."""
    return held_sigma(tables, x, y, chip=chip) ** 2


def _warnings(config: Config, stored: StoredLookupTables, fit: TableFit | None) -> Iterator[str]:
    """Warnings about the errors of the tables, each as a clause."""
    block = config.tables
    if block.detector is not None and any(t.sigma is None for t in stored.tables if not t.filter):
        yield "the detector's tables have no errors, and none are counted"
    if stored.tables and len(stored.between) < len(config.chips()):
        yield (
            "too few stars lie near each other to tell what the look-up tables leave between "
            "their nodes, and no error is counted for it"
        )
    if fit is None:
        return
    if block.method == "binned":
        yield (
            "the tables are smoothed bins: their errors are those of the bins; what smoothing "
            "takes off the pattern is among what lies between the nodes"
        )
    if not fit.converged:
        yield (
            f"the look-up tables still moved by {fit.progress[-1].moved:.2g} pixels in the last "
            f"of {len(fit.progress)} iterations"
        )


def tables_section(
    config: Config, stored: StoredLookupTables, fit: TableFit | None
) -> dict[str, object]:
    """Section 'tables' of summary.json."""
    out: dict[str, object] = {
        "method": config.tables.method,
        "detector": config.tables.detector,
        "chips": [_row(table) for table in stored.tables],
        "between_nodes": [_between(chip_between) for chip_between in stored.between.values()],
        "warnings": list(_warnings(config, stored, fit)),
    }
    if fit is not None:
        out |= {
            "converged": fit.converged,
            "rms_before": fit.progress[0].rms,
            "rms_after": fit.progress[-1].rms,
        }
    return out


def _row(table: LookupTable) -> Mapping[str, object]:
    return {
        "chip": table.chip,
        "filter": table.filter or None,
        "nodes": list(table.shape),
        "rms": float(np.sqrt((table.values**2).mean())),
        "largest": float(np.hypot(*table.values).max()),
        "sigma_median": None if table.sigma is None else float(np.median(table.sigma)),
    }


def _between(one: BetweenNodes) -> Mapping[str, object]:
    """Rms between the nodes along x and y (pixels), and mean squares as measured."""
    return {
        "chip": one.chip,
        "rms_x": float(one.left.mean[0] ** 0.5),
        "rms_y": float(one.left.mean[1] ** 0.5),
        "square": one.square.tolist(),
        "square_error": one.error.tolist(),
        "n_pairs": one.n_pairs,
    }
