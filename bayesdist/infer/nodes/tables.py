"""Detector and filter tables of a whole calibration, and the error of the position with them.

ACS ISR 2015-06, section 4.3: the detector's table comes from a base filter whose own irregularities
are the smallest, and is then held; each other filter has its own polynomial, and a table of what
the two leave.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesdist.data.matches import MatchTable
from bayesdist.errors import InputError
from bayesdist.infer.linear import fit_linear
from bayesdist.infer.nodes.alternation import (
    Alternated,
    Fit,
    Round,
    alternate,
    on_the_chips,
    with_columns,
)
from bayesdist.infer.nodes.filters import matches_of_filter
from bayesdist.infer.nodes.grid import STEP
from bayesdist.infer.nodes.matern import SMOOTHNESS
from bayesdist.infer.nodes.pixels import pixel_jacobian
from bayesdist.infer.nodes.posterior import TablePosterior
from bayesdist.model import DistortionModel
from bayesdist.model.lookup import LookupTable, corrected

__all__ = ["TableFit", "fit_with_tables"]

Float = NDArray[np.float64]

BLOCK = 1024  # positions whose derivatives are held at once


@dataclass(frozen=True, eq=False)
class TableFit:
    """Polynomials and look-up tables of all filters.

    Parameters
    ----------
    base : str
        Filter that the detector's tables come from.  What is the base filter's own is in them: one
        filter alone cannot tell it from the detector's.
    parts : dict of str to Alternated
        By filter, the base filter first.  The tables of the base filter are the detector's.
    """

    base: str
    parts: dict[str, Alternated]

    @property
    def tables(self) -> tuple[LookupTable, ...]:
        """All tables, the detector's first."""
        return tuple(table for part in self.parts.values() for table in part.tables)

    @property
    def progress(self) -> tuple[Round, ...]:
        """All rounds."""
        return tuple(one for part in self.parts.values() for one in part.progress)

    @property
    def converged(self) -> bool:
        """Whether all tables stand still."""
        return all(part.converged for part in self.parts.values())

    def part(self, filter: str | None = None) -> Alternated:
        """What belongs to a filter (the base filter by default).

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

    def corrected(self, matches: MatchTable) -> MatchTable:
        """Matches at the pixels that the tables have corrected.

        Parameters
        ----------
        matches : MatchTable
            At raw pixels.

        Returns
        -------
        MatchTable
            The few that are moved off their chip are left out, and counted in `rejected`.
        """
        numbers = np.asarray(matches.chip_numbers)[matches.chip]
        names = np.asarray(matches.filter_names)[matches.filter]
        x, y = corrected(self.tables, matches.x, matches.y, chip=numbers, filter=names)
        return on_the_chips(with_columns(matches, x=x, y=y), self.part().fit.model)

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
        The formal covariance of the fit is that of the polynomial with the tables held.  The part
        of the tables is what their errors leave after the polynomial has followed them, so that
        the sum is the variance of the joint solution.  The error of the detector's table counts in
        another filter only as far as that filter's own table does not take it up.
        """
        part = self.part(filter)
        if not part.posteriors:
            raise InputError(
                "binned tables know no covariance of their nodes", do="choose method 'field'"
            )
        raw_x, raw_y = np.broadcast_arrays(
            np.atleast_1d(np.asarray(x, float)), np.asarray(y, float)
        )
        n = len(raw_x)
        dates = None if epoch is None else np.broadcast_to(np.asarray(epoch, float), (n,))
        frames = None if exposure is None else np.broadcast_to(np.asarray(exposure), (n,))
        out = np.empty((n, 2))
        for start in range(0, n, BLOCK):
            rows = slice(start, start + BLOCK)
            of = {
                "epoch": None if dates is None else dates[rows],
                "exposure": None if frames is None else frames[rows],
                "chip": chip,
            }
            px, py = self._pixels(raw_x[rows], raw_y[rows], chip, part)
            model, theta = part.fit.model, part.fit.mean
            D = model.jacobian(theta, px, py, **of)
            formal = np.einsum("nap,pq,naq->na", D, part.fit.cov, D, optimize=True)
            J = pixel_jacobian(model, theta, px, py, **of)
            table = self._table_variance(raw_x[rows], raw_y[rows], chip, part)
            out[rows] = np.sqrt(formal + np.einsum("nab,nb->na", J**2, table))
        return out

    def _pixels(
        self, x: ArrayLike, y: ArrayLike, chip: int, part: Alternated
    ) -> tuple[Float, Float]:
        # the base filter's tables are the detector's
        return corrected(self.tables, x, y, chip=chip, filter=part.filter)

    def _table_variance(self, x: Float, y: Float, chip: int, part: Alternated) -> Float:
        """Variance (N, 2) of the tables' shift where the polynomial follows, square pixels."""
        own = _of_chip(part, chip)
        if part is self.parts[self.base]:
            return own.position_sigma(x, y, refitted=True) ** 2
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


