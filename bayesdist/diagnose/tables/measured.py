"""Errors that look-up tables leave between their nodes, from neighbours in different exposures."""

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

FAR = 6.0  # standard deviations

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
    """Distortion that tables leave between their nodes, for each chip where it can be measured.

    `pairs`: at raw pixels, with errors. `fit`: the polynomial that goes with the tables. `filter`:
    of the pairs. `posteriors`: of the tables that were fitted to these pairs. `mixture`: of the
    pairs; by default that of their residuals. `fitted`: whether the tables were fitted to these
    pairs. Those that were not err by themselves.
    """
    if pairs.star is None:
        return ()
    numbers = pairs.chip_number
    left = pixel_shifts(fit, corrected_matches(tables, pairs))
    mixture = mixture or fit_mixture(left.shift, left.variance)
    jitter = np.full(len(pairs), mixture.jitter)
    for one in posteriors:
        jitter[numbers == one.table.chip] = one.jitter
    total = left.variance + jitter[:, None] ** 2
    # a false match has nothing in common with its neighbours: to leave out no more than those far
    # off keeps stars that the pattern itself has moved
    near = (left.shift**2 / total).sum(axis=1, keepdims=True) < FAR**2
    precision = near / total
    out = []
    for chip in fit.model.chips:
        own = [t for t in tables if t.chip == chip.number and t.filter in ("", filter)]
        rows = np.flatnonzero(numbers == chip.number)
        if not own or not len(rows):
            continue
        posterior = next((p for p in posteriors if p.table.chip == chip.number), None)
        try:
            found = between_nodes(
                pairs.x[rows],
                pairs.y[rows],
                left.shift[rows],
                precision[rows],
                star=pairs.star[rows],
                exposure=pairs.exposure[rows],
                chip=chip,
                step=own[-1].step,
                taken=_taken(posterior, own, chip, fitted),
            )
        except DegenerateError as error:
            log.info("fit: %s", error)
            continue
        out.append(found)
    return tuple(out)


def _taken(
    posterior: TablePosterior | None, tables: Sequence[LookupTable], chip: Chip, fitted: bool
) -> Callable[[Float, Float], Float]:
    """Variance (n, 2) that tables and polynomial have taken of the residuals at pixels (n,)."""
    if posterior is not None:
        return partial(_of_posterior, posterior, chip)

    def of_nodes(x: Float, y: Float) -> Float:
        variance = held_sigma(tables[-1:], x, y, chip=chip.number) ** 2
        return variance if fitted else -variance

    return of_nodes


def _of_posterior(posterior: TablePosterior, chip: Chip, x: Float, y: Float) -> Float:
    """Variance (n, 2) of a posterior with that of its polynomial."""
    out = posterior.position_sigma(x, y, refitted=True) ** 2
    phi = posterior.grid.basis.evaluate(*_on(chip, x, y))
    for a, axis in enumerate(posterior.axes):
        out[:, a] += ((phi @ axis.sums.polynomial_root) ** 2).sum(axis=1)
    return out


def _on(chip: Chip, x: Float, y: Float) -> tuple[Float, Float]:
    """The nearest pixels of the chip: cells at its edge have their middle beyond."""
    nx, ny = chip.size
    return np.clip(x, 0.5, nx + 0.5), np.clip(y, 0.5, ny + 0.5)
