"""The error of the reference catalogue: one star has one error, in however many exposures it is.

A fit counts every match as a measurement of its own, with the catalogue's error in its sigma.  But
a star that is matched in many exposures is wrong in all of them by the same amount (and by a proper
motion that is wrong by the same amount), so this part of the error does not average out.  With
normal matrix H, residual weights W and the derivatives J of all matches i of star s,

    cov = H^-1 [sum_s G_s Sigma_s G_s^T] H^-1          G_s = sum_i a_i J_i^T W_i

is what the errors Sigma_s of the catalogue do to the parameters; a_i is 1 for a position and t - t0
for a proper motion.  The fit has already counted the diagonal part, sum_i instead of (sum_i)^2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesdist.data.matches import MatchTable
from bayesdist.errors import InputError
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.stars.stars import Stars, prepare
from bayesdist.infer.transforms import Solution

__all__ = ["StarCovariance", "star_covariance"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

SCRATCH = 64_000_000  # bytes of the stars' sums G_s that are held at a time


@dataclass(frozen=True, eq=False)
class StarCovariance:
    """What the errors of the catalogue do to the parameters of a solution.

    Parameters
    ----------
    total : ndarray, shape (D, D)
        Covariance of the parameters' error that the catalogue causes.
    counted : ndarray, shape (D, D)
        The part of it that is in the solution's covariance: that of errors which are independent
        from match to match.  Zero where the quoted errors are without the catalogue's.
    motions : ndarray, shape (D, D), optional
        The part of `total` that the errors of the proper motions cause; None where there are none.
    """

    total: Float
    counted: Float
    motions: Float | None = None

    @property
    def extra(self) -> Float:
        """What has to be added to the solution's covariance."""
        return self.total - self.counted


