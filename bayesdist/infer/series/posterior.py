"""Posterior of a series: draws of trend and scatter, predictions, and changes at breaks."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.errors import InputError
from bayesdist.infer.convergence import Convergence
from bayesdist.infer.equations.scaled import chi_square
from bayesdist.infer.series.chains import Draws, Engine
from bayesdist.infer.series.design import Design
from bayesdist.infer.series.problem import State
from bayesdist.infer.series.series import Series
from bayesdist.infer.series.trend import TrendModel
from bayesdist.utils.arrays import Float


@dataclass(frozen=True, eq=False)
class Change:
    """Change of k coefficients, with its covariance.

    Parameters
    ----------
    value : ndarray, shape (k,)
        Change of each coefficient.
    cov : ndarray, shape (k, k)
        Covariance of the changes.
    """

    value: Float
    cov: Float

    @classmethod
    def of(cls, draws: Float) -> Change:
        """Compute mean and covariance from draws.

        Parameters
        ----------
        draws : ndarray, shape (n, k)
            Draws of the change.

        Returns
        -------
        Change
        """
        return cls(draws.mean(axis=0), np.atleast_2d(np.cov(draws, rowvar=False)))

    @property
    def sigma(self) -> Float:
        """Standard deviation (k,) of each change."""
        return np.sqrt(np.diag(self.cov))

    @property
    def significance(self) -> Float:
        """Change divided by its error (k,); 0 if the trend does not allow a change."""
        return np.divide(
            self.value, self.sigma, out=np.zeros_like(self.value), where=self.sigma > 0
        )

    @property
    def p_value(self) -> float:
        """Probability of a larger chi-square if there is no change.

        It assumes a Gaussian posterior.  With few exposures, the posterior has heavier tails, and
        this value is too small.
        """
        return chi_square(self.value, self.cov).p_value


@dataclass(frozen=True, eq=False)
class Prediction:
    """Predicted coefficients at M epochs.

    Parameters
    ----------
    epoch : ndarray, shape (M,)
        Decimal years.
    mean : ndarray, shape (M, k)
        Posterior mean of the trend.
    cov : ndarray, shape (M, k, k)
        Covariance of the trend.
    cov_new : ndarray, shape (M, k, k)
        Covariance of the coefficients of a new exposure that is not an outlier and has no formal
        errors: that of the trend plus the intrinsic covariance.
    """

    epoch: Float
    mean: Float
    cov: Float
    cov_new: Float

    @property
    def sigma(self) -> Float:
        """Standard deviation (M, k) of the trend."""
        return np.sqrt(np.diagonal(self.cov, axis1=1, axis2=2))

    @property
    def sigma_new(self) -> Float:
        """Standard deviation (M, k) of a new exposure without formal errors."""
        return np.sqrt(np.diagonal(self.cov_new, axis1=1, axis2=2))


@dataclass(frozen=True, eq=False)
class SeriesPosterior:
    """Posterior of a trend and of the scatter of the exposures about it.

    Parameters
    ----------
    series : Series
    trend : TrendModel
    design : Design
        Design matrix of the trend.
    raw : Draws
        Draws in units of the spread of the series.
    convergence : Convergence
    engine : Engine
        Sampler, to continue the chains.
    last : State
        Last state of the chains.
    """

    series: Series
    trend: TrendModel
    design: Design
    raw: Draws
    convergence: Convergence
    engine: Engine
    last: State

    @property
    def _parameters(self) -> Float:
        """Draws (n, k, p) of the parameters of the columns."""
        return self.raw.b.reshape(-1, *self.raw.b.shape[2:])

    @cached_property
    def _lines(self) -> tuple[Float, Float]:
        level, slope = self.design.lines(self._parameters, self._breaks)
        unit = self.series.spread
        return self.series.centre + level * unit, slope * unit

    @cached_property
    def _breaks(self) -> Float:
        """Draws (n, B) of the break dates; a single row if they are given."""
        if not self.trend.find:
            return self.design.given_breaks()
        return self.raw.breaks.reshape(self.raw.fraction.size, self.trend.find)

    @property
    def reference(self) -> Float:
        """Reference date (S,) of each segment in decimal years."""
        return self.design.reference

    @property
    def alpha(self) -> Float:
        """Draws (n, S, k) of the coefficients at the reference dates, for the first group."""
        return self._lines[0]

    @property
    def beta(self) -> Float:
        """Draws (n, S, k) of the slopes per year; zero if the trend has no slopes."""
        return self._lines[1]

    @cached_property
    def scatter(self) -> Float:
        """Draws (n, k, k) of the intrinsic covariance."""
        unit = self.series.spread
        k = len(unit)
        return self.raw.sigma.reshape(-1, k, k) * (unit[:, None] * unit)

    @property
    def scatter_sigma(self) -> Float:
        """Draws (n, k) of the intrinsic standard deviations."""
        return np.sqrt(np.diagonal(self.scatter, axis1=1, axis2=2))

    @property
    def breaks(self) -> Float:
        """Draws (n, B) of the dates of unknown breaks, in decimal years."""
        return self.raw.breaks.reshape(-1, self.trend.find)

    @property
    def outlier_probability(self) -> Float:
        """Posterior outlier probability (E,) of each exposure."""
        return self.raw.outlier_probability

    @cached_property
    def group_offset(self) -> Float:
        """Draws (n, G - 1, k) of the offsets of the other groups from the first group."""
        return self._group_columns(self.trend.n_columns) * self.series.spread

    @cached_property
    def group_slope(self) -> Float:
        """Draws (n, G - 1, k) of the slopes of the other groups minus that of the first, per year.

        Raises
        ------
        InputError
            If the groups have common slopes.
        """
        if self.trend.groups != "slopes":
            raise InputError(
                "the groups have common slopes",
                where=self.series.source,
                do="fit a trend with groups='slopes'",
            )
        first = self.trend.n_columns + self.design.n_groups - 1
        return self._group_columns(first) * self.series.spread / self.design.years

    def _group_columns(self, first: int) -> Float:
        columns = slice(first, first + self.design.n_groups - 1)
        return np.swapaxes(self._parameters[..., columns], 1, 2)

    def change(self, number: int = 0) -> tuple[Change, Change]:
        """Changes of the coefficients and of their slopes at a break.

        Parameters
        ----------
        number : int
            Number of the break, starting from 0.

        Returns
        -------
        level, slope : Change
            Values after the break minus those before it, at the date of the break. If the trend
            does not allow the slopes to change, their change is zero with zero error.

        Raises
        ------
        InputError
            If the trend has no such break.
        """
        if not 0 <= number < self.trend.n_breaks:
            raise InputError(
                f"there is no break {number + 1}", where=self.series.source, do="see trend.breaks"
            )
        date = self._breaks[:, number, None, None]
        at = self.alpha + self.beta * (date - self.reference[:, None])
        level = at[:, number + 1] - at[:, number]
        slope = self.beta[:, number + 1] - self.beta[:, number]
        return Change.of(level), Change.of(slope)

    # -- prediction -------------------------------------------------------------------------------

    def predict(self, epoch: ArrayLike, *, group: str | None = None) -> Prediction:
        """Predict the coefficients at epochs between the first and the last exposure.

        Parameters
        ----------
        epoch : array_like, shape (M,)
            Decimal years.
        group : str, optional
            Name of the group; by default that with most exposures.

        Returns
        -------
        Prediction

        Raises
        ------
        InputError
            If an epoch is outside the range of the exposures, or the group is unknown.
        """
        t = np.atleast_1d(np.asarray(epoch, float))
        trend = self._trend_draws(t, group)
        mean = trend.mean(axis=0)
        off = trend - mean
        cov = np.einsum("nmi,nmj->mij", off, off) / (len(off) - 1)
        return Prediction(t, mean, cov, cov + self.scatter.mean(axis=0))

    def _trend_draws(self, t: Float, group: str | None) -> Float:
        """Draws (n, M, k) of the trend at epochs t (M,)."""
        first, last = self.series.span
        outside = ~((t >= first) & (t <= last))
        if outside.any():
            raise InputError(
                f"epoch {t[int(np.argmax(outside))]:g} is outside the range of the exposures, "
                f"{first:.2f} to {last:.2f}",
                where=self.series.source,
                do="give another epoch",
            )
        names = self.series.group_names
        if group is not None and group not in names:
            raise InputError(
                f"there is no group {group!r}",
                where=self.series.source,
                do=f"choose among {', '.join(names)}" if names else "the series has no groups",
            )
        code = np.full(len(t), names.index(group) if group is not None else 0)
        columns = self.design.matrix(t, code, self._breaks)  # (n or 1, M, p)
        values = columns @ np.swapaxes(self._parameters, 1, 2)
        return self.series.centre + values * self.series.spread
