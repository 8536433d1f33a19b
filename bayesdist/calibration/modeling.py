"""Models of astropy.modeling for a chip: pixels to a plane or to the sky, and back.

    pixel -> look-up tables -> offset from the reference pixel -> two Polynomial2D -> plane

Pixels are 0-based as everywhere in astropy and gwcs.  In distortion reference files the plane is
rotated to V2, V3 and shifted to the position of the aperture; on the sky it is a tangent plane.
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

# Fixed-point steps that invert tables: each leaves the table's largest slope times what was left.
_LEFT, _MOST_STEPS = 1e-10, 12
_SPLIT = models.Mapping((0, 1, 0, 1))


def plane_model(chip: ChipMap, inverse_order: int | None = None) -> Model:
    """Model from 0-based pixels to the plane (u, v) of a chip, with its inverse.

    The inverse iterates by default; with `inverse_order` it is a polynomial that is fitted over the
    chip, and every part of the model is one that ASDF can write.
    InputError for such a polynomial beside look-up tables behind the polynomial of the chip, and as
    for `fitted_inverse`.
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
            "has look-up tables behind its polynomial, which no fitted inverse takes back",
            where=chip.name,
            do="leave inverse_order out",
        )
    back = fitted_inverse(replace(chip, before=()), inverse_order)
    model.inverse = inverse_transform(back, np.eye(2), (0.0, 0.0), chip.before)
    return model


def sky_model(plane: Model, placement: SkyPlacement) -> Model:
    """Model from 0-based pixels to right ascension and declination in degrees.

    `plane` is the model from pixels to the plane, to which the projection is added.
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
        Map that is inverted, look-up tables included.
    """

    n_inputs = 2
    n_outputs = 2

    def __init__(self, chip: ChipMap, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.inputs, self.outputs = ("u", "v"), ("x", "y")
        self.chip = chip

    def evaluate(self, u: Float, v: Float) -> tuple[Float, Float]:
        """Pixels of positions of any shape; NaN if no pixel has a position."""
        u, v = np.broadcast_arrays(np.asarray(u, float), np.asarray(v, float))
        x, y = self.chip.unfolded_pixels(np.stack([u.ravel(), v.ravel()])) - 1.0
        return x.reshape(u.shape), y.reshape(u.shape)

    # astropy would read the annotations of `evaluate` as units
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
    """Transform from 0-based pixels to V2, V3 [arcsec], without inverse.

    `poly` maps FITS pixels to the plane in arcsec; `matrix` turns that to V2, V3; `tables` are
    applied in their order.
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
    """Transform from V2, V3 [arcsec] to 0-based pixels."""
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
    whole, *others = parts
    for part in others:
        whole = whole | part
    return whole


def _pair(kind: type[Model], a: float, b: float) -> Model:
    return kind(float(a)) & kind(float(b))


def _polynomials(x_terms: Terms, y_terms: Terms) -> Model:
    """Two polynomials side by side."""
    return _polynomial(x_terms) & _polynomial(y_terms)


def _polynomial(terms: Terms) -> Model:
    order = max(i + j for i, j in terms)
    return models.Polynomial2D(order, **{f"c{i}_{j}": float(c) for (i, j), c in terms.items()})


def _shifts(table: LookupTable) -> tuple[Model, Model]:
    """Tables of both axes over 0-based pixels.

    `Tabular2D` goes on in a straight line beyond its outermost nodes, and ours are constant there:
    a further row of equal nodes all around makes it so.
    """
    x, y = table.nodes()
    points = tuple(
        np.concatenate([[n[0] - step], n, [n[-1] + step]]) - 1.0
        for n, step in zip((x, y), table.step, strict=True)
    )
    values = np.pad(table.values, ((0, 0), (1, 1), (1, 1)), mode="edge")
    one, two = (
        models.Tabular2D(
            points=points,
            lookup_table=np.ascontiguousarray(plane.T),
            method="linear",
            bounds_error=False,
            fill_value=None,
        )
        for plane in values
    )
    return one, two


def _corrected(table: LookupTable) -> Model:
    """Pixels (x, y) with their shifts."""
    dx, dy = _shifts(table)
    first, second = (models.Mapping((axis,), n_inputs=2) for axis in (0, 1))
    return _SPLIT | (first + dx) & (second + dy)


def _uncorrected(table: LookupTable) -> Model:
    """Pixels whose corrected ones are given: x = x' - D(x), by so many steps as its slope needs."""
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
