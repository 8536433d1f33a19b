"""Error fields as they are after the observer has fitted shift and rotation of the exposure."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from bayesdist.model import DistortionModel

__all__ = ["without_rigid"]

Float = NDArray[np.float64]


def without_rigid(
    errors: Mapping[int, Float], positions: Mapping[int, Float], model: DistortionModel
) -> dict[int, Float]:
    """Take the best shift and rotation of the whole detector out of error fields.

    Whoever uses a calibration on an exposure fits where the telescope pointed.  What this takes up
    is no error, and depends on the gauge: without it, a field is the same in every gauge.

    `errors`: (n, 2, K), by chip number, for all chips of the model: Legendre coefficients of each
    error. `positions`: (2, K), those of the positions (u, v), in the same orientation. Returns (n,
    2, K), the residual errors: least squares over stars that cover all chips evenly.
    """
    chips = model.chips
    basis = model.basis(chips[0].number)
    # mean square of each Legendre product over a chip, times the chip's area
    square = np.array([1.0 / ((2 * i + 1) * (2 * j + 1)) for i, j in basis.terms])
    area = np.array([chip.size[0] * chip.size[1] for chip in chips])
    weight = (area / area.sum())[:, None, None] * square

    rigid = np.zeros((3, len(chips), 2, basis.n_terms))
    rigid[0, :, 0, 0] = rigid[1, :, 1, 0] = 1.0
    for c, chip in enumerate(chips):
        u, v = positions[chip.number]
        rigid[2, c] = -v, u
    # about the middle of the detector a rotation is no shift
    rigid[2, ..., 0] -= np.einsum("c,ca->a", area / area.sum(), rigid[2, ..., 0])
    stacked = np.stack([errors[chip.number] for chip in chips], axis=1)
    normal = np.einsum("pcak,cak,qcak->pq", rigid, np.broadcast_to(weight, rigid[0].shape), rigid)
    projected = np.einsum("pcak,ncak->np", rigid * weight, stacked)
    rest = stacked - np.einsum("np,pcak->ncak", np.linalg.solve(normal, projected.T).T, rigid)
    return {chip.number: rest[:, c] for c, chip in enumerate(chips)}
