"""Effective coefficients: a chip of an exposure at an epoch as one polynomial of the pixels.

Fits, samplers and predictions use a model through the map from theta to effective coefficients, and
its derivative, alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.arrays import Float, Int
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
            for g, d in enumerate(self._drift(self.time, chip, epoch)):
                own = theta[..., self.drift_slice(int(chip[g]))]
                out[..., g, :, :] += np.einsum("akm,...m->...ak", d, own)
        return out

    def _drift(self, time: TimeDependence, chip: Int, epoch: Float) -> list[Float]:
        """Derivative of a group's polynomial by the chip's tdd parameters, (2, K, n_tdd) each."""
        columns, axes = self.drift_columns
        weights = time.weights(epoch)
        out = []
        for c, w in zip(chip, weights, strict=True):
            d = np.zeros((2, self.n_terms, self.n_tdd))
            for t, axis in enumerate(axes):
                cols = slice(t * time.n_values, (t + 1) * time.n_values)
                d[axis, :, cols] = np.outer(columns[c][t], w)
            out.append(d)
        return out

    def frame(self, theta: ArrayLike, exposure: int) -> tuple[Float, Float]:
        """Linear part (..., 2, 2) and shift (..., 2) of T_e for an exposure code."""
        return frame_matrix(*self._frame_parameters(np.asarray(theta, float), exposure))

    def _frame_parameters(self, theta: Float, exposure: int) -> tuple[str, Float]:
        """Kind of an exposure's frame, and all its parameters (..., q), held ones included."""
        if not self.has_frame(exposure):
            return "none", theta[..., :0]
        names = frame_names(self.frames)
        values = theta[..., self.frame_slice(exposure)]
        if exposure:
            return self.frames, values[..., : len(names)]
        free = self.free_frame_names(0)
        out = np.empty((*theta.shape[:-1], len(names)))
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
        if not self.n_frame:
            return out
        o = np.asarray(self.origin)
        if self.chip_deviations:
            at_centre = np.stack([basis.monomial_matrix[0] for basis in self.bases])
            centre = np.einsum("...gak,gk->...ga", out, at_centre[groups.chip])
            for g, (c, e) in enumerate(zip(groups.chip, groups.exposure, strict=True)):
                own = self.own_slice(int(c), int(e))
                if own.stop:
                    L, d = chip_matrix(theta[..., self.frame_slice(int(e))][..., own])
                    w = out[..., g, :, :]
                    w += np.einsum("...ab,...bk->...ak", L, self._about_chip(w, int(c)))
                    w[..., 0] += d
        for e in np.unique(groups.exposure):
            if not self.has_frame(int(e)):
                continue
            M, d = self.frame(theta, int(e))
            sel = groups.exposure == e
            w = out[..., sel, :, :]
            w[..., 0] -= o
            w = np.einsum("...ab,...gbk->...gak", M, w)
            w[..., 0] += (o + d)[..., None, :]
            if self.chip_deviations:
                R, _ = rigid_part(*self._frame_parameters(theta, int(e)))
                back = np.einsum("...ab,...gb->...ga", M - R, centre[..., sel, :] - o)
                w[..., 0] -= back * (groups.chip[sel] > 0)[:, None]
            out[..., sel, :, :] = w
        return out

    def effective_jacobian(self, theta: ArrayLike, groups: Groups) -> list[tuple[Int, Float]]:
        """Derivatives of the effective coefficients.

        `theta` (n_params,): the point at which the frames are linearised. Result: `columns` (m,)
        are the entries of theta that the group depends on (global ones first), `derivative` (2, K,
        m).
        """
        theta = np.asarray(theta, float)
        K, o = self.n_terms, np.asarray(self.origin)
        poly = self.polynomials(theta, groups.chip, groups.epoch)
        time = self.time
        drift = None if time is None else self._drift(time, groups.chip, groups.epoch)
        out = []
        for g in range(len(groups)):
            chip, e = int(groups.chip[g]), int(groups.exposure[g])
            M, _ = self.frame(theta, e)
            block, own = self.frame_slice(e), self.own_slice(chip, e)
            values = theta[block][own]
            L, d = chip_matrix(values) if own.stop else (np.zeros((2, 2)), np.zeros(2))

            # by the polynomial's coefficients, then by the parameters of the drift
            columns = [np.r_[slice(2 * K * chip, 2 * K * (chip + 1))]]
            direct = np.einsum("ab,kl->akbl", M, np.eye(K))
            if own.stop:
                R, turning = rigid_part(*self._frame_parameters(theta, e))
                at_centre = self.bases[chip].monomial_matrix[0]
                direct += np.einsum("ab,kl->akbl", M @ L, self._about_chip(np.eye(K), chip).T)
                direct[:, 0] -= np.einsum("ab,l->abl", M - R, at_centre)
            blocks = [direct.reshape(2, K, 2 * K)]
            if drift is not None:
                columns.append(np.r_[self.drift_slice(chip)])
                blocks.append(np.einsum("akbl,blm->akm", direct, drift[g]))
            if block.stop > block.start:
                about_chip = self._about_chip(poly[g], chip)
                w = poly[g] + L @ about_chip
                w[:, 0] += d - o
                shift = np.zeros((2, K, 2))
                shift[0, 0, 0] = shift[1, 0, 1] = 1.0
                tangent = frame_tangent(*self._frame_parameters(theta, e))
                by_frame = np.einsum("mab,bk->akm", tangent, w)
                if own.stop:
                    by_frame[:, 0] -= ((tangent - turning) @ (poly[g] @ at_centre - o)).T
                of_all = np.concatenate([shift, by_frame], axis=2)
                names = frame_names(self.frames)
                fitted = [n for n in self.free_frame_names(e) if n in names]
                columns.append(np.r_[block][: len(fitted)])
                blocks.append(of_all[..., [names.index(n) for n in fitted]])
                if own.stop:
                    shapes, shifts = chip_matrix(np.eye(len(CHIP_DEVIATIONS)))
                    by_own = np.einsum("mab,bk->akm", shapes, about_chip)
                    by_own[:, 0] += shifts.T
                    columns.append(np.r_[block][own])
                    blocks.append(np.einsum("ab,bkm->akm", M, by_own))
            out.append((np.concatenate(columns), np.concatenate(blocks, axis=2)))
        return out
