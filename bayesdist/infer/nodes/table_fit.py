"""Fitted tables of a calibration: corrected pixels, positions, and their errors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.infer.nodes.alternation import Alternated, Round, on_the_chips
from bayesdist.infer.nodes.pixels import pixel_jacobian
from bayesdist.infer.nodes.posterior import TablePosterior
from bayesdist.model.lookup import LookupTable, corrected

__all__ = ["TableFit", "held_sigma"]

Float = NDArray[np.float64]

BLOCK = 1024  # positions whose derivatives are in memory at once


@dataclass(frozen=True, eq=False)
class TableFit:
    """Polynomials and look-up tables of all filters.

    Parameters
    ----------
    base : str
        Filter that the detector's tables come from.  They contain the base filter's own pattern:
        one filter alone cannot separate it from the detector's.
    parts : dict of str to Alternated
        By filter, the base filter first.  The tables of the base filter are the detector's, unless
        these were given.
    held : tuple of LookupTable
        Detector's tables that were given; the base filter then has tables of its own.
    """

    base: str
    parts: dict[str, Alternated]
    held: tuple[LookupTable, ...] = ()

    @property
    def tables(self) -> tuple[LookupTable, ...]:
        """All tables, the detector's first."""
        return (*self.held, *(table for part in self.parts.values() for table in part.tables))

    @property
    def progress(self) -> tuple[Round, ...]:
        """Rounds of all filters."""
        return tuple(one for part in self.parts.values() for one in part.progress)

    @property
    def converged(self) -> bool:
        """True if all tables converged."""
        return all(part.converged for part in self.parts.values())

    def part(self, filter: str | None = None) -> Alternated:
        """Polynomial and tables of a filter (the base filter by default).

        Raises
        ------
        InputError
            For a filter that was not fitted.
        """
        name = self.base if filter is None else filter
        if name not in self.parts:
            raise InputError(
                f"there are no tables for filter {name!r}",
                do=f"known filters are {', '.join(map(repr, self.parts))}",
            )
        return self.parts[name]

    def corrected(self, matches: Matches) -> Matches:
        """Matches at the pixels that the tables have corrected.

        Parameters
        ----------
        matches : Matches
            At raw pixels.

        Returns
        -------
        Matches
            The few that are moved off their chip are left out, and counted in `rejected`.
        """
        names = np.asarray(matches.filter_names)[matches.filter]
        x, y = corrected(self.tables, matches.x, matches.y, chip=matches.chip_number, filter=names)
        return on_the_chips(matches.with_columns(x=x, y=y), self.part().fit.model)

    def predict(
        self,
        x: ArrayLike,
        y: ArrayLike,
        *,
        chip: int,
        filter: str | None = None,
        epoch: ArrayLike | None = None,
        exposure: ArrayLike | None = None,
    ) -> Float:
        """Positions (u, v) of raw pixels: tables, then polynomial.

        Parameters
        ----------
        x, y : array_like, shape (N,)
            FITS 1-based pixels.
        chip : int
        filter : str, optional
            The base filter by default.
        epoch, exposure : array_like, optional
            As in `DistortionModel.predict`.

        Returns
        -------
        ndarray, shape (N, 2)
        """
        part = self.part(filter)
        px, py = self._pixels(x, y, chip, part)
        return part.fit.model.predict(
            part.fit.mean, px, py, epoch=epoch, exposure=exposure, chip=chip
        )

    def position_sigma(
        self,
        x: ArrayLike,
        y: ArrayLike,
        *,
        chip: int,
        filter: str | None = None,
        epoch: ArrayLike | None = None,
        exposure: ArrayLike | None = None,
    ) -> Float:
        """Standard error of a position: polynomial with all its terms, and tables.

        Parameters
        ----------
        x, y, chip, filter, epoch, exposure
            As in `predict`.

        Returns
        -------
        ndarray, shape (N, 2)
            In the unit of u, v.

        Raises
        ------
        InputError
            For binned tables, whose nodes have no covariance.

        Notes
        -----
        The formal covariance of the fit is that of the polynomial for fixed tables.  The tables
        contribute the part of their errors that is left after the polynomial has followed them, so
        that the sum is the variance of the joint solution.  The error of the detector's table
        counts in another filter only as far as that filter's own table does not absorb it.
        """
        part, model = self.part(filter), self.part(filter).fit.model
        x, y = np.broadcast_arrays(np.atleast_1d(np.asarray(x, float)), np.asarray(y, float))
        out = self.table_sigma(x, y, chip=chip, filter=filter, epoch=epoch, exposure=exposure) ** 2
        for rows, of in _blocks(len(x), chip, epoch, exposure):
            px, py = self._pixels(x[rows], y[rows], chip, part)
            D = model.jacobian(part.fit.mean, px, py, **of)
            out[rows] += np.einsum("nap,pq,naq->na", D, part.fit.cov, D, optimize=True)
        return np.sqrt(out)

    def table_sigma(
        self,
        x: ArrayLike,
        y: ArrayLike,
        *,
        chip: int,
        filter: str | None = None,
        epoch: ArrayLike | None = None,
        exposure: ArrayLike | None = None,
    ) -> Float:
        """Standard error of a position by those of the tables alone.

        Parameters
        ----------
        x, y, chip, filter, epoch, exposure
            As in `predict`.

        Returns
        -------
        ndarray, shape (N, 2)
            In the unit of u, v: the part left after the polynomial has followed the tables.  It
            is not assumed to follow held tables (`held_sigma`).

        Raises
        ------
        InputError
            For binned tables, whose nodes have no covariance.
        """
        part = self.part(filter)
        if not part.posteriors:
            raise InputError(
                "binned tables know no covariance of their nodes", do="choose method 'field'"
            )
        x, y = np.broadcast_arrays(np.atleast_1d(np.asarray(x, float)), np.asarray(y, float))
        out = np.empty((len(x), 2))
        for rows, of in _blocks(len(x), chip, epoch, exposure):
            px, py = self._pixels(x[rows], y[rows], chip, part)
            J = pixel_jacobian(part.fit.model, part.fit.mean, px, py, **of)
            table = self._table_variance(x[rows], y[rows], chip, part)
            out[rows] = np.sqrt(np.einsum("nab,nb->na", J**2, table))
        return out

    def _pixels(
        self, x: ArrayLike, y: ArrayLike, chip: int, part: Alternated
    ) -> tuple[Float, Float]:
        # tables of no filter are the detector's
        return corrected(self.tables, x, y, chip=chip, filter=part.filter)

    def _table_variance(self, x: Float, y: Float, chip: int, part: Alternated) -> Float:
        """Variance (N, 2) of the tables' shift where the polynomial follows, square pixels."""
        own = _of_chip(part, chip)
        if not part.filter:
            return own.position_sigma(x, y, refitted=True) ** 2
        if self.held:
            px, py = corrected(self.held, x, y, chip=chip)
            own_variance = own.position_sigma(px, py, refitted=True) ** 2
            return own_variance + held_sigma(self.held, x, y, chip=chip) ** 2
        detector = _of_chip(self.parts[self.base], chip)
        px, py = corrected([detector.table], x, y, chip=chip)
        out = np.empty((len(x), 2))
        for a in (0, 1):
            axis = own.axes[a]
            rows = own.rows(px, py, a, refitted=True)
            # the filter's polynomial and its table both follow an error of the detector's table
            left = rows - axis.gain(rows)
            out[:, a] = ((rows @ axis.root) ** 2).sum(axis=1)
            out[:, a] += ((left @ detector.axes[a].root) ** 2).sum(axis=1)
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


def _blocks(
    n: int, chip: int, epoch: ArrayLike | None, exposure: ArrayLike | None
) -> Iterator[tuple[slice, dict[str, Any]]]:
    """Chunks of n positions, with the arguments of `DistortionModel.predict` for each."""
    dates = None if epoch is None else np.broadcast_to(np.asarray(epoch, float), (n,))
    frames = None if exposure is None else np.broadcast_to(np.asarray(exposure), (n,))
    for start in range(0, n, BLOCK):
        rows = slice(start, start + BLOCK)
        yield (
            rows,
            {
                "epoch": None if dates is None else dates[rows],
                "exposure": None if frames is None else frames[rows],
                "chip": chip,
            },
        )


def _of_chip(part: Alternated, chip: int) -> TablePosterior:
    for posterior in part.posteriors:
        if posterior.table.chip == chip:
            return posterior
    raise InputError(
        f"there is no table for chip {chip}",
        do=f"there are those for {', '.join(str(t.chip) for t in part.tables)}",
    )
