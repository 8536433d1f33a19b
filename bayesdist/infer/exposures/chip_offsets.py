"""Constant terms of a chip whose shift varies from exposure to exposure.

The constant terms of a chip and the shifts of the chip in every exposure are seen only as their
sums, which the data determine very well.  A fit in which these shifts shall not constrain other
parameters gives them a wide prior (see `hierarchy`), and leaves the constants as open as that
prior.  The constants are determined here: as the mean of the sums over the exposures, with the
error that the scatter of the shifts gives a mean,

    c -> c + G s + d      s -> s - X (G s + d)      d ~ N(0, tau^2 (X^T X)^-1)

with G the least-squares regression of the shifts s on X: ones, and the steps where the drift has
breaks.  No predicted position of any exposure changes by this.
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
    """One axis of one chip."""

    kind: int  # of its shifts, among the kinds of deviation
    constants: Int  # indices (p,) in theta of the constant term and its steps
    shifts: Int  # indices (E,) in theta of the shifts
    design: Float  # X (E, p)
    used: Bool  # exposures (E,) whose shifts scatter by tau

    @property
    def inverse(self) -> Float:
        """(X^T X)^-1, shape (p, p)."""
        some = self.design[self.used]
        return np.asarray(np.linalg.inv(some.T @ some))

    def moved(self, theta: Float, d: Float) -> None:
        """Transform parameters (..., D) in place, with given errors (..., p) of the constants."""
        shifts = theta[..., self.shifts]
        step = shifts[..., self.used] @ self.design[self.used] @ self.inverse + d
        theta[..., self.constants] += step
        theta[..., self.shifts] -= step @ self.design.T

    def covariance(self, n: int, tau: float) -> Float:
        """Covariance (n, n) of theta by the errors d of the constants."""
        by = np.zeros((n, len(self.constants)))
        by[self.constants] = np.eye(len(self.constants))
        by[self.shifts] = -self.design
        return tau**2 * by @ self.inverse @ by.T


@dataclass(frozen=True, eq=False)
class Settling:
    """Transformation from shifts with a wide prior to constants that are means."""

    places: tuple[_Place, ...]  # one for each axis of every chip but the first

    @classmethod
    def of(
        cls,
        model: DistortionModel,
        kinds: Sequence[str],
        groups: Groups,
        held: Bool,
        outlying: Bool,
    ) -> Settling:
        """Transformation for the shifts of single chips among the kinds of deviation.

        The groups of the data give the chips and the epoch of each exposure; `held` (D,) are
        parameters with a prior of their own, `outlying` (E,) exposures that went wrong.
        """
        names = {name: k for k, name in enumerate(model.names)}
        places = []
        for code, chip in enumerate(model.chips):
            seen = np.zeros(len(model.exposures), bool)
            epoch = np.zeros(len(model.exposures))
            here = groups.chip == code
            seen[groups.exposure[here]] = True
            epoch[groups.exposure[here]] = groups.epoch[here]
            for a, axis in enumerate(AXES):
                kind = f"{chip.name}.shift_{axis}"
                if kind not in kinds:
                    continue
                at, X = [model.coefficient_slice(chip.number, a).start], [np.ones(len(seen))]
                if model.time is not None and (axis, 0, 0) in model.time.terms:
                    weights = model.time.weights(epoch)
                    first = model.tdd_slice(chip.number).start
                    first += model.time.terms.index((axis, 0, 0)) * model.time.n_values
                    free = ~held[first : first + model.time.n_values]
                    at += (first + np.flatnonzero(free)).tolist()
                    X += list(weights.T[free])
                shifts = [names[f"{e}.{kind}"] for e in model.exposures]
                used = seen & ~outlying
                design = np.stack(X, axis=1)
                if np.linalg.matrix_rank(design[used]) == len(at):
                    places.append(
                        _Place(
                            list(kinds).index(kind), np.array(at), np.array(shifts), design, used
                        )
                    )
        return cls(tuple(places))

    def mean(self, theta: Float) -> Float:
        """Transformed parameters (..., D), without an error of the constants."""
        out = np.array(theta, float)
        for place in self.places:
            place.moved(out, np.zeros(len(place.constants)))
        return out

    def covariance(self, cov: Float, tau: Float) -> Float:
        """Covariance (D, D) of transformed parameters, where the scatter is tau (k,)."""
        out = self.mean(self.mean(np.asarray(cov)).T)
        for place in self.places:
            out += place.covariance(len(out), float(tau[place.kind]))
        return np.asarray((out + out.T) / 2)

    def draws(self, theta: Float, tau: Float, rng: np.random.Generator) -> Float:
        """Transformed draws (n, D), with an error of the constants each, for scatter tau (n, k)."""
        out = np.array(theta, float)
        for place in self.places:
            root = np.linalg.cholesky(place.inverse)
            z = rng.standard_normal((len(out), len(place.constants)))
            place.moved(out, tau[:, [place.kind]] * z @ root.T)
        return out
