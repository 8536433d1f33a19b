"""Constant terms of chips that shift from exposure to exposure.

The data determine only the sums of a chip's constant terms and its shifts in each exposure, but
these very well.  In the fit the shifts get a wide prior, so that they do not constrain other
parameters (see `hierarchy`); the constants are then as uncertain as that prior.  This module
determines the constants from the mean of the sums over the exposures, with the error that results
from the scatter of the shifts:

    c -> c + G s + d      s -> s - X (G s + d)      d ~ N(0, tau^2 (X^T X)^-1)

G is the least-squares regression of the shifts s on X, which has a column of ones and, if the drift
has breaks, its steps.  The predicted positions of all exposures are unchanged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bayesdist.model import DistortionModel, Groups
from bayesdist.utils.arrays import Bool, Float, Int

AXES = ("u", "v")


@dataclass(frozen=True, eq=False)
class _Place:
    """Constants and shifts of one axis of one chip."""

    kind: int  # index of its shifts among the kinds of deviation
    constants: Int  # indices (p,) in theta of the constant term and its steps
    shifts: Int  # indices (E,) in theta of the shifts
    design: Float  # X (E, p)
    used: Bool  # mask (E,) of the exposures that are used for the mean

    @property
    def inverse(self) -> Float:
        """(X^T X)^-1, shape (p, p)."""
        design = self.design[self.used]
        return np.asarray(np.linalg.inv(design.T @ design))

    def moved(self, theta: Float, d: Float) -> None:
        """Transform theta (..., D) in place, with errors d (..., p) of the constants."""
        shifts = theta[..., self.shifts]
        step = shifts[..., self.used] @ self.design[self.used] @ self.inverse + d
        theta[..., self.constants] += step
        theta[..., self.shifts] -= step @ self.design.T

    def covariance(self, n: int, tau: float) -> Float:
        """Covariance (n, n) of theta caused by the errors d of the constants, for scatter tau."""
        by = np.zeros((n, len(self.constants)))
        by[self.constants] = np.eye(len(self.constants))
        by[self.shifts] = -self.design
        return tau**2 * by @ self.inverse @ by.T


@dataclass(frozen=True, eq=False)
class Settling:
    """Transformation that determines the constants of chips from the mean of their shifts."""

    places: tuple[_Place, ...]  # one per axis of every chip except the first

    @classmethod
    def of(
        cls,
        model: DistortionModel,
        kinds: Sequence[str],
        groups: Groups,
        held: Bool,
        outlying: Bool,
    ) -> Settling:
        """Make the transformation for the shifts of single chips among the kinds of deviation.

        `groups` of the data provide the chips and the epoch of each exposure.  `held` (D,) is True
        for parameters with other priors, and `outlying` (E,) for outlying exposures.
        """
        names = {name: k for k, name in enumerate(model.names)}
        places = []
        for code, chip in enumerate(model.chips):
            present = np.zeros(len(model.exposures), bool)
            epoch = np.zeros(len(model.exposures))
            on_chip = groups.chip == code
            present[groups.exposure[on_chip]] = True
            epoch[groups.exposure[on_chip]] = groups.epoch[on_chip]
            for a, axis in enumerate(AXES):
                kind = f"{chip.name}.shift_{axis}"
                if kind not in kinds:
                    continue
                at, X = [model.coefficient_slice(chip.number, a).start], [np.ones(len(present))]
                if model.time is not None and (axis, 0, 0) in model.time.terms:
                    weights = model.time.weights(epoch)
                    first = model.tdd_slice(chip.number).start
                    first += model.time.terms.index((axis, 0, 0)) * model.time.n_values
                    free = ~held[first : first + model.time.n_values]
                    at += (first + np.flatnonzero(free)).tolist()
                    X += list(weights.T[free])
                shifts = [names[f"{e}.{kind}"] for e in model.exposures]
                used = present & ~outlying
                design = np.stack(X, axis=1)
                if np.linalg.matrix_rank(design[used]) == len(at):
                    places.append(
                        _Place(
                            list(kinds).index(kind), np.array(at), np.array(shifts), design, used
                        )
                    )
        return cls(tuple(places))

    def mean(self, theta: Float) -> Float:
        """Transformed theta (..., D), with d = 0."""
        out = np.array(theta, float)
        for place in self.places:
            place.moved(out, np.zeros(len(place.constants)))
        return out

    def covariance(self, cov: Float, tau: Float) -> Float:
        """Covariance (D, D) of the transformed parameters, for scatter tau (k,)."""
        out = self.mean(self.mean(np.asarray(cov)).T)
        for place in self.places:
            out += place.covariance(len(out), float(tau[place.kind]))
        return np.asarray((out + out.T) / 2)

    def draws(self, theta: Float, tau: Float, rng: np.random.Generator) -> Float:
        """Transformed draws (n, D), each with a random d for its scatter tau (n, k)."""
        out = np.array(theta, float)
        for place in self.places:
            root = np.linalg.cholesky(place.inverse)
            z = rng.standard_normal((len(out), len(place.constants)))
            place.moved(out, tau[:, [place.kind]] * z @ root.T)
        return out
