"""A model whose (u, v) are shifted, rotated and scaled as a whole.

With u + i v as one complex number the change is a multiplication and an addition:

    u' + i v' = shift + turn (u + i v)

It is linear in the polynomials of both axes together, and in their drifting terms.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.model.distortion import DistortionModel
from bayesdist.model.timedep import TimeDependence
from bayesdist.utils.arrays import Float


def turned_model(model: DistortionModel) -> DistortionModel:
    """Structure of a turned model without frames: drifting terms come in pairs of both axes.

    The terms that drifted come first, then their partners on the other axis.
    """
    time = model.time
    if time is None:
        return model
    partners = (("v" if axis == "u" else "u", i, j) for axis, i, j in time.terms)
    terms = (*time.terms, *(p for p in partners if p not in time.terms))
    return replace(model, time=TimeDependence(terms, time.epoch0, time.breaks))


def turned(model: DistortionModel, theta: ArrayLike, turn: ArrayLike, shift: ArrayLike) -> Float:
    """Parameters (..., D') of `turned_model` for shift + turn (u + i v), from those (..., D).

    The argument of `turn` is the rotation from u towards v, its modulus the scale; `shift` is added
    to u (real part) and to v (imaginary part).
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
