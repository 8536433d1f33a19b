"""Series in units of its spread, state of its Markov chains, and normal equations of its trend."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from bayesdist.kinds.campaign.series.series import Series
from bayesdist.kinds.campaign.series.trend import Design
from bayesdist.utils.arrays import Bool, Float, Int

WIDE = 100.0  # prior standard deviation of the trend's parameters, in units of the spread
MIN_EIGENVALUE = 1e-10  # smallest relative eigenvalue of a formal covariance to be inverted


@dataclass(frozen=True, eq=False)
class SeriesProblem:
    """Series in units of its spread, with its trend and noise model."""

    series: Series
    design: Design
    y: Float  # coefficients (k, E) minus their medians
    formal: Float  # formal covariances (k, k, E)
    root: Float  # matrix square roots (k, k, E) of the formal covariances
    sigma: Float | None = None  # intrinsic covariance (k, k), if it is known
    outliers: bool = True  # True if exposures may be outliers

    @classmethod
    def of(
        cls, series: Series, design: Design, scatter: Float | None = None, *, outliers: bool = True
    ) -> SeriesProblem:
        """Convert a series to units of its spread.

        `scatter` (k, k) is the intrinsic covariance, if it is known.  With `outliers`, exposures
        may be outliers.
        """
        unit = series.spread
        square = unit[:, None] * unit
        formal = series.cov / square
        values, vectors = np.linalg.eigh(formal)
        root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
        return cls(
            series=series,
            design=design,
            y=np.ascontiguousarray(((series.values - series.centre) / unit).T),
            formal=np.ascontiguousarray(np.moveaxis(formal, 0, -1)),
            root=np.ascontiguousarray(np.moveaxis(root, 0, -1)),
            sigma=None if scatter is None else np.asarray(scatter, float) / square,
            outliers=outliers,
        )

    @cached_property
    def inverse(self) -> Float | None:
        """Inverse (k, k, E) of the formal covariances; None if any of them is singular."""
        formal = np.moveaxis(self.formal, -1, 0)
        values = np.linalg.eigvalsh(formal)
        if not (values[:, 0] > MIN_EIGENVALUE * values[:, -1]).all():
            return None
        return np.ascontiguousarray(np.moveaxis(np.linalg.inv(formal), 0, -1))

    def residual(self, b: Float, columns: Float) -> Float:
        """Residuals (C, k, E) from the trend: parameters b (C, k, p), columns (C or 1, E, p)."""
        return self.y - b @ np.swapaxes(columns, -1, -2)

    def columns(self, breaks: Float) -> Float:
        """Design matrix (C or 1, E, p) of the trend at the exposures, for breaks (C, B)."""
        if not self.design.trend.find:
            return self._given_columns
        return self.design.matrix(self.series.epoch, self.series.group_code, breaks)

    @cached_property
    def _given_columns(self) -> Float:
        """Design matrix (1, E, p) for given breaks."""
        return self.design.matrix(self.series.epoch, self.series.group_code)


@dataclass(frozen=True, eq=False)
class State:
    """State of C chains, in units of the spread of the series."""

    b: Float  # parameters (C, k, p) of the columns of the trend
    sigma: Float  # intrinsic covariance (C, k, k)
    off: Bool  # mask (C, E) of outliers
    probability: Float  # outlier probability (C, E), conditional on the other quantities
    fraction: Float  # fraction of outliers (C,)
    kappa2: Float  # factor (C,) on the covariance of outliers
    breaks: Float  # dates of unknown breaks (C, B)
    drift: Float  # amplitude (C, k) of the random part of the trend

    def take(self, chains: Int) -> State:
        """State of selected chains, which may be repeated."""
        return State(**{item.name: getattr(self, item.name)[chains] for item in fields(self)})


def normal_equations(precision: Float, y: Float, columns: Float) -> tuple[Float, Float]:
    """Normal matrices (..., k p, k p) and right-hand sides (..., k p) of the trend's parameters.

    `precision` (C, k, k, E) is the inverse covariance of each exposure, `y` (k, E) are the data,
    and `columns` is the design matrix (C or 1, E, p) or (C, M, E, p).
    """
    k = len(y)
    *_, n, p = columns.shape
    pairs = (columns[..., :, None] * columns[..., None, :]).reshape(*columns.shape[:-1], p * p)
    flat = precision.reshape(len(precision), k * k, n)
    pull = (precision * y).sum(axis=2)
    if columns.ndim == 4:
        flat, pull = flat[:, None], pull[:, None]
    if columns.ndim == 3 and len(columns) == 1:  # one matrix product for all chains
        sums = (flat.reshape(-1, n) @ pairs[0]).reshape(-1, k, k, p, p)
        right = (pull.reshape(-1, n) @ columns[0]).reshape(-1, k * p)
    else:
        sums = flat @ pairs
        sums = sums.reshape(*sums.shape[:-2], k, k, p, p)
        right = pull @ columns
        right = right.reshape(*right.shape[:-2], k * p)
    matrix = np.swapaxes(sums, -3, -2)
    return matrix.reshape(*matrix.shape[:-4], k * p, k * p), right


def trend_equations(
    problem: SeriesProblem, precision: Float, columns: Float, drift: Float
) -> tuple[Float, Float]:
    """Conditional precision (C, k p, k p) of the parameters b, and precision times mean (C, k p).

    `precision` (C, k, k, E) is the inverse covariance of each exposure, `columns` (C or 1, E, p)
    the design matrix, and `drift` (C, k) the amplitude of the random part.
    """
    matrix, right = normal_equations(precision, problem.y, columns)
    design = problem.design
    prior = np.full((*drift.shape, design.n_columns), WIDE**-2)
    prior[..., design.n_fixed :] = drift[..., None] ** -2
    flat = prior.reshape(len(drift), -1)
    return matrix + flat[:, :, None] * np.eye(flat.shape[1]), right
