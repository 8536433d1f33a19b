"""The error budget: what the error of each position is made of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.drawn import CENTROID, PositionErrors, position_errors, sigma_at
from bayesdist.assess.requirements.verdict import effective_draws
from bayesdist.assess.solution import Solution, place_of
from bayesdist.assess.terms.field_terms import FieldTerm
from bayesdist.assess.terms.fields import MODEL
from bayesdist.assess.terms.given import LOCAL, MEASURED, LocalTerm, UserTerm
from bayesdist.assess.terms.product_terms import PRODUCT, ProductTerm
from bayesdist.assess.units import pixel_scale_of
from bayesdist.model.grid import DEFAULT_GRID

__all__ = [
    "TOTAL",
    "BudgetTerm",
    "ErrorBudget",
    "detector_budget",
    "error_budget",
    "place_budget",
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
    u, v : ndarray, shape (P,)
        Standard deviations, in the unit of the budget; of products the displacements' sizes.
    source : str
        Begins with 'measured in this run', 'given by the user' or 'published'.
    relative_error : float or None
        How well the standard deviations are known themselves, relative to their size: of draws the
        Monte-Carlo error.  None where it is not known.
    by_chip : mapping of int to float or None
        The same by chip number, where that differs; `relative_error` is that of the first chip.
    """

    name: str
    kind: str
    u: Float
    v: Float
    source: str
    relative_error: float | None = None
    by_chip: Mapping[int, float | None] = field(default_factory=dict)

    @property
    def radial(self) -> Float:
        """hypot(u, v), (P,)."""
        return np.hypot(self.u, self.v)

    def on(self, chip: int, rows: slice) -> BudgetTerm:
        """The same on one chip, whose positions are some of the rows."""
        known = self.by_chip.get(chip, self.relative_error)
        return replace(self, u=self.u[rows], v=self.v[rows], relative_error=known, by_chip={})


