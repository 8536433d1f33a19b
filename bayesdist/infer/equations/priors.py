"""Gaussian priors of the parameters: independent ones by name, and correlated ones."""

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
    """Gaussian prior of the first entries of theta with their correlations."""

    centre: Float  # (G,)
    precision: Float  # (G, G), inverse covariance; it may leave directions flat
    rank: int  # number of directions that are not flat


@dataclass(frozen=True, eq=False)
class GaussianPriors:
    """Gaussian priors on entries of theta: independent ones, and a joint one of the first entries.

    Parameters
    ----------
    centre : ndarray, shape (D,)
    precision : ndarray, shape (D,)
        Inverse variances; 0 is a flat prior.
    joint : JointPrior, optional
        Of the polynomials and their drift.
    """

    centre: Float
    precision: Float
    joint: JointPrior | None = None

    @classmethod
    def none(cls, model: DistortionModel) -> GaussianPriors:
        """Flat priors on everything."""
        return cls(np.zeros(model.n_params), np.zeros(model.n_params))

    @classmethod
    def of(cls, model: DistortionModel, named: Mapping[str, tuple[float, float]]) -> GaussianPriors:
        """Priors from a mapping of parameter names to (mean, sigma).

        Raises
        ------
        InputError
            For an unknown name or a sigma that is not positive.
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
                raise InputError(f"prior of {name} is {mean} +- {sigma}", where="prior")
            k = model.names.index(name)
            centre[k], precision[k] = mean, sigma**-2
        return cls(centre, precision)

    @property
    def n_informative(self) -> int:
        """Number of directions in which a prior is not flat."""
        joint = 0 if self.joint is None else self.joint.rank
        return int((self.precision > 0).sum()) + joint

    def pull(self, theta: Float) -> Float:
        """Gradient of the log prior."""
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
        """Priors as one of all parameters, about theta (D,)."""
        return Prior(theta, self.information(len(self.precision)), self.pull(theta))

    def information(self, n: int) -> Float:
        """Precision (n, n) of the first entries of theta."""
        out = np.diag(self.precision[:n])
        if self.joint is not None:
            G = len(self.joint.centre)
            out[:G, :G] += self.joint.precision[:n, :n]
        return out

    def matrix(self, model: DistortionModel, n_tail: int = 0) -> Arrow:
        """The priors' precision as an arrow without edges."""
        n, q, g = len(model.local_blocks), model.n_frame, model.n_global
        local = self.precision[g:].reshape(n, q) if n else np.zeros((0, q))
        blocks = np.einsum("nq,qr->nqr", local, np.eye(q))
        border = np.zeros((g + n_tail, g + n_tail))
        border[:g, :g] = self.information(g)
        return Arrow(border, np.zeros((n, g + n_tail, q)), blocks, n_tail)


@dataclass(frozen=True, eq=False)
class Prior:
    """Correlated Gaussian prior of the parameters, linearised at some.

    log p = -d^T P d / 2 + r^T d with d = theta - reference.
    """

    reference: Float  # (D,), near the solution, so that no digits are lost
    precision: Float  # (D, D), P
    right: Float  # (D,), r

    @classmethod
    def none(cls, reference: Float) -> Prior:
        """Flat prior."""
        D = len(reference)
        return cls(reference, np.zeros((D, D)), np.zeros(D))

    def __add__(self, other: Prior) -> Prior:
        """Sum of two independent pieces."""
        shift = self.reference - other.reference
        return Prior(
            self.reference,
            self.precision + other.precision,
            self.right + other.right - other.precision @ shift,
        )

    def pull(self, theta: Float) -> Float:
        """Gradient (D,)."""
        return np.asarray(self.right - self.precision @ (theta - self.reference))

    def log_density(self, theta: Float) -> Float:
        """Log density of parameter vectors (..., D), up to a constant."""
        d = theta - self.reference
        return np.asarray(d @ self.right - 0.5 * np.einsum("...d,...d->...", d @ self.precision, d))
