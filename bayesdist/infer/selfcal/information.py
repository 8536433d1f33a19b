"""Information from other sources than the detections, which fixes free directions.

Every piece is Gaussian in the parameters, linearised at a solution.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.model import DistortionModel

__all__ = ["Information", "frame_information", "linear_part", "pointing_information", "tie"]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Information:
    """log p = -d^T P d / 2 + r^T d with d = theta - reference.

    Parameters
    ----------
    reference : ndarray, shape (D,)
        Near the solution, so that no digits are lost.
    precision : ndarray, shape (D, D)
        P.
    right : ndarray, shape (D,)
        r.
    """

    reference: Float
    precision: Float
    right: Float

    @classmethod
    def none(cls, reference: Float) -> Information:
        """Information without any content."""
        D = len(reference)
        return cls(reference, np.zeros((D, D)), np.zeros(D))

    def __add__(self, other: Information) -> Information:
        """Sum of two independent pieces."""
        shift = self.reference - other.reference
        return Information(
            self.reference,
            self.precision + other.precision,
            self.right + other.right - other.precision @ shift,
        )

    def pull(self, theta: Float) -> Float:
        """Gradient (D,)."""
        return np.asarray(self.right - self.precision @ (theta - self.reference))

    def log_density(self, theta: Float) -> Float:
        """Log density of parameter vectors (..., D), up to a constant."""
        d = theta - self.reference
        return np.asarray(d @ self.right - 0.5 * np.einsum("...d,...d->...", d @ self.precision, d))


def tie(reference: Float, row: Float, value: float, sigma: float) -> Information:
    """Information of one measured linear combination of the parameters.

    Parameters
    ----------
    reference : ndarray, shape (D,)
    row : ndarray, shape (D,)
    value : float
        Measured `row @ (theta - reference)`.
    sigma : float
    """
    return Information(reference, np.outer(row, row) / sigma**2, row * value / sigma**2)


def pointing_information(
    model: DistortionModel,
    theta: Float,
    offsets: Float,
    sigma: Float,
    *,
    group: NDArray[np.int64] | None = None,
    pixels: Sequence[tuple[int, float, float]] | None = None,
) -> Information:
    """Information of commanded offsets: sky positions of the first chip's reference pixel.

    The pointings of a group of exposures have one unknown origin and independent errors.

    Parameters
    ----------
    model : DistortionModel
    theta : ndarray, shape (D,)
        At which it is linearised.
    offsets : ndarray, shape (E, 2)
        Along u and v; NaN where there is none.
    sigma : ndarray, shape (E,)
        Error of each on one axis.
    group : ndarray of int, shape (E,), optional
        Exposures with the same guide stars; all of them by default.
    pixels : sequence of (int, float, float), optional
        Chip number, x and y of some pixels: their mean position is pointed, in place of the
        reference pixel.
    """
    E, first = len(model.exposures), model.chips[0]
    pixels = pixels or [(first.number, *first.reference_pixel)]
    rows, places = np.zeros((E, 2, model.n_params)), np.zeros((E, 2))
    for chip, x, y in pixels:
        at: dict[str, Any] = {"exposure": np.arange(E), "chip": chip}
        if model.time is not None:
            at["epoch"] = np.full(E, model.time.epoch0[0])
        rows += model.jacobian(theta, np.full(E, x), np.full(E, y), **at) / len(pixels)
        places += model.predict(theta, np.full(E, x), np.full(E, y), **at) / len(pixels)
    precision, right = np.zeros((model.n_params,) * 2), np.zeros(model.n_params)
    known = np.isfinite(offsets).all(axis=1)
    group = np.zeros(E, np.int64) if group is None else group
    for one in np.unique(group[known]):
        here = np.flatnonzero(known & (group == one))
        weight = np.diag(sigma[here] ** -2.0)
        mean = weight.sum(axis=1)
        weight -= np.outer(mean, mean) / mean.sum()  # the origin is unknown
        for axis in range(2):
            J = rows[here, axis]
            precision += J.T @ weight @ J
            right += J.T @ weight @ (offsets[here, axis] - places[here, axis])
    return Information(np.array(theta, float), precision, right)


def frame_information(
    model: DistortionModel, theta: Float, name: str, values: Float, sigma: float
) -> Information:
    """Information on one property of the exposures' frames ('rotation', 'scale').

    Commanded rolls, each with its error, or scales that scatter about one; the zero point that all
    share stays free.  `values` (E,) are NaN where there is none; the first exposure's is that of
    the polynomials.
    """
    known = np.flatnonzero(np.isfinite(values))
    rows, now = np.zeros((len(known), model.n_params)), np.zeros(len(known))
    for r, e in enumerate(known):
        names = model.free_frame_names(int(e))
        if name in names:
            at = model.frame_slice(int(e)).start + names.index(name)
            rows[r, at], now[r] = 1.0, theta[at]
    weight = (np.eye(len(known)) - 1.0 / len(known)) / sigma**2
    right = rows.T @ weight @ (values[known] - now)
    return Information(np.array(theta, float), rows.T @ weight @ rows, right)


def linear_part(model: DistortionModel, chip: int | None = None) -> Float:
    """Rows (2, 2, D): derivatives of u and v by x and y at a chip's reference pixel."""
    basis = model.basis(chip)
    by = basis.monomial_matrix[1:3]
    out = np.zeros((2, 2, model.n_params))
    for axis in range(2):
        out[axis, :, model.coefficient_slice(chip, axis)] = by
    return out
