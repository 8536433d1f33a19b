"""Gaussian priors on the parameters, independent or correlated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches

import numpy as np

from bayesdist.errors import InputError
from bayesdist.infer.equations.arrow import Arrow
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float


@dataclass(frozen=True, eq=False)
class JointPrior:
    """Correlated Gaussian prior on the first G entries of theta."""

    centre: Float  # mean (G,)
    precision: Float  # inverse covariance (G, G); may be singular (flat in some directions)
    rank: int  # rank of `precision`


@dataclass(frozen=True, eq=False)
class GaussianPriors:
    """Independent Gaussian priors on the parameters, and optionally a correlated prior.

    Parameters
    ----------
    centre : ndarray, shape (D,)
        Prior means, in the order of `model.names`.
    precision : ndarray, shape (D,)
        Inverse prior variances; 0 means a flat prior.
    joint : JointPrior, optional
        Correlated prior on the polynomials and their drift, in addition to the independent ones.
    """

    centre: Float
    precision: Float
    joint: JointPrior | None = None

    @classmethod
    def none(cls, model: DistortionModel) -> GaussianPriors:
        """Flat priors on all parameters of a model."""
        return cls(np.zeros(model.n_params), np.zeros(model.n_params))

    @classmethod
    def of(cls, model: DistortionModel, named: Mapping[str, tuple[float, float]]) -> GaussianPriors:
        """Independent priors on named parameters; flat on all others.

        Parameters
        ----------
        model : DistortionModel
        named : mapping of str to (float, float)
            Prior mean and standard deviation, in the parameter's unit, by parameter name.

        Returns
        -------
        GaussianPriors

        Raises
        ------
        InputError
            If a name is unknown, a mean is not finite, or a standard deviation is not positive.
        """
        centre, precision = np.zeros(model.n_params), np.zeros(model.n_params)
        for name, (mean, sigma) in named.items():
            if name not in model.names:
                near = get_close_matches(name, model.names, 1)
                raise InputError(
                    f"there is no parameter {name!r}",
                    where="prior",
                    do=f"did you mean {near[0]!r}" if near else "see coefficients.ecsv for names",
                )
            if not (np.isfinite(mean) and 0 < sigma < np.inf):
                raise InputError(
                    f"prior of {name} is {mean} +- {sigma}",
                    where="prior",
                    do="give a finite mean and a positive finite sigma",
                )
            k = model.names.index(name)
            centre[k], precision[k] = mean, sigma**-2
        return cls(centre, precision)

    @property
    def n_informative(self) -> int:
        """Number of directions in parameter space in which the prior is not flat."""
        joint = 0 if self.joint is None else self.joint.rank
        return int((self.precision > 0).sum()) + joint

    def pull(self, theta: Float) -> Float:
        """Gradient (D,) of the log prior at theta (D,)."""
        out = self.precision * (self.centre - theta)
        if self.joint is not None:
            G = len(self.joint.centre)
            out[:G] += self.joint.precision @ (self.joint.centre - theta[:G])
        return out

    def log_density(self, theta: Float) -> Float:
        """Log prior of parameter vectors (..., D), up to a constant."""
        out = -0.5 * ((theta - self.centre) ** 2 * self.precision).sum(axis=-1)
        if self.joint is not None:
            d = theta[..., : len(self.joint.centre)] - self.joint.centre
            out = out - 0.5 * np.einsum("...d,...d->...", d @ self.joint.precision, d)
        return np.asarray(out)

    def about(self, theta: Float) -> Prior:
        """Equivalent `Prior` on all parameters, expanded about theta (D,)."""
        return Prior(theta, self.information(len(self.precision)), self.pull(theta))

    def information(self, n: int) -> Float:
        """Prior precision (n, n) of the first n entries of theta."""
        out = np.diag(self.precision[:n])
        if self.joint is not None:
            G = len(self.joint.centre)
            out[:G, :G] += self.joint.precision[:n, :n]
        return out

    def matrix(self, model: DistortionModel, n_tail: int = 0) -> Arrow:
        """Prior precision as an arrow matrix with a zero edge.

        The border has `n_tail` additional rows of zeros, for hyperparameters.
        """
        n, q, g = len(model.local_blocks), model.n_frame, model.n_global
        local = self.precision[g:].reshape(n, q) if n else np.zeros((0, q))
        blocks = np.einsum("nq,qr->nqr", local, np.eye(q))
        border = np.zeros((g + n_tail, g + n_tail))
        border[:g, :g] = self.information(g)
        return Arrow(border, np.zeros((n, g + n_tail, q)), blocks, n_tail)


@dataclass(frozen=True, eq=False)
class Prior:
    """Correlated Gaussian prior on all parameters, expanded about a reference point.

    log p = -d^T P d / 2 + r^T d with d = theta - reference.

    Parameters
    ----------
    reference : ndarray, shape (D,)
        Parameters near the solution, to avoid rounding errors.
    precision : ndarray, shape (D, D)
        The matrix P.
    right : ndarray, shape (D,)
        The vector r, the gradient at `reference`.
    """

    reference: Float
    precision: Float
    right: Float

    @classmethod
    def none(cls, reference: Float) -> Prior:
        """Flat prior on the D parameters, expanded about `reference` (D,)."""
        D = len(reference)
        return cls(reference, np.zeros((D, D)), np.zeros(D))

    def __add__(self, other: Prior) -> Prior:
        """Product of two independent priors: the sum of their log densities."""
        shift = self.reference - other.reference
        return Prior(
            self.reference,
            self.precision + other.precision,
            self.right + other.right - other.precision @ shift,
        )

    def pull(self, theta: Float) -> Float:
        """Gradient (D,) of the log prior at theta (D,)."""
        return np.asarray(self.right - self.precision @ (theta - self.reference))

    def log_density(self, theta: Float) -> Float:
        """Log density of parameter vectors (..., D), up to a constant."""
        d = theta - self.reference
        return np.asarray(d @ self.right - 0.5 * np.einsum("...d,...d->...", d @ self.precision, d))
