"""Models of astropy.modeling as stored in distortion reference files of other programs."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from astropy.modeling import CompoundModel, Model, models
from numpy.typing import ArrayLike

from bayesdist.utils.arrays import Float

# Models that do not change the order of a polynomial.
_AFFINE = (
    models.Shift,
    models.Scale,
    models.Multiply,
    models.AffineTransformation2D,
    models.Rotation2D,
    models.Identity,
    models.Mapping,
)


def evaluated(model: Model, x: ArrayLike, y: ArrayLike) -> Float:
    """Values (2, N) of a transform at inputs (N,), without units."""
    out = model(np.asarray(x, float), np.asarray(y, float))
    return np.stack(
        [np.asarray(getattr(coordinate, "value", coordinate), float) for coordinate in out]
    )


def leaves(model: Model) -> Iterator[Model]:
    """Elementary models of a compound transform, from left to right."""
    if isinstance(model, CompoundModel):
        for part in (model.left, model.right):
            if isinstance(part, Model):
                yield from leaves(part)
    else:
        yield model


def tables_of(model: Model) -> list[Model]:
    """Two-dimensional look-up tables in a transform."""
    return [leaf for leaf in leaves(model) if leaf.n_inputs == 2 and hasattr(leaf, "lookup_table")]


def order_of(model: Model) -> int | None:
    """Order of a transform that is a polynomial; None for any other transform."""
    if isinstance(model, CompoundModel):
        left_order, right_order = order_of(model.left), order_of(model.right)
        if left_order is None or right_order is None or model.op not in ("|", "&", "+", "-"):
            return None
        return left_order * right_order if model.op == "|" else max(left_order, right_order)
    if isinstance(model, (models.Polynomial2D, models.Polynomial1D)):
        return max(int(model.degree), 1)
    if isinstance(model, (models.Chebyshev2D, models.Legendre2D)):
        return max(int(model.x_degree) + int(model.y_degree), 1)
    return 1 if isinstance(model, (*_AFFINE, models.Const1D)) else None


def exchanged(model: Model, lowest: int = 1) -> Model:
    """Copy of a transform with the powers of x and y exchanged in its polynomials.

    Only terms of total order `lowest` or higher are exchanged. Polynomials of order 1, which
    describe rotations, are unchanged.
    """
    out = model.copy()
    for leaf in leaves(out):
        if isinstance(leaf, models.Polynomial2D) and leaf.degree > 1:
            values = dict(zip(leaf.param_names, leaf.parameters.copy(), strict=True))
            for name in leaf.param_names:
                i, j = map(int, name[1:].split("_"))
                if i + j >= lowest:
                    setattr(leaf, name, values[f"c{j}_{i}"])
    return out
