"""Effective coefficients: the polynomial of the pixels for one chip, exposure and epoch.

For one chip, exposure and epoch the complete model (polynomial, time dependence, frame) is a single
polynomial of the pixel position.  The data constrain the parameters theta only through these
polynomials.  Fits, samplers and predictions therefore use a model only through the map from theta
to the effective coefficients and the derivatives of this map.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.model.frames import (
    CHIP_DEVIATIONS,
    RIGID,
    chip_matrix,
    frame_matrix,
    frame_names,
    frame_tangent,
    rigid_part,
)
from bayesdist.model.layout import ParameterLayout
from bayesdist.model.timedep import TimeDependence
from bayesdist.utils.arrays import Float, Int


@dataclass(frozen=True)
class EffectiveCoefficients(ParameterLayout):
    """Effective coefficients of groups of stars, and their derivatives."""

    def polynomials(self, theta: ArrayLike, chip: Int, epoch: Float) -> Float:
        """Legendre coefficients of w, the position before the exposure frame is applied.

        Parameters
        ----------
        theta : array_like, shape (..., n_params)
            Parameters of the model.
        chip : ndarray of int, shape (G,)
            Chip codes.
        epoch : ndarray, shape (G,)
            Decimal years.

        Returns
        -------
        ndarray, shape (..., G, 2, K)
        """
        theta = np.asarray(theta, float)
        K = self.n_terms
        poly = theta[..., : self.n_polynomial].reshape(*theta.shape[:-1], len(self.chips), 2, K)
        out = poly[..., chip, :, :]
        if self.time is not None:
            for c in np.unique(chip):
                on_chip = chip == c
                d = self._drift(self.time, int(c), epoch[on_chip])
                drift_values = theta[..., self.drift_slice(int(c))]
                out[..., on_chip, :, :] += np.einsum("gakm,...m->...gak", d, drift_values)
        return out

    def _drift(self, time: TimeDependence, chip: int, epoch: Float) -> Float:
        """Derivatives (G, 2, K, n_tdd) of a chip's coefficients with respect to its drift."""
        columns, axes = self.drift_columns
        weights = time.weights(epoch)
        out = np.zeros((len(weights), 2, self.n_terms, len(axes), time.n_values))
        for t, axis in enumerate(axes):
            out[:, axis, :, t] = columns[chip][t][:, None] * weights[:, None, :]
        return out.reshape(len(weights), 2, self.n_terms, self.n_tdd)

    def frame(self, theta: ArrayLike, exposure: int) -> tuple[Float, Float]:
        """Linear part (..., 2, 2) and shift (..., 2) of the frame T_e of an exposure code."""
        return frame_matrix(*self._frame_parameters(np.asarray(theta, float), exposure))

    def _frame_parameters(self, theta: Float, exposure: int | Int) -> tuple[str, Float]:
        """Kind of a frame and all its parameters (..., q), including those that are held fixed.

        `exposure` is one code, or the codes (n,) of several exposures that do not include the first
        one; in this case the parameters have shape (..., n, q).
        """
        first = int(np.ravel(exposure)[0])
        if not self.has_frame(first):
            return "none", np.zeros((*theta.shape[:-1], *np.shape(exposure), 0))
        names = frame_names(self.frames)
        values = theta[..., self.frame_columns(exposure)]
        if first:
            return self.frames, values[..., : len(names)]
        free = self.free_frame_names(0)
        out = np.empty((*values.shape[:-1], len(names)))
        for k, name in enumerate(names):
            out[..., k] = (
                self.held[RIGID.index(name)] if name in RIGID else values[..., free.index(name)]
            )
        return self.frames, out

    def _about_chip(self, w: Float, chip_code: int) -> Float:
        """Coefficients (..., K) of w minus its value at the reference pixel of the chip."""
        out = w.copy()
        out[..., 0] -= w @ self.bases[chip_code].monomial_matrix[0]
        return out

    def effective(self, theta: ArrayLike, groups: Groups) -> Float:
        """Effective Legendre coefficients of each group.

        Parameters
        ----------
        theta : array_like, shape (..., n_params)
            Parameters of the model.
        groups : Groups

        Returns
        -------
        ndarray, shape (..., G, 2, K)
            In the unit of u and v.
        """
        theta = np.asarray(theta, float)
        out = self.polynomials(theta, groups.chip, groups.epoch)
        o = np.asarray(self.origin)
        for rows in self._alike(groups):
            chip, exposure = int(groups.chip[rows[0]]), groups.exposure[rows]
            deviation = self.own_slice(chip, int(exposure[0]))
            if not self.has_frame(int(exposure[0])):
                continue
            w = out[..., rows, :, :]
            centre = (
                w @ self.bases[chip].monomial_matrix[0]
            )  # reference pixel without chip deviation
            if deviation.stop:
                L, d = chip_matrix(theta[..., self.frame_columns(exposure)][..., deviation])
                w += np.einsum("...ab,...bk->...ak", L, self._about_chip(w, chip))
                w[..., 0] += d
            frame = self._frame_parameters(theta, exposure)
            M, d = frame_matrix(*frame)
            w[..., 0] -= o
            w = np.einsum("...ab,...bk->...ak", M, w)
            w[..., 0] += o + d
            if self.chip_deviations and chip:
                R, _ = rigid_part(*frame)
                w[..., 0] -= np.einsum("...ab,...b->...a", M - R, centre - o)
            out[..., rows, :, :] = w
        return out

    def _alike(self, groups: Groups) -> list[Int]:
        """Indices of the groups of each chip, separately for the first and for later exposures."""
        kind = 3 * groups.chip + np.sign(groups.exposure)
        return [np.flatnonzero(kind == value) for value in np.unique(kind)]

    def effective_jacobian(self, theta: ArrayLike, groups: Groups) -> list[tuple[Int, Float]]:
        """Derivatives of the effective coefficients with respect to the parameters, per group.

        Parameters
        ----------
        theta : array_like, shape (n_params,)
            Point at which the frames are linearised.
        groups : Groups

        Returns
        -------
        list of (ndarray of int, shape (m,); ndarray, shape (2, K, m))
            For each group the entries of theta on which it depends, global parameters first, and
            the derivatives with respect to them.
        """
        out = [(np.zeros(0, np.int64), np.zeros(0))] * len(groups)
        for rows, columns, derivative in self.jacobian_blocks(theta, groups):
            for g, *group_derivative in zip(rows, columns, derivative, strict=True):
                out[g] = tuple(group_derivative)
        return out

    def jacobian_blocks(self, theta: ArrayLike, groups: Groups) -> Iterator[tuple[Int, Int, Float]]:
        """Derivatives of the effective coefficients for many groups at a time.

        Parameters
        ----------
        theta, groups
            See `effective_jacobian`.

        Yields
        ------
        rows : ndarray of int, shape (n,)
            Indices of groups that depend on the same global parameters and on equal numbers of
            frame parameters.
        columns : ndarray of int, shape (n, m)
            Entries of theta on which each group depends, global parameters first.
        derivative : ndarray, shape (n, 2, K, m)
        """
        theta = np.asarray(theta, float)
        K, o = self.n_terms, np.asarray(self.origin)
        poly_of = self.polynomials(theta, groups.chip, groups.epoch)
        for rows in self._alike(groups):
            chip, exposure, poly = int(groups.chip[rows[0]]), groups.exposure[rows], poly_of[rows]
            n, first = len(rows), int(exposure[0])
            frame = self._frame_parameters(theta, exposure)
            M, _ = frame_matrix(*frame)
            block, deviation = self.frame_columns(exposure), self.own_slice(chip, first)
            about_chip = self._about_chip(poly, chip)

            # with respect to the polynomial's coefficients, then to the drift parameters
            columns = [np.r_[slice(2 * K * chip, 2 * K * (chip + 1))]]
            direct = np.einsum("nab,kl->nakbl", M, np.eye(K))
            if deviation.stop:
                L, d = chip_matrix(theta[block][:, deviation])
                R, turning = rigid_part(*frame)
                at_centre = self.bases[chip].monomial_matrix[0]
                direct += np.einsum("nab,kl->nakbl", M @ L, self._about_chip(np.eye(K), chip).T)
                direct[:, :, 0] -= np.einsum("nab,l->nabl", M - R, at_centre)
            direct = direct.reshape(n, 2 * K, 2 * K)
            blocks = [direct]
            if self.time is not None:
                columns.append(np.r_[self.drift_slice(chip)])
                drift = self._drift(self.time, chip, groups.epoch[rows])
                blocks.append(direct @ drift.reshape(n, 2 * K, -1))
            columns = [np.broadcast_to(part, (n, len(part))) for part in columns]
            if block.size:
                w = poly.copy()
                if deviation.stop:
                    w += L @ about_chip
                    w[..., 0] += d
                w[..., 0] -= o
                shift = np.zeros((n, 2, K, 2))
                shift[:, 0, 0, 0] = shift[:, 1, 0, 1] = 1.0
                tangent = frame_tangent(*frame)
                by_frame = np.einsum("nmab,nbk->nakm", tangent, w)
                if deviation.stop:
                    off = poly @ at_centre - o
                    by_frame[:, :, 0] -= np.einsum("nmab,nb->nam", tangent - turning, off)
                by_all_frame = np.concatenate([shift, by_frame], axis=-1)
                names = frame_names(self.frames)
                fitted = [k for k in self.free_frame_names(first) if k in names]
                columns.append(block[:, : len(fitted)])
                blocks.append(by_all_frame[..., [names.index(k) for k in fitted]])
                if deviation.stop:
                    shapes, shifts = chip_matrix(np.eye(len(CHIP_DEVIATIONS)))
                    by_deviation = np.einsum("mab,nbk->nakm", shapes, about_chip)
                    by_deviation[:, :, 0] += shifts.T
                    columns.append(block[:, deviation])
                    blocks.append(np.einsum("nab,nbkm->nakm", M, by_deviation))
            derivative = [part.reshape(n, 2, K, -1) for part in blocks]
            yield rows, np.concatenate(columns, axis=1), np.concatenate(derivative, axis=-1)


