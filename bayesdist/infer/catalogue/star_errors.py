"""Errors of the stars of a reference catalogue: of positions, proper motions and parallaxes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bayesdist.data.covariances import without_sizes
from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float, Int

ROUNDING = 1e-9  # relative, of variances


@dataclass(frozen=True, eq=False)
class StarErrors:
    """Errors of a reference catalogue by star code.

    Parameters
    ----------
    position : ndarray, shape (S, 2)
        Standard errors of the positions along u and v, in the unit of u, v.
    motion : ndarray, shape (S, 2), optional
        Standard errors of the proper motions along u and v, in the unit of u, v per year.
    epoch : ndarray, shape (S,), optional
        Dates (decimal years) of the positions; required with `motion`. Without `correlations`, the
        errors of position and proper motion are uncorrelated at this date.
    correlations : ndarray, shape (S, 2, 2), (S, 4, 4) or (S, 5, 5), optional
        Correlation matrices of the errors in u and v, with `motion` of the proper motions in u and
        v, and with `parallax` of the parallaxes. By default all errors are independent.
    parallax : ndarray, shape (S,), optional
        Standard errors of the parallaxes, in the unit of u, v. They need `motion`, `correlations`
        and `factors`.
    factors : callable, optional
        ``factors(epoch)`` returns the parallax factors (n, 2) along u and v at dates (n,) in
        decimal years.
    """

    position: Float
    motion: Float | None = None
    epoch: Float | None = None
    correlations: Float | None = None
    parallax: Float | None = None
    factors: Callable[[Float], Float] | None = None

    @classmethod
    def contained_in(cls, matches: Matches) -> StarErrors:
        """Errors of positions that are at most those of any match of the star, on all directions.

        They are the smallest covariance of the matches of a star, reduced where that of another
        match is smaller along some direction.

        Parameters
        ----------
        matches : Matches
            Matches with star codes, whose errors are those of the catalogue.

        Returns
        -------
        StarErrors
            Without errors of proper motions; zero for codes without a match.
        """
        code, C = matches.column("star"), matches.covariances()
        n = int(code.max()) + 1
        det = np.linalg.det(C)
        first = np.lexsort((det, code))
        smallest = np.zeros((n, 2, 2))
        smallest[code[first[::-1]]] = C[first[::-1]]  # the smallest of each star comes last
        relative = np.linalg.solve(smallest[code], C)
        half = np.einsum("naa->n", relative) / 2
        ratio = half - np.sqrt(np.maximum(half**2 - np.linalg.det(relative), 0.0))
        least = np.ones(n)
        np.minimum.at(least, code, ratio)
        sigma, correlations = without_sizes(least[:, None, None] * smallest)
        return cls(sigma, correlations=correlations)

    def levers(self, star: Int, epoch: Float | None) -> Float:
        """Derivatives of matched positions with respect to catalogue position and proper motion.

        Parameters
        ----------
        star : ndarray of int, shape (n,)
            Star codes of the matches.
        epoch : ndarray, shape (n,), or None
            Dates of the matches in decimal years.

        Returns
        -------
        ndarray, shape (levers, 2, n)
            Along u and v: 1 for the position; if proper motions have errors, years since the
            catalogue epoch; and if parallaxes have errors, their factors.
        """
        ones = np.ones((2, len(star)))
        if self.motion is None or self.epoch is None or epoch is None:
            return ones[None]
        levers = [ones, (epoch - self.epoch[star]) * ones]
        if self.parallax is not None and self.factors is not None:
            dates, of_match = np.unique(epoch, return_inverse=True)
            levers.append(self.factors(dates)[of_match].T)
        return np.stack(levers)

    @property
    def n_levers(self) -> int:
        """Number of errors of a star that matches share on each axis: 1, 2 or 3; see `levers`."""
        return len(self._sigmas)

    @property
    def variances(self) -> Float:
        """Variances (levers, S, 2) of positions and, if given, of motions and of parallaxes."""
        return np.asarray(np.stack(self._sigmas) ** 2)

    @property
    def _sigmas(self) -> list[Float]:
        """Standard errors (S, 2) of positions and, if given, of motions and of parallaxes."""
        if self.motion is None:
            return [self.position]
        if self.parallax is None:
            return [self.position, self.motion]
        return [self.position, self.motion, np.tile(self.parallax[:, None], 2)]

    def covariances(self, star: Int, n_levers: int) -> Float:
        """Covariances (n, levers, 2, levers, 2) of positions, motions and parallaxes.

        The second and the fourth axis are the lever (see `levers`), the others u and v.  A parallax
        has the same error on both axes.  `star` (n,) are star codes.
        """
        sigma = np.stack([values[star] for values in self._sigmas[:n_levers]], axis=1)
        m = 2 * n_levers
        if self.correlations is None:
            out = np.broadcast_to(np.eye(m), (len(star), m, m))
        else:
            parameters = np.minimum(np.arange(m), 4)  # the parallax stands for both axes
            out = self.correlations[star][:, parameters[:, None], parameters]
        out = out.reshape(len(star), n_levers, 2, n_levers, 2)
        return np.asarray(out * sigma[:, :, :, None, None] * sigma[:, None, None])

    def covariances_at(self, star: Int, epoch: Float | None) -> Float:
        """Covariances (n, 2, 2) of the catalogue positions at the dates of the matches.

        The arguments are those of `at`.
        """
        levers = self.levers(star, epoch)
        covariances = self.covariances(star, len(levers))
        return np.asarray(np.einsum("lan,nlamb,mbn->nab", levers, covariances, levers))

    def at(self, star: Int, epoch: Float | None) -> Float:
        """Variances of the catalogue positions at the dates of the matches.

        Parameters
        ----------
        star : ndarray of int, shape (n,)
            Star codes of the matches.
        epoch : ndarray, shape (n,), or None
            Dates of the matches in decimal years.

        Returns
        -------
        ndarray, shape (n, 2)
        """
        if self.correlations is not None:
            return np.einsum("naa->na", self.covariances_at(star, epoch))
        levers = self.levers(star, epoch)
        variances = self.variances[: len(levers), star]
        return np.asarray(np.einsum("lan,lna->na", levers**2, variances))

    def checked(self, n_stars: int) -> StarErrors:
        """Errors of the first `n_stars` stars, validated.

        Raises InputError if there are fewer stars, values are not finite or negative, correlations
        are impossible, or the epoch, or what errors of parallaxes need, is missing.
        """
        position = _checked(self.position, n_stars, "position")
        if self.parallax is not None and (
            self.motion is None or self.correlations is None or self.factors is None
        ):
            raise InputError(
                "errors of parallaxes are given without what they need",
                do="give motion, correlations and factors",
            )
        if self.motion is None or not (self.motion.any() or self.parallax is not None):
            return StarErrors(position, correlations=_possible(self.correlations, n_stars, 2))
        if self.epoch is None:
            raise InputError("errors of proper motions need the catalogue's epoch", do="give it")
        motion = _checked(self.motion, n_stars, "motion")
        epoch = _checked(self.epoch, n_stars, "epoch", signed=True)
        if self.parallax is None:
            return StarErrors(position, motion, epoch, _possible(self.correlations, n_stars, 4))
        parallax = _checked(self.parallax, n_stars, "parallax")
        matrices = _possible(self.correlations, n_stars, 5)
        return StarErrors(position, motion, epoch, matrices, parallax, self.factors)


def _possible(correlations: Float | None, n_stars: int, n: int) -> Float | None:
    """Correlation matrices (n_stars, n, n) of the first parameters; InputError if impossible."""
    if correlations is None:
        return None
    if len(correlations) < n_stars or min(correlations.shape[1:]) < n:
        raise InputError(
            f"correlations have shape {correlations.shape}, but {n_stars} stars need "
            f"{(n_stars, n, n)}",
            where="correlations",
            do="give a matrix for each star",
        )
    out = np.asarray(correlations[:n_stars, :n, :n], float)
    unit = np.isclose(np.einsum("naa->na", out), 1.0, rtol=0.0, atol=ROUNDING)
    if not np.isfinite(out).all() or not unit.all() or np.linalg.eigvalsh(out).min() < -1e-5:
        raise InputError(
            "some matrices are not correlation matrices",
            where="correlations",
            do="give 1 on the diagonal, and no negative eigenvalue",
        )
    return out


def _checked(values: Float, n_stars: int, name: str, *, signed: bool = False) -> Float:
    """Values of the first stars; they must be finite and, unless `signed`, not negative."""
    if len(values) < n_stars:
        raise InputError(
            f"{name} is given for {len(values)} stars, but star codes go up to {n_stars - 1}",
            where=name,
            do="give it for all stars",
        )
    values = values[:n_stars]
    good = np.isfinite(values) & (signed | (values >= 0))
    if not good.all():
        raise InputError(
            f"{name} is {values[~good][0]:g}",
            where=name,
            do="give finite numbers" + ("" if signed else " that are not negative"),
        )
    return values
