"""Effect of errors of the reference catalogue, which are the same in all exposures of a star.

A fit treats every match as an independent measurement, with the catalogue's error included in its
sigma.  The position of a star in the catalogue, however, has the same error in all exposures, and
so has its proper motion.  This part of the error does not average out.  Catalogue errors with the
covariance Sigma_s of each star s cause the covariance

    cov = H^-1 [sum_s G_s Sigma_s G_s^T] H^-1        G_s = sum_i a_i J_i^T W_i

of the parameters.  H is the normal matrix, and i are the matches of star s, with the weights W_i
and the derivatives J_i of the position with respect to the parameters.  a_i is the derivative of
the match's position with respect to the error: 1 for a position, t - t0 for a proper motion, and
the factors along u and v for a parallax.  The covariance of the fit already includes the diagonal
part, sum_i instead of (sum_i)^2.

An error c_s of star s changes the parameters theta by H^-1 G_s c_s.  If the star is observed in
another exposure that was not part of the fit, its error is therefore correlated with that of the
solution: cov(c_s, theta) = Sigma_s (H^-1 G_s)^T.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.infer.catalogue.star_errors import ROUNDING, StarErrors
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.solution.linear import LinearFit
from bayesdist.infer.solution.solution import Solution
from bayesdist.infer.stars.stars import Stars, prepare
from bayesdist.model import DistortionModel, Groups
from bayesdist.utils.arrays import Bool, Float, Int

SCRATCH = 64_000_000  # bytes of sums that are computed at a time


@dataclass(frozen=True, eq=False)
class StarCovariance:
    """Covariance of a solution's parameters caused by the errors of the catalogue.

    Parameters
    ----------
    total : ndarray, shape (D, D)
        Covariance of the parameters caused by the catalogue errors.
    counted : ndarray, shape (D, D)
        Part that the covariance of the solution already includes, because it treats the errors of
        all matches as independent.
    motions : ndarray, shape (D, D), optional
        Part of `total` caused by the errors of the proper motions, and by what the errors of
        positions and parallaxes have in common with them; None if proper motions have no errors.
    """

    total: Float
    counted: Float
    motions: Float | None = None

    @property
    def extra(self) -> Float:
        """Covariance (D, D) to add to that of the solution."""
        return self.total - self.counted


@one_thread
def star_covariance(
    solution: Solution,
    matches: Matches,
    errors: StarErrors,
    *,
    frames: bool = True,
    scratch: int = SCRATCH,
) -> StarCovariance:
    """Compute the covariance of a solution's parameters caused by the errors of the catalogue.

    Parameters
    ----------
    solution : Solution
        Fit or posterior of these matches. Its covariance is used as the inverse of the normal
        matrix; the fit must therefore not have additional weight in the corners.
    matches : Matches
        All stars with their star codes. Their quoted errors must include the catalogue errors.
        Stars that the fit rejects are ignored.
    errors : StarErrors
        Errors of the catalogue by star code.
    frames : bool
        True to compute the covariance of the exposure frames exactly. If False, only polynomials
        and drift are exact, and the frames change according to their correlation with those; this
        is much faster (by a factor of seven for 110 exposures).
    scratch : int
        Memory in bytes for the sums over the matches of each star.

    Returns
    -------
    StarCovariance

    Raises
    ------
    InputError
        If the matches have no star codes, catalogue errors are missing, negative or not finite, or
        the quoted errors are smaller than the catalogue errors.
    """
    if matches.star is None:
        raise InputError(
            "the matches have no star codes",
            where=", ".join(matches.sources),
            do="give a table with a column 'star'",
        )
    code = matches.star
    errors = errors.checked(int(code.max()) + 1)
    if errors.motion is not None and matches.epoch is None:
        raise InputError(
            "errors of proper motions need the epochs of the matches",
            do="give a column 'epoch', or leave out the errors of motions",
        )
    levers, variances = errors.levers(code, matches.epoch), errors.variances
    _require_contained(matches, code, errors)
    stars, order = prepare(solution.model, matches)
    used = solution.uses(matches)[order]
    sums = MatchesByStar.weighted(stars, code[order], list(levers[..., order]), used.astype(float))
    cov, mean = np.asarray(solution.cov, float), np.asarray(solution.mean)
    D = solution.model.n_params if frames else solution.model.n_distortion
    influence = influence_by_group(solution.model, mean, stars.groups, cov, D)
    if errors.correlations is None:
        parts = sums.shared(influence, list(variances), scratch)
        counted = sums.independent(influence, list(variances))
    else:
        parts = sums.shared_correlated(influence, errors, scratch)
        counted = sums.counted(influence, errors.covariances_at(code, matches.epoch)[order])
    if not frames:
        follow = np.linalg.solve(cov[:D, :D], cov[:D]).T
        parts, counted = (follow @ c @ follow.T for c in (parts, counted))
    positions, *motions = ((part + part.T) / 2 for part in parts)
    return StarCovariance(sum(motions, positions), (counted + counted.T) / 2, *motions)


def _require_contained(matches: Matches, code: Int, errors: StarErrors) -> None:
    """Raise InputError if quoted errors are smaller than the catalogue errors, on any direction."""
    if matches.sigma_u is None or matches.sigma_v is None:
        return  # `prepare` refuses these
    if matches.rho_uv is None and errors.correlations is None:
        part = errors.at(code, matches.epoch)
        for axis, quoted in enumerate((matches.sigma_u, matches.sigma_v)):
            _refuse_small(quoted**2 < part[:, axis] * (1 - ROUNDING), "sigma_" + "uv"[axis])
        return
    quoted = matches.covariances()
    least = np.linalg.eigvalsh(quoted - errors.covariances_at(code, matches.epoch))[:, 0]
    _refuse_small(least < -ROUNDING * np.einsum("naa->n", quoted), "sigma_u, sigma_v, rho_uv")


def _refuse_small(small: Bool, where: str) -> None:
    if small.any():
        raise InputError(
            f"the quoted errors of {int(small.sum())} matches are smaller than the error of "
            "their star in the catalogue",
            where=where,
            do="add the catalogue's errors to them",
        )


@dataclass(frozen=True, eq=False)
class StarInfluence:
    """Catalogue errors and their effect on the polynomials and the drift of a solution."""

    errors: StarErrors
    codes: Int  # codes (k,) of the stars that affect the solution, ascending
    # derivatives (levers, 2, k, n_distortion) of the parameters with respect to the errors of these
    # stars in u and v
    by: Float

    def with_solution(self, star: Int, epoch: Float | None) -> Float:
        """Covariance (n, 2, n_distortion) of catalogue errors with the errors of the parameters.

        `star` (n,) are star codes and `epoch` (n,) the dates in decimal years, or None.
        """
        out = np.zeros((len(star), 2, self.by.shape[-1]))
        if not len(self.codes):
            return out
        at = np.minimum(np.searchsorted(self.codes, star), len(self.codes) - 1)
        common = np.flatnonzero(self.codes[at] == star)
        star, at = star[common], at[common]
        levers = self.errors.levers(star, None if epoch is None else epoch[common])
        by = self.by[: len(levers)][:, :, at]
        if self.errors.correlations is not None:
            covariances = self.errors.covariances(star, len(levers))
            out[common] = np.einsum("lan,nlamb,mbnd->nad", levers, covariances, by, optimize=True)
            return out
        variances = self.errors.variances[: len(levers), star]
        out[common] = np.einsum("lan,lna,land->nad", levers, variances, by)
        return out


@one_thread
def star_influence(
    fit: LinearFit, matches: Matches, errors: StarErrors, codes: Int
) -> StarInfluence:
    """Compute the effect of the catalogue errors of the stars `codes` (k,), ascending, on a fit.

    The fit must not have additional weight in the corners.  `matches` are the matches of the fit,
    with errors and star codes.
    """
    code = matches.column("star")
    model, D = fit.model, fit.model.n_distortion
    by = np.zeros((errors.n_levers, 2, len(codes), D))
    wanted = np.isin(code, codes) & fit.uses(matches)
    if not wanted.any():
        return StarInfluence(errors, codes, by)
    stars, order = prepare(model, matches.select(wanted))
    star = code[wanted][order]
    epoch = None if matches.epoch is None else matches.epoch[wanted][order]
    levers = list(errors.levers(star, epoch))
    sums = MatchesByStar.weighted(stars, np.searchsorted(codes, star), levers)
    influence = influence_by_group(model, fit.mean, stars.groups, fit.cov, D)
    by[: len(levers)] = sums.each(influence, 0, len(codes))
    return StarInfluence(errors, codes, by)


# -- sums over the matches of each star, for the effect of errors common to all of them ------------


def influence_by_group(
    model: DistortionModel, theta: Float, groups: Groups, cov: Float | None, D: int
) -> list[Float]:
    """Matrices (2, K, D) of each group that map weighted basis functions to D parameters.

    If `cov` is given, the results are changes of the first D parameters; otherwise gradients with
    respect to them.
    """
    out = []
    for columns, d in model.effective_jacobian(theta, groups):
        if cov is not None:
            out.append(d @ cov[columns, :D])
            continue
        included = columns < D
        gradient = np.zeros((*d.shape[:2], D))
        gradient[:, :, columns[included]] = d[:, :, included]
        out.append(gradient)
    return out


def _summed(sums: Float, covariances: Float) -> Float:
    """Sum (D, D) over stars of products of sums (n, m, D) with covariances (n, m, m)."""
    flat = sums.reshape(-1, sums.shape[2])
    return np.asarray(flat.T @ (covariances @ sums).reshape(flat.shape))


@dataclass(frozen=True, eq=False)
class MatchesByStar:
    """Matches sorted by group, and by star within each group."""

    starts: Int  # first match (G + 1,) of each group
    code: Int  # star (N,) of each match
    phi: list[Float]  # basis functions (n_g, K) of each group
    weight: Float  # weights (2, N) of both axes
    # derivatives (2, N) of the match's position along u and v with respect to each error of the
    # star; see `StarErrors.levers`
    levers: list[Float]
    order: Int  # index (N,) of each match in the stars that it was taken from
    cross: Float | None = None  # off-diagonal weight (N,) between u and v

    @classmethod
    def of(
        cls,
        stars: Stars,
        code: Int,
        weight: Float,
        levers: list[Float],
        cross: Float | None = None,
    ) -> MatchesByStar:
        """Sort matches by group and star.

        The matches are in the order of `stars`.  `code` (N,) are their star codes; see the class
        for `weight`, `levers` and `cross`; levers of shape (N,) are those of both axes.
        """
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
        return cls(
            stars.starts,
            code[order],
            phi,
            weight[:, order],
            [np.broadcast_to(lever, weight.shape)[:, order] for lever in levers],
            order,
            None if cross is None else cross[order],
        )

    @classmethod
    def weighted(
        cls, stars: Stars, code: Int, levers: list[Float], used: Float | float = 1.0
    ) -> MatchesByStar:
        """Sums with weights `used` (N,) times the inverse covariances of the matches."""
        if not stars.is_correlated:
            return cls.of(stars, code, np.stack([used / stars.var_u, used / stars.var_v]), levers)
        uu, uv, vv = stars.matrices_off_axes(used / stars.var_u, 0.0, used / stars.var_v)
        return cls.of(stars, code, np.stack([uu, vv]), levers, uv)

    def each(self, influence: list[Float], first: int, end: int) -> Float:
        """Sums (levers, 2, end - first, D) for the stars from `first` to `end`, by lever and axis.

        `influence` is the result of `influence_by_group`.
        """
        out = np.zeros((len(self.levers), 2, end - first, influence[0].shape[2]))
        for g, phi in enumerate(self.phi):
            a = int(self.starts[g])
            code = self.code[a : self.starts[g + 1]]
            lo, hi = np.searchsorted(code, [first, end])
            if lo == hi:
                continue
            rows, at = slice(a + lo, a + hi), code[lo:hi] - first
            new = np.flatnonzero(np.diff(at, prepend=-1))  # a star may occur twice in a group
            repeated = len(new) < len(at)
            for axis in (0, 1):
                pull = (phi[lo:hi] * self.weight[axis, rows, None]) @ influence[g][axis]
                if self.cross is not None:
                    pull += (phi[lo:hi] * self.cross[rows, None]) @ influence[g][1 - axis]
                for c, lever in enumerate(self.levers):
                    # the first lever is 1
                    moved = pull if c == 0 else pull * lever[axis, rows, None]
                    if repeated:
                        moved = np.add.reduceat(moved, new, axis=0)
                    out[c, axis, at[new]] += moved
        return out

    def shared(
        self, influence: list[Float], variances: list[Float], scratch: int = SCRATCH
    ) -> Float:
        """Covariances (levers, D, D) from errors with variances (n_stars, 2) common to a star.

        `influence` is the result of `influence_by_group`.  Stars are processed in chunks whose sums
        take at most `scratch` bytes.
        """
        D, n_stars = influence[0].shape[2], len(variances[0])
        out = np.zeros((len(variances), D, D))
        step = max(1, scratch // (16 * D * len(variances)))
        for first in range(0, n_stars, step):
            sums = self.each(influence, first, min(first + step, n_stars))
            for c, variance in enumerate(variances):
                for axis in (0, 1):
                    part = sums[c, axis]
                    part *= np.sqrt(variance[first : first + step, axis])[:, None]
                    out[c] += part.T @ part
        return out

    def shared_correlated(
        self, influence: list[Float], errors: StarErrors, scratch: int = SCRATCH
    ) -> Float:
        """Covariances (1 or 2, D, D) from correlated errors that the matches of a star share.

        The second is that of the motions, if they have errors, and of what positions and parallaxes
        have in common with them: the first is that of the positions at the date when both are
        uncorrelated, and of the parallaxes.  Stars are processed in chunks, as in `shared`.
        """
        D, n_stars, n_levers = influence[0].shape[2], len(errors.position), len(self.levers)
        out = np.zeros((min(n_levers, 2), D, D))
        still, moving = np.r_[0:2, 4 : 2 * n_levers], np.arange(2, 4)
        step = max(1, scratch // (32 * D * n_levers))
        for first in range(0, n_stars, step):
            codes = np.arange(first, min(first + step, n_stars))
            sums = self.each(influence, first, first + len(codes))
            flat = np.moveaxis(sums, 2, 0).reshape(len(codes), 2 * n_levers, D)
            total = errors.covariances(codes, n_levers).reshape(-1, 2 * n_levers, 2 * n_levers)
            if n_levers == 1:
                out[0] += _summed(flat, total)
                continue
            mixed = total[:, still[:, None], moving]
            motions = total[:, moving[:, None], moving]
            gain = mixed @ np.linalg.pinv(motions, hermitian=True)
            rest = total[:, still[:, None], still] - gain @ np.swapaxes(mixed, 1, 2)
            out[0] += _summed(flat[:, still], rest)
            out[1] += _summed(flat, total)
        out[1:] -= out[0]
        return out

    def counted(self, influence: list[Float], covariances: Float) -> Float:
        """Covariance (D, D) from errors of the matches with covariances (N, 2, 2), if independent.

        `covariances` are in the order of the stars that the sums were made of.
        """
        D = influence[0].shape[2]
        out = np.zeros((D, D))
        for g, phi in enumerate(self.phi):
            rows = slice(self.starts[g], self.starts[g + 1])
            W = np.empty((len(phi), 2, 2))
            W[:, 0, 0], W[:, 1, 1] = self.weight[:, rows]
            W[:, 0, 1] = W[:, 1, 0] = 0.0 if self.cross is None else self.cross[rows]
            products = W @ covariances[self.order[rows]] @ W
            for a, b in ((0, 0), (0, 1), (1, 0), (1, 1)):
                moment = (phi * products[:, a, b, None]).T @ phi
                out += influence[g][a].T @ moment @ influence[g][b]
        return out

    def independent(self, influence: list[Float], variances: list[Float]) -> Float:
        """Covariance (D, D) from the same errors if they were independent between matches.

        `influence` has one array per group, and `variances` one array (S, 2) per lever.
        """
        D = influence[0].shape[2]
        out = np.zeros((D, D))
        for g, phi in enumerate(self.phi):
            rows = slice(self.starts[g], self.starts[g + 1])
            variance = [
                sum(
                    lever[axis, rows] ** 2 * v[self.code[rows], axis]
                    for lever, v in zip(self.levers, variances, strict=True)
                )
                for axis in (0, 1)
            ]
            for axis_a, axis_b, weight in self._products(rows, variance):
                moment = (phi * weight[:, None]).T @ phi
                out += influence[g][axis_a].T @ moment @ influence[g][axis_b]
        return out

    def _products(self, rows: slice, variance: list[Float]) -> Iterator[tuple[int, int, Float]]:
        """Yield pairs of axes with the sums (n,) of variance times both weights over the axes."""
        u, v = self.weight[:, rows]
        if self.cross is None:
            yield 0, 0, u**2 * variance[0]
            yield 1, 1, v**2 * variance[1]
            return
        cross = self.cross[rows]
        yield 0, 0, u**2 * variance[0] + cross**2 * variance[1]
        yield 1, 1, cross**2 * variance[0] + v**2 * variance[1]
        mixed = cross * (u * variance[0] + v * variance[1])
        yield 0, 1, mixed
        yield 1, 0, mixed
