"""A series in units of its spread, the state of its chains, and its normal equations."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from bayesdist.infer.kernel import gaussians
from bayesdist.infer.series.breaks import Likelihood
from bayesdist.infer.series.design import Design
from bayesdist.infer.series.series import Series
from bayesdist.utils.arrays import Bool, Float, Int

WIDE = 100.0  # prior standard deviation of the trend's parameters
CANDIDATES_AT_ONCE = 8
MIN_EIGENVALUE = 1e-10  # of a formal covariance, as a fraction of the largest, that is inverted


@dataclass(frozen=True, eq=False)
class Problem:
    """A series in units of its spread, with its trend and noise model."""

    series: Series
    design: Design
    y: Float  # (k, E)
    formal: Float  # formal covariance (k, k, E)
    root: Float  # a square root of it (k, k, E)
    sigma: Float | None = None  # intrinsic covariance (k, k) where it is known
    outliers: bool = True  # True if exposures may lie off the trend

    @classmethod
    def of(
        cls, series: Series, design: Design, scatter: Float | None = None, *, outliers: bool = True
    ) -> Problem:
        """Problem in units of the spread; `scatter` (k, k) is a known intrinsic covariance."""
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
        """Inverse (k, k, E) of the formal covariance; None where some exposure's is singular."""
        formal = np.moveaxis(self.formal, -1, 0)
        values = np.linalg.eigvalsh(formal)
        if not (values[:, 0] > MIN_EIGENVALUE * values[:, -1]).all():
            return None
        return np.ascontiguousarray(np.moveaxis(np.linalg.inv(formal), 0, -1))

    def residual(self, b: Float, columns: Float) -> Float:
        """Values less the trend (C, k, E) of parameters (C, k, p) and columns (C or 1, E, p)."""
        return self.y - b @ np.swapaxes(columns, -1, -2)

    def columns(self, breaks: Float) -> Float:
        """Columns (C or 1, E, p) of the trend at the exposures, for breaks (..., B)."""
        if not self.design.trend.find:
            return self._given_columns
        return self.design.matrix(self.series.epoch, self.series.group_code, breaks)

    @cached_property
    def _given_columns(self) -> Float:
        """Columns (1, E, p) of a trend whose breaks are given."""
        return self.design.matrix(self.series.epoch, self.series.group_code)


@dataclass(frozen=True, eq=False)
class State:
    """State of C chains."""

    b: Float  # (C, k, p)
    sigma: Float  # (C, k, k)
    off: Bool  # outliers (C, E)
    probability: Float  # of an outlier (C, E), given everything else
    fraction: Float  # (C,)
    kappa2: Float  # (C,)
    breaks: Float  # (C, B) those to be found
    drift: Float  # amplitude (C, k) of the random part

    def take(self, chains: Int) -> State:
        """State of some of the chains, possibly several times."""
        return State(**{one.name: getattr(self, one.name)[chains] for one in fields(self)})


def normal_equations(precision: Float, y: Float, columns: Float) -> tuple[Float, Float]:
    """Normal matrices (..., k p, k p) and right-hand sides (..., k p).

    `precision` (C, k, k, E) is the inverse covariance of each exposure, `y` (k, E), `columns` (C or
    1, E, p) or (C, M, E, p).
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
    problem: Problem, precision: Float, columns: Float, drift: Float
) -> tuple[Float, Float]:
    """Precision (C, k p, k p) of the parameters b given everything else, and that times their mean.

    `precision` (C, k, k, E) is the inverse covariance of each exposure, `columns` (C or 1, E, p),
    `drift` (C, k).
    """
    matrix, right = normal_equations(precision, problem.y, columns)
    design = problem.design
    prior = np.full((*drift.shape, design.n_columns), WIDE**-2)
    prior[..., design.n_fixed :] = drift[..., None] ** -2
    flat = prior.reshape(len(drift), -1)
    return matrix + flat[:, :, None] * np.eye(flat.shape[1]), right


def break_likelihood(problem: Problem, precision: Float) -> Likelihood:
    """Function of dates (C, M, B): log likelihood (C, M) with b integrated out."""

    def some(breaks: Float) -> Float:
        columns = problem.columns(breaks)
        matrix, right = normal_equations(precision, problem.y, columns)
        matrix = matrix + WIDE**-2 * np.eye(matrix.shape[-1])
        flat = right.reshape(-1, right.shape[-1])
        square = matrix.reshape(len(flat), *matrix.shape[-2:])
        return gaussians(square, flat, np.zeros_like(flat))[1].reshape(right.shape[:-1])

    def of(breaks: Float) -> Float:
        # a few candidates at a time: all their columns would not fit into the cache, or into memory
        places = range(0, breaks.shape[1], CANDIDATES_AT_ONCE)
        return np.concatenate([some(breaks[:, i : i + CANDIDATES_AT_ONCE]) for i in places], axis=1)

    return of