# -- groups of stars with the same effective coefficients ------------------------------------------


@dataclass(frozen=True, eq=False)
class Groups:
    """Membership of stars in groups.

    Parameters
    ----------
    index : ndarray of int, shape (N,)
        Group of each star.
    chip, exposure : ndarray of int, shape (G,)
        Chip and exposure of each group, as indices into the model's chips and exposures.
    epoch : ndarray, shape (G,)
        Decimal years; 0 if the model has no time dependence.
    """

    index: Int
    chip: Int
    exposure: Int
    epoch: Float

    def __len__(self) -> int:
        return len(self.chip)

    def same(self, other: Groups) -> bool:
        """True if two sets of groups have equal chips, exposures and epochs."""
        return all(
            np.array_equal(getattr(self, name), getattr(other, name))
            for name in ("chip", "exposure", "epoch")
        )

    def members(self) -> list[Int]:
        """Indices of the stars of each group, in ascending order."""
        if not len(self):
            return []
        order = np.argsort(self.index, kind="stable")
        ends = np.cumsum(np.bincount(self.index, minlength=len(self)))
        return np.split(order, ends[:-1])


def group_by(chip: Int, exposure: Int, epoch: Float) -> Groups:
    """Groups of stars with equal chip, exposure and epoch, sorted by these in this order.

    `chip` and `exposure` are codes and `epoch` is in decimal years, each of shape (N,).
    """
    # stars of a group are usually adjacent, so only the first star of each sequence is sorted
    heads = _starts_of_runs(chip, exposure, epoch)
    chip_of, exposure_of, epoch_of = chip[heads], exposure[heads], epoch[heads]
    order = np.lexsort((epoch_of, exposure_of, chip_of))
    starts = _starts_of_runs(chip_of[order], exposure_of[order], epoch_of[order])
    group_of = np.empty(len(order), np.int64)
    group_of[order] = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(order)))
    first = order[starts]
    return Groups(
        index=np.repeat(group_of, np.diff(heads, append=len(chip))),
        chip=chip_of[first],
        exposure=exposure_of[first],
        epoch=epoch_of[first],
    )


def _starts_of_runs(*columns: Int | Float) -> Int:
    """Indices of the rows that differ from the previous row, including the first row."""
    starts = np.ones(len(columns[0]), bool)
    if len(starts):
        starts[1:] = np.logical_or.reduce([c[1:] != c[:-1] for c in columns])
    return np.flatnonzero(starts)


def merge_groups(a: Groups, b: Groups) -> tuple[Groups, Int, Int]:
    """Union of two sets of groups, in the order of `group_by`.

    Parameters
    ----------
    a, b : Groups

    Returns
    -------
    groups : Groups
        Union of the groups, without members.
    of_a, of_b : ndarray of int, shapes (len(a),) and (len(b),)
        Indices of the groups of `a` and of `b` in the union.
    """
    union = group_by(
        np.concatenate([a.chip, b.chip]),
        np.concatenate([a.exposure, b.exposure]),
        np.concatenate([a.epoch, b.epoch]),
    )
    index = union.index
    return replace(union, index=np.zeros(0, np.int64)), index[: len(a)], index[len(a) :]
