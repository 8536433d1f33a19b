"""A solution: a distortion model with values of its parameters, their covariance, and draws."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from bayesdist.errors import InputError
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Bool, Float, Int
from bayesdist.utils.quantities import Random

if TYPE_CHECKING:  # a file is inspected without what they import
    from bayesdist.data.matches import Matches
    from bayesdist.infer.convergence import Convergence
    from bayesdist.infer.stars.likelihood import Likelihood
    from bayesdist.infer.stars.mixture import OutlierMixture


def root_of_diagonal(cov: Float) -> Float:
    """Standard deviations (D,), 0 where rounding leaves a fixed parameter's variance negative."""
    return np.sqrt(np.maximum(np.diag(cov), 0.0))


class Solution(ABC):
    """A fit or a posterior of a distortion model, or one made from either.

    A subclass has at least the three attributes without a default, and `draws`.

    Attributes
    ----------
    model : DistortionModel
    mean : ndarray, shape (D,)
    cov : ndarray, shape (D, D)
    convergence : Convergence or None
        Of the sampler, where draws are those of a sampler.
    mixture : OutlierMixture or None
        Where false matches were modelled.
    tangent_point : tuple of float or None
        RA and Dec in degrees of (u, v) = (0, 0), if u increases to the east and v to the north.
    """

    if TYPE_CHECKING:  # read-only: fields of some subclasses, computed by others

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
        rng : int or numpy.random.Generator

        Returns
        -------
        ndarray, shape (n, D)
        """

    def drawn_rows(self, n: int, rng: Random) -> tuple[Float, Int]:
        """Parameter vectors (m, D), and the rows (n,) among them that `draws` gives."""
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
        """'posterior' for draws of a sampler, else 'least squares'."""
        return "least squares" if self.convergence is None else "posterior"

    @property
    def approximation(self) -> str:
        """Warning for every output that the draws are not exact; empty where they are."""
        return ""

    @property
    def likelihood(self) -> Likelihood | None:
        """Likelihood of a star by its position, at the mean; None for a transformed solution."""
        return None

    def uses(self, matches: Matches) -> Bool:
        """Boolean mask (N,) of a table's stars that were not left out; all by default."""
        return np.ones(len(matches), bool)

    def mapped(self, matrix: Float) -> Solution:
        """Solution whose deviations from the mean are mapped by a matrix (D, D)."""
        mean = np.asarray(self.mean, float)
        return self.transformed(self.model, lambda theta: mean + (theta - mean) @ matrix.T, matrix)

    def transformed(
        self, model: DistortionModel, transform: Callable[[Float], Float], jacobian: Float
    ) -> TransformedSolution:
        """Solution of another model, by a transformation of the parameters.

        Parameters
        ----------
        model : DistortionModel
        transform : callable
            From parameters (..., D) of this solution to (..., D') of the other.
        jacobian : ndarray, shape (D', n)
            Its derivatives at the mean by the first n parameters; the others have no effect.

        Returns
        -------
        TransformedSolution
        """
        n = jacobian.shape[1]
        cov = jacobian @ np.asarray(self.cov, float)[:n, :n] @ jacobian.T
        mean = transform(np.asarray(self.mean, float))
        return TransformedSolution(model, mean, (cov + cov.T) / 2, self, transform)


def likelihood_of(solution: Solution) -> Likelihood:
    """Likelihood of a fit or a posterior; InputError for a solution that was made from another."""
    likelihood = solution.likelihood
    if likelihood is None:
        raise InputError(
            f"a {type(solution).__name__} does not say how it was fitted",
            where="solution",
            do="give the fit or the posterior itself, and make views of the result",
        )
    return likelihood


@dataclass(frozen=True)
class ReferenceGauge:
    """Rotation and shift that bring one chip to the reference gauge.

        (u', v') = R(rotation) ((u, v) - shift)

    Parameters
    ----------
    chip : int
    epoch : float or None
        Where the polynomials depend on time: the date at which the gauge holds.
    rotation : float
        Radians, from u towards v.
    shift : tuple of float
        In the unit of u, v.
    sigma_rotation : float
    sigma_shift : tuple of float
        How well the data determine them.
    """

    chip: int
    epoch: float | None
    rotation: float
    shift: tuple[float, float]
    sigma_rotation: float
    sigma_shift: tuple[float, float]


class DerivedSolution(Solution):
    """Base of solutions made from another one, whose sampler diagnostics they report."""

    source: Solution

    @property
    def convergence(self) -> Convergence | None:
        """Convergence of the source."""
        return self.source.convergence

    @property
    def approximation(self) -> str:
        """Warning that the draws of the source are not exact."""
        return self.source.approximation


@dataclass(frozen=True, eq=False)
class TransformedSolution(DerivedSolution):
    """A solution transformed from another one.

    Parameters
    ----------
    model : DistortionModel
    mean : ndarray, shape (D,)
        The source's mean, transformed.
    cov : ndarray, shape (D, D)
    source : Solution
    transform : callable
        From parameters (..., D') of the source to (..., D).
    """

    model: DistortionModel
    mean: Float
    cov: Float
    source: Solution
    transform: Callable[[Float], Float]

    def draws(self, n: int, rng: Random) -> Float:
        """Parameter vectors, shape (n, D): draws of the source, each transformed."""
        return self.transform(np.asarray(self.source.draws(n, rng), float))


@dataclass(frozen=True, eq=False)
class LinearMap:
    """Linear map of parameters (..., n) by a matrix (m, n); it can be pickled."""

    matrix: Float

    def __call__(self, theta: Float) -> Float:
        return theta[..., : self.matrix.shape[1]] @ self.matrix.T


@dataclass(frozen=True, eq=False)
class GaugedSolution(TransformedSolution):
    """A solution rotated and shifted to the reference gauge."""

    gauge: ReferenceGauge  # rotation and shift that were applied
