"""Similarity transformations of a solution: (u, v) are shifted, rotated and scaled.

For the complex number u + i v this is a multiplication and an addition:

    u' + i v' = shift + turn (u + i v)

The transformation is linear in the coefficients of both axes and in their drifts.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.model.distortion import DistortionModel
from bayesdist.model.timedep import TimeDependence
from bayesdist.utils.arrays import Float


def turned_model(model: DistortionModel) -> DistortionModel:
    """Model for the transformed solution of a model without frames.

    A rotation mixes the axes, so that each drifting term needs a counterpart on the other axis.
    The original drifting terms come first, followed by their counterparts.
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
