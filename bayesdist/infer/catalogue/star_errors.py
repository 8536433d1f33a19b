"""Effect of reference-catalogue errors, which a star has in common in all of its exposures.

A fit counts every match as an independent measurement, with the catalogue's error in its sigma.
But a star that is matched in many exposures is wrong in all of them by the same amount (and by a
proper motion that is wrong by the same amount), so this part of the error does not average out.
With normal matrix H and the sums G_s over all matches of star s (`star_sums`),

    cov = H^-1 [sum_s G_s Sigma_s G_s^T] H^-1

is the covariance of the parameters by the errors Sigma_s of the catalogue.  The fit has already
counted the diagonal part, sum_i instead of (sum_i)^2.

An error c_s of star s moves the parameters by H^-1 G_s c_s.  So a star that is seen again, in an
exposure that was no part of the fit, has an error with which the solution's own is correlated:
cov(c_s, theta) = Sigma_s (H^-1 G_s)^T.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.infer.catalogue.star_sums import StarSums, influence_by_group
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.solution.linear import LinearFit
from bayesdist.infer.solution.solution import Solution
from bayesdist.infer.stars.stars import prepare
from bayesdist.utils.arrays import Float, Int


@dataclass(frozen=True, eq=False)
class StarErrors:
    """Errors of a catalogue by code of the star.

    Parameters
    ----------
    position : ndarray, shape (S, 2)
        Standard errors of the positions along u and v, in the unit of u, v.
    motion : ndarray, shape (S, 2), optional
        Standard errors of the proper motions, in that unit per year.
    epoch : ndarray, shape (S,), optional
        Dates at which errors of positions and motions are uncorrelated; needed with motions.
    """

    position: Float
    motion: Float | None = None
    epoch: Float | None = None

    def levers(self, star: Int, epoch: Float | None) -> Float:
        """Derivatives (levers, n) of matched positions by the errors of position and motion."""
        one = np.ones(len(star))
        if self.motion is None or self.epoch is None or epoch is None:
            return one[None]
        return np.stack([one, epoch - self.epoch[star]])

    @property
    def variances(self) -> Float:
        """Variances (levers, S, 2) of positions, and then of motions where there are any."""
        parts = [self.position] if self.motion is None else [self.position, self.motion]
        return np.asarray(np.stack(parts) ** 2)

    def at(self, star: Int, epoch: Float | None) -> Float:
        """Variances (n, 2) of the catalogue's positions for some matches."""
        levers = self.levers(star, epoch)
        variances = self.variances[: len(levers), star]
        return np.asarray(np.einsum("ln,lna->na", levers**2, variances))

    def checked(self, n_stars: int) -> StarErrors:
        """These errors of the first stars; InputError for fewer, and for numbers that are none."""
        position = _checked(self.position, n_stars, "position")
        if self.motion is None or not self.motion.any():
            return StarErrors(position)
        if self.epoch is None:
            raise InputError("errors of proper motions need the catalogue's epoch", do="give it")
        motion = _checked(self.motion, n_stars, "motion")
        return StarErrors(position, motion, _checked(self.epoch, n_stars, "epoch", signed=True))


@dataclass(frozen=True, eq=False)
class StarCovariance:
    """Covariance of a solution's parameters by the errors of the catalogue.

    Parameters
    ----------
    total : ndarray, shape (D, D)
        Covariance of the parameters' error that the catalogue causes.
    counted : ndarray, shape (D, D)
        The part of it that is in the solution's covariance, by errors taken as independent from
        match to match.
    motions : ndarray, shape (D, D), optional
        The part of `total` that the errors of the proper motions cause; None where there are none.
    """

    total: Float
    counted: Float
    motions: Float | None = None

    @property
    def extra(self) -> Float:
        """Covariance (D, D) to add to the solution's own."""
        return self.total - self.counted


