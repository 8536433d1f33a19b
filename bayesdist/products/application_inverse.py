"""A fitted polynomial from the output frame back to the pixels of a chip, with its error.

Newton's method needs no such thing; programs that cannot iterate do, and this says what they lose.
Powers are those of offsets in undistorted pixels: of the output offset from the chip's zero point,
behind the inverse of the linear part there, as in AP and BP of SIP.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesdist.errors import InputError
from bayesdist.model.basis import MAX_ORDER
from bayesdist.products.application import Application
from bayesdist.products.formats.common.coefficients import evaluate
from bayesdist.products.sip_inverse import detector_grid, fit_inverse

__all__ = ["InversePolynomial", "fitted_inverse"]

Float = NDArray[np.float64]
Terms = dict[tuple[int, int], float]


@dataclass(frozen=True, eq=False)
class InversePolynomial:
    """Pixels of one chip as polynomials of the output position.

    Parameters
    ----------
    chip : int
    order : int
    reference_pixel : tuple of float
        Zero point of the chip.
    zero : ndarray, shape (2,)
        Its output position.
    linear : ndarray, shape (2, 2)
        d(output) / d(pixel) there.
    x_terms, y_terms : dict
        From powers (p, q) of the undistorted offsets to what is added to them, pixels.
    closure, rms : float
        Largest and rms distance, over the chip, between a pixel and what the polynomials make of
        its output position, pixels.
    """

    chip: int
    order: int
    reference_pixel: tuple[float, float]
    zero: Float
    linear: Float
    x_terms: Terms
    y_terms: Terms
    closure: float
    rms: float

    def pixels(self, X: ArrayLike, Y: ArrayLike) -> tuple[Float, Float]:
        """Pixels of the whole chip, FITS 1-based, from output positions (N,)."""
        at = np.stack([np.asarray(X, float), np.asarray(Y, float)])
        return _apply(at, self.reference_pixel, self.zero, self.linear, self.x_terms, self.y_terms)


def fitted_inverse(
    application: Application, chip: int, order: int | None = None
) -> InversePolynomial:
    """Fit the inverse of one chip over its whole area.

    Parameters
    ----------
    application : Application
    chip : int
    order : int, optional
        One above that of the calibration by default, and at most 9.

    Returns
    -------
    InversePolynomial

    Raises
    ------
    InputError
        For an unknown chip, an order outside 1 to 9, or a chip that is folded onto itself.
    """
    whole = Application(application.chips, application.frame)
    calibration = whole.calibration(chip)
    basis = calibration.basis
    if order is None:
        order = min(basis.order + 1, MAX_ORDER)
    if not 1 <= order <= MAX_ORDER:
        raise InputError(
            f"the order of the inverse is {order}",
            where="order",
            do=f"choose one from 1 to {MAX_ORDER}",
        )
    x0, y0 = basis.reference_pixel
    at_zero = whole.forward([x0], [y0], chip=chip)
    zero = np.array([at_zero.x[0], at_zero.y[0]])
    gradient = basis.gradient([x0], [y0])
    linear = whole.frame.pixels_per_unit * np.concatenate(
        [calibration.coefficients @ g.T for g in gradient], axis=1
    )

    def undistorted(x: Float, y: Float) -> tuple[Float, Float]:
        at = whole.forward(x, y, chip=chip)
        U, V = np.linalg.solve(linear, np.stack([at.x, at.y]) - zero[:, None])
        return U, V

    x_terms, y_terms = fit_inverse(undistorted, (x0, y0), basis.size, order)
    x, y = detector_grid(basis.size)
    at = whole.forward(x, y, chip=chip)
    back = _apply(np.stack([at.x, at.y]), (x0, y0), zero, linear, x_terms, y_terms)
    miss = np.hypot(back[0] - x, back[1] - y)
    return InversePolynomial(
        chip=chip,
        order=order,
        reference_pixel=(x0, y0),
        zero=zero,
        linear=linear,
        x_terms=x_terms,
        y_terms=y_terms,
        closure=float(miss.max()),
        rms=float(np.sqrt(np.mean(miss**2))),
    )


def _apply(
    at: Float,
    reference_pixel: tuple[float, float],
    zero: Float,
    linear: Float,
    x_terms: Terms,
    y_terms: Terms,
) -> tuple[Float, Float]:
    U, V = np.linalg.solve(linear, at - zero.reshape(2, *[1] * (at.ndim - 1)))
    x0, y0 = reference_pixel
    return x0 + U + evaluate(x_terms, U, V), y0 + V + evaluate(y_terms, U, V)
