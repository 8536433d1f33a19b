"""Solutions: a distortion model with its parameters, their covariance, and draws."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from bayesdist.errors import InputError
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Bool, Float, Int
from bayesdist.utils.quantities import Random, generator_of

if TYPE_CHECKING:  # not imported at run time, so that inspecting a file stays fast
    from bayesdist.data.matches import Matches
    from bayesdist.infer.convergence import Convergence
    from bayesdist.infer.stars.likelihood import Likelihood, OutlierMixture


def root_of_diagonal(cov: Float) -> Float:
    """Standard deviations (D,) from a covariance; variances that rounding made negative give 0."""
    return np.sqrt(np.maximum(np.diag(cov), 0.0))


class Solution(ABC):
    """Base class of fits and posteriors, and of solutions derived from them.

    A subclass must define `model`, `mean`, `cov` and `draws`.

    Attributes
    ----------
    model : DistortionModel
    mean : ndarray, shape (D,)
        Best-fitting or mean parameters, in the order of `model.names`.
    cov : ndarray, shape (D, D)
        Covariance of the parameters.
    convergence : Convergence or None
        Convergence diagnostics of the sampler; None for a solution that was not sampled.
    mixture : OutlierMixture or None
        Model of the false matches; None if they were not modelled.
    tangent_point : tuple of float or None
        RA and Dec in degrees of (u, v) = (0, 0) if u, v are on a tangent plane with u increasing
        to the east and v to the north; otherwise None.
    """

    if TYPE_CHECKING:  # read-only: dataclass fields in some subclasses, properties in others

        @property
        def model(self) -> DistortionModel: ...

        @property
        def mean(self) -> Float: ...

        @property
        def cov(self) -> Float: ...

        @property
        def convergence(self) -> Convergence | None: ...

        @property
        def mixture(self) -> OutlierMixture | None: ...

        @property
        def tangent_point(self) -> tuple[float, float] | None: ...

    else:
        convergence = mixture = tangent_point = None

    @abstractmethod
    def draws(self, n: int, rng: Random) -> Float:
        """Random draws of the parameters.

        Parameters
        ----------
        n : int
            Number of draws.
        rng : int or numpy.random.Generator
            Seed or random generator.

        Returns
        -------
        ndarray, shape (n, D)
        """

    def drawn_rows(self, n: int, rng: Random) -> tuple[Float, Int]:
        """Parameter vectors (m, D), and indices (n,) of the rows that `draws` returns."""
        return np.asarray(self.draws(n, rng), float), np.arange(n)

    @property
    def sigma(self) -> Float:
        """Standard deviation of each parameter, shape (D,)."""
        return root_of_diagonal(np.asarray(self.cov))

    @property
    def unit(self) -> str:
        """Unit of u and v."""
        return self.model.unit

    @property
    def kind(self) -> str:
        """'posterior' if the solution was sampled, otherwise 'least squares'."""
        return "least squares" if self.convergence is None else "posterior"

    @property
    def likelihood(self) -> Likelihood | None:
        """Likelihood of a star's residual at the mean; None if the solution has none."""
        return None

    def uses(self, matches: Matches) -> Bool:
        """Boolean mask (N,) that is False for stars that the fit rejects; all True by default."""
        return np.ones(len(matches), bool)

    def mapped(self, matrix: Float) -> Solution:
        """Solution with the deviations from the mean multiplied by a matrix (D, D)."""
        mean = np.asarray(self.mean, float)
        return self.transformed(self.model, lambda theta: mean + (theta - mean) @ matrix.T, matrix)

    def transformed(
        self, model: DistortionModel, transform: Callable[[Float], Float], jacobian: Float
    ) -> TransformedSolution:
        """Transform the parameters to those of another model.

        Parameters
        ----------
        model : DistortionModel
            Model of the result, with D' parameters.
        transform : callable
            Function that maps parameters (..., D) of this solution to (..., D') of the result.
        jacobian : ndarray, shape (D', n)
            Derivatives of `transform`, at the mean, with respect to the first n parameters. The
            other parameters must have no effect.

        Returns
        -------
        TransformedSolution
        """
        n = jacobian.shape[1]
        cov = jacobian @ np.asarray(self.cov, float)[:n, :n] @ jacobian.T
        mean = transform(np.asarray(self.mean, float))
        return TransformedSolution(model, mean, (cov + cov.T) / 2, self, transform)


def likelihood_of(solution: Solution) -> Likelihood:
    """Likelihood of a fit or a posterior; raises InputError for a transformed solution."""
    likelihood = solution.likelihood
    if likelihood is None:
        raise InputError(
            f"a {type(solution).__name__} has no likelihood",
            where="solution",
            do="give the fit or the posterior itself, and transform the result",
        )
    return likelihood


@dataclass(frozen=True)
class ReferenceGauge:
    """Rotation and shift that transform a solution to the reference gauge of one chip.

        (u', v') = R(rotation) ((u, v) - shift)

    Parameters
    ----------
    chip : int
        Number of the reference chip.
    epoch : float or None
        Date (decimal years) at which the gauge holds; None if the polynomials do not depend on
        time.
    rotation : float
        Angle in radians, from u towards v.
    shift : tuple of float
        Shift in u and v, in their unit.
    sigma_rotation : float
        Standard error of the rotation in radians.
    sigma_shift : tuple of float
        Standard errors of the shift.
    """

    chip: int
    epoch: float | None
    rotation: float
    shift: tuple[float, float]
    sigma_rotation: float
    sigma_shift: tuple[float, float]


@dataclass(frozen=True, eq=False)
class GaussianSolution(Solution):
    """Solution that consists only of a mean and a covariance of its parameters."""

    model: DistortionModel
    mean: Float
    cov: Float

    def draws(self, n: int, rng: Random) -> Float:
        """Random parameter vectors (n, D) from the normal distribution."""
        generator = generator_of(rng)
        return generator.multivariate_normal(self.mean, self.cov, size=n, method="eigh")


class DerivedSolution(Solution):
    """Base class of solutions derived from another solution; they report its diagnostics."""

    source: Solution

    @property
    def convergence(self) -> Convergence | None:
        """Convergence of the source; None if the source was not sampled."""
        return self.source.convergence


@dataclass(frozen=True, eq=False)
class TransformedSolution(DerivedSolution):
    """Solution of one model whose parameters are computed from those of another solution.

    Parameters
    ----------
    model : DistortionModel
    mean : ndarray, shape (D,)
        Transformed mean of the source.
    cov : ndarray, shape (D, D)
        Covariance, propagated from the source.
    source : Solution
    transform : callable
        Function that maps parameters (..., D') of the source to parameters (..., D) of `model`.
    """

    model: DistortionModel
    mean: Float
    cov: Float
    source: Solution
    transform: Callable[[Float], Float]

    def draws(self, n: int, rng: Random) -> Float:
        """Draws of the source, transformed; see `Solution.draws`."""
        return self.transform(np.asarray(self.source.draws(n, rng), float))


@dataclass(frozen=True, eq=False)
class ParameterMap:
    """Linear map of the first n of the parameters (..., D) by a matrix (m, n); can be pickled."""

    matrix: Float

    def __call__(self, theta: Float) -> Float:
        return theta[..., : self.matrix.shape[1]] @ self.matrix.T


@dataclass(frozen=True, eq=False)
class GaugedSolution(TransformedSolution):
    """Solution that was rotated and shifted to the reference gauge."""

    gauge: ReferenceGauge  # rotation and shift that were applied
