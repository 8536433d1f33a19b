"""Errors of look-up tables between their nodes, from neighbouring stars in different exposures."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from bayesdist.data import Matches
from bayesdist.diagnose.tables.between_nodes import BetweenNodes, between_nodes
from bayesdist.errors import DegenerateError
from bayesdist.infer import LinearFit
from bayesdist.infer.nodes import (
    ResidualMixture,
    TablePosterior,
    corrected_matches,
    fit_mixture,
    held_sigma,
    pixel_shifts,
)
from bayesdist.model import Chip, LookupTable
from bayesdist.utils.arrays import Float

FAR = 6.0  # residual beyond which a match is excluded, in standard deviations

log = logging.getLogger("bayesdist")


def measured_between(
    pairs: Matches,
    fit: LinearFit,
    tables: Sequence[LookupTable],
    *,
    filter: str,
    posteriors: Sequence[TablePosterior] = (),
    mixture: ResidualMixture | None = None,
    fitted: bool = True,
) -> tuple[BetweenNodes, ...]:
    """Distortion that tables lack between their nodes, for each chip on which it can be measured.

    Parameters
    ----------
    pairs : Matches
        Pairs at raw pixels, with errors.
    fit : LinearFit
        The polynomial that belongs to the tables.
    tables : sequence of LookupTable
        Look-up tables of all chips and filters.
    filter : str
        Filter of the pairs.
    posteriors : sequence of TablePosterior
        Posteriors of the tables that were fitted to these pairs.
    mixture : ResidualMixture, optional
        Mixture model of the pairs; fitted to their residuals by default.
    fitted : bool
        True if the tables were fitted to these pairs.  Otherwise the errors of the tables are
        independent of them.

    Returns
    -------
    tuple of BetweenNodes
        One item per chip; empty if the pairs have no star codes.
    """
    if pairs.star is None:
        return ()
    numbers = pairs.chip_number
    shifts = pixel_shifts(fit, corrected_matches(tables, pairs))
    mixture = mixture or fit_mixture(shifts.shift, shifts.variance)
    jitter = np.full(len(pairs), mixture.jitter)
    for table_posterior in posteriors:
        jitter[numbers == table_posterior.table.chip] = table_posterior.jitter
    total = shifts.variance + jitter[:, None] ** 2
    # A false match is independent of its neighbours. Only those far off are excluded, so that stars
    # displaced by the pattern itself are kept.
    near = (shifts.shift**2 / total).sum(axis=1, keepdims=True) < FAR**2
    precision = near / total
    out = []
    for chip in fit.model.chips:
        chip_tables = [t for t in tables if t.chip == chip.number and t.filter in ("", filter)]
        rows = np.flatnonzero(numbers == chip.number)
        if not chip_tables or not len(rows):
            continue
        posterior = next((p for p in posteriors if p.table.chip == chip.number), None)
        try:
            result = between_nodes(
                pairs.x[rows],
                pairs.y[rows],
                shifts.shift[rows],
                precision[rows],
                star=pairs.star[rows],
                exposure=pairs.exposure[rows],
                chip=chip,
                step=chip_tables[-1].step,
                taken=_taken(posterior, chip_tables, chip, fitted),
            )
        except DegenerateError as error:
            log.info("fit: %s", error)
            continue
        out.append(result)
    return tuple(out)


def _taken(
    posterior: TablePosterior | None, tables: Sequence[LookupTable], chip: Chip, fitted: bool
) -> Callable[[Float, Float], Float]:
    """Function for the variance (n, 2) that tables and polynomial absorb at pixels (n,)."""
    if posterior is not None:
        return partial(_of_posterior, posterior, chip)

    def of_nodes(x: Float, y: Float) -> Float:
        variance = held_sigma(tables[-1:], x, y, chip=chip.number) ** 2
        return variance if fitted else -variance

    return of_nodes


def _of_posterior(posterior: TablePosterior, chip: Chip, x: Float, y: Float) -> Float:
    """Variance (n, 2) of a posterior, including that of its polynomial."""
    out = posterior.position_sigma(x, y, refitted=True) ** 2
    phi = posterior.grid.basis.evaluate(*_on(chip, x, y))
    for a, axis in enumerate(posterior.axes):
        out[:, a] += ((phi @ axis.sums.polynomial_root) ** 2).sum(axis=1)
    return out


def _on(chip: Chip, x: Float, y: Float) -> tuple[Float, Float]:
    """Nearest pixels on the chip: centres of cells at its edge may be outside."""
    nx, ny = chip.size
    return np.clip(x, 0.5, nx + 0.5), np.clip(y, 0.5, ny + 0.5)