@dataclass(frozen=True, eq=False)
class ErrorBudget:
    """Contributions to the errors of positions, or of their differences to the first one.

    Parameters
    ----------
    domain : EvaluationDomain
        N positions; P = N, or N - 1 where errors are those of differences to the first.
    unit : str
    terms : tuple of BudgetTerm
        Parts of the model first, then field terms, local ones, and the user's.
    model : BudgetTerm
        All parts of the model and the field terms jointly.  They are correlated, so this may be
        smaller than any of them.
    n_draws : int
        Draws behind the model's parts: their relative error is about 1 / sqrt(2 n_draws).
    products : tuple of BudgetTerm
        What files differ by from the solution: in no total.
    """

    domain: EvaluationDomain
    unit: str
    terms: tuple[BudgetTerm, ...]
    model: BudgetTerm
    total: BudgetTerm
    n_draws: int
    products: tuple[BudgetTerm, ...] = ()

    @property
    def x(self) -> Float:
        """FITS 1-based columns (P,)."""
        return self.domain.x[self._kept]

    @property
    def y(self) -> Float:
        """FITS 1-based rows (P,)."""
        return self.domain.y[self._kept]

    @property
    def _kept(self) -> slice:
        return slice(1 if self.domain.relative else 0, None)

    @property
    def epoch(self) -> float | None:
        """Decimal years."""
        return self.domain.epoch

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the terms."""
        return tuple(t.name for t in self.terms)

    @property
    def every(self) -> tuple[BudgetTerm, ...]:
        """All rows: terms, products, and the total last."""
        return (*self.terms, *self.products, self.total)

    @property
    def radial(self) -> Float:
        """Total radial error (P,)."""
        return self.total.radial

    @property
    def dominant(self) -> Int:
        """Index into `terms` of the one with the largest radial error, (P,)."""
        return np.argmax([t.radial for t in self.terms], axis=0)

    @property
    def share(self) -> Float:
        """Fraction of the positions at which each term is the largest."""
        dominant = self.dominant
        return np.bincount(dominant, minlength=len(self.terms)) / dominant.size

    @property
    def chips(self) -> tuple[ErrorBudget, ...]:
        """The budget of each chip by itself."""
        return tuple(
            replace(
                self,
                domain=self.domain.on(chip),
                terms=tuple(t.on(chip, rows) for t in self.terms),
                model=self.model.on(chip, rows),
                total=self.total.on(chip, rows),
                products=tuple(t.on(chip, rows) for t in self.products),
            )
            for chip, rows in self.domain.by_chip()
        )

    @property
    def axes(self) -> tuple[Float, Float]:
        """Columns (nx,) and rows (ny,) of the grid, of a budget over the grid of one chip."""
        nx, ny = self.domain.grid or (self.domain.size, 1)
        return self.x[:nx], self.y.reshape(ny, nx)[:, 0]

    def on_grid(self, values: NDArray[Any]) -> NDArray[Any]:
        """Values (N,) of a budget over the grid of one chip as a map (ny, nx)."""
        nx, ny = self.domain.grid or (self.domain.size, 1)
        return values.reshape(ny, nx)

    def rows(self) -> list[dict[str, Any]]:
        """The budget as a table: one row for each term and each product, the total last.

        The total is known as well as its terms are: not where one of them was given without an
        error.

        Returns
        -------
        list of dict
            name, kind, u, v, radial (root mean squares over the positions), radial_error (how well
            that is known; None where it is not), source.
        """
        rows = []
        for t in self.every:
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
        if total["radial"] > 0:
            parts = [(r["radial"], r["radial_error"]) for r in rows[:-1] if r["kind"] != PRODUCT]
            known = [(radial, error) for radial, error in parts if error is not None]
            spread = sum((radial * error) ** 2 for radial, error in known) ** 0.5
            # a term of nothing needs no error
            whole = len(known) == sum(radial > 0 or error is not None for radial, error in parts)
            total["radial_error"] = spread / total["radial"] if whole else None
        return rows

    def rows_by_chip(self) -> list[dict[str, Any]]:
        """As `rows`, followed by those of each chip alone; column chip is 'all' or its number."""
        alone = zip(self.domain.chips, self.chips, strict=True)
        parts = [("all", self.rows()), *((str(chip), b.rows()) for chip, b in alone)]
        return [{"chip": chip} | row for chip, rows in parts for row in rows]


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
    """The error budget of a solution over a grid on a chip, at an epoch.

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
    return detector_budget(
        solution,
        terms=terms,
        fields=fields,
        aligned=aligned,
        grid=grid,
        epoch=epoch,
        chips=(place_of(solution.model, epoch=epoch, chip=chip).chip.number,),
        n_draws=n_draws,
        rng=rng,
        pixel_scale=pixel_scale,
    )


