"""Error budget: the contributions to the error of each position."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from html import escape
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.drawn import DrawnErrors
from bayesdist.assess.solution import place_of
from bayesdist.assess.terms.forms import PRODUCT
from bayesdist.model.grid import grid_pixels
from bayesdist.utils.arrays import Float, Int

if TYPE_CHECKING:
    from astropy.table import QTable

TOTAL = "total"
TOGETHER = "all terms but products, combined by draws"
MODEL = "model, jointly"
JOINTLY = "errors of the parameters, combined by draws"


@dataclass(frozen=True, eq=False)
class BudgetTerm:
    """One contribution to the position error.

    Parameters
    ----------
    name : str
        Name of the row.
    kind : str
        'random'; 'systematic' (shared by all stars, like errors of the model's parameters); 'local'
        (shared by stars near a position); or 'product' (known deviation of a file, in no total).
    u, v : ndarray, shape (P,)
        Standard deviations in the unit of the budget; for products the displacements.
    source : str
        Begins with 'measured in this run', 'given by the user' or 'published'.
    relative_error : float or None
        Relative uncertainty of the standard deviations; for draws their Monte-Carlo error. None if
        it is unknown.
    by_chip : mapping of int to (float or None)
        Relative uncertainty by chip number, if it differs; `relative_error` is for the first chip.
    of_parameters : bool
        True for errors of the model's parameters, which are correlated.
    """

    name: str
    kind: str
    u: Float
    v: Float
    source: str
    relative_error: float | None = None
    by_chip: Mapping[int, float | None] = field(default_factory=dict)
    of_parameters: bool = False

    @property
    def radial(self) -> Float:
        """Radial errors hypot(u, v), shape (P,), in the unit of the budget."""
        return np.hypot(self.u, self.v)

    def on(self, chip: int, rows: slice) -> BudgetTerm:
        """Part of the term on one chip, for the slice `rows` of its positions."""
        relative_error = self.by_chip.get(chip, self.relative_error)
        return replace(
            self, u=self.u[rows], v=self.v[rows], relative_error=relative_error, by_chip={}
        )


class BudgetEntry(TypedDict):
    """Row of an error budget: rms over the positions, in the unit of the budget."""

    name: str
    kind: str  # random, systematic, local, product or total
    u: float
    v: float
    radial: float
    radial_error: float | None  # uncertainty of `radial`; None if unknown
    source: str


class ChipBudgetEntry(BudgetEntry):
    """Row of an error budget of a chip."""

    chip: str  # number of the chip, or 'all'


@dataclass(frozen=True, eq=False)
class ErrorBudget:
    """Contributions to the errors of positions, or of their differences from the first one.

    Parameters
    ----------
    domain : EvaluationDomain
        N positions; P = N, or N - 1 for errors of differences from the first position.
    unit : str
        Unit of all errors, that of u and v.
    terms : tuple of BudgetTerm
        Errors of parameters first, followed by local ones and those stated by the user.
    total : BudgetTerm
        Sum of all terms. Rows of one term are correlated, so the total may be smaller than any of
        them.
    n_draws : int
        Number of draws of the model's parts: their relative error is about 1 / sqrt(2 n_draws).
    products : tuple of BudgetTerm
        Deviations of files from the solution, which are not included in the total.
    notes : tuple of str
        Sentences on what the budget lacks, such as measured terms if the residuals were not
        examined.

    Examples
    --------
    >>> from bayesdist.missions.wise import simulate_wise
    >>> rng = np.random.default_rng(1)
    >>> matches, truth = simulate_wise(500, rng=rng)
    >>> model = bd.build_model(matches, order=2, size=(1016, 1016))
    >>> fit = bd.fit_linear(matches, model)
    >>> budget = bd.error_budget(fit, grid=(5, 3), n_draws=100, rng=rng)
    >>> budget.total.name, budget.unit
    ('total', 'pix')
    """

    domain: EvaluationDomain
    unit: str
    terms: tuple[BudgetTerm, ...]
    total: BudgetTerm
    n_draws: int
    products: tuple[BudgetTerm, ...] = ()
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        *_, total = self.rows()
        largest = max(self.rows()[:-1], key=lambda row: row["radial"], default=total)
        head = (
            f"ErrorBudget(total {total['radial']:.3g} {self.unit} radial rms {self._where}; "
            f"largest of {len(self.terms)} terms: {largest['name']}, "
            f"{largest['radial']:.3g} {self.unit})"
        )
        return "\n".join([head, *(f"  - {note}" for note in self.notes)])

    def __str__(self) -> str:
        head, *cells = self._cells()
        widths = [max(map(len, column)) for column in zip(head, *cells, strict=True)]
        lines = [
            "  ".join(
                cell.rjust(width) if 0 < k < 5 else cell.ljust(width)
                for k, (cell, width) in enumerate(zip(row, widths, strict=True))
            ).rstrip()
            for row in (head, *cells)
        ]
        return "\n".join([f"Errors {self._where}", *lines, *(f"- {note}" for note in self.notes)])

    def _repr_html_(self) -> str:
        head, *cells = self._cells()
        rows = [f"<tr>{''.join(f'<th>{escape(cell)}</th>' for cell in head)}</tr>"]
        rows += [f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in cells]
        notes = "".join(f"<p>{escape(note)}</p>" for note in self.notes)
        caption = f"<caption>Errors {escape(self._where)}</caption>"
        return f"<table>{caption}{''.join(rows)}</table>{notes}"

    @property
    def _where(self) -> str:
        """Description of the positions and the epoch."""
        chips = ", ".join(map(str, self.domain.chips))
        several = "s" if len(self.domain.chips) > 1 else ""
        words = f"at {self.x.size} positions on chip{several} {chips}"
        if self.domain.relative == "first":
            start, *ends = zip(self.domain.x, self.domain.y, strict=True)
            to = f"({ends[0][0]:g}, {ends[0][1]:g})" if len(ends) == 1 else f"{len(ends)} positions"
            words = f"of the separation of ({start[0]:g}, {start[1]:g}) from {to} on chip {chips}"
        elif self.x.size == 1:
            words = f"at ({self.x[0]:g}, {self.y[0]:g}) on chip {chips}"
        return words if self.epoch is None else f"{words} in {self.epoch:.2f}"

    def _cells(self) -> list[tuple[str, ...]]:
        """Cells of a text table: the header, followed by one row per term."""
        units = [f"{name} [{self.unit}]" for name in ("u", "v", "radial")]
        out = [("term", *units, "relative uncertainty", "kind", "source")]
        for row in self.rows():
            sizes = [f"{row[name]:.3g}" for name in ("u", "v", "radial")]
            relative = _relative_error(row)
            percentage = f"{100 * relative:.1f} %" if np.isfinite(relative) else "unknown"
            out.append((row["name"], *sizes, percentage, row["kind"], row["source"]))
        return out

    def to_table(self) -> QTable:
        """The budget as an astropy table with units: one row per term, the total last.

        Returns
        -------
        astropy.table.QTable
            Columns name; u, v and radial, root mean squares over the positions, in the unit of the
            budget; relative_error (nan if it is not known), kind and source.  Notes, epoch and
            chips are in `meta`.

        Examples
        --------
        >>> table = budget.to_table()  # doctest: +SKIP
        >>> table["radial"].to("mas")  # doctest: +SKIP
        """
        import astropy.units as apu
        from astropy.table import QTable

        rows = self.rows()
        table = QTable()
        table["name"] = [row["name"] for row in rows]
        for name in ("u", "v", "radial"):
            table[name] = np.array([row[name] for row in rows]) * apu.Unit(self.unit)
        table["relative_error"] = [_relative_error(row) for row in rows]
        table["kind"] = [row["kind"] for row in rows]
        table["source"] = [row["source"] for row in rows]
        table.meta = {
            "statistic": "rms over the positions",
            "epoch": self.epoch,
            "chips": list(self.domain.chips),
            "notes": list(self.notes),
        }
        return table

    @property
    def x(self) -> Float:
        """Pixel coordinates x (P,) of the positions, FITS 1-based."""
        return self.domain.x[self._compared]

    @property
    def y(self) -> Float:
        """Pixel coordinates y (P,) of the positions, FITS 1-based."""
        return self.domain.y[self._compared]

    @property
    def _compared(self) -> slice:
        """Slice of the positions, without the first one if it is the reference of differences."""
        return slice(1 if self.domain.relative else 0, None)

    @property
    def epoch(self) -> float | None:
        """Epoch of the budget in decimal years; None if the model does not depend on time."""
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
        """Total radial error (P,), in `unit`."""
        return self.total.radial

    @property
    def model(self) -> BudgetTerm | None:
        """Joint error of the model's parameters; None if fewer than two terms are of parameters.

        It is the total minus the independent terms in quadrature. Since the parts are correlated,
        it may be smaller than any of them.
        """
        parts = [t for t in self.terms if t.of_parameters]
        if len(parts) < 2:
            return None
        independent = [t for t in self.terms if not t.of_parameters]
        u, v = (
            np.sqrt(
                np.maximum(
                    getattr(self.total, axis) ** 2
                    - sum(getattr(t, axis) ** 2 for t in independent),
                    0.0,
                )
            )
            for axis in "uv"
        )
        return replace(parts[0], name=MODEL, u=u, v=v, source=JOINTLY)

    @property
    def dominant(self) -> Int:
        """Index into `terms` of the term with the largest radial error, shape (P,)."""
        return np.argmax([t.radial for t in self.terms], axis=0)

    @property
    def share(self) -> Float:
        """Fraction of the positions at which each term is the largest, shape (number of terms,)."""
        dominant = self.dominant
        return np.bincount(dominant, minlength=len(self.terms)) / dominant.size

    @property
    def chips(self) -> tuple[ErrorBudget, ...]:
        """Budget of each chip, in the order of `domain.chips`."""
        return tuple(
            replace(
                self,
                domain=self.domain.on(chip),
                terms=tuple(t.on(chip, rows) for t in self.terms),
                total=self.total.on(chip, rows),
                products=tuple(t.on(chip, rows) for t in self.products),
            )
            for chip, rows in self.domain.by_chip()
        )

    @property
    def axes(self) -> tuple[Float, Float]:
        """Columns x (nx,) and rows y (ny,) of the grid of one chip, in FITS 1-based pixels."""
        if self.domain.grid is None:
            return self.x, self.y[:1]
        [number] = self.domain.chips
        place = place_of(self.domain.model, epoch=self.epoch, chip=number)
        return grid_pixels(place.chip.size, self.domain.grid)

    def on_grid(self, values: NDArray[Any]) -> NDArray[Any]:
        """Map (ny, nx) of values (P,) of a budget over the grid of one chip; NaN elsewhere."""
        x, y = self.axes
        gridded = np.full((y.size, x.size), np.nan)
        gridded[np.searchsorted(y, self.y), np.searchsorted(x, self.x)] = values
        return gridded

    def rows(self) -> list[BudgetEntry]:
        """The budget as a list of rows: each term, each product, and the total last.

        The uncertainty of the total follows from those of its terms and is unknown if a term was
        stated without one. A budget without diagnostics has no rows of measured errors except those
        of the parameters: structure and differences between exposures are missing; see `notes`.

        Returns
        -------
        list of BudgetEntry
            Dictionaries of name, kind, u, v, radial (rms over the positions), radial_error
            (uncertainty of radial; None if unknown), source.
        """
        rows: list[BudgetEntry] = []
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
            with_error = [(radial, error) for radial, error in parts if error is not None]
            spread = sum((radial * error) ** 2 for radial, error in with_error) ** 0.5
            # a term of size zero needs no uncertainty
            complete = len(with_error) == sum(
                radial > 0 or error is not None for radial, error in parts
            )
            total["radial_error"] = spread / total["radial"] if complete else None
        return rows

    def rows_by_chip(self) -> list[ChipBudgetEntry]:
        """Result of `rows`, followed by the rows of each chip; chip is 'all' or the chip number."""
        alone = zip(self.domain.chips, self.chips, strict=True)
        parts = [("all", self.rows()), *((str(chip), b.rows()) for chip, b in alone)]
        return [{"chip": chip, **row} for chip, rows in parts for row in rows]


def _relative_error(row: BudgetEntry) -> float:
    """Relative error of the radial size of a row; NaN if it is unknown."""
    if row["radial_error"] is None or not row["radial"] > 0:
        return float("nan")
    return row["radial_error"] / row["radial"]


def budget_of(errors: DrawnErrors, domain: EvaluationDomain) -> ErrorBudget:
    """Error budget of positions, or of their differences from the first one.

    Terms are independent of each other, so their squares add up to the total. Rows of one term may
    be correlated; the total includes their joint error.

    Raises InputError if the epoch is missing, or the domain has a magnitude but no errors by
    magnitude are known.
    """
    monte_carlo = (2.0 * errors.n_effective) ** -0.5
    fields = errors.at(domain)
    terms: list[tuple[bool, BudgetTerm]] = []
    products = []
    for term_errors in fields:
        for row, part, square in term_errors.by_row():
            relative_errors = {c: part.relative_error(c, monte_carlo) for c in domain.chips}
            u, v = np.sqrt(square).T
            first = relative_errors[domain.chips[0]]
            term = BudgetTerm(
                row.name, row.kind, u, v, row.source, first, relative_errors, part.of_parameters
            )
            if row.kind == PRODUCT:
                products.append(term)
            else:
                terms.append((not part.of_parameters, term))
    u, v = np.sqrt(sum(term_errors.total() for term_errors in fields)).T
    return ErrorBudget(
        domain,
        errors.unit,
        # errors of parameters come first, even if their term has other rows
        tuple(t for _, t in sorted(terms, key=lambda pair: pair[0])),
        BudgetTerm(TOTAL, TOTAL, u, v, TOGETHER),
        errors.n_draws,
        tuple(products),
    )


def place_budget(
    errors: DrawnErrors,
    x: ArrayLike,
    y: ArrayLike,
    *,
    chip: int,
    epoch: float | None = None,
    magnitude: float | None = None,
    relative: bool = False,
) -> ErrorBudget:
    """Error budget of given positions, or of their differences from the first one.

    `x`, `y`: FITS 1-based pixels, shape (N,); at least two for relative errors. `chip`: chip
    number. `epoch`: decimal years; required if the model depends on time. `magnitude`: magnitude
    of the stars, for which the error of their centroids is included. `relative`: True for errors of
    the differences from the first position in the same image; errors common to all positions cancel
    and independent errors count twice. Raises InputError if the chip is unknown, a position is off
    the chip, the epoch is missing, a magnitude is given but no errors by magnitude are known, or a
    relative error of a single position is requested.
    """
    return budget_of(
        errors,
        EvaluationDomain.at_pixels(
            errors.solution.model, chip, x, y, epoch=epoch, magnitude=magnitude, relative=relative
        ),
    )


def with_product(total: float, product: float) -> float:
    """Rms of an error with zero mean and rms `total`, plus a constant displacement `product`.

    A constant is independent of any error, so the squares add up exactly.
    """
    return float(np.hypot(total, product))
