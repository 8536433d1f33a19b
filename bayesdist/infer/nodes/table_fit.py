"""Polynomial and look-up tables of one filter: corrected pixels, and their errors."""

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

BLOCK = 1024  # positions whose rows over all nodes are in memory at once


@dataclass(frozen=True)
class Iteration:
    """Statistics of one iteration."""

    number: int  # from 1
    moved: float  # largest change of a node, pixels
    # rms residual of an axis before the new tables, stars weighted by their probability of being
    # true matches, pixels
    rms: float
    false_fraction: float  # of the matches


def shifts_of(table: LookupTable | TablePosterior) -> LookupTable:
    """The table, of a posterior its means without their errors."""
    return table.means if isinstance(table, TablePosterior) else table


@dataclass(frozen=True, eq=False)
class TableFit:
    """Polynomial and look-up tables of the matches of one filter.

    Parameters
    ----------
    filter : str
        Filter of the fitted tables.  '' for the detector's: these contain the own pattern of the
        filter that they come from, which one filter alone cannot separate from the detector's.
    solution : LinearFit
        The polynomial, fitted last, with these tables fixed.
    beneath : tuple of LookupTable or TablePosterior
        The detector's tables that were given.
    fitted : tuple of LookupTable or TablePosterior
        One for each chip; binned ones have no posterior.
    mixture : ResidualMixture
        Memberships of the matches, in their order.
    progress : tuple of Iteration
    converged : bool
        True if the tables moved less than the tolerance in the last iteration.
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
        """All tables, the detector's first."""
        every = (*self.beneath, *self.fitted)
        return tuple(one.table if isinstance(one, TablePosterior) else one for one in every)

    @property
    def posteriors(self) -> tuple[TablePosterior, ...]:
        """Posteriors of the fitted tables; empty for binned ones."""
        return tuple(one for one in self.fitted if isinstance(one, TablePosterior))

    def corrected(self, matches: Matches) -> Matches:
        """Matches of the filter at the pixels that the tables have corrected.

        Parameters
        ----------
        matches : Matches
            At raw pixels.

        Returns
        -------
        Matches
            The few that are moved off their chip are left out, and counted in `rejected`.
        """
        tables = [shifts_of(one) for one in (*self.beneath, *self.fitted)]
        return on_the_chips(corrected_matches(tables, matches), self.solution.model)

    def shift_variance(self, x: ArrayLike, y: ArrayLike, *, chip: int) -> Float:
        """Variance of the tables' shift, less what the polynomial follows.

        The formal covariance of the fit is that of the polynomial for fixed tables; with this
        variance, projected by the slopes of the polynomial, it adds up to that of the joint
        solution.  The error of the detector's table counts in another filter only as far as that
        filter's own table does not absorb it; the polynomial is not assumed to follow plain tables
        beneath (`held_sigma`).

        Parameters
        ----------
        x, y : array_like, shape (N,)
            FITS 1-based raw pixels.
        chip : int

        Returns
        -------
        ndarray, shape (N, 2)
            Square pixels.

        Raises
        ------
        InputError
            For binned tables, whose nodes have no covariance.
        """
        x, y = np.broadcast_arrays(np.atleast_1d(np.asarray(x, float)), np.asarray(y, float))
        own = self._posterior(chip)
        blocks = [slice(start, start + BLOCK) for start in range(0, len(x), BLOCK)]
        return np.concatenate([self._variance(own, x[rows], y[rows], chip) for rows in blocks])

    def _posterior(self, chip: int) -> TablePosterior:
        """Posterior of the fitted table of a chip."""
        if not self.posteriors:
            raise InputError(
                "binned tables know no covariance of their nodes", do="choose method 'field'"
            )
        for posterior in self.posteriors:
            if posterior.grid.chip.number == chip:
                return posterior
        raise InputError(
            f"there is no table for chip {chip}",
            do=f"there are those for {', '.join(str(p.grid.chip.number) for p in self.posteriors)}",
        )

    def _variance(self, own: TablePosterior, x: Float, y: Float, chip: int) -> Float:
        """Variance (N, 2) of the tables' shift where the polynomial follows, square pixels."""
        lower = next((one for one in self.beneath if shifts_of(one).chip == chip), None)
        if lower is None:
            return own.position_sigma(x, y, refitted=True) ** 2
        px, py = corrected([shifts_of(lower)], x, y, chip=chip)
        if not isinstance(lower, TablePosterior):
            own_variance = own.position_sigma(px, py, refitted=True) ** 2
            return own_variance + held_sigma([lower], x, y, chip=chip) ** 2
        out = np.empty((len(x), 2))
        for a, axis in enumerate(own.axes):
            rows = own.rows(px, py, a, refitted=True)
            # the filter's polynomial and its table both follow an error of the detector's table
            left = rows - axis.gain(rows)
            out[:, a] = ((rows @ axis.root) ** 2).sum(axis=1)
            out[:, a] += ((left @ lower.axes[a].root) ** 2).sum(axis=1)
        return out


def held_sigma(tables: Sequence[LookupTable], x: ArrayLike, y: ArrayLike, *, chip: int) -> Float:
    """Standard error (N, 2), pixels, of the shift by held tables, from the errors of their nodes.

    Zero where the chip has no table, or the table no errors.  With the nodes' covariance unknown
    this is its upper bound: the errors of neighbouring nodes are taken as fully correlated.
    """
    x, y = np.broadcast_arrays(np.atleast_1d(np.asarray(x, float)), np.asarray(y, float))
    for table in tables:
        if table.chip == chip and table.sigma is not None:
            return LookupTable(chip, table.sigma, "", table.first, table.step).evaluate(x, y)
    return np.zeros((len(x), 2))
