"""Transforms of astropy.modeling from 0-based pixels to V2, V3, and back.

    pixel -> look-up tables -> offset from the reference pixel -> two Polynomial2D -> turn with
    parity -> shift to V2Ref, V3Ref

Pipelines and gwcs evaluate them as any other model, and use the inverse that is attached.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from astropy.modeling import CompoundModel, Model, models
from numpy.typing import ArrayLike

from bayesdist.calibration.chip_map import Monomials
from bayesdist.calibration.inverse import ExplicitInverse
from bayesdist.model import LookupTable
from bayesdist.products.formats.common.coefficients import Coefficients
from bayesdist.utils.arrays import Float

# Fixed-point steps that invert tables: each leaves the table's largest slope times what was left.
_LEFT, _MOST_STEPS = 1e-10, 12
_SPLIT = models.Mapping((0, 1, 0, 1))
# Models that leave the order of a polynomial as it is.
_AFFINE = (
    models.Shift,
    models.Scale,
    models.Multiply,
    models.AffineTransformation2D,
    models.Rotation2D,
    models.Identity,
    models.Mapping,
)


# -- ours -----------------------------------------------------------------------------------------


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


def _polynomials(x_terms: Coefficients, y_terms: Coefficients) -> Model:
    """Two polynomials side by side."""
    both = []
    for terms in (x_terms, y_terms):
        order = max(i + j for i, j in terms)
        values = {f"c{i}_{j}": float(c) for (i, j), c in terms.items()}
        both.append(models.Polynomial2D(order, **values))
    return both[0] & both[1]


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


# -- those of others ------------------------------------------------------------------------------


def evaluated(model: Model, x: ArrayLike, y: ArrayLike) -> Float:
    """Values (2, N) of a transform at its own inputs (N,), without units."""
    out = model(np.asarray(x, float), np.asarray(y, float))
    return np.stack([np.asarray(getattr(one, "value", one), float) for one in out])


def leaves(model: Model) -> Iterator[Model]:
    """Elementary models of a transform from left to right."""
    if isinstance(model, CompoundModel):
        for part in (model.left, model.right):
            if isinstance(part, Model):
                yield from leaves(part)
    else:
        yield model


def tables_of(model: Model) -> list[Model]:
    """Look-up tables in a transform."""
    return [one for one in leaves(model) if one.n_inputs == 2 and hasattr(one, "lookup_table")]


def order_of(model: Model) -> int | None:
    """Order of the polynomial that a transform is; None where it is none."""
    if isinstance(model, CompoundModel):
        left, right = order_of(model.left), order_of(model.right)
        if left is None or right is None or model.op not in ("|", "&", "+", "-"):
            return None
        return left * right if model.op == "|" else max(left, right)
    if isinstance(model, (models.Polynomial2D, models.Polynomial1D)):
        return max(int(model.degree), 1)
    if isinstance(model, (models.Chebyshev2D, models.Legendre2D)):
        return max(int(model.x_degree) + int(model.y_degree), 1)
    return 1 if isinstance(model, (*_AFFINE, models.Const1D)) else None


def exchanged(model: Model, lowest: int = 1) -> Model:
    """Copy of a transform in which powers of x and y are exchanged in its polynomials.

    From the total order `lowest` on; polynomials of order 1, which turn, are left as they are.
    """
    out = model.copy()
    for one in leaves(out):
        if isinstance(one, models.Polynomial2D) and one.degree > 1:
            values = dict(zip(one.param_names, one.parameters.copy(), strict=True))
            for name in one.param_names:
                i, j = map(int, name[1:].split("_"))
                if i + j >= lowest:
                    setattr(one, name, values[f"c{j}_{i}"])
    return out
