"""The error budget: what the error of each position is made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from html import escape
from typing import TYPE_CHECKING, Any

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
    """One contribution to the position error."""

    name: str
    # 'random', 'systematic' (as the parts of the model, which all stars share), 'local' (shared by
    # the stars at one position), or 'product' (of a file, known, and in no total)
    kind: str
    # (P,), standard deviations, in the unit of the budget; of products the displacements' sizes
    u: Float
    v: Float  # (P,)
    source: str  # begins with 'measured in this run', 'given by the user' or 'published'
    # how well the standard deviations are known themselves, relative to their size: of draws the
    # Monte-Carlo error.  None where it is not known
    relative_error: float | None = None
    # the same by chip number, where that differs; `relative_error` is that of the first chip
    by_chip: Mapping[int, float | None] = field(default_factory=dict)
    of_parameters: bool = False  # True for errors of the model's parameters, which are correlated

    @property
    def radial(self) -> Float:
        """hypot(u, v), (P,)."""
        return np.hypot(self.u, self.v)

    def on(self, chip: int, rows: slice) -> BudgetTerm:
        """Budget on one chip, whose positions are some of the rows."""
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
        Errors of parameters first, then local ones, and the user's.
    total : BudgetTerm
        All terms together.  Rows of one term are correlated, so this may be smaller than any of
        them.
    n_draws : int
        Draws behind the model's parts: their relative error is about 1 / sqrt(2 n_draws).
    products : tuple of BudgetTerm
        What files differ by from the solution: in no total.
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
        """Words on the positions and the epoch."""
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
        """Texts of a table: its head, and one row for each term."""
        units = [f"{name} [{self.unit}]" for name in ("u", "v", "radial")]
        out = [("term", *units, "relative uncertainty", "kind", "source")]
        for row in self.rows():
            sizes = [f"{row[name]:.3g}" for name in ("u", "v", "radial")]
            relative = _relative_error(row)
            known = f"{100 * relative:.1f} %" if np.isfinite(relative) else "unknown"
            out.append((row["name"], *sizes, known, row["kind"], row["source"]))
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
        """FITS 1-based columns (P,)."""
        return self.domain.x[self._compared]

    @property
    def y(self) -> Float:
        """FITS 1-based rows (P,)."""
        return self.domain.y[self._compared]

    @property
    def _compared(self) -> slice:
        """Rows of the positions, without the one that the others are compared with."""
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
    def model(self) -> BudgetTerm | None:
        """Errors of the model's parameters jointly; None if fewer than two terms are of them.

        The parts are correlated: this is what they leave of the total, beside independent terms,
        and may be smaller than any of them.
        """
        parts = [t for t in self.terms if t.of_parameters]
        if len(parts) < 2:
            return None
        others = [t for t in self.terms if not t.of_parameters]
        u, v = (
            np.sqrt(
                np.maximum(
                    getattr(self.total, axis) ** 2 - sum(getattr(t, axis) ** 2 for t in others), 0.0
                )
            )
            for axis in "uv"
        )
        return replace(parts[0], name=MODEL, u=u, v=v, source=JOINTLY)

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
                total=self.total.on(chip, rows),
                products=tuple(t.on(chip, rows) for t in self.products),
            )
            for chip, rows in self.domain.by_chip()
        )

    @property
    def axes(self) -> tuple[Float, Float]:
        """Columns (nx,) and rows (ny,) of the grid, of a budget over the grid of one chip."""
        if self.domain.grid is None:
            return self.x, self.y[:1]
        [number] = self.domain.chips
        place = place_of(self.domain.model, epoch=self.epoch, chip=number)
        return grid_pixels(place.chip.size, self.domain.grid)

    def on_grid(self, values: NDArray[Any]) -> NDArray[Any]:
        """Values (N,) of a budget over the grid of one chip as a map (ny, nx), NaN off it."""
        x, y = self.axes
        found = np.full((y.size, x.size), np.nan)
        found[np.searchsorted(y, self.y), np.searchsorted(x, self.x)] = values
        return found

    def rows(self) -> list[dict[str, Any]]:
        """The budget as a table: one row for each term and each product, the total last.

        The total is known as well as its terms are: not where one of them was given without an
        error.  A budget made without diagnostics has no rows of measured errors beyond those of the
        parameters: structure, differences between exposures; see `notes`.

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


def _relative_error(row: Mapping[str, Any]) -> float:
    """Relative error of the radial size of a row; nan if it is not known."""
    if row["radial_error"] is None or not row["radial"] > 0:
        return float("nan")
    return float(row["radial_error"] / row["radial"])


def budget_of(errors: DrawnErrors, domain: EvaluationDomain) -> ErrorBudget:
    """The error budget of positions, or of their differences to the first one.

    Terms are independent of each other, so that their squares add up to the total; rows of one term
    may be correlated, and the term counts as they do together.

    InputError for a missing epoch, and a magnitude where no errors by magnitude are known.
    """
    monte_carlo = (2.0 * errors.n_effective) ** -0.5
    fields = errors.at(domain)
    terms: list[tuple[bool, BudgetTerm]] = []
    products = []
    for one in fields:
        for row, part, square in one.by_row():
            known = {c: part.relative_error(c, monte_carlo) for c in domain.chips}
            u, v = np.sqrt(square).T
            first = known[domain.chips[0]]
            found = BudgetTerm(
                row.name, row.kind, u, v, row.source, first, known, part.of_parameters
            )
            if row.kind == PRODUCT:
                products.append(found)
            else:
                terms.append((not part.of_parameters, found))
    u, v = np.sqrt(sum(one.total() for one in fields)).T
    return ErrorBudget(
        domain,
        errors.unit,
        # errors of parameters come first, whatever else their term holds
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
    """The error budget of some positions, or of their differences to the first one.

    `x`, `y`: (N,), FITS 1-based pixels; two or more for relative errors. `chip`: chip number.
    `epoch`: decimal years; needed by a model with time dependence. `magnitude`: of the stars: their
    centroids' errors are a term then. `relative`: errors of the differences to the first position,
    in one image: what all positions share drops out, and what is independent counts twice.
    InputError for an unknown chip, a position off the chip, a missing epoch, a magnitude where no
    errors by magnitude are known, and relative errors of one position.
    """
    return budget_of(
        errors,
        EvaluationDomain.at_pixels(
            errors.solution.model, chip, x, y, epoch=epoch, magnitude=magnitude, relative=relative
        ),
    )


def with_product(total: float, product: float) -> float:
    """Root mean square of an error of mean zero together with a displacement that never changes.

    A constant is independent of every error: the squares add up exactly.
    """
    return float(np.hypot(total, product))
