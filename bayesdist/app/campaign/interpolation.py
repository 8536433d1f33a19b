"""Errors that look-up tables leave between their nodes: measured once, then a term."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.solution import place_of
from bayesdist.assess.terms.forms import MEASURED
from bayesdist.assess.terms.local import LocalErrors
from bayesdist.data import Matches
from bayesdist.diagnose.tables.between_nodes import BetweenNodes, between_nodes
from bayesdist.diagnose.tables.mean_square import MeanSquare
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
from bayesdist.infer.solution import Solution
from bayesdist.model import Chip, LookupTable
from bayesdist.model.grid import grid_pixels, mesh

__all__ = ["INTERPOLATION", "interpolation_term", "measured_between"]

Float = NDArray[np.float64]

INTERPOLATION = "look-up tables, between nodes"
SOURCE = f"{MEASURED}: neighbours in different exposures"

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

    Parameters
    ----------
    pairs : Matches
        At raw pixels, with errors.
    fit : LinearFit
        The polynomial that goes with the tables.
    tables : sequence of LookupTable
    filter : str
        Of the pairs.
    posteriors : sequence of TablePosterior
        Of the tables that were fitted to these pairs.
    mixture : ResidualMixture, optional
        Of the pairs; by default that of their residuals.
    fitted : bool
        Whether the tables were fitted to these pairs.  Those that were not err by themselves.
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

    def of_posterior(x: Float, y: Float) -> Float:
        assert posterior is not None
        out = posterior.position_sigma(x, y, refitted=True) ** 2
        phi = posterior.grid.basis.evaluate(*_on(chip, x, y))
        for a, axis in enumerate(posterior.axes):
            out[:, a] += ((phi @ axis.sums.polynomial_root) ** 2).sum(axis=1)
        return out

    def of_nodes(x: Float, y: Float) -> Float:
        variance = held_sigma(tables[-1:], x, y, chip=chip.number) ** 2
        return variance if fitted else -variance

    return of_nodes if posterior is None else of_posterior


def _on(chip: Chip, x: Float, y: Float) -> tuple[Float, Float]:
    """The nearest pixels of the chip: cells at its edge have their middle beyond."""
    nx, ny = chip.size
    return np.clip(x, 0.5, nx + 0.5), np.clip(y, 0.5, ny + 0.5)


def interpolation_term(
    between: Mapping[int, BetweenNodes],
    solution: Solution,
    *,
    grid: tuple[int, int],
    epoch: float | None,
) -> tuple[LocalErrors, ...]:
    """The term of the budget; nothing where a chip has not been measured.

    Parameters
    ----------
    between : mapping of int to BetweenNodes
        By chip number.
    solution : Solution
        Its derivatives bring pixels to u and v, along the axes of the polynomials.
    grid : tuple of int
        Points on x and y of each chip.
    epoch : float or None
        Decimal years.
    """
    chips = solution.model.chips
    if not between or any(chip.number not in between for chip in chips):
        return ()
    sigma, squares = {}, {}
    for chip in chips:
        place = place_of(solution.model, epoch=epoch, chip=chip.number)
        P = place.polynomial(solution.mean)
        by_x, by_y = place.gradient(*mesh(*grid_pixels(chip.size, grid)))
        J = np.stack([by_x @ P.T, by_y @ P.T], axis=-1)
        found, into = between[chip.number], np.mean(J**2, axis=0)
        variance = J**2 @ found.left.mean
        sigma[chip.number] = np.sqrt(variance).reshape(grid[1], grid[0], 2)
        error = np.sqrt(into**2 @ found.error**2)
        squares[chip.number] = MeanSquare(into @ found.square, error)
    return (LocalErrors.on_grid(INTERPOLATION, sigma, solution.model, SOURCE, squares),)
