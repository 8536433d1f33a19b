"""The error budget at every position and epoch, compact enough to be embedded in a web page.

Every part of the model's error is a polynomial of the pixel position. Its second moments therefore
contain everything: the variance at any pixel, or of the difference between two pixels, is a
quadratic form of the moments. Within one segment of the drift the moments are polynomials of time:
of degree 2 if the coefficients are linear in time, which three epochs determine, and of degree 4 if
the drift has a curvature. Epochs are added until the moments at other epochs are reproduced.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.drawn import DrawnErrors
from bayesdist.assess.terms.forms import LOCAL, ErrorField, Image, Known, Row
from bayesdist.assess.terms.functions import PolynomialField
from bayesdist.assess.terms.given import Centroids
from bayesdist.data.magnitude_errors import MagnitudeErrors
from bayesdist.errors import InputError
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float

JOINT = "model"  # name of the joint error of all parameters
NUMBERS_OF_NODES = (3, 5, 9, 17)  # epochs per segment of the drift: the first sufficient number
PROBES = (0.07, 0.31, 0.82)  # fractions of a segment at which the interpolation is tested
FOLLOWED = 1e-6  # largest interpolation error, relative to the largest moment
CONSTANT = 1e-9  # relative change below which moments are taken as independent of time


@dataclass(frozen=True, eq=False)
class BudgetSpan:
    """Moments of the errors within one segment of the drift."""

    # epochs from the first to the last, decimal years, between which moments are interpolated by
    # Lagrange's polynomial; empty for a model without time dependence
    nodes: tuple[float, ...]
    # (n, 2, K, K), by chip number and part: mean products of the Legendre coefficients of the
    # errors in u and in v, at each node; n = 1 for a part that does not depend on time. The joint
    # error is the last part
    moments: dict[int, dict[str, Float]]


@dataclass(frozen=True, eq=False)
class GridRow:
    """A row that is not a polynomial: values on the grid."""

    row: Row
    # (n, N, 2) by chip number, for each span: for an error its standard deviations, n = 1; for a
    # file its displacements at the nodes, linear in time between them, n = 1 if they do not
    # depend on time
    values: tuple[dict[int, Float], ...]


@dataclass(frozen=True, eq=False)
class BudgetSurface:
    """The error budget as a function of position, epoch and magnitude."""

    model: DistortionModel
    epoch: float | None  # epoch at which the budget is quoted
    # number of points along x and y of a chip, over which the budget is averaged and at which
    # `local` is given
    grid: tuple[int, int]
    spans: tuple[BudgetSpan, ...]  # in chronological order
    parts: tuple[Row, ...]  # errors of parameters; their moments are in `spans`
    local: tuple[GridRow, ...]  # other errors, at the epoch at which the budget is quoted
    constant: tuple[tuple[Row, Float], ...]  # (2,), errors that are equal at all positions
    centroid: MagnitudeErrors | None
    products: tuple[GridRow, ...] = ()  # not included in the total


def budget_surface(
    errors: DrawnErrors,
    grid: tuple[int, int],
    *,
    epoch: float | None = None,
    years: tuple[float, float] | None = None,
) -> BudgetSurface:
    """Second moments of all errors of a position.

    `errors`: with the draws of a budget, the surface reproduces its numbers. `grid`: number of
    points along x and y of a chip. `epoch`: decimal years, epoch at which the budget is quoted; the
    first of `years` by default. `years`: first and last epoch; required if the model depends on
    time. Raises InputError if the model depends on time and `years` is missing or not ascending.
    """
    model = errors.solution.model
    ends = _ends(model, years)
    if epoch is None and ends[0]:
        epoch = ends[0][0]
    spans = tuple(_span(errors, segment, epoch) for segment in ends)
    nodes = [span.nodes for span in spans]
    domain = EvaluationDomain.of_chips(model, grid, epoch=epoch)
    parts, local, constant, products = [], list[GridRow](), [], list[GridRow]()
    for draws, term_errors in zip(errors.draws, errors.at(domain), strict=True):
        for row, part, values in term_errors.by_row():
            if part.of_parameters:
                parts.append(row)
            elif isinstance(draws, Known):
                products.append(GridRow(row, tuple(_shifts(draws, domain, n) for n in nodes)))
            elif row.kind != LOCAL and np.ptp(values, axis=0).max() <= CONSTANT * values.max():
                constant.append((row, np.sqrt(values[0])))
            else:
                sigma = {chip: np.sqrt(values[rows])[None] for chip, rows in domain.by_chip()}
                local.append(GridRow(row, (sigma,)))
    centroid = [term.errors for term in errors.terms if isinstance(term, Centroids)]
    return BudgetSurface(
        model=model,
        epoch=epoch,
        grid=grid,
        spans=spans,
        parts=tuple(parts),
        local=tuple(local),
        constant=tuple(constant),
        centroid=centroid[0] if centroid else None,
        products=tuple(products),
    )


def _shifts(draws: Known, domain: EvaluationDomain, nodes: Sequence[float]) -> dict[int, Float]:
    """Displacements (n, N, 2) by chip number, at the nodes of a span."""
    moved = [draws.on(domain.at(epoch), Image()).shift for epoch in nodes or (None,)]
    return {
        chip: _short(np.stack([displacement[rows] for displacement in moved]))
        for chip, rows in domain.by_chip()
    }


def _ends(
    model: DistortionModel, years: tuple[float, float] | None
) -> tuple[tuple[float, ...], ...]:
    """First and last epoch of each segment of the drift; empty without time dependence."""
    if model.time is None:
        return ((),)
    if years is None or not years[0] < years[1]:
        raise InputError(
            f"the years are {years}, which are not ascending",
            do="give the first and then the last year",
        )
    first, last = years
    edges = [first, *(b for b in model.time.breaks if first < b < last), last]
    out = []
    for start, stop in pairwise(edges):
        # at a break the later segment applies
        end = stop if stop == last else float(np.nextafter(stop, start))
        out.append((start, end))
    return tuple(out)


def _span(errors: DrawnErrors, ends: Sequence[float], epoch: float | None) -> BudgetSpan:
    """Moments in one segment of the drift, at as many epochs as interpolation requires."""
    if not ends:
        return BudgetSpan((), _moments(errors, ()))
    start, end = ends
    probes = tuple(start + part * (end - start) for part in PROBES)
    truth = _moments(errors, probes)
    for n in NUMBERS_OF_NODES:
        nodes = _nodes(start, end, n, epoch)
        span = BudgetSpan(nodes, _moments(errors, nodes))
        if _follows(span, probes, truth):
            break
    return span


def _nodes(start: float, end: float, n: int, epoch: float | None) -> tuple[float, ...]:
    """Chebyshev extrema in a segment; the nearest one is moved to the quoted epoch."""
    at = 0.5 * (start + end) - 0.5 * (end - start) * np.cos(np.pi * np.arange(n) / (n - 1))
    at[0], at[-1] = start, end
    if epoch is not None and start < epoch < end:
        nearest = 1 + int(np.argmin(np.abs(at[1:-1] - epoch)))
        before, after = at[nearest - 1], at[nearest + 1]
        room = 0.25 * min(after - at[nearest], at[nearest] - before)
        # nodes that are too close would amplify rounding errors
        if before + room < epoch < after - room:
            at[nearest] = epoch
    return tuple(float(t) for t in at)


def lagrange_weights(nodes: Sequence[float], epoch: float) -> Float:
    """Lagrange interpolation weights (n,) of the nodes at an epoch."""
    t = np.asarray(nodes, float)
    factors = [np.prod((epoch - np.delete(t, k)) / (t[k] - np.delete(t, k))) for k in range(len(t))]
    return np.array(factors)


def _follows(span: BudgetSpan, probes: Sequence[float], truth: dict[int, dict[str, Float]]) -> bool:
    """True if the interpolated moments agree with those at the probes."""
    for chip, parts in span.moments.items():
        for part, at_nodes in parts.items():
            limit = FOLLOWED * np.abs(at_nodes).max()
            for k, epoch in enumerate(probes):
                asked = truth[chip][part]
                weights = lagrange_weights(span.nodes, epoch) if len(at_nodes) > 1 else np.ones(1)
                interpolated = np.tensordot(weights, at_nodes, 1)
                if np.abs(interpolated - asked[k if len(asked) > 1 else 0]).max() > limit:
                    return False
    return True


def _moments(errors: DrawnErrors, nodes: Sequence[float]) -> dict[int, dict[str, Float]]:
    """Moments (n, 2, K, K) at the nodes, by chip number and part; the joint ones are last."""
    model = errors.solution.model
    epochs = nodes or (None,)
    # moments do not depend on the positions of the domain
    domain = EvaluationDomain.of_chips(model, (2, 2), epoch=epochs[0])
    at = [errors.at(domain.at(epoch)) for epoch in epochs]
    out: dict[int, dict[str, Float]] = {chip.number: {} for chip in model.chips}
    for chip, moments in out.items():
        by_node = [_of_parameters(fields, chip) for fields in at]
        for part in by_node[0]:
            moments[part] = _short(np.stack([moments_at_node[part] for moments_at_node in by_node]))
    return out


def _of_parameters(fields: Sequence[ErrorField], chip: int) -> dict[str, Float]:
    """Moments (2, K, K) of each part on a chip, and of their joint error."""
    out: dict[str, Float] = {}
    joint: Float | float = 0.0
    for term_errors in fields:
        for part in term_errors.parts:
            if isinstance(part, PolynomialField):
                out[part.rows[0].name] = _second(part.coefficients[chip])
        added = [p.coefficients[chip] for p in term_errors.summed if isinstance(p, PolynomialField)]
        if added:
            joint = joint + _second(sum(added[1:], added[0]))
    return out | {JOINT: np.asarray(joint)}


def _second(e: Float) -> Float:
    """Mean products (2, K, K) of coefficients (n, 2, K)."""
    axes = np.swapaxes(e, 0, 1)
    return np.swapaxes(axes, 1, 2) @ axes / len(e)


def _short(moments: Float) -> Float:
    """Moments reduced to a single node if they are equal at all nodes."""
    change = np.abs(moments - moments[:1]).max()
    return moments[:1] if change <= CONSTANT * np.abs(moments).max() else moments