def fit_with_tables(
    matches: MatchTable,
    model: DistortionModel | Mapping[str, DistortionModel],
    *,
    base: str | None = None,
    filters: Sequence[str] | None = None,
    method: str = "field",
    rounds: int = 8,
    tolerance: float = 2e-4,
    step: tuple[float, float] = STEP,
    smoothness: Sequence[float] = SMOOTHNESS,
    fit: Fit = fit_linear,
    report: Callable[[Round], None] | None = None,
) -> TableFit:
    """Fit polynomials and look-up tables in turn: the detector's, then each filter's.

    Parameters
    ----------
    matches : MatchTable
        At raw pixels, with errors, of one filter or several.
    model : DistortionModel or dict of str to DistortionModel
        One for all filters, or one for each by name.  A model for all is cut to the exposures of
        each filter.
    base : str, optional
        Filter of the detector's tables; by default the one with the most matches.
    filters : sequence of str, optional
        Other filters that get a polynomial and tables of their own; all by default.
    method : str
        'field': a Gaussian random field, with the covariance of its nodes; 'binned': clipped means
        in bins, smoothed, as ACS ISR 2015-06.  Either is made orthogonal to the polynomial.
    rounds : int
        At most, for each filter.
    tolerance : float
        Change of every node, pixels, below which the rounds end.
    step : tuple of float
        Pixels between nodes.
    smoothness : sequence of float
        Matern smoothness to choose from, for 'field'.
    fit : callable
        Takes matches and a model, returns a solution with `model`, `mean` and `cov`.
    report : callable, optional
        Called with each round.

    Returns
    -------
    TableFit
        `converged` says whether the tables stand still.

    Raises
    ------
    InputError
        For an unknown filter or method, or a gauge that needs an exposure that a filter lacks.
    DegenerateError
        When the matches of a filter do not determine its model.
    """
    present = [name for k, name in enumerate(matches.filter_names) if (matches.filter == k).any()]
    if base is None:
        counts = np.bincount(matches.filter, minlength=len(matches.filter_names))
        base = matches.filter_names[int(np.argmax(counts))]
    others = [f for f in present if f != base] if filters is None else list(filters)
    for name in (base, *others):
        if name not in present:
            raise InputError(
                f"there are no matches in filter {name!r}",
                do=f"the matches are in {', '.join(map(repr, present))}",
            )
    parts: dict[str, Alternated] = {}
    detector: tuple[LookupTable, ...] = ()
    for name in (base, *[f for f in others if f != base]):
        some, own_model = matches_of_filter(matches, model, name)
        parts[name] = alternate(
            some,
            own_model,
            beneath=detector,
            filter="" if name == base else name,
            method=method,
            rounds=rounds,
            tolerance=tolerance,
            step=step,
            smoothness=smoothness,
            fit=fit,
            report=report,
        )
        if name == base:
            detector = parts[name].tables
    return TableFit(base, parts)


def _of_chip(part: Alternated, chip: int) -> TablePosterior:
    for posterior in part.posteriors:
        if posterior.table.chip == chip:
            return posterior
    raise InputError(
        f"there is no table for chip {chip}",
        do=f"there are those for {', '.join(str(t.chip) for t in part.tables)}",
    )
