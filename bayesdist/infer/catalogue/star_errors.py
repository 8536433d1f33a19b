"""Effect of reference-catalogue errors, which a star has in common in all of its exposures.

A fit counts every match as an independent measurement, with the catalogue's error in its sigma.
But a star that is matched in many exposures is wrong in all of them by the same amount (and by a
proper motion that is wrong by the same amount), so this part of the error does not average out.
With normal matrix H and the sums G_s over all matches of star s (`star_sums`),

    cov = H^-1 [sum_s G_s Sigma_s G_s^T] H^-1

is the covariance of the parameters by the errors Sigma_s of the catalogue.  The fit has already
counted the diagonal part, sum_i instead of (sum_i)^2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.infer.catalogue.star_sums import StarSums, influence_by_group
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.stars.stars import prepare
from bayesdist.infer.transforms import Solution

__all__ = ["StarCovariance", "star_covariance"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class StarCovariance:
    """Covariance of a solution's parameters by the errors of the catalogue.

    Parameters
    ----------
    total : ndarray, shape (D, D)
        Covariance of the parameters' error that the catalogue causes.
    counted : ndarray, shape (D, D)
        The part of it that is in the solution's covariance, by errors taken as independent from
        match to match.  Zero where the quoted errors do not contain the catalogue's.
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
    sigma_u: ArrayLike,
    sigma_v: ArrayLike,
    *,
    motion_u: ArrayLike = 0.0,
    motion_v: ArrayLike = 0.0,
    epoch0: ArrayLike | None = None,
    star: ArrayLike | None = None,
    weight: ArrayLike | None = None,
    included: bool = True,
    frames: bool = True,
) -> StarCovariance:
    """Covariance of a solution's parameters by the errors of the catalogue.

    Parameters
    ----------
    solution : Solution
        A fit or a posterior of these matches: its covariance stands for the inverse of the normal
        matrix, so that it must not come from a fit with extra weight in the corners.
    matches : Matches
        All stars at once.
    sigma_u, sigma_v : array_like, shape () or (n_stars,)
        Errors of the catalogue's positions at `epoch0`, in the unit of u, v; by star code.
    motion_u, motion_v : array_like, shape () or (n_stars,)
        Errors of the proper motions, in that unit per year.
    epoch0 : array_like, shape () or (n_stars,), optional
        Date at which errors of positions and motions are uncorrelated; needed with motions.
    star : array_like of int, shape (N,), optional
        Code of the star of each match; the table's by default.
    weight : array_like, shape (N,), optional
        Probability that a match is true.  By default 1 for the stars that a fit used and 0 for
        those that it left out.
    included : bool
        True if the quoted errors of the matches contain the catalogue's.
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
        When the stars have no codes, for errors that are negative or not finite, arrays of other
        lengths, and errors of the catalogue that quoted errors do not contain.
    """
    code = _codes(matches, star)
    n_stars = int(code.max()) + 1
    by_axis = [
        _by_star(s, n_stars, name) for s, name in ((sigma_u, "sigma_u"), (sigma_v, "sigma_v"))
    ]
    variances = [np.stack(by_axis, axis=1) ** 2]
    levers = [np.ones(len(matches))]
    moving = [
        _by_star(s, n_stars, name) for s, name in ((motion_u, "motion_u"), (motion_v, "motion_v"))
    ]
    if any(m.any() for m in moving):
        if epoch0 is None or matches.epoch is None:
            raise InputError(
                "errors of proper motions need the catalogue's epoch and those of the matches",
                do="give epoch0, and a table with epochs",
            )
        variances.append(np.stack(moving, axis=1) ** 2)
        levers.append(matches.epoch - _by_star(epoch0, n_stars, "epoch0", signed=True)[code])
    if weight is None:
        uses = getattr(solution, "uses", None)
        weight = np.ones(len(matches)) if uses is None else uses(matches)
    weight = np.broadcast_to(np.asarray(weight, float), (len(matches),))

    if included:
        _require_contained(matches, code, variances, levers)
    stars, order = prepare(solution.model, matches)
    inverse = np.stack([weight[order] / stars.var_u, weight[order] / stars.var_v])
    sums = StarSums.of(stars, code[order], inverse, [lever[order] for lever in levers])
    cov, mean = np.asarray(solution.cov, float), np.asarray(solution.mean)
    D = solution.model.n_params if frames else solution.model.n_distortion
    influence = influence_by_group(solution.model, mean, stars.groups, cov, D)
    parts = sums.shared(influence, variances)
    counted = sums.independent(influence, variances) if included else np.zeros((D, D))
    if not frames:
        follow = np.linalg.solve(cov[:D, :D], cov[:D]).T
        parts, counted = (follow @ c @ follow.T for c in (parts, counted))
    positions, *motions = (parts + np.swapaxes(parts, 1, 2)) / 2
    return StarCovariance(sum(motions, positions), (counted + counted.T) / 2, *motions)


def _require_contained(
    matches: Matches, code: Int, variances: list[Float], levers: list[Float]
) -> None:
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
                do="add the catalogue's errors to them, or say that they are not included",
            )


def _codes(matches: Matches, star: ArrayLike | None) -> Int:
    given = matches.star if star is None else star
    if given is None:
        raise InputError(
            "the matches do not say which star is which",
            where=", ".join(matches.sources),
            do="give a table with a column 'star', or the codes",
        )
    code = np.asarray(given)
    if code.shape != (len(matches),) or code.dtype.kind not in "iu" or code.min() < 0:
        raise InputError(
            f"star codes have shape {code.shape} and type {code.dtype} for {len(matches)} matches",
            where="star",
            do="give one integer, 0 or more, for each match",
        )
    return code.astype(np.int64)


def _by_star(values: ArrayLike, n_stars: int, name: str, *, signed: bool = False) -> Float:
    """Values of every star, from one for all or an array of n_stars or more."""
    values = np.asarray(values, float)
    if values.ndim and (values.ndim > 1 or len(values) < n_stars):
        raise InputError(
            f"{name} has shape {values.shape}, and star codes go up to {n_stars - 1}",
            where=name,
            do="give one value, or one for each star",
        )
    good = np.isfinite(values) if signed else np.isfinite(values) & (values >= 0)
    if not good.all():
        raise InputError(
            f"{name} is {values.ravel()[int(np.argmin(good))]:g}",
            where=name,
            do="give finite numbers" + ("" if signed else " that are not negative"),
        )
    return np.broadcast_to(values, (n_stars,)) if values.ndim == 0 else values[:n_stars]
