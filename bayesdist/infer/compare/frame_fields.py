"""Changes of the polynomials that exposure frames can absorb and that are therefore ignored."""

from __future__ import annotations

import numpy as np

from bayesdist.model import DistortionModel, PolynomialBasis
from bayesdist.model.frames import frame_matrix, frame_names, nearest_frame
from bayesdist.utils.arrays import Float


def term_squares(basis: PolynomialBasis) -> Float:
    """Mean square (2 K,) over the detector of each basis function, for u and then for v."""
    return np.tile(basis.mean_squares, 2)


def mean_squares(model: DistortionModel) -> Float:
    """Mean square (n,) of each basis function over the detector, with chips weighted by area."""
    area = np.array([chip.size[0] * chip.size[1] for chip in model.chips])
    return np.kron(area / area.sum(), term_squares(model.basis()))


def without(fields: Float, norm: Float) -> Float:
    """Projector (n, n) that removes fields from a polynomial by least squares over the detector.

    `fields` (n, q) are the coefficients of the fields and `norm` (n,) the mean square of each term,
    from `mean_squares`.
    """
    out = np.eye(len(fields))
    if fields.shape[1]:
        weighted = fields * norm[:, None]
        out -= fields @ np.linalg.solve(fields.T @ weighted, weighted.T)
    return out


def frame_between(old: Float, now: Float, model: DistortionModel) -> tuple[Float, Float]:
    """Frame (matrix, shift) that best maps old polynomials (chips, 2, K) to new ones.

    The frame is of the kind `model.frames`.
    """
    if model.frames == "none":
        return np.eye(2), np.zeros(2)
    norm = mean_squares(model).reshape(old.shape)[:, 0]
    o = np.asarray(model.origin)
    constant_term = np.zeros_like(old[:, 0])
    constant_term[:, 0] = 1.0
    shifted = old.copy()
    shifted[:, :, 0] -= o
    A = np.stack([constant_term.ravel(), shifted[:, 0].ravel(), shifted[:, 1].ravel()], axis=1)
    target = now.copy()
    target[:, :, 0] -= o
    B = target.transpose(0, 2, 1).reshape(-1, 2)
    root = np.sqrt(norm.ravel())[:, None]
    affine = np.linalg.lstsq(root * A, root * B)[0]
    return frame_matrix(model.frames, nearest_frame(model.frames, affine[1:].T, affine[0]))


def frame_fields(model: DistortionModel, kind: str, w: Float, origin: Float) -> Float:
    """Derivatives (n, q) of the polynomials w (chips, 2, K) with respect to the frame parameters.

    `kind` is the kind of frame, and `origin` (2,) the centre of its rotation and scaling.
    """
    about = w.copy()
    about[:, :, 0] -= origin
    names = frame_names(kind)
    out = []
    for k, name in enumerate(names):
        if name.startswith("shift"):
            field = np.zeros_like(w)
            field[:, k, 0] = 1.0
        else:
            unit = np.zeros(len(names))
            unit[k] = 1e-6
            # central difference, which cancels the second-order term of rotations
            slope = (frame_matrix(kind, unit)[0] - frame_matrix(kind, -unit)[0]) / 2e-6
            field = np.einsum("ab,cbk->cak", slope, about)
        out.append(field.ravel())
    return np.stack(out, axis=1) if out else np.zeros((model.n_polynomial, 0))
