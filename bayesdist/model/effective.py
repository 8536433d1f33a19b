"""Effective coefficients: a chip of an exposure at an epoch as one polynomial of the pixels.

Fits, samplers and predictions use a model through the map from theta to effective coefficients, and
its derivative, alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

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
from bayesdist.model.grouping import Groups
from bayesdist.model.layout import ParameterLayout
from bayesdist.model.timedep import TimeDependence
from bayesdist.utils.arrays import Float, Int


@dataclass(frozen=True)
class EffectiveCoefficients(ParameterLayout):
    """Effective coefficients of groups of stars, and their derivatives."""

    def polynomials(self, theta: ArrayLike, chip: Int, epoch: Float) -> Float:
        """Legendre coefficients of w, before the exposure frame.

        `theta`: (..., n_params). `chip` (G,): chip codes. `epoch`: (G,). Result: (..., G, 2, K).
        """
        theta = np.asarray(theta, float)
        K = self.n_terms
        poly = theta[..., : self.n_polynomial].reshape(*theta.shape[:-1], len(self.chips), 2, K)
        out = poly[..., chip, :, :]
        if self.time is not None:
            for c in np.unique(chip):
                own = chip == c
                d = self._drift(self.time, int(c), epoch[own])
                by_time = theta[..., self.drift_slice(int(c))]
                out[..., own, :, :] += np.einsum("gakm,...m->...gak", d, by_time)
        return out

    def _drift(self, time: TimeDependence, chip: int, epoch: Float) -> Float:
        """Derivatives (G, 2, K, n_tdd) of a chip's polynomial by its tdd parameters at epochs."""
        columns, axes = self.drift_columns
        weights = time.weights(epoch)
        out = np.zeros((len(weights), 2, self.n_terms, len(axes), time.n_values))
        for t, axis in enumerate(axes):
            out[:, axis, :, t] = columns[chip][t][:, None] * weights[:, None, :]
        return out.reshape(len(weights), 2, self.n_terms, self.n_tdd)

    def frame(self, theta: ArrayLike, exposure: int) -> tuple[Float, Float]:
        """Linear part (..., 2, 2) and shift (..., 2) of T_e for an exposure code."""
        return frame_matrix(*self._frame_parameters(np.asarray(theta, float), exposure))

    def _frame_parameters(self, theta: Float, exposure: int | Int) -> tuple[str, Float]:
        """Kind of a frame, and all its parameters (..., q), held ones included.

        Of one exposure, or of several (n,) that are all later than the first: then (..., n, q).
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
        """w (..., K) of a chip, less its value at the reference pixel."""
        out = w.copy()
        out[..., 0] -= w @ self.bases[chip_code].monomial_matrix[0]
        return out

    def effective(self, theta: ArrayLike, groups: Groups) -> Float:
        """Effective Legendre coefficients of each group: the whole model as polynomials.

        `theta`: (..., n_params). Result: (..., G, 2, K).
        """
        theta = np.asarray(theta, float)
        out = self.polynomials(theta, groups.chip, groups.epoch)
        o = np.asarray(self.origin)
        for rows in self._alike(groups):
            chip, exposure = int(groups.chip[rows[0]]), groups.exposure[rows]
            own = self.own_slice(chip, int(exposure[0]))
            if not self.has_frame(int(exposure[0])):
                continue
            w = out[..., rows, :, :]
            centre = w @ self.bases[chip].monomial_matrix[0]  # of the chip, before its deviations
            if own.stop:
                L, d = chip_matrix(theta[..., self.frame_columns(exposure)][..., own])
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
        """Indices of groups of one chip: of the first exposure, and of all later ones."""
        kind = 3 * groups.chip + np.sign(groups.exposure)
        return [np.flatnonzero(kind == one) for one in np.unique(kind)]

    def effective_jacobian(self, theta: ArrayLike, groups: Groups) -> list[tuple[Int, Float]]:
        """Derivatives of the effective coefficients.

        `theta` (n_params,): the point at which the frames are linearised. Result: `columns` (m,)
        are the entries of theta that the group depends on (global ones first), `derivative` (2, K,
        m).
        """
        out = [(np.zeros(0, np.int64), np.zeros(0))] * len(groups)
        for rows, columns, derivative in self.jacobian_blocks(theta, groups):
            for g, *one in zip(rows, columns, derivative, strict=True):
                out[g] = tuple(one)
        return out

    def jacobian_blocks(self, theta: ArrayLike, groups: Groups) -> Iterator[tuple[Int, Int, Float]]:
        """Derivatives of the effective coefficients, many groups at a time.

        `theta`, `groups`: as of `effective_jacobian`. Result: `rows` (n,): groups of one chip that
        depend on the same global parameters, and on as many of their exposures; `columns` (n, m):
        entries of theta, global ones first; `derivative` (n, 2, K, m).
        """
        theta = np.asarray(theta, float)
        K, o = self.n_terms, np.asarray(self.origin)
        poly_of = self.polynomials(theta, groups.chip, groups.epoch)
        for rows in self._alike(groups):
            chip, exposure, poly = int(groups.chip[rows[0]]), groups.exposure[rows], poly_of[rows]
            n, first = len(rows), int(exposure[0])
            frame = self._frame_parameters(theta, exposure)
            M, _ = frame_matrix(*frame)
            block, own = self.frame_columns(exposure), self.own_slice(chip, first)
            about_chip = self._about_chip(poly, chip)

            # by the polynomial's coefficients, then by the parameters of the drift
            columns = [np.r_[slice(2 * K * chip, 2 * K * (chip + 1))]]
            direct = np.einsum("nab,kl->nakbl", M, np.eye(K))
            if own.stop:
                L, d = chip_matrix(theta[block][:, own])
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
            columns = [np.broadcast_to(one, (n, len(one))) for one in columns]
            if block.size:
                w = poly.copy()
                if own.stop:
                    w += L @ about_chip
                    w[..., 0] += d
                w[..., 0] -= o
                shift = np.zeros((n, 2, K, 2))
                shift[:, 0, 0, 0] = shift[:, 1, 0, 1] = 1.0
                tangent = frame_tangent(*frame)
                by_frame = np.einsum("nmab,nbk->nakm", tangent, w)
                if own.stop:
                    off = poly @ at_centre - o
                    by_frame[:, :, 0] -= np.einsum("nmab,nb->nam", tangent - turning, off)
                of_all = np.concatenate([shift, by_frame], axis=-1)
                names = frame_names(self.frames)
                fitted = [k for k in self.free_frame_names(first) if k in names]
                columns.append(block[:, : len(fitted)])
                blocks.append(of_all[..., [names.index(k) for k in fitted]])
                if own.stop:
                    shapes, shifts = chip_matrix(np.eye(len(CHIP_DEVIATIONS)))
                    by_own = np.einsum("mab,nbk->nakm", shapes, about_chip)
                    by_own[:, :, 0] += shifts.T
                    columns.append(block[:, own])
                    blocks.append(np.einsum("nab,nbkm->nakm", M, by_own))
            derivative = [one.reshape(n, 2, K, -1) for one in blocks]
            yield rows, np.concatenate(columns, axis=1), np.concatenate(derivative, axis=-1)