def detector_budget(
    solution: Solution,
    *,
    terms: Sequence[UserTerm] = (),
    fields: Sequence[FieldTerm] = (),
    aligned: bool = False,
    local: Sequence[LocalTerm] = (),
    products: Sequence[ProductTerm] = (),
    grid: tuple[int, int] = DEFAULT_GRID,
    epoch: float | None = None,
    chips: Sequence[int] | None = None,
    n_draws: int = 4000,
    rng: np.random.Generator,
    pixel_scale: float | None = None,
) -> ErrorBudget:
    """The error budget of a solution over its chips, the same grid on each.

    Parameters
    ----------
    solution : LinearFit or Posterior
    local : sequence of LocalTerm
        Measured beside the solution.
    products : sequence of ProductTerm
        Shown beside the others, and in no total.
    chips : sequence of int, optional
        Chip numbers; all by default.
    terms, fields, aligned, grid, epoch, n_draws, rng, pixel_scale
        As in `error_budget`.

    Returns
    -------
    ErrorBudget
        In the unit of u, v.

    Raises
    ------
    InputError
        As `error_budget`.
    """
    if pixel_scale is None:
        pixel_scale = pixel_scale_of(solution, None if chips is None else chips[0])
    domain = EvaluationDomain.of_chips(solution.model, grid, chips=chips, epoch=epoch)
    errors = position_errors(
        solution,
        terms=terms,
        fields=fields,
        aligned=aligned,
        local=local,
        grid=grid,
        n_draws=n_draws,
        rng=rng,
        pixel_scale=pixel_scale,
    )
    noise = 1.0 / (2.0 * effective_draws(solution, n_draws)) ** 0.5
    sources = {t.name: t.source for t in fields}
    return _budget(errors, domain, relative_error=noise, sources=sources, products=products)


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
    sources: Mapping[str, str] | None = None,
    products: Sequence[ProductTerm] = (),
) -> ErrorBudget:
    """The error budget of some positions, or of their differences to the first one.

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
    sources : mapping of str to str, optional
        Where terms come from; 'measured in this run' by default.
    products : sequence of ProductTerm
        Shown beside the others, and in no total.

    Returns
    -------
    ErrorBudget

    Raises
    ------
    InputError
        For an unknown chip, a position off the chip, a missing epoch, a magnitude where no errors
        by magnitude are known, and relative errors of one position.
    """
    model = errors.fields.whole.solution.model
    domain = EvaluationDomain.at_pixels(
        model, chip, x, y, epoch=epoch, magnitude=magnitude, relative=relative
    )
    return _budget(
        errors, domain, relative_error=relative_error, sources=sources or {}, products=products
    )


def _budget(
    errors: PositionErrors,
    domain: EvaluationDomain,
    *,
    relative_error: float | None,
    sources: Mapping[str, str],
    products: Sequence[ProductTerm],
) -> ErrorBudget:
    fields, relative, N = errors.at(domain), bool(domain.relative), domain.size

    def drawn(part: str) -> Float:
        if not relative:
            return fields.variance(part)
        values = fields.values(part)
        return np.asarray(np.mean((values[:, 1:] - values[:, :1]) ** 2, axis=0))

    def single(sigma: Float) -> Float:
        return sigma[1:] ** 2 + sigma[:1] ** 2 if relative else sigma**2

    def term(
        name: str, kind: str, square: Float, source: str, error: float | None = None
    ) -> BudgetTerm:
        return BudgetTerm(name, kind, *np.sqrt(square).T, source, error)

    terms = [
        term(name, "systematic", drawn(name), sources.get(name, MEASURED), relative_error)
        for name in fields.parts
    ]
    model, others = drawn(MODEL), []
    for local in errors.local:
        square = single(sigma_at(local, domain))
        known = {chip: local.relative_error(chip) for chip in domain.chips}
        one = term(local.name, LOCAL, square, local.source, known[domain.chips[0]])
        others.append(replace(one, by_chip=known))
    for given, sigma in zip(errors.terms, errors.sigmas, strict=True):
        square = single(np.tile(sigma, (N, 1)))
        if given.kind != "random" and relative:
            square = np.zeros_like(square)
        others.append(term(given.name, given.kind, square, given.source))
    if domain.magnitude is not None:
        sigma = np.tile(errors.centroid_at(domain.magnitude), (N, 1))
        others.append(term(CENTROID, "random", single(sigma), MEASURED))
    moved = [
        np.concatenate(
            [p.at(domain.x[k], domain.y[k], chip, domain.epoch) for chip, k in domain.by_chip()]
        )
        for p in products
    ]
    total = sum((np.stack([t.u, t.v], axis=1) ** 2 for t in others), model)
    return ErrorBudget(
        domain,
        errors.unit,
        (*terms, *others),
        term("model", "systematic", model, MEASURED, relative_error),
        term(TOTAL, TOTAL, total, TOGETHER),
        errors.n_draws,
        tuple(
            term(p.name, PRODUCT, (m[1:] - m[:1] if relative else m) ** 2, p.source, 0.0)
            for p, m in zip(products, moved, strict=True)
        ),
    )
