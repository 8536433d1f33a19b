"""One calibration at one chip and date: a polynomial from pixels to (u, v), wherever it stood.

Fits, posteriors, IDCTABs, SIP headers and WISE meta-data come down to this, so that any two of them
can be compared.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from bayesdist.assess.grid import mesh
from bayesdist.assess.solution import Solution, place_of
from bayesdist.errors import InputError
from bayesdist.model import PolynomialBasis

__all__ = ["Calibration", "calibration_of_map", "calibration_of_solution"]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Calibration:
    """What one calibration says of one chip at one date.

    Parameters
    ----------
    name : str
        What to call it.
    basis : PolynomialBasis
    unit : str
        Of u and v.
    coefficients : ndarray, shape (2, K)
        Legendre coefficients of u and v.
    cov : ndarray, shape (2 K, 2 K), optional
        Of the coefficients, u before v; None where the source gives no errors.
    correlated : bool
        False where the source gives a standard deviation of each monomial and no correlations.
    draws : float
        Effective number of draws that `cov` was estimated from; infinite where it is computed.
    chip : int, optional
    epoch : float, optional
        Decimal years.
    notes : tuple of str
        What else a reader has to know.
    """

    name: str
    basis: PolynomialBasis
    unit: str
    coefficients: Float
    cov: Float | None = None
    correlated: bool = True
    draws: float = np.inf
    chip: int | None = None
    epoch: float | None = None
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        known = [self.coefficients] if self.cov is None else [self.coefficients, self.cov]
        if not all(np.isfinite(values).all() for values in known):
            raise InputError(
                "holds coefficients or errors that are not finite",
                where=self.name,
                do="check the file",
            )

    @property
    def kind_of_error(self) -> str:
        """What is known of its errors: 'none', 'sigma' or 'covariance'."""
        if self.cov is None:
            return "none"
        return "covariance" if self.correlated else "sigma"


def calibration_of_solution(
    solution: Solution, name: str, *, chip: int | None = None, epoch: float | None = None
) -> Calibration:
    """A chip of a fit or a posterior, without the frames of exposures.

    Parameters
    ----------
    solution : Solution
    name : str
    chip : int, optional
        Chip number; the first chip by default.
    epoch : float, optional
        Decimal years; needed by a model with time dependence.

    Returns
    -------
    Calibration

    Raises
    ------
    InputError
        For an unknown chip, or a missing epoch.
    """
    if solution.model.time is not None and epoch is None:
        raise InputError("depends on time and no date is given", where=name, do="give --epoch")
    place = place_of(solution.model, epoch=epoch, chip=chip)
    size = 2 * place.basis.n_terms
    convergence = getattr(solution, "convergence", None)
    return Calibration(
        name=name,
        basis=place.basis,
        unit=solution.model.unit,
        coefficients=place.polynomial(solution.mean),
        cov=place.covariance(solution).reshape(size, size),
        draws=np.inf if convergence is None else float(convergence.ess_bulk_min),
        chip=place.chip.number,
        epoch=place.epoch,
        notes=() if convergence is None or convergence.converged else ("has not converged",),
    )


def calibration_of_map(
    positions: Callable[[Float, Float], tuple[Float, Float]],
    name: str,
    *,
    order: int,
    size: tuple[float, float],
    reference_pixel: tuple[float, float],
    unit: str,
    monomial_cov: Float | None = None,
    correlated: bool = True,
    chip: int | None = None,
    epoch: float | None = None,
    notes: tuple[str, ...] = (),
) -> Calibration:
    """Whatever maps pixels to (u, v) by a polynomial.

    Parameters
    ----------
    positions : callable
        From FITS 1-based pixels x, y (N,) to u, v (N,): a polynomial of total order `order`.
    name : str
    order : int
    size, reference_pixel : tuple of float
        As in `PolynomialBasis`.
    unit : str
    monomial_cov : ndarray, shape (2 K, 2 K), optional
        Covariance of the coefficients of (x - xref)^i (y - yref)^j, u before v.
    correlated, chip, epoch, notes
        As in `Calibration`.

    Returns
    -------
    Calibration
    """
    basis = PolynomialBasis(order, size, reference_pixel)
    # products of two terms have twice the order, for which this many nodes are exact
    nodes, weights = legendre.leggauss(order + 1)
    X, Y = mesh(nodes, nodes)
    (sx, sy), (nx, ny) = basis.half_size, size
    values = np.stack(positions(X * sx + (nx + 1) / 2, Y * sy + (ny + 1) / 2))
    i, j = np.array(basis.terms).T
    norm = (2 * i + 1) * (2 * j + 1) / 4
    weight = np.outer(weights, weights).ravel()
    coefficients = (values * weight) @ basis.evaluate_scaled(X, Y) * norm
    cov = None
    if monomial_cov is not None:
        back = np.kron(np.eye(2), basis.from_monomials(np.eye(basis.n_terms)).T)
        cov = back @ monomial_cov @ back.T
        cov = (cov + cov.T) / 2
    return Calibration(name, basis, unit, coefficients, cov, correlated, np.inf, chip, epoch, notes)
