"""The error budget everywhere and at all times, small enough to be carried along in a page.

Every part of the model's error is a polynomial of the pixel whose coefficients are, within one
segment of the drift, linear in time.  So its second moments say all: the variance at any pixel, or
of the difference of two, is a quadratic form of them, and they are quadratic in time, which three
epochs fix.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.drawn import PositionErrors
from bayesdist.assess.terms.fields import MODEL
from bayesdist.assess.terms.given import LocalTerm, UserTerm
from bayesdist.assess.terms.product_terms import ProductTerm
from bayesdist.data.magnitude_errors import MagnitudeErrors
from bayesdist.errors import InputError
from bayesdist.model import DistortionModel
from bayesdist.model.grid import grid_pixels, mesh

__all__ = ["BudgetSpan", "BudgetSurface", "SurfaceProduct", "budget_surface"]

Float = NDArray[np.float64]

CONSTANT = 1e-9  # moments that change less, relative to the largest, do not depend on time


@dataclass(frozen=True, eq=False)
class BudgetSpan:
    """Years within one segment of the drift.

    Parameters
    ----------
    nodes : tuple of float
        First, middle and last epoch, decimal years; empty for a model without time dependence.
    moments : dict of int to dict of str to ndarray, shape (n, 2, K, K)
        By chip number and part: mean products of the Legendre coefficients of the error in u and
        in v, at each of the nodes; n = 1 for a part that does not depend on time.  The joint error
        is the last part.
    """

    nodes: tuple[float, ...]
    moments: dict[int, dict[str, Float]]


@dataclass(frozen=True, eq=False)
class SurfaceProduct:
    """What a file differs by from the solution, on the grid.

    Parameters
    ----------
    name, source : str
    shifts : tuple of dict of int to ndarray, shape (n, N, 2)
        For each span, by chip number: displacements at its nodes, linear in time between them;
        n = 1 for those that do not depend on time.
    """

    name: str
    source: str
    shifts: tuple[dict[int, Float], ...]


@dataclass(frozen=True, eq=False)
class BudgetSurface:
    """The error budget as a function of position, epoch and magnitude.

    Parameters
    ----------
    model : DistortionModel
    epoch : float or None
        At which the budget is quoted.
    grid : tuple of int
        Points on x and y of a chip over which it is averaged, and on which `local` is known.
    spans : tuple of BudgetSpan
        In the order of time.
    sources : dict of str to str
        Where parts come from, of those that say so.
    terms : tuple of UserTerm
    sigmas : tuple of (float, float)
        Of these, in the unit of the model.
    local : tuple of LocalTerm
    centroid : MagnitudeErrors or None
    products : tuple of SurfaceProduct
        In no total.
    """

    model: DistortionModel
    epoch: float | None
    grid: tuple[int, int]
    spans: tuple[BudgetSpan, ...]
    sources: dict[str, str]
    terms: tuple[UserTerm, ...]
    sigmas: tuple[tuple[float, float], ...]
    local: tuple[LocalTerm, ...]
    centroid: MagnitudeErrors | None
    products: tuple[SurfaceProduct, ...] = ()

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the model's parts and of the field terms, without the joint error."""
        first = next(iter(self.spans[0].moments.values()))
        return tuple(name for name in first if name != MODEL)


def budget_surface(
    errors: PositionErrors,
    *,
    epoch: float | None = None,
    years: tuple[float, float] | None = None,
    sources: dict[str, str] | None = None,
    products: Sequence[ProductTerm] = (),
) -> BudgetSurface:
    """Second moments of all errors of a position.

    Parameters
    ----------
    errors : PositionErrors
        The same draws as those of a budget give the same numbers.
    epoch : float, optional
        Decimal years, at which the budget is quoted.
    years : tuple of float, optional
        First and last epoch; needed by a model with time dependence.
    sources : dict of str to str, optional
        Where parts come from.
    products : sequence of ProductTerm

    Returns
    -------
    BudgetSurface

    Raises
    ------
    InputError
        For a model with time dependence and no years, or years that do not rise.
    """
    model = errors.fields.whole.solution.model
    spans = tuple(BudgetSpan(nodes, _moments(errors, nodes)) for nodes in _nodes(model, years))
    return BudgetSurface(
        model=model,
        epoch=epoch,
        grid=errors.grid,
        spans=spans,
        sources=dict(sources or {}),
        terms=errors.terms,
        sigmas=errors.sigmas,
        local=errors.local,
        centroid=errors.centroid,
        products=tuple(_on_the_grid(p, model, errors.grid, spans) for p in products),
    )


def _on_the_grid(
    term: ProductTerm,
    model: DistortionModel,
    grid: tuple[int, int],
    spans: Sequence[BudgetSpan],
) -> SurfaceProduct:
    shifts = []
    for span in spans:
        by_chip = {}
        for chip in model.chips:
            at = mesh(*grid_pixels(chip.size, grid))
            nodes = [term.at(*at, chip.number, epoch) for epoch in span.nodes or (None,)]
            by_chip[chip.number] = _short(np.stack(nodes))
        shifts.append(by_chip)
    return SurfaceProduct(term.name, term.source, tuple(shifts))


def _nodes(
    model: DistortionModel, years: tuple[float, float] | None
) -> tuple[tuple[float, ...], ...]:
    if model.time is None:
        return ((),)
    if years is None or not years[0] < years[1]:
        raise InputError(f"the years are {years}", do="give a first and a later last one")
    first, last = years
    edges = [first, *(b for b in model.time.breaks if first < b < last), last]
    out = []
    for start, stop in pairwise(edges):
        # a break belongs to what begins there
        end = stop if stop == last else float(np.nextafter(stop, start))
        out.append((start, 0.5 * (start + end), end))
    return tuple(out)


def _moments(errors: PositionErrors, nodes: Sequence[float]) -> dict[int, dict[str, Float]]:
    nowhere = np.empty(0), np.empty(0)
    numbers = [chip.number for chip in errors.fields.whole.solution.model.chips]
    points = dict.fromkeys(numbers, nowhere)
    at = [errors.fields.at(points, epoch=epoch) for epoch in nodes or (None,)]
    out = {}
    for number, fields in zip(numbers, zip(*at, strict=True), strict=True):
        out[number] = {
            part: _short(np.stack([_second(f.polynomials[part]) for f in fields]))
            for part in fields[0].parts
        }
    return out


def _second(e: Float) -> Float:
    """Mean products (2, K, K) of coefficients (n, 2, K)."""
    axes = np.swapaxes(e, 0, 1)
    return np.swapaxes(axes, 1, 2) @ axes / len(e)


def _short(moments: Float) -> Float:
    """Those of one node where all are the same."""
    change = np.abs(moments - moments[:1]).max()
    return moments[:1] if change <= CONSTANT * np.abs(moments).max() else moments
