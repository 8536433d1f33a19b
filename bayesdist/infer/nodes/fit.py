"""Alternating fit of a polynomial and look-up tables until both converge.

Each iteration corrects the pixels by the previous tables, fits the polynomial, and makes new tables
from the residuals with the shifts of the previous tables added back.  Nothing is smoothed twice,
and the iterations converge to the joint solution of polynomial and tables.

The detector's tables are made from the filter with the smallest irregularities and are then fixed.
Every other filter gets a polynomial and a table of the remaining residuals (Kozhurina-Platais et
al. 2015, section 4.3).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.nodes.field import binned_table, field_table
from bayesdist.infer.nodes.grid import STEP
from bayesdist.infer.nodes.posterior import SMOOTHNESS, TablePosterior
from bayesdist.infer.nodes.residuals import (
    ResidualMixture,
    corrected_matches,
    fit_mixture,
    on_the_chips,
    pixel_shifts,
)
from bayesdist.infer.solution.linear import LinearFit, fit_linear
from bayesdist.model import DistortionModel
from bayesdist.model.lookup import LookupTable, corrected
from bayesdist.utils.arrays import Bool, Float

LIKELY = 0.5  # stars with a smaller probability of being true matches are left out
# how the hyperparameters are searched in the first iterations (see `field_table`); then they are
# fixed
SEARCHES = ("tiles", "chip")

BLOCK = 1024  # positions processed at a time, with dense rows over all nodes


# all large matrices are factored in here; see the comment at `field_table`
@one_thread
def fit_with_tables(
    matches: Matches,
    model: DistortionModel,
    *,
    filter: str = "",
    beneath: Sequence[LookupTable | TablePosterior] = (),
    method: str = "field",
    max_iterations: int = 8,
    tolerance: float = 2e-4,
    step: tuple[float, float] = STEP,
    smoothness: Sequence[float] = SMOOTHNESS,
    start: TableFit | None = None,
    report: Callable[[Iteration], None] | None = None,
) -> TableFit:
    """Fit the polynomial and the look-up tables of one filter, alternating until both converge.

    Parameters
    ----------
    matches : Matches
        Stars of one filter at raw pixel coordinates, with errors.
    model : DistortionModel
        Model of the polynomials. Exposures without matches are dropped.
    filter : str
        Filter of the new tables; '' for the detector's tables.
    beneath : sequence of LookupTable or TablePosterior
        Tables of the detector, if known. They are applied first and kept fixed. The error of a
        `TablePosterior` is propagated except for the part that the new tables absorb; for a
        `LookupTable` an upper bound of its error is used.
    method : str
        'field' for a Gaussian random field, which provides the covariance of its nodes; 'binned'
        for smoothed means in bins as in Kozhurina-Platais et al. (2015). Both are made orthogonal
        to the polynomial.
    max_iterations : int
        Maximum number of iterations.
    tolerance : float
        The iterations end when no node changes by more than this, in pixels.
    step : tuple of float
        Distance of the nodes along x and y, in pixels.
    smoothness : sequence of float
        Values of the Matern smoothness to try, for 'field'.
    start : TableFit, optional
        Earlier fit of the same matches, possibly with other errors, to continue. The
        hyperparameters are fixed from the third iteration on, counting those of `start`.
    report : callable, optional
        Called with the `Iteration` after each iteration.

    Returns
    -------
    TableFit

    Raises
    ------
    InputError
        If `method` is unknown, `max_iterations` or `tolerance` is not positive, the matches are
        of several filters or lack the exposure that defines the gauge, `beneath` contains a table
        of a filter, or `start` has other chips or another method.
    DegenerateError
        If the matches do not determine the model.

    Notes
    -----
    Make the detector's tables from one filter, then those of each other filter on top of them::

        base = fit_with_tables(matches.select(matches.filter == 0), model)
        other = matches.select(matches.filter == 1)
        fit_with_tables(other, model, filter="F814W", beneath=base.fitted)
    """
    _check(matches, beneath, method, max_iterations, tolerance)
    matches, model = _with_own_exposures(matches, model)
    chips = [c for k, c in enumerate(matches.chip_numbers) if (matches.chip == k).any()]
    numbers = matches.chip_number
    lower = corrected_matches([shifts_of(lower_table) for lower_table in beneath], matches)
    x, y = lower.x, lower.y
    progress: list[Iteration] = []
    fitted: dict[int, LookupTable | TablePosterior] = {}
    own_shift = np.zeros((len(x), 2))
    if start is not None:
        _check_start(start, chips, method)
        progress += start.progress
        fitted |= zip(chips, start.fitted, strict=True)
        for c, table in fitted.items():
            rows = numbers == c
            own_shift[rows] = shifts_of(table).evaluate(x[rows], y[rows])
    searched = dict(fitted)  # tables from the last search, with the hyperparameters to keep

    def solved(moved: Matches, mixture: ResidualMixture, pixel: float) -> LinearFit:
        """Fit the polynomial with the tables fixed; `pixel` is the pixel size in u, v."""
        jitter = np.full(len(x), mixture.jitter)
        for chip, table in fitted.items():
            if isinstance(table, TablePosterior):
                jitter[numbers == chip] = table.jitter
        moved = _with_memberships(moved, mixture, jitter * pixel)
        return fit_linear(on_the_chips(moved, model), model)

    def new_table(
        chip: int, rows: Bool, shift: Float, variance: Float, search: str
    ) -> LookupTable | TablePosterior:
        chip_model = model.chips[model.chip_code(chip)]
        if method == "binned":
            return binned_table(
                x[rows],
                y[rows],
                shift[rows],
                chip=chip_model,
                order=model.order,
                filter=filter,
                step=step,
            )
        earlier = searched.get(chip)
        return field_table(
            x[rows],
            y[rows],
            shift[rows],
            variance[rows],
            chip=chip_model,
            order=model.order,
            weight=weight[rows],
            filter=filter,
            step=step,
            smoothness=smoothness,
            earlier=earlier if isinstance(earlier, TablePosterior) else None,
            search=search,
        )

    def corrected_by_all() -> Matches:
        return matches.with_columns(x=x + own_shift[:, 0], y=y + own_shift[:, 1])

    moved = corrected_by_all()
    solution = fit_linear(on_the_chips(moved, model), model)
    for number in range(len(progress) + 1, len(progress) + 1 + max_iterations):
        search = SEARCHES[number - 1] if number <= len(SEARCHES) else "none"
        pixel = model.pixel_size(solution.mean)
        shifts = pixel_shifts(solution, moved)
        mixture = fit_mixture(shifts.shift, shifts.variance)
        weight = np.where(mixture.probability >= LIKELY, mixture.probability, 0.0)
        rms = float(np.sqrt((weight[:, None] * shifts.shift**2).sum() / (2 * weight.sum())))
        total = shifts.shift + own_shift
        change = 0.0
        for c in chips:
            rows = numbers == c
            before = shifts_of(fitted[c]).values if c in fitted else 0.0
            fitted[c] = new_table(c, rows, total, shifts.variance, search)
            new = shifts_of(fitted[c])
            change = max(change, float(np.abs(new.values - before).max()))
            if search != "none":
                searched[c] = fitted[c]
            own_shift[rows] = new.evaluate(x[rows], y[rows])
        progress.append(
            Iteration(number=number, moved=change, rms=rms, false_fraction=mixture.fraction)
        )
        if report is not None:
            report(progress[-1])
        moved = corrected_by_all()
        solution = solved(moved, mixture, pixel)
        if progress[-1].moved < tolerance:
            break
    return TableFit(
        filter=filter,
        solution=solution,
        beneath=tuple(beneath),
        fitted=tuple(fitted[c] for c in chips),
        mixture=mixture,
        progress=tuple(progress),
        converged=progress[-1].moved < tolerance,
    )


def _check(
    matches: Matches,
    beneath: Sequence[LookupTable | TablePosterior],
    method: str,
    max_iterations: int,
    tolerance: float,
) -> None:
    """Raise InputError if arguments of `fit_with_tables` are invalid."""
    if method not in ("field", "binned"):
        raise InputError(f"there is no method {method!r} for tables", do="choose field or binned")
    if max_iterations < 1 or not tolerance > 0:
        raise InputError(
            f"{max_iterations} iterations to a tolerance of {tolerance} pixels",
            do="give one iteration or more and a positive tolerance",
        )
    for table in map(shifts_of, beneath):
        if table.filter:
            raise InputError(
                f"the look-up table {table.label} is not a table of the detector",
                where="beneath",
                do="give tables without a filter",
            )
    present = [matches.filter_names[k] for k in np.unique(matches.filter)]
    if len(present) > 1:
        raise InputError(
            f"the matches are of filters {', '.join(map(repr, present))}",
            do="give those of one filter: matches.select(matches.filter == k)",
        )


def _check_start(start: TableFit, chips: Sequence[int], method: str) -> None:
    """Raise InputError if the start has tables of other chips or was made by another method."""
    chip_numbers = [shifts_of(table).chip for table in start.fitted]
    fields = all(isinstance(table, TablePosterior) for table in start.fitted)
    if chip_numbers != list(chips) or fields != (method == "field"):
        raise InputError(
            f"the start has tables of chips {chip_numbers}, {'fields' if fields else 'bins'}",
            where="start",
            do=f"give a fit of chips {list(chips)} by the method {method!r}",
        )


def _with_own_exposures(
    matches: Matches, model: DistortionModel
) -> tuple[Matches, DistortionModel]:
    """Matches and model without the exposures that have no stars."""
    names = matches.exposures
    if model.n_frame and model.gauge != "first" and names[0] != model.exposures[0]:
        raise InputError(
            f"no match is of exposure {model.exposures[0]!r}, which holds the gauge",
            do="give the filter a separate model",
        )
    return matches.with_exposure_names(names), replace(model, exposures=names)


def _with_memberships(matches: Matches, mixture: ResidualMixture, jitter: Float) -> Matches:
    """Select the likely true matches and adapt their errors.

    Errors include the jitter.  The variance of a star with probability p of being a true match is
    divided by p, as in the fit of the tables.
    """
    sigma_u, sigma_v = matches.column("sigma_u"), matches.column("sigma_v")
    likely = mixture.probability >= LIKELY
    p = np.maximum(mixture.probability, LIKELY)
    if matches.rho_uv is not None:
        covariances = matches.covariances() + jitter[:, None, None] ** 2 * np.eye(2)
        wide = matches.with_covariances(covariances / p[:, None, None])
        return wide.select(likely, reason="false match")
    wide = matches.with_errors(
        (
            np.sqrt((sigma_u**2 + jitter**2) / p),
            np.sqrt((sigma_v**2 + jitter**2) / p),
        )
    )
    return wide.select(likely, reason="false match")


# -- fitted polynomial and look-up tables of one filter, and the errors of corrected pixels --------


@dataclass(frozen=True)
class Iteration:
    """Statistics of one iteration of `fit_with_tables`.

    Parameters
    ----------
    number : int
        Number of the iteration, starting from 1.
    moved : float
        Largest change of a node in pixels.
    rms : float
        Rms residual per axis in pixels, before the new tables were made. Stars are weighted by
        their probability of being true matches.
    false_fraction : float
        Fraction of false matches.
    """

    number: int
    moved: float
    rms: float
    false_fraction: float


def shifts_of(table: LookupTable | TablePosterior) -> LookupTable:
    """Look-up table, or the means of a table posterior, without errors."""
    return table.means if isinstance(table, TablePosterior) else table


@dataclass(frozen=True, eq=False)
class TableFit:
    """Polynomial and look-up tables of the matches of one filter.

    Parameters
    ----------
    filter : str
        Filter of the fitted tables; '' for the detector's tables. The latter include the pattern
        of the filter from which they were made, since a single filter cannot separate the two.
    solution : LinearFit
        The polynomial, fitted last with the tables fixed.
    beneath : tuple of LookupTable or TablePosterior
        Tables of the detector that were given and kept fixed.
    fitted : tuple of LookupTable or TablePosterior
        Fitted tables, one per chip; `LookupTable` for the method 'binned'.
    mixture : ResidualMixture
        Outlier mixture, with membership probabilities in the order of the matches.
    progress : tuple of Iteration
        Statistics of all iterations.
    converged : bool
        True if no node changed by more than the tolerance in the last iteration.
    """

    filter: str
    solution: LinearFit
    beneath: tuple[LookupTable | TablePosterior, ...]
    fitted: tuple[LookupTable | TablePosterior, ...]
    mixture: ResidualMixture
    progress: tuple[Iteration, ...]
    converged: bool

    @property
    def tables(self) -> tuple[LookupTable, ...]:
        """All tables, starting with those of the detector."""
        tables = (*self.beneath, *self.fitted)
        return tuple(
            table.table if isinstance(table, TablePosterior) else table for table in tables
        )

    @property
    def posteriors(self) -> tuple[TablePosterior, ...]:
        """Posteriors of the fitted tables; empty for binned tables."""
        return tuple(table for table in self.fitted if isinstance(table, TablePosterior))

    def corrected(self, matches: Matches) -> Matches:
        """Apply all tables to the pixel coordinates of matches of this filter.

        Parameters
        ----------
        matches : Matches
            Stars at raw pixel coordinates.

        Returns
        -------
        Matches
            Stars at corrected pixel coordinates. The few that are moved off their chip are left
            out and counted in `rejected`.
        """
        tables = [shifts_of(table) for table in (*self.beneath, *self.fitted)]
        return on_the_chips(corrected_matches(tables, matches), self.solution.model)

    def shift_variance(self, x: ArrayLike, y: ArrayLike, *, chip: int) -> Float:
        """Variance of the shift by the tables, after refitting the polynomial.

        The formal covariance of `solution` is that of the polynomial for fixed tables.  Adding this
        variance, projected with the Jacobian of the polynomial, gives the variance of the joint
        solution.  The error of the detector's table counts only as far as the filter's table does
        not absorb it.  If the detector's table is a `LookupTable`, neither table nor polynomial
        is assumed to absorb its error, for which `held_sigma` gives an upper bound.

        Parameters
        ----------
        x, y : array_like, shape (N,)
            Raw pixel coordinates (FITS convention, 1-based).
        chip : int
            Chip number.

        Returns
        -------
        ndarray, shape (N, 2)
            Variances along x and y in square pixels.

        Raises
        ------
        InputError
            If the tables are binned, so that the covariance of the nodes is unknown, or if the
            chip has no table.
        """
        x, y = np.broadcast_arrays(np.atleast_1d(np.asarray(x, float)), np.asarray(y, float))
        posterior = self._posterior(chip)
        blocks = [slice(start, start + BLOCK) for start in range(0, len(x), BLOCK)]
        return np.concatenate(
            [self._variance(posterior, x[rows], y[rows], chip) for rows in blocks]
        )

    def _posterior(self, chip: int) -> TablePosterior:
        """Posterior of the fitted table of a chip."""
        if not self.posteriors:
            raise InputError(
                "the covariance of the nodes of binned tables is unknown",
                do="choose method 'field'",
            )
        for posterior in self.posteriors:
            if posterior.grid.chip.number == chip:
                return posterior
        raise InputError(
            f"there is no table for chip {chip}",
            do=f"choose among {', '.join(str(p.grid.chip.number) for p in self.posteriors)}",
        )

    def _variance(self, own: TablePosterior, x: Float, y: Float, chip: int) -> Float:
        """`shift_variance` (N, 2) from the posterior `own` of the chip's fitted table."""
        lower = next((table for table in self.beneath if shifts_of(table).chip == chip), None)
        if lower is None:
            return own.position_sigma(x, y, refitted=True) ** 2
        px, py = corrected([shifts_of(lower)], x, y, chip=chip)
        if not isinstance(lower, TablePosterior):
            own_variance = own.position_sigma(px, py, refitted=True) ** 2
            return own_variance + held_sigma([lower], x, y, chip=chip) ** 2
        out = np.empty((len(x), 2))
        for a, axis in enumerate(own.axes):
            rows = own.rows(px, py, a, refitted=True)
            # the filter's polynomial and table both absorb errors of the detector's table
            remainder = rows - axis.gain(rows)
            out[:, a] = ((rows @ axis.root) ** 2).sum(axis=1)
            out[:, a] += ((remainder @ lower.axes[a].root) ** 2).sum(axis=1)
        return out


def held_sigma(tables: Sequence[LookupTable], x: ArrayLike, y: ArrayLike, *, chip: int) -> Float:
    """Upper bound on the standard error of the shift by fixed tables, from their node errors.

    Since the covariance of the nodes is unknown, errors of neighbouring nodes are assumed to be
    fully correlated.

    Parameters
    ----------
    tables : sequence of LookupTable
    x, y : array_like, shape (N,)
        Raw pixel coordinates.
    chip : int
        Chip number.

    Returns
    -------
    ndarray, shape (N, 2)
        Standard errors along x and y in pixels; zero if the chip has no table or the table has no
        errors.
    """
    x, y = np.broadcast_arrays(np.atleast_1d(np.asarray(x, float)), np.asarray(y, float))
    for table in tables:
        if table.chip == chip and table.sigma is not None:
            return LookupTable(chip, table.sigma, "", table.first, table.step).evaluate(x, y)
    return np.zeros((len(x), 2))
