"""Shift and rotation of the whole detector, which observers fit to an exposure.

Observers who apply a calibration to an exposure fit its pointing. The part of an error that this
fit absorbs is not an error, and it depends on the gauge; the residual is the same in every gauge.
The fit is by least squares to stars that cover all chips evenly.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.solution import place_of
from bayesdist.model import DistortionModel
from bayesdist.model.alignment import mean_squares
from bayesdist.utils.arrays import Float

QUADRATURE = 24  # points along x and y of a chip in integrals over it (Gauss-Legendre)


@dataclass(frozen=True, eq=False)
class Alignment:
    """Best-fitting shift and rotation of the whole detector for error fields.

    Shifts along u and v and a rotation about the mean position are orthogonal functions; here they
    have unit mean square (the sum of both axes) over the detector.
    """

    model: DistortionModel
    # Legendre coefficients (2, K) of the positions (u, v) by chip number, for all chips
    positions: Mapping[int, Float]

    @classmethod
    def of(cls, model: DistortionModel, mean: Float, epoch: float | None) -> Alignment:
        """Alignment by the positions that parameters (D,) give at an epoch in decimal years."""
        return cls(
            model,
            {
                chip.number: place_of(model, epoch=epoch, chip=chip.number).polynomial(mean)
                for chip in model.chips
            },
        )

    @cached_property
    def _weight(self) -> Float:
        """Mean square (C, 2, K) of each basis function, with chips weighted by area."""
        return mean_squares(self.model).reshape(len(self.model.chips), 2, -1)

    @cached_property
    def rigid(self) -> Float:
        """Legendre coefficients (3, C, 2, K) of both shifts and the rotation on the C chips."""
        weight = self._weight
        rigid = np.zeros((3, *weight.shape))
        rigid[0, :, 0, 0] = rigid[1, :, 1, 0] = 1.0
        for c, chip in enumerate(self.model.chips):
            u, v = self.positions[chip.number]
            rigid[2, c] = -v, u
        rigid[2, ..., 0] -= np.einsum("ca,ca->a", weight[..., 0], rigid[2, ..., 0])
        rigid[2] /= np.sqrt(np.sum(weight * rigid[2] ** 2))
        return rigid

    def without(self, errors: Mapping[int, Float]) -> dict[int, Float]:
        """Subtract the best-fitting shift and rotation from errors that are polynomials.

        `errors` are Legendre coefficients (n, 2, K) by chip number, for all chips of the model. The
        result has the same form.
        """
        chips = self.model.chips
        stacked = np.stack([errors[chip.number] for chip in chips], axis=1)
        fitted = np.einsum("pcak,ncak->np", self.rigid * self._weight, stacked)
        residual = stacked - np.einsum("np,pcak->ncak", fitted, self.rigid)
        return {chip.number: residual[:, c] for c, chip in enumerate(chips)}

    def at(self, chip: int, x: Float, y: Float) -> Float:
        """Both shifts and the rotation (N, 2, 3) at pixels (N,) of a chip, along u and v."""
        phi = self.model.basis(chip).evaluate(x, y)
        rigid = self.rigid[:, self.model.chip_code(chip)]
        return np.asarray(np.moveaxis(rigid @ phi.T, 2, 0).swapaxes(1, 2))

    def fitted(
        self, chip: int, functions: Callable[[int, Float, Float], NDArray[np.floating]]
    ) -> Float:
        """Shifts and rotation (3, 2, m) fitted to each function on a chip, as an error of u or v.

        `functions(chip, x, y)` returns values (N, m) at pixels. The shifts and rotation fitted to
        an error on several chips are the sum over these.
        """
        size = self.model.chips[self.model.chip_code(chip)].size
        area = sum(c.size[0] * c.size[1] for c in self.model.chips)
        nodes, weights = np.polynomial.legendre.leggauss(QUADRATURE)
        x, y = (a.ravel() for a in np.meshgrid(*(0.5 + n * (nodes + 1.0) / 2.0 for n in size)))
        weight = np.outer(weights, weights).ravel() * (size[0] * size[1] / area / 4.0)
        return np.einsum(
            "nap,nm->pam", weight[:, None, None] * self.at(chip, x, y), functions(chip, x, y)
        )
