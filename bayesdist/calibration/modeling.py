"""Models of astropy.modeling for a chip: from pixels to a plane or the sky, and back.

    pixel -> look-up tables -> offset from the reference pixel -> two Polynomial2D -> plane

Pixels are 0-based, as in astropy and gwcs.  In distortion reference files the plane is rotated to
V2, V3 and shifted to the position of the aperture; on the sky it is a tangent plane.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from astropy.modeling import Model, models

from bayesdist.calibration.chip_map import ChipMap, Monomials
from bayesdist.calibration.inverse import ExplicitInverse, Terms, fitted_inverse
from bayesdist.calibration.plane import SkyPlacement
from bayesdist.errors import InputError
from bayesdist.model import LookupTable
from bayesdist.utils.arrays import Float

# fixed-point iteration that inverts tables: error in pixels to be reached, and maximum number of
# steps; each step multiplies the error by at most the largest slope of the table
_LEFT, _MOST_STEPS = 1e-10, 12
_SPLIT = models.Mapping((0, 1, 0, 1))


def plane_model(chip: ChipMap, inverse_order: int | None = None) -> Model:
    """Model from 0-based pixels to the plane (u, v) of a chip, with an inverse.

    Parameters
    ----------
    chip : ChipMap
    inverse_order : int, optional
        Order of a polynomial inverse that is fitted over the chip, so that ASDF can write all parts
        of the model.  By default the inverse uses Newton's method.

    Returns
    -------
    astropy.modeling.Model

    Raises
    ------
    InputError
        If a polynomial inverse is requested for a chip with look-up tables `after` the polynomial,
        or cannot be fitted (see `fitted_inverse`).
    """
    x, y = chip.basis.reference_pixel
    poly = chip.monomials()
    offset = _pair(models.Shift, 1.0 - x, 1.0 - y)
    first, second = (dict(zip(poly.terms, c, strict=True)) for c in poly.values)
    u, v = (offset | _polynomial(terms) for terms in (first, second))
    for table in chip.after:
        du, dv = _shifts(table)
        u, v = u + du, v + dv
    model = _chain([*(_corrected(table) for table in chip.before), _SPLIT, u & v])
    if inverse_order is None:
        model.inverse = PlaneToPixel(chip)
        return model
    if chip.after:
        raise InputError(
            "has look-up tables after its polynomial, which a fitted inverse cannot include",
            where=chip.name,
            do="omit inverse_order",
        )
    back = fitted_inverse(replace(chip, before=()), inverse_order)
    model.inverse = inverse_transform(back, np.eye(2), (0.0, 0.0), chip.before)
    return model


def sky_model(plane: Model, placement: SkyPlacement) -> Model:
    """Model from 0-based pixels to right ascension and declination in degrees.

    `plane` is the model from pixels to the plane, and `placement` the position of the plane on the
    sky.
    """
    ra, dec = placement.point
    return _chain(
        [
            plane,
            models.AffineTransformation2D(placement.matrix / 3600.0, [0.0, 0.0]),
            models.Pix2Sky_TAN(),
            models.RotateNative2Celestial(ra, dec, 180.0),
        ]
    )


class PlaneToPixel(Model):
    """Model from the plane (u, v) of a chip to its 0-based pixels, by Newton's method.

    Parameters
    ----------
    chip : ChipMap
        Map to be inverted, including its look-up tables.
    """

    n_inputs = 2
    n_outputs = 2

    def __init__(self, chip: ChipMap, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.inputs, self.outputs = ("u", "v"), ("x", "y")
        self.chip = chip

    def evaluate(self, u: Float, v: Float) -> tuple[Float, Float]:
        """0-based pixels of positions of any shape; NaN if there is no such pixel."""
        u, v = np.broadcast_arrays(np.asarray(u, float), np.asarray(v, float))
        x, y = self.chip.unfolded_pixels(np.stack([u.ravel(), v.ravel()])) - 1.0
        return x.reshape(u.shape), y.reshape(u.shape)

    # without these properties astropy would take the annotations of `evaluate` for units
    @property
    def input_units(self) -> None:
        """None: the inputs are numbers."""

    @property
    def return_units(self) -> None:
        """None: the outputs are numbers."""

    @property
    def inverse(self) -> Model:
        """Model from pixels to the plane."""
        return plane_model(self.chip)


# -- distortion reference files -------------------------------------------------------------------


def forward_transform(
    poly: Monomials, matrix: Float, v2v3: tuple[float, float], tables: Sequence[LookupTable] = ()
) -> Model:
    """Model from 0-based pixels to V2, V3 in arcsec, without an inverse.

    Parameters
    ----------
    poly : Monomials
        Polynomials from FITS 1-based pixels to the plane in arcsec.
    matrix : ndarray, shape (2, 2)
        Rotation from the plane to V2, V3.
    v2v3 : tuple of float
        V2, V3 of the zero point of the plane, arcsec.
    tables : sequence of LookupTable
        Look-up tables that are applied in this order before the polynomials.
    """
    x, y = poly.basis.reference_pixel
    parts = [_corrected(table) for table in tables]
    parts += [
        _pair(models.Shift, 1.0 - x, 1.0 - y),
        _SPLIT,
        _polynomials(*(dict(zip(poly.terms, c, strict=True)) for c in poly.values)),
        models.AffineTransformation2D(matrix, [0.0, 0.0]),
        _pair(models.Shift, *v2v3),
    ]
    return _chain(parts)


def inverse_transform(
    back: ExplicitInverse, matrix: Float, v2v3: tuple[float, float], tables: Sequence[LookupTable]
) -> Model:
    """Model from V2, V3 in arcsec to 0-based pixels; see `forward_transform`."""
    x, y = back.reference_pixel
    linear = np.eye(2) if back.linear is None else back.linear
    terms = [dict(back.x_terms), dict(back.y_terms)]
    for axis, power in enumerate(((1, 0), (0, 1))):
        terms[axis][power] = terms[axis].get(power, 0.0) + 1.0
    parts = [
        _pair(models.Shift, -v2v3[0], -v2v3[1]),
        models.AffineTransformation2D(np.linalg.inv(matrix), [0.0, 0.0]),
        _pair(models.Shift, -back.zero[0], -back.zero[1]),
        models.AffineTransformation2D(np.linalg.inv(linear), [0.0, 0.0]),
        _SPLIT,
        _polynomials(*terms),
        _pair(models.Shift, x - 1.0, y - 1.0),
    ]
    parts += [_uncorrected(table) for table in reversed(tables)]
    return _chain(parts)


def _chain(parts: Sequence[Model]) -> Model:
    combined, *following = parts
    for part in following:
        combined = combined | part
    return combined


def _pair(kind: type[Model], a: float, b: float) -> Model:
    return kind(float(a)) & kind(float(b))


def _polynomials(x_terms: Terms, y_terms: Terms) -> Model:
    """Parallel combination of two polynomials."""
    return _polynomial(x_terms) & _polynomial(y_terms)


def _polynomial(terms: Terms) -> Model:
    order = max(i + j for i, j in terms)
    return models.Polynomial2D(order, **{f"c{i}_{j}": float(c) for (i, j), c in terms.items()})


def _shifts(table: LookupTable) -> tuple[Model, Model]:
    """Models of the shifts along x and y as functions of 0-based pixels.

    `Tabular2D` extrapolates linearly beyond its outermost nodes, whereas look-up tables are
    constant there.  The outermost nodes are therefore repeated once on all sides.
    """
    x, y = table.nodes()
    points = tuple(
        np.concatenate([[n[0] - step], n, [n[-1] + step]]) - 1.0
        for n, step in zip((x, y), table.step, strict=True)
    )
    values = np.pad(table.values, ((0, 0), (1, 1), (1, 1)), mode="edge")
    along_x, along_y = (
        models.Tabular2D(
            points=points,
            lookup_table=np.ascontiguousarray(plane.T),
            method="linear",
            bounds_error=False,
            fill_value=None,
        )
        for plane in values
    )
    return along_x, along_y


def _corrected(table: LookupTable) -> Model:
    """Model that applies the shifts of a table to pixels."""
    dx, dy = _shifts(table)
    first, second = (models.Mapping((axis,), n_inputs=2) for axis in (0, 1))
    return _SPLIT | (first + dx) & (second + dy)


def _uncorrected(table: LookupTable) -> Model:
    """Model that removes the shifts of a table from pixels, by fixed-point iteration.

    It solves x = x' - D(x) for x; the number of steps depends on the slope of the table.
    """
    dx, dy = _shifts(table)
    slope = max(
        np.abs(np.diff(table.values, axis=2)).max() / table.step[0],
        np.abs(np.diff(table.values, axis=1)).max() / table.step[1],
    )
    largest = float(np.abs(table.values).max())
    steps = 1
    while largest * (2 * slope) ** steps > _LEFT and steps < _MOST_STEPS:
        steps += 1
    # (x', y', x, y) -> (x', y', x' - Dx(x, y), y' - Dy(x, y))
    at = models.Mapping((1, 2), n_inputs=3)
    target = models.Mapping((0,), n_inputs=3)
    nearer = (target - (at | dx)) & (target - (at | dy))
    step = models.Mapping((0, 1, 0, 2, 3, 1, 2, 3)) | models.Identity(2) & nearer
    return _chain([_SPLIT, *[step] * steps, models.Mapping((2, 3), n_inputs=4)])
