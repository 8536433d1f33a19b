"""Sums over the matches of each star, for the effect of errors common to all of them.

For star s with matches i, the sums are

    G_s = sum_i a_i J_i^T W_i

with weights W and derivatives J of the positions with respect to the parameters.  a_i is the
derivative of the match's position with respect to the error: 1 for a position, t - t0 for a proper
motion.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bayesdist.infer.stars.stars import Stars
from bayesdist.model import DistortionModel, Groups
from bayesdist.utils.arrays import Float, Int

SCRATCH = 64_000_000  # bytes of sums that are computed at a time


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


@dataclass(frozen=True, eq=False)
class StarSums:
    """Matches sorted by group, and by star within each group."""

    starts: Int  # first match (G + 1,) of each group
    code: Int  # star (N,) of each match
    phi: list[Float]  # basis functions (n_g, K) of each group
    weight: Float  # weights (2, N) of both axes
    # derivatives (N,) of the match's position with respect to an error of the star: 1 for its
    # position and, if proper motions have errors, years
    levers: list[Float]
    cross: Float | None = None  # off-diagonal weight (N,) between u and v

    @classmethod
    def of(
        cls,
        stars: Stars,
        code: Int,
        weight: Float,
        levers: list[Float],
        cross: Float | None = None,
    ) -> StarSums:
        """Sort matches, given in the order of `stars`, with their star codes (N,)."""
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
            [lever[order] for lever in levers],
            None if cross is None else cross[order],
        )

    def each(self, influence: list[Float], first: int, end: int) -> Float:
        """Sums (levers, 2, end - first, D) of the stars first..end, for each lever and axis."""
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
                    moved = pull if c == 0 else pull * lever[rows, None]  # the first lever is 1
                    if repeated:
                        moved = np.add.reduceat(moved, new, axis=0)
                    out[c, axis, at[new]] += moved
        return out

    def shared(self, influence: list[Float], variances: list[Float]) -> Float:
        """Covariances (levers, D, D) from errors with variances (n_stars, 2) common to a star."""
        D, n_stars = influence[0].shape[2], len(variances[0])
        out = np.zeros((len(variances), D, D))
        step = max(1, SCRATCH // (16 * D * len(variances)))
        for first in range(0, n_stars, step):
            sums = self.each(influence, first, min(first + step, n_stars))
            for c, variance in enumerate(variances):
                for axis in (0, 1):
                    part = sums[c, axis]
                    part *= np.sqrt(variance[first : first + step, axis])[:, None]
                    out[c] += part.T @ part
        return out

    def independent(self, influence: list[Float], variances: list[Float]) -> Float:
        """Covariance (D, D) from the same errors if they were independent between matches."""
        D = influence[0].shape[2]
        out = np.zeros((D, D))
        for g, phi in enumerate(self.phi):
            rows = slice(self.starts[g], self.starts[g + 1])
            variance = [
                sum(
                    lever[rows] ** 2 * v[self.code[rows], axis]
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
