"""Transforms of others: models of astropy.modeling as distortion reference files hold them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from astropy.modeling import CompoundModel, Model, models
from numpy.typing import ArrayLike

from bayesdist.utils.arrays import Float

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
