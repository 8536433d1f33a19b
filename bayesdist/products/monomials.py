"""The polynomial of one chip in pixel offsets, as the products write it, and what it depends on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.solution import Solution, place_of
from bayesdist.model import Chip

__all__ = ["ChipPolynomial", "chip_polynomial"]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ChipPolynomial:
    """Coefficients of (x - xref)^i (y - yref)^j of one chip at one epoch, in the gauge exposure.

    Parameters
    ----------
    chip : Chip
    terms : tuple of (int, int)
        Powers (i, j), length K.
    values : ndarray, shape (2, K)
        Coefficients of u and v, in the unit of u, v.
    jacobian : ndarray, shape (2, K, D)
        Derivatives by the parameters of the model.
    """

    chip: Chip
    terms: tuple[tuple[int, int], ...]
    values: Float
    jacobian: Float

    def index(self, i: int, j: int) -> int:
        """Position of a term."""
        return self.terms.index((i, j))

    @property
    def constant(self) -> Float:
        """(u, v) at the reference pixel, shape (2,)."""
        return self.values[:, 0]

    @property
    def linear(self) -> Float:
        """d(u, v) / d(x, y) at the reference pixel, shape (2, 2)."""
        return self.values[:, 1:3]


def chip_polynomial(
    solution: Solution, *, chip: int | None = None, epoch: float | None = None
) -> ChipPolynomial:
    """Monomial form of a solution.

    Parameters
    ----------
    solution : LinearFit or Posterior
    chip : int, optional
        Chip number; the first chip by default.
    epoch : float, optional
        Decimal years; needed by a model with time dependence.

    Returns
    -------
    ChipPolynomial

    Raises
    ------
    InputError
        For an unknown chip or a missing epoch.
    """
    model = solution.model
    place = place_of(model, epoch=epoch if model.time is not None else None, chip=chip)
    basis = place.basis
    matrix = basis.monomial_matrix
    [(columns, derivative)] = model.effective_jacobian(solution.mean, place.group)
    jacobian = np.zeros((2, basis.n_terms, model.n_params))
    jacobian[:, :, columns] = np.einsum("kl,alm->akm", matrix, derivative)
    values = basis.to_monomials(place.polynomial(solution.mean))
    return ChipPolynomial(place.chip, basis.terms, values, jacobian)