@one_thread
def star_covariance(
    solution: Solution,
    matches: Matches,
    errors: StarErrors,
    *,
    frames: bool = True,
) -> StarCovariance:
    """Covariance of a solution's parameters by the errors of the catalogue.

    Parameters
    ----------
    solution : Solution
        A fit or a posterior of these matches: its covariance stands for the inverse of the normal
        matrix, so that it must not come from a fit with extra weight in the corners.
    matches : Matches
        All stars at once, with their codes.  Their quoted errors contain the catalogue's; those
        that a fit left out do not count.
    errors : StarErrors
        Of the catalogue, by star code; where there are errors of proper motions, with dates.
    frames : bool
        True to propagate to the frames of the exposures exactly.  If False, only polynomials and
        drift are exact, in a fraction of the time (a seventh with 110 exposures), and the errors of
        the frames change only as far as they are correlated with those.

    Returns
    -------
    StarCovariance

    Raises
    ------
    InputError
        When the stars have no codes, for errors that are negative or not finite, or of too few
        stars, and errors of the catalogue that quoted errors do not contain.
    """
    if matches.star is None:
        raise InputError(
            "the matches do not say which star is which",
            where=", ".join(matches.sources),
            do="give a table with a column 'star'",
        )
    code = matches.star
    errors = errors.checked(int(code.max()) + 1)
    if errors.motion is not None and matches.epoch is None:
        raise InputError("errors of proper motions need the epochs of the matches")
    levers, variances = errors.levers(code, matches.epoch), errors.variances
    _require_contained(matches, code, variances, levers)
    stars, order = prepare(solution.model, matches)
    used = solution.uses(matches)[order]
    inverse = np.stack([used / stars.var_u, used / stars.var_v])
    sums = StarSums.of(stars, code[order], inverse, list(levers[:, order]))
    cov, mean = np.asarray(solution.cov, float), np.asarray(solution.mean)
    D = solution.model.n_params if frames else solution.model.n_distortion
    influence = influence_by_group(solution.model, mean, stars.groups, cov, D)
    parts = sums.shared(influence, list(variances))
    counted = sums.independent(influence, list(variances))
    if not frames:
        follow = np.linalg.solve(cov[:D, :D], cov[:D]).T
        parts, counted = (follow @ c @ follow.T for c in (parts, counted))
    positions, *motions = ((part + part.T) / 2 for part in parts)
    return StarCovariance(sum(motions, positions), (counted + counted.T) / 2, *motions)


def _require_contained(matches: Matches, code: Int, variances: Float, levers: Float) -> None:
    """Raise InputError for quoted errors that are smaller than the catalogue's part of them."""
    for axis, quoted in enumerate((matches.sigma_u, matches.sigma_v)):
        if quoted is None:
            continue  # `prepare` refuses these
        part = sum(lever**2 * v[code, axis] for lever, v in zip(levers, variances, strict=True))
        small = quoted**2 < part * (1 - 1e-9)
        if small.any():
            raise InputError(
                f"the quoted errors of {int(small.sum())} matches are smaller than the error of "
                "their star in the catalogue",
                where="sigma_" + "uv"[axis],
                do="add the catalogue's errors to them",
            )


def _checked(values: Float, n_stars: int, name: str, *, signed: bool = False) -> Float:
    """Values of the first stars, which must be finite and, but for signed ones, not negative."""
    if len(values) < n_stars:
        raise InputError(
            f"{name} is given for {len(values)} stars, and codes go up to {n_stars - 1}",
            where=name,
            do="give that of all stars",
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


@dataclass(frozen=True, eq=False)
class StarInfluence:
    """Errors of a catalogue, and their effect on polynomials and drift of a solution."""

    errors: StarErrors
    codes: Int  # stars (k,) in the solution, ascending; all others have no effect on it
    # derivatives (levers, 2, k, n_distortion) of the parameters by these stars' errors on either
    # axis
    by: Float

    def with_solution(self, star: Int, epoch: Float | None) -> Float:
        """Covariance (n, 2, n_distortion) of the stars' errors with those of the parameters."""
        out = np.zeros((len(star), 2, self.by.shape[-1]))
        if not len(self.codes):
            return out
        at = np.minimum(np.searchsorted(self.codes, star), len(self.codes) - 1)
        known = np.flatnonzero(self.codes[at] == star)
        star, at = star[known], at[known]
        levers = self.errors.levers(star, None if epoch is None else epoch[known])
        variances = self.errors.variances[: len(levers), star]
        weight = levers[..., None] * variances  # (levers, n, 2)
        out[known] = np.einsum("lna,land->nad", weight, self.by[: len(levers)][:, :, at])
        return out


@one_thread
def star_influence(
    fit: LinearFit, matches: Matches, errors: StarErrors, codes: Int
) -> StarInfluence:
    """Effect on a fit of the catalogue errors of the stars `codes` (k,), ascending.

    The fit has no extra weight in the corners; `matches` are its own, with errors and star codes.
    """
    code = matches.column("star")
    model, D = fit.model, fit.model.n_distortion
    n_levers = 1 if errors.motion is None else 2
    by = np.zeros((n_levers, 2, len(codes), D))
    wanted = np.isin(code, codes) & fit.uses(matches)
    if not wanted.any():
        return StarInfluence(errors, codes, by)
    stars, order = prepare(model, matches.select(wanted))
    star = code[wanted][order]
    epoch = None if matches.epoch is None else matches.epoch[wanted][order]
    levers = list(errors.levers(star, epoch))
    inverse = np.stack([1 / stars.var_u, 1 / stars.var_v])
    sums = StarSums.of(stars, np.searchsorted(codes, star), inverse, levers)
    influence = influence_by_group(model, fit.mean, stars.groups, fit.cov, D)
    by[: len(levers)] = sums.each(influence, 0, len(codes))
    return StarInfluence(errors, codes, by)
