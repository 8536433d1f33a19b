"""The error budget of single positions, and of the difference of two in one image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesdist.assess.budget.budget import TOGETHER, TOTAL, BudgetTerm
from bayesdist.assess.drawn import CENTROID, PositionErrors
from bayesdist.assess.terms.fields import MODEL
from bayesdist.assess.terms.given import LOCAL, MEASURED
from bayesdist.assess.terms.product_terms import PRODUCT, ProductTerm
from bayesdist.errors import InputError

__all__ = ["PlaceBudget", "place_budget"]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PlaceBudget:
    """Contributions to the errors of positions.

    Parameters
    ----------
    x, y : ndarray, shape (N,)
        FITS 1-based pixels.
    chip : int
    epoch : float or None
    magnitude : float or None
    relative : bool
        Whether the errors are those of the difference to the first position.
    unit : str
    terms : tuple of BudgetTerm
        Standard deviations (N,), the total last.
    """

    x: Float
    y: Float
    chip: int
    epoch: float | None
    magnitude: float | None
    relative: bool
    unit: str
    terms: tuple[BudgetTerm, ...]


def place_budget(
    errors: PositionErrors,
    x: ArrayLike,
    y: ArrayLike,
    *,
    chip: int,
    epoch: float | None = None,
    magnitude: float | None = None,
    relative: bool = False,
    relative_error: float | None = None,
    sources: dict[str, str] | None = None,
    products: Sequence[ProductTerm] = (),
) -> PlaceBudget:
    """What the errors of some positions are made of.

    Parameters
    ----------
    errors : PositionErrors
    x, y : array_like, shape (N,)
        FITS 1-based pixels; two or more for relative errors.
    chip : int
        Chip number.
    epoch : float, optional
        Decimal years; needed by a model with time dependence.
    magnitude : float, optional
        Of the stars: their centroids' errors are a term then.
    relative : bool
        Errors of the differences to the first position, in one image: what all positions share
        drops out, and what is independent counts twice.
    relative_error : float, optional
        Monte-Carlo error of what is drawn.
    sources : dict of str to str, optional
        Where terms come from; 'measured in this run' by default.
    products : sequence of ProductTerm
        Shown beside the others, and in no total.

    Returns
    -------
    PlaceBudget

    Raises
    ------
    InputError
        For an unknown chip, a position off the chip, a missing epoch, a magnitude where no errors
        by magnitude are known, and relative errors of one position.
    """
    model = errors.fields.whole.solution.model
    size = model.chips[model.chip_code(chip)].size
    at = [np.atleast_1d(np.asarray(a, float)) for a in (x, y)]
    for name, values, extent in zip("xy", at, size, strict=True):
        outside = ~((values >= 0.5) & (values <= extent + 0.5))
        if outside.any():
            raise InputError(
                f"{name} = {values[int(np.argmax(outside))]:g} is not on chip {chip} of "
                f"{size[0]:g} x {size[1]:g} pixels",
                do="give FITS 1-based pixels",
            )
    if relative and at[0].size < 2:
        raise InputError("a relative error is of two positions", do="give a second one")
    (fields,) = errors.fields.at({chip: (at[0], at[1])}, epoch=epoch)

    def drawn(part: str) -> Float:
        values = fields.field(part)
        if relative:
            values = values[:, 1:] - values[:, :1]
        return np.sqrt(np.mean(values**2, axis=0))

    def single(sigma: Float) -> Float:
        return np.hypot(sigma[1:], sigma[:1]) if relative else sigma

    N = at[0].size
    terms = [
        _term(name, "systematic", drawn(name), (sources or {}).get(name, MEASURED), relative_error)
        for name in fields.parts
        if name != MODEL
    ]
    others = []
    for local in errors.local:
        sigma = single(local.at(chip, size, *at))
        others.append(_term(local.name, LOCAL, sigma, local.source, local.relative_error(chip)))
    for term, sigma in zip(errors.terms, errors.sigmas, strict=True):
        wide = np.tile(sigma, (N, 1))
        if term.kind == "random":
            others.append(_term(term.name, term.kind, single(wide), term.source))
        else:
            shared = np.zeros((N - 1, 2)) if relative else wide
            others.append(_term(term.name, term.kind, shared, term.source))
    if magnitude is not None:
        sigma = np.tile(errors.centroid_at(magnitude), (N, 1))
        others.append(_term(CENTROID, "random", single(sigma), MEASURED))
    of_files = []
    for product in products:
        moved = product.at(*at, chip, fields.epoch)
        moved = np.abs(moved[1:] - moved[:1] if relative else moved)
        of_files.append(_term(product.name, PRODUCT, moved, product.source, 0.0))
    model_term = drawn(MODEL)
    total = np.sqrt(sum((np.stack([t.u, t.v], axis=1) ** 2 for t in others), model_term**2))
    kept = [a[1:] if relative else a for a in at]
    return PlaceBudget(
        *kept,
        chip=chip,
        epoch=fields.epoch,
        magnitude=magnitude,
        relative=relative,
        unit=errors.unit,
        terms=(*terms, *others, *of_files, _term(TOTAL, TOTAL, total, TOGETHER)),
    )


def _term(
    name: str, kind: str, sigma: Float, source: str, relative_error: float | None = None
) -> BudgetTerm:
    return BudgetTerm(name, kind, sigma[:, 0], sigma[:, 1], source, relative_error)
