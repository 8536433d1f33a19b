"""Look-up tables of a campaign: fitted with the polynomial, or held as another run has them."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial

import numpy as np

from bayesdist.app.config import Config
from bayesdist.app.kinds.campaign.inputs import Inputs
from bayesdist.app.kinds.campaign.matched import CampaignMatched
from bayesdist.app.kinds.campaign.reference import held_tables
from bayesdist.app.kinds.fitted import StoredLookupTables
from bayesdist.data.magnitude_errors import MagnitudeErrors
from bayesdist.data.matches import Matches
from bayesdist.diagnose.tables.between_nodes import BetweenNodes
from bayesdist.diagnose.tables.measured import measured_between
from bayesdist.errors import InputError
from bayesdist.infer import LinearFit, fit_by_magnitude, residuals
from bayesdist.infer.nodes import (
    Iteration,
    TableFit,
    corrected_matches,
    fit_with_tables,
    held_sigma,
    on_the_chips,
)
from bayesdist.model import DistortionModel, LookupTable, corrected
from bayesdist.model.grid import grid_pixels, mesh
from bayesdist.utils.arrays import Float

MIN_SCATTER_RATIO = 2.0  # ratio of scatters beyond which centroids are not what most of it is
MIN_EXPLAINED = 0.5  # fraction of the variance of the scatters that the dates must explain
MIN_EXPOSURES = 5  # exposures: a parabola in time takes three
SIGMA_OF_MEDIAN = 1.4826  # of the median of |z|


def refuse_outrun_stars(inputs: Inputs, fit: LinearFit, pairs: Matches) -> None:
    """Refuse a catalogue without motions where residuals grow with the time from its epoch.

    The square of the residuals of stars that move is a parabola in time.
    """
    if inputs.catalog.pm_u is not None or pairs.epoch is None:
        return
    size = np.abs(residuals(fit, pairs))
    names = range(len(pairs.exposure_names))
    rows = [np.flatnonzero(pairs.exposure == k) for k in names]
    rows = [one for one in rows if len(one)]
    if len(rows) < MIN_EXPOSURES:
        return
    date = np.array([pairs.epoch[one[0]] for one in rows])
    scatter = np.array([SIGMA_OF_MEDIAN * np.median(size[one]) for one in rows])
    if np.ptp(date) == 0 or scatter.max() < MIN_SCATTER_RATIO * scatter.min():
        return
    at = (date - date.mean()) / np.ptp(date)
    curve = np.polynomial.Polynomial.fit(at, scatter**2, 2).convert()
    left = np.var(scatter**2 - curve(at)) / np.var(scatter**2)
    if left > 1.0 - MIN_EXPLAINED or curve.coef[2] <= 0:
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

ROUGH_ITERATIONS = 1  # of the tables from whose residuals the errors of the stars are taken


def fit_tables(matched: CampaignMatched) -> tuple[StoredLookupTables, TableFit | None]:
    """The look-up tables that are asked for, and those that are held; and their fit, if any.

    Fitted are the detector's, unless these are taken from another run: then the filter's.  The
    linear part of each exposure is free.
    """
    config, model, filter = matched.inputs.config, matched.affine_model, matched.inputs.filter
    block, grid = config.tables, config.assess.grid
    held = held_tables(block, config.chips(), matched.inputs.base)
    if block.method == "none":
        if not held:
            return StoredLookupTables(), None
        placed = on_the_chips(corrected_matches(held, matched.stars), model)
        fit, _, errors = scatter_by_magnitude(placed, model, matched.inputs)
        pairs = matched.stars.with_errors(errors)
        between = measured_between(pairs, fit, held, filter=filter, fitted=False)
        of_nodes = _on_the_grid(held, fit, "", grid, partial(_held_variance, held))
        return _stored(held, of_nodes, between), None
    pairs, rough = _with_errors(matched, held)
    found = fit_with_tables(
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
    known = bool(found.posteriors)
    variance = found.shift_variance if known else partial(_held_variance, found.tables)
    between = measured_between(
        pairs,
        found.solution,
        found.tables,
        filter=found.filter,
        posteriors=found.posteriors,
        mixture=found.mixture,
    )
    of_nodes = _on_the_grid(found.tables, found.solution, found.filter, grid, variance)
    return _stored(found.tables, of_nodes, between), found


def scatter_by_magnitude(
    pairs: Matches, model: DistortionModel, inputs: Inputs
) -> tuple[LinearFit, Matches, MagnitudeErrors]:
    """Fit of every exposure by itself and scatter by magnitude, as `fit_by_magnitude`."""
    fit, _, errors = fit_by_magnitude(pairs, model)
    scattered = pairs.with_errors(errors)
    refuse_outrun_stars(inputs, fit, scattered)
    return fit, scattered, errors


def _with_errors(
    matched: CampaignMatched, held: tuple[LookupTable, ...]
) -> tuple[Matches, TableFit]:
    """Pairs with errors by magnitude, free of the pattern of tables; and those rough tables.

    The scatter of the residuals before any table is twice that of the stars: with errors from
    there the tables would be smoothed too much, and their own errors twice too large.  How smooth
    the rough tables are hardly matters: their stars scatter alike.
    """
    pairs, inputs, model = matched.stars, matched.inputs, matched.affine_model
    block = inputs.config.tables
    _, rough_errors, _ = scatter_by_magnitude(pairs, model, inputs)
    rough = fit_with_tables(
        rough_errors,
        model,
        filter=inputs.filter if held else "",
        beneath=held,
        method=block.method,
        step=block.step,
        max_iterations=ROUGH_ITERATIONS,
        report=_log_iteration,
    )
    _, _, errors = scatter_by_magnitude(rough.corrected(pairs), model, inputs)
    return pairs.with_errors(errors), rough


def _stored(
    tables: Sequence[LookupTable], of_nodes: Mapping[int, Float], between: Sequence[BetweenNodes]
) -> StoredLookupTables:
    """Tables in the order in which their file has them: the detector's first, chips by number."""
    return StoredLookupTables(
        tuple(sorted(tables, key=lambda table: (table.filter != "", table.chip))),
        dict(sorted(of_nodes.items())),
        {one.chip: one for one in sorted(between, key=lambda one: one.chip)},
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
    """Errors (ny, nx, 2) of positions on the grid of the assessment, by chip.

    `variance`: of the tables' shift (n, 2) at pixels x and y of a `chip`.
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
    """Variance (n, 2) of the shift by tables that have no covariance, or are held."""
    return held_sigma(tables, x, y, chip=chip) ** 2


def _warnings(config: Config, stored: StoredLookupTables, fit: TableFit | None) -> Iterator[str]:
    """Warnings of the tables' errors, each as a clause."""
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
        "between_nodes": [_between(one) for one in stored.between.values()],
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
    """Pixels along x and y, as the budget has them, and mean squares as measured."""
    return {
        "chip": one.chip,
        "rms_x": float(one.left.mean[0] ** 0.5),
        "rms_y": float(one.left.mean[1] ** 0.5),
        "square": one.square.tolist(),
        "square_error": one.error.tolist(),
        "n_pairs": one.n_pairs,
    }
