"""Fitted polynomial and look-up tables of one filter, and the errors of corrected pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.infer.nodes.mixture import ResidualMixture
from bayesdist.infer.nodes.pixels import corrected_matches, on_the_chips
from bayesdist.infer.nodes.posterior import TablePosterior
from bayesdist.infer.solution.linear import LinearFit
from bayesdist.model.lookup import LookupTable, corrected
from bayesdist.utils.arrays import Float

BLOCK = 1024  # positions processed at a time, with dense rows over all nodes


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
