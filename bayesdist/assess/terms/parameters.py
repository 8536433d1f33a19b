"""Errors of an image's scale or orientation that a calibration does not know.

Velocity aberration that is left out, or known only as far as the header knows the spacecraft's
velocity, is an error of the scale: VAFACTOR differs from 1 by up to 1e-4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.names import require_known
from bayesdist.assess.solution import Solution, place_of
from bayesdist.assess.terms.field_terms import FieldDraws
from bayesdist.assess.terms.given import GIVEN
from bayesdist.errors import InputError

__all__ = ["LINEAR_KINDS", "LinearTerm"]

Float = NDArray[np.float64]

LINEAR_KINDS = ("scale", "rotation")


@dataclass(frozen=True, eq=False)
class LinearTerm:
    """A Gaussian error of scale or orientation about the reference pixel of the first chip.

    Parameters
    ----------
    name : str
    kind : str
        'scale' or 'rotation'.
    sigma : float
        Standard deviation: relative, or in radians.
    solution : Solution
        Whose positions it moves.
    source : str
    part_of : str
        Name of the term that holds this one, which is then shown and not added.

    Raises
    ------
    InputError
        For an unknown kind, or a sigma that is negative or not finite.
    """

    name: str
    kind: str
    sigma: float
    solution: Solution
    source: str = GIVEN
    part_of: str = ""
    without: None = None

    def __post_init__(self) -> None:
        where = f"budget term {self.name!r}"
        require_known(self.kind, LINEAR_KINDS, "kind", where=where)
        if not (math.isfinite(self.sigma) and self.sigma >= 0):
            raise InputError(
                f"sigma is {self.sigma}", where=where, do="give a number that is not negative"
            )

    def draws(self, n: int, rng: np.random.Generator) -> FieldDraws:
        """Draws of the error: one number for the whole image."""
        model, mean = self.solution.model, np.asarray(self.solution.mean, float)
        epoch = None if model.time is None else model.time.epoch0[0]
        first = place_of(model, epoch=epoch)
        phi = first.basis.evaluate(*np.array(first.chip.reference_pixel)[:, None])[0]
        origin = first.polynomial(mean) @ phi
        moved = np.zeros_like(mean)
        for chip in model.chips:
            slices = [model.coefficient_slice(chip.number, axis) for axis in (0, 1)]
            position = np.stack([mean[s] for s in slices])
            position[:, 0] -= origin  # the first basis function is 1
            if self.kind == "rotation":
                position = np.stack([-position[1], position[0]])
            for s, change in zip(slices, position, strict=True):
                moved[s] = change
        sizes = self.sigma * rng.standard_normal((n, 1))
        return FieldDraws(model, mean, mean + sizes * moved)
