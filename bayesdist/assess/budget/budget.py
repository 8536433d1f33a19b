"""The error budget: what the position error at each place of the detector is made of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.requirements.verdict import effective_draws
from bayesdist.assess.solution import Solution, place_of
from bayesdist.assess.terms.field_terms import FieldTerm
from bayesdist.assess.terms.fields import MODEL, ErrorFields, draw_errors
from bayesdist.assess.terms.given import LOCAL, MEASURED, LocalTerm, UserTerm
from bayesdist.assess.terms.product_terms import PRODUCT, ProductTerm
from bayesdist.assess.units import pixel_scale_of
from bayesdist.model.grid import DEFAULT_GRID, grid_pixels, mesh

__all__ = [
    "BudgetTerm",
    "ErrorBudget",
    "budget_rows",
    "error_budget",
    "error_budgets",
]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

TOTAL = "total"
TOGETHER = "all terms but products, combined by draws"


@dataclass(frozen=True, eq=False)
class BudgetTerm:
    """One contribution to the position error.

    Parameters
    ----------
    name : str
    kind : str
        'random', 'systematic' (as the parts of the model, which all stars share), 'local' (shared
        by the stars at one place), or 'product' (of a file, known, and in no total).
    u, v : ndarray, shape (ny, nx)
        Standard deviations, in the unit of the budget; of products the displacements' sizes.
    source : str
        Begins with 'measured in this run', 'given by the user' or 'published'.
    relative_error : float or None
        How well the standard deviations are known themselves, relative to their size: of draws the
        Monte-Carlo error.  None where it is not known.
    """

    name: str
    kind: str
    u: Float
    v: Float
    source: str
    relative_error: float | None = None

    @property
    def radial(self) -> Float:
        """hypot(u, v), (ny, nx)."""
        return np.hypot(self.u, self.v)


@dataclass(frozen=True, eq=False)
class ErrorBudget:
    """Contributions to the position error over the detector, and their total.

    Parameters
    ----------
    x : ndarray, shape (nx,)
    y : ndarray, shape (ny,)
        FITS 1-based pixels.
    unit : str
    chip : int
    epoch : float or None
    terms : tuple of BudgetTerm
        Parts of the model first, then field terms, local ones, and the user's.
    model_u, model_v : ndarray, shape (ny, nx)
        All parts of the model and the field terms jointly.  They are correlated, so this may be
        smaller than any of them.
    total_u, total_v : ndarray, shape (ny, nx)
        The former, the local terms and the user's in quadrature.
    dominant : ndarray of int, shape (ny, nx)
        Index into `terms` of the one with the largest radial error.
    n_draws : int
        Draws behind the model's parts: their relative error is about 1 / sqrt(2 n_draws).
    products : tuple of BudgetTerm
        What files differ by from the solution: in no total.
    """

    x: Float
    y: Float
    unit: str
    chip: int
    epoch: float | None
    terms: tuple[BudgetTerm, ...]
    model_u: Float
    model_v: Float
    total_u: Float
    total_v: Float
    dominant: Int
    n_draws: int
    products: tuple[BudgetTerm, ...] = ()

    @property
    def radial(self) -> Float:
        """Total radial error hypot(total_u, total_v), (ny, nx)."""
        return np.hypot(self.total_u, self.total_v)

    @property
    def total(self) -> BudgetTerm:
        """All terms together, as one."""
        return BudgetTerm("total", TOTAL, self.total_u, self.total_v, TOGETHER)

    def rows(self) -> list[dict[str, Any]]:
        """The budget as a table: one row for each term and each product, the total last.

        Returns
        -------
        list of dict
            name, kind, u, v, radial (root mean squares over the grid), radial_error (how well that
            is known; None where it is not), source.
        """
        return budget_rows([*self.terms, *self.products, self.total])


def budget_rows(terms: Sequence[BudgetTerm]) -> list[dict[str, Any]]:
    """Rows of a budget: root mean squares of the standard deviations; the total is the last one.

    The total is known as well as its terms are: not where one of them was given without an error.
    """
    rows = []
    for t in terms:
        mean_u, mean_v = float(np.mean(t.u**2)), float(np.mean(t.v**2))
        radial = (mean_u + mean_v) ** 0.5
        error = None if t.relative_error is None else t.relative_error * radial
        rows.append(
            {
                "name": t.name,
                "kind": t.kind,
                "u": mean_u**0.5,
                "v": mean_v**0.5,
                "radial": radial,
                "radial_error": error,
                "source": t.source,
            }
        )
    total = rows[-1]
    if total["kind"] == TOTAL and total["radial"] > 0:
        parts = [(r["radial"], r["radial_error"]) for r in rows[:-1] if r["kind"] != PRODUCT]
        known = [(radial, error) for radial, error in parts if error is not None]
        spread = sum((radial * error) ** 2 for radial, error in known) ** 0.5
        # a term of nothing needs no error
        whole = len(known) == sum(radial > 0 or error is not None for radial, error in parts)
        total["radial_error"] = spread / total["radial"] if whole else None
    return rows


def error_budget(
    solution: Solution,
    *,
    terms: Sequence[UserTerm] = (),
    fields: Sequence[FieldTerm] = (),
    aligned: bool = False,
    grid: tuple[int, int] = DEFAULT_GRID,
    epoch: float | None = None,
    chip: int | None = None,
    n_draws: int = 4000,
    rng: np.random.Generator,
    pixel_scale: float | None = None,
) -> ErrorBudget:
    """The error budget of a solution over a grid, at an epoch.

    The parts of the model and the field terms are combined by joint draws, for they are correlated;
    the user's terms are independent and added in quadrature.

    Parameters
    ----------
    solution : LinearFit or Posterior
    terms : sequence of UserTerm
    fields : sequence of FieldTerm
        Errors that are fields over the detector, each a row of its own.
    aligned : bool
        Whether shift and rotation of the exposure are the observer's to fit, as in `error_fields`.
        The user's terms stay as they are given.
    grid : tuple of int
        Points on x and y.
    epoch : float, optional
        Decimal years; needed by a model with time dependence.
    chip : int, optional
        Chip number; the first chip by default.
    n_draws : int
    rng : numpy.random.Generator
    pixel_scale : float, optional
        Size of one pixel in mas; `pixel_scale_of` the solution by default.

    Returns
    -------
    ErrorBudget
        In the unit of u, v.

    Raises
    ------
    InputError
        For an unknown chip, a missing epoch, a bad grid, fewer than two draws, or a term whose unit
        needs a pixel scale that is not known.
    """
    number = place_of(solution.model, epoch=epoch, chip=chip).chip.number
    (budget,) = error_budgets(
        solution,
        (number,),
        terms=terms,
        fields=fields,
        aligned=aligned,
        grid=grid,
        epoch=epoch,
        n_draws=n_draws,
        rng=rng,
        pixel_scale=pixel_scale,
    )
    return budget


def error_budgets(
    solution: Solution,
    chips: Sequence[int],
    *,
    terms: Sequence[UserTerm] = (),
    fields: Sequence[FieldTerm] = (),
    aligned: bool = False,
    local: Sequence[LocalTerm] = (),
    products: Sequence[ProductTerm] = (),
    grid: tuple[int, int] = DEFAULT_GRID,
    epoch: float | None = None,
    n_draws: int = 4000,
    rng: np.random.Generator,
    pixel_scale: float | None = None,
) -> tuple[ErrorBudget, ...]:
    """Error budgets of several chips from one set of draws: the chips share parameters.

    Parameters
    ----------
    solution : LinearFit or Posterior
    chips : sequence of int
        Chip numbers.
    local : sequence of LocalTerm
        Measured beside the solution, on this grid.
    products : sequence of ProductTerm
        Shown beside the others, and in no total.
    terms, fields, aligned, grid, epoch, n_draws, rng, pixel_scale
        As in `error_budget`.

    Returns
    -------
    tuple of ErrorBudget

    Raises
    ------
    InputError
        As `error_budget`.
    """
    unit = solution.model.unit
    if pixel_scale is None:
        pixel_scale = pixel_scale_of(solution, chips[0])
    sigmas = [t.sigma(unit, pixel_scale) for t in terms]  # refuse bad units before the work
    grids = {
        c: grid_pixels(place_of(solution.model, epoch=epoch, chip=c).chip.size, grid) for c in chips
    }
    draws = draw_errors(solution, n_draws, rng, fields=fields, aligned=aligned)
    drawn = draws.at({c: mesh(*xy) for c, xy in grids.items()}, epoch=epoch)
    noise = 1.0 / (2.0 * effective_draws(solution, n_draws)) ** 0.5
    sources = {t.name: t.source for t in fields}
    return tuple(
        replace(
            _budget(f, *grids[f.chip], terms, sigmas, local, noise, sources),
            products=tuple(_product(p, *grids[f.chip], f.chip, f.epoch) for p in products),
        )
        for f in drawn
    )


def _product(term: ProductTerm, x: Float, y: Float, chip: int, epoch: float | None) -> BudgetTerm:
    u, v = np.abs(term.at(*mesh(x, y), chip, epoch)).T.reshape(2, y.size, x.size)
    return BudgetTerm(term.name, PRODUCT, u, v, term.source, 0.0)


def _budget(
    fields: ErrorFields,
    x: Float,
    y: Float,
    terms: Sequence[UserTerm],
    sigmas: Sequence[tuple[float, float]],
    local: Sequence[LocalTerm],
    noise: float,
    sources: Mapping[str, str],
) -> ErrorBudget:
    shape = (y.size, x.size)
    measured = {part: tuple(s.reshape(shape) for s in fields.sigma(part)) for part in fields.parts}
    model_u, model_v = measured.pop(MODEL)
    entries = [
        BudgetTerm(n, "systematic", u, v, sources.get(n, MEASURED), noise)
        for n, (u, v) in measured.items()
    ]
    n_parts = len(entries)
    entries += [
        BudgetTerm(
            t.name, LOCAL, *t.on(fields.chip, shape), t.source, t.relative_error(fields.chip)
        )
        for t in local
    ]
    for t, (su, sv) in zip(terms, sigmas, strict=True):
        entries.append(BudgetTerm(t.name, t.kind, np.full(shape, su), np.full(shape, sv), t.source))
    others = entries[n_parts:]
    user_u2, user_v2 = (sum(getattr(t, axis) ** 2 for t in others) for axis in "uv")
    return ErrorBudget(
        x=x,
        y=y,
        unit=fields.unit,
        chip=fields.chip,
        epoch=fields.epoch,
        terms=tuple(entries),
        model_u=model_u,
        model_v=model_v,
        total_u=np.sqrt(model_u**2 + user_u2),
        total_v=np.sqrt(model_v**2 + user_v2),
        dominant=np.argmax([t.radial for t in entries], axis=0),
        n_draws=fields.n_draws,
    )