@one_thread
def star_covariance(
    solution: Solution,
    matches: MatchTable,
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
    """Covariance of the parameters by the errors of the catalogue.

    Parameters
    ----------
    solution : Solution
        A fit or a posterior of these matches: its covariance stands for the inverse of the normal
        matrix, so that it must not come from a fit with extra weight in the corners.
    matches : MatchTable
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
        Whether the quoted errors of the matches contain the catalogue's.
    frames : bool
        Whether the frames of the exposures are followed exactly.  Without, polynomials and drift
        still are, in a fraction of the time (a seventh with 110 exposures), and the errors of the
        frames change only as far as they are correlated with those.

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
    pairs = _Pairs.of(stars, code[order], weight[order], [lever[order] for lever in levers])
    D = solution.model.n_params if frames else solution.model.n_distortion
    influence = _influence(solution, stars, D)
    parts = np.zeros((len(levers), D, D))
    step = max(1, SCRATCH // (16 * D * len(levers)))
    for first in range(0, n_stars, step):
        sums = pairs.sums(influence, first, min(first + step, n_stars))
        for c, variance in enumerate(variances):
            for axis in (0, 1):
                part = sums[c, axis]
                part *= np.sqrt(variance[first : first + step, axis])[:, None]
                parts[c] += part.T @ part
    counted = np.zeros((D, D))
    if included:
        counted = pairs.diagonal(influence, variances)
    if not frames:
        cov = np.asarray(solution.cov, float)
        follow = np.linalg.solve(cov[:D, :D], cov[:D]).T
        parts, counted = (follow @ c @ follow.T for c in (parts, counted))
    positions, *motions = (parts + np.swapaxes(parts, 1, 2)) / 2
    return StarCovariance(sum(motions, positions), (counted + counted.T) / 2, *motions)


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Matches in the order of their groups, and of their stars within each.

    Parameters
    ----------
    starts : ndarray of int, shape (G + 1,)
    code : ndarray of int, shape (N,)
    phi : list of ndarray, shape (n_g, K)
        Basis functions of each group.
    weight : ndarray, shape (2, N)
        Inverse variances of both axes.
    levers : list of ndarray, shape (N,)
        How an error of the star moves the match: first 1, then years where stars move.
    """

    starts: Int
    code: Int
    phi: list[Float]
    weight: Float
    levers: list[Float]

    @classmethod
    def of(cls, stars: Stars, code: Int, weight: Float, levers: list[Float]) -> _Pairs:
        bounds = [slice(a, b) for a, b in zip(stars.starts[:-1], stars.starts[1:], strict=True)]
        order = np.concatenate(
            [rows.start + np.argsort(code[rows], kind="stable") for rows in bounds]
        )
        model, chips = stars.model, stars.groups.chip
        phi = [
            model.basis(model.chips[c].number).evaluate_scaled(
                stars.X[order[rows]], stars.Y[order[rows]]
            )
            for c, rows in zip(chips, bounds, strict=True)
        ]
        inverse = np.stack([weight / stars.var_u, weight / stars.var_v])[:, order]
        return cls(stars.starts, code[order], phi, inverse, [lever[order] for lever in levers])

    def sums(self, influence: list[Float], first: int, end: int) -> Float:
        """H^-1 G_s of the stars first to end, each lever and axis: (levers, 2, stars, D)."""
        out = np.zeros((len(self.levers), 2, end - first, influence[0].shape[2]))
        for g, phi in enumerate(self.phi):
            a = int(self.starts[g])
            code = self.code[a : self.starts[g + 1]]
            lo, hi = np.searchsorted(code, [first, end])
            if lo == hi:
                continue
            rows, at = slice(a + lo, a + hi), code[lo:hi] - first
            new = np.flatnonzero(np.diff(at, prepend=-1))  # a star may stand twice in a group
            twice = len(new) < len(at)
            for axis in (0, 1):
                each = (phi[lo:hi] * self.weight[axis, rows, None]) @ influence[g][axis]
                for c, lever in enumerate(self.levers):
                    moved = each if c == 0 else each * lever[rows, None]  # the first lever is 1
                    if twice:
                        moved = np.add.reduceat(moved, new, axis=0)
                    out[c, axis, at[new]] += moved
        return out

    def diagonal(self, influence: list[Float], variances: list[Float]) -> Float:
        """The same with each match as a star of its own: shape (D, D)."""
        D = influence[0].shape[2]
        out = np.zeros((D, D))
        for g, phi in enumerate(self.phi):
            rows = slice(self.starts[g], self.starts[g + 1])
            for axis in (0, 1):
                variance = sum(
                    lever[rows] ** 2 * v[self.code[rows], axis]
                    for lever, v in zip(self.levers, variances, strict=True)
                )
                moment = (phi * (self.weight[axis, rows] ** 2 * variance)[:, None]).T @ phi
                out += influence[g][axis].T @ moment @ influence[g][axis]
        return out


def _influence(solution: Solution, stars: Stars, D: int) -> list[Float]:
    """For each group the matrices (2, K, D) from weighted basis functions to D parameters."""
    cov = np.asarray(solution.cov, float)[:, :D]
    jacobians = solution.model.effective_jacobian(np.asarray(solution.mean), stars.groups)
    return [d @ cov[columns] for columns, d in jacobians]


def _require_contained(
    matches: MatchTable, code: Int, variances: list[Float], levers: list[Float]
) -> None:
    """Refuse quoted errors that are smaller than the catalogue's part of them."""
    for axis, quoted in enumerate((matches.sigma_u, matches.sigma_v)):
        if quoted is None:
            continue  # which `prepare` refuses
        part = sum(lever**2 * v[code, axis] for lever, v in zip(levers, variances, strict=True))
        small = quoted**2 < part * (1 - 1e-9)
        if small.any():
            raise InputError(
                f"the quoted errors of {int(small.sum())} matches are smaller than the error of "
                "their star in the catalogue",
                where="sigma_" + "uv"[axis],
                do="add the catalogue's errors to them, or say that they are not included",
            )


def _codes(matches: MatchTable, star: ArrayLike | None) -> Int:
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
    """Values of every star, one or n_stars or more of them given."""
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
