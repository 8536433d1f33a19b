"""Effective coefficients: a chip of an exposure at an epoch as one polynomial of the pixels.

Fits, samplers and predictions use a model through the map from theta to effective coefficients, and
its derivative, alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

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

__all__ = ["effective_coefficients", "effective_derivatives", "frame_of", "polynomials"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]


def polynomials(layout: ParameterLayout, theta: ArrayLike, chip: Int, epoch: Float) -> Float:
    """Legendre coefficients (..., G, 2, K) before the frames, as `DistortionModel.polynomials`."""
    theta = np.asarray(theta, float)
    K = layout.n_terms
    poly = theta[..., : layout.n_polynomial].reshape(*theta.shape[:-1], len(layout.chips), 2, K)
    out = poly[..., chip, :, :]
    if layout.time is not None:
        for g, d in enumerate(_drift(layout, chip, epoch)):
            own = theta[..., layout.drift_slice(int(chip[g]))]
            out[..., g, :, :] += np.einsum("akm,...m->...ak", d, own)
    return out


def _drift(layout: ParameterLayout, chip: Int, epoch: Float) -> list[Float]:
    """Derivative of a group's polynomial by the chip's tdd parameters, (2, K, n_tdd) each."""
    assert layout.time is not None
    columns, axes = layout.drift_columns
    weights = layout.time.weights(epoch)
    out = []
    for c, w in zip(chip, weights, strict=True):
        d = np.zeros((2, layout.n_terms, layout.n_tdd))
        for t, axis in enumerate(axes):
            cols = slice(t * layout.time.n_values, (t + 1) * layout.time.n_values)
            d[axis, :, cols] = np.outer(columns[c][t], w)
        out.append(d)
    return out


def frame_of(layout: ParameterLayout, theta: ArrayLike, exposure: int) -> tuple[Float, Float]:
    """Linear part (..., 2, 2) and shift (..., 2) of T_e for an exposure code."""
    return frame_matrix(*_frame_parameters(layout, np.asarray(theta, float), exposure))


def _frame_parameters(layout: ParameterLayout, theta: Float, exposure: int) -> tuple[str, Float]:
    """Kind of an exposure's frame, and all its parameters (..., q), held ones included."""
    if not layout.has_frame(exposure):
        return "none", theta[..., :0]
    names = frame_names(layout.frames)
    values = theta[..., layout.frame_slice(exposure)]
    if exposure:
        return layout.frames, values[..., : len(names)]
    free = layout.free_frame_names(0)
    out = np.empty((*theta.shape[:-1], len(names)))
    for k, name in enumerate(names):
        out[..., k] = (
            layout.held[RIGID.index(name)] if name in RIGID else values[..., free.index(name)]
        )
    return layout.frames, out


def _about_chip(layout: ParameterLayout, w: Float, chip_code: int) -> Float:
    """w (..., K) of a chip, less its value at the reference pixel."""
    out = w.copy()
    out[..., 0] -= w @ layout.bases[chip_code].monomial_matrix[0]
    return out


def effective_coefficients(layout: ParameterLayout, theta: ArrayLike, groups: Groups) -> Float:
    """Coefficients (..., G, 2, K) of each group, as `DistortionModel.effective`."""
    theta = np.asarray(theta, float)
    out = polynomials(layout, theta, groups.chip, groups.epoch)
    if not layout.n_frame:
        return out
    o = np.asarray(layout.origin)
    if layout.chip_deviations:
        at_centre = np.stack([basis.monomial_matrix[0] for basis in layout.bases])
        centre = np.einsum("...gak,gk->...ga", out, at_centre[groups.chip])
        for g, (c, e) in enumerate(zip(groups.chip, groups.exposure, strict=True)):
            own = layout.own_slice(int(c), int(e))
            if own.stop:
                L, d = chip_matrix(theta[..., layout.frame_slice(int(e))][..., own])
                w = out[..., g, :, :]
                w += np.einsum("...ab,...bk->...ak", L, _about_chip(layout, w, int(c)))
                w[..., 0] += d
    for e in np.unique(groups.exposure):
        if not layout.has_frame(int(e)):
            continue
        M, d = frame_of(layout, theta, int(e))
        sel = groups.exposure == e
        w = out[..., sel, :, :]
        w[..., 0] -= o
        w = np.einsum("...ab,...gbk->...gak", M, w)
        w[..., 0] += (o + d)[..., None, :]
        if layout.chip_deviations:
            R, _ = rigid_part(*_frame_parameters(layout, theta, int(e)))
            back = np.einsum("...ab,...gb->...ga", M - R, centre[..., sel, :] - o)
            w[..., 0] -= back * (groups.chip[sel] > 0)[:, None]
        out[..., sel, :, :] = w
    return out


def effective_derivatives(
    layout: ParameterLayout, theta: ArrayLike, groups: Groups
) -> list[tuple[Int, Float]]:
    """Derivatives of effective coefficients by theta, as `DistortionModel.effective_jacobian`."""
    theta = np.asarray(theta, float)
    K, o = layout.n_terms, np.asarray(layout.origin)
    poly = polynomials(layout, theta, groups.chip, groups.epoch)
    drift = _drift(layout, groups.chip, groups.epoch) if layout.time is not None else None
    out = []
    for g in range(len(groups)):
        chip, e = int(groups.chip[g]), int(groups.exposure[g])
        M, _ = frame_of(layout, theta, e)
        block, own = layout.frame_slice(e), layout.own_slice(chip, e)
        values = theta[block][own]
        L, d = chip_matrix(values) if own.stop else (np.zeros((2, 2)), np.zeros(2))

        # by the polynomial's coefficients, then by the parameters of the drift
        columns = [np.r_[slice(2 * K * chip, 2 * K * (chip + 1))]]
        direct = np.einsum("ab,kl->akbl", M, np.eye(K))
        if own.stop:
            R, turning = rigid_part(*_frame_parameters(layout, theta, e))
            at_centre = layout.bases[chip].monomial_matrix[0]
            direct += np.einsum("ab,kl->akbl", M @ L, _about_chip(layout, np.eye(K), chip).T)
            direct[:, 0] -= np.einsum("ab,l->abl", M - R, at_centre)
        blocks = [direct.reshape(2, K, 2 * K)]
        if drift is not None:
            columns.append(np.r_[layout.drift_slice(chip)])
            blocks.append(np.einsum("akbl,blm->akm", direct, drift[g]))
        if block.stop > block.start:
            about_chip = _about_chip(layout, poly[g], chip)
            w = poly[g] + L @ about_chip
            w[:, 0] += d - o
            shift = np.zeros((2, K, 2))
            shift[0, 0, 0] = shift[1, 0, 1] = 1.0
            tangent = frame_tangent(*_frame_parameters(layout, theta, e))
            by_frame = np.einsum("mab,bk->akm", tangent, w)
            if own.stop:
                by_frame[:, 0] -= ((tangent - turning) @ (poly[g] @ at_centre - o)).T
            of_all = np.concatenate([shift, by_frame], axis=2)
            names = frame_names(layout.frames)
            fitted = [n for n in layout.free_frame_names(e) if n in names]
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
