"""Alignment of solutions: similarity transformations, and the changes that frames can absorb.

A similarity transformation shifts, rotates and scales (u, v).  For the complex number u + i v this
is a multiplication and an addition:

    u' + i v' = shift + turn (u + i v)

The transformation is linear in the coefficients of both axes and in their drifts.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.model.basis import PolynomialBasis
from bayesdist.model.distortion import DistortionModel
from bayesdist.model.frames import frame_matrix, frame_names, nearest_frame
from bayesdist.model.timedep import TimeDependence
from bayesdist.utils.arrays import Float


def turned_model(model: DistortionModel) -> DistortionModel:
    """Model that can hold a rotated solution of a model without frames.

    A rotation mixes the axes, so that each drifting term needs a counterpart on the other axis. The
    original drifting terms come first, followed by their counterparts.
    """
    time = model.time
    if time is None:
        return model
    partners = (("v" if axis == "u" else "u", i, j) for axis, i, j in time.terms)
    terms = (*time.terms, *(p for p in partners if p not in time.terms))
    return replace(model, time=TimeDependence(terms, time.epoch0, time.breaks))


def turned(model: DistortionModel, theta: ArrayLike, turn: ArrayLike, shift: ArrayLike) -> Float:
    """Parameters of `turned_model` for the positions shift + turn (u + i v).

    Parameters
    ----------
    model : DistortionModel
        Original model, without frames.
    theta : array_like, shape (..., D)
        Parameters of the original model.
    turn : array_like of complex, shape (...)
        The argument is the rotation from u towards v, the modulus is the scale.
    shift : array_like of complex, shape (...)
        Added to u (real part) and to v (imaginary part).

    Returns
    -------
    ndarray, shape (..., D')
    """
    theta = np.asarray(theta, float)
    turn = np.asarray(turn, complex)[..., None]
    shift = np.asarray(shift, complex)
    new = turned_model(model)
    lead = theta.shape[:-1]
    out = np.zeros((*lead, new.n_params))
    for chip in model.chips:
        u, v = (model.coefficient_slice(chip.number, axis) for axis in (0, 1))
        w = turn * (theta[..., u] + 1j * theta[..., v])
        w[..., 0] += shift  # P_0 P_0 = 1
        out[..., u], out[..., v] = w.real, w.imag
        if model.time is None or new.time is None:
            continue
        values = theta[..., model.tdd_slice(chip.number)]
        values = values.reshape(*lead, len(model.time.terms), model.time.n_values)
        drift = np.zeros((*lead, len(new.time.terms), new.time.n_values))
        for t, (axis, i, j) in enumerate(model.time.terms):
            z = turn * values[..., t, :] * (1.0 if axis == "u" else 1j)
            drift[..., new.time.terms.index(("u", i, j)), :] += z.real
            drift[..., new.time.terms.index(("v", i, j)), :] += z.imag
        out[..., new.tdd_slice(chip.number)] = drift.reshape(*lead, -1)
    return out


# -- changes of the polynomials that exposure frames can absorb and that are therefore ignored -----


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

    `old` and `now` are Legendre coefficients.  The frame is of the kind `model.frames`.
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
