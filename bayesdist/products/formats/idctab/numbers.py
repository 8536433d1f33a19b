"""The numbers that an IDCTAB takes from a solution, with their derivatives by its parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.solution import Solution
from bayesdist.errors import DegenerateError, InputError
from bayesdist.model import Chip, DistortionModel
from bayesdist.products.formats.common.coefficients import idctab_column
from bayesdist.products.formats.idctab.drift import RATES
from bayesdist.products.monomials import ChipPolynomial, chip_polynomial

__all__ = ["ChipNumbers", "check_time", "chip_numbers"]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ChipNumbers:
    """The fitted numbers of one chip, as an IDCTAB names them.

    Parameters
    ----------
    chip : Chip
    names : tuple of str
        V2REF, V3REF, CX10, CX11, ..., CY10, ...; then keywords of the rates that were fitted.
    values : ndarray, shape (P,)
        Arcseconds, arcsec/pix^n, arcsec/pix/yr.
    jacobian : ndarray, shape (P, D)
        Derivatives by the parameters of the model.
    constant : ndarray, shape (2,)
        (Xc, Yc) of the reference pixel, which V2REF and V3REF contain; arcseconds.
    """

    chip: Chip
    names: tuple[str, ...]
    values: Float
    jacobian: Float
    constant: Float

    def column(self, name: str) -> float:
        """Value of a name."""
        return float(self.values[self.names.index(name)])


def check_time(model: DistortionModel, *, acs_wfc: bool) -> None:
    """Refuse time dependence that stwcs would not apply; to leave it out would be a silent error.

    Raises
    ------
    InputError
        For time-dependent terms other than (u, 1, 0), (v, 1, 0) and (v, 0, 1), of several segments,
        or of a detector other than ACS/WFC.
    """
    if model.time is None:
        return
    single = "write SIP headers for single epochs instead"
    if not acs_wfc:
        raise InputError(
            "an IDCTAB stores time-dependent terms for ACS/WFC only", where="model.tdd", do=single
        )
    for axis, i, j in model.time.terms:
        if (axis, i, j) not in RATES:
            raise InputError(
                f"an IDCTAB cannot store the time-dependent term ({axis}, {i}, {j})",
                where="model.tdd.terms",
                do=f"keep to (u, 1, 0), (v, 1, 0) and (v, 0, 1), or {single}",
            )
    if model.time.n_segments > 1:
        raise InputError(
            f"an IDCTAB holds one reference date, and there are {model.time.n_segments} segments",
            where="model.tdd.breaks",
            do="fit each segment by itself and write a file for each",
        )


def chip_numbers(
    solution: Solution,
    chip: int,
    *,
    factor: float,
    parity: tuple[int, int],
    zero: tuple[float, float],
) -> ChipNumbers:
    """Numbers of one chip, at the reference date of its drift.

    Parameters
    ----------
    solution : LinearFit or Posterior
    chip : int
        Chip number.
    factor : float
        Arcseconds of the IDCTAB in one unit of u, v.
    parity : tuple of int
        Sense of V2 and V3 against Xc and Yc.
    zero : tuple of float
        V2 and V3 of (u, v) = (0, 0), arcseconds.

    Returns
    -------
    ChipNumbers

    Raises
    ------
    InputError
        For an unknown chip.
    DegenerateError
        When the linear part is singular.
    """
    model = solution.model
    epoch = model.time.epoch0[0] if model.time is not None else None
    poly = chip_polynomial(solution, chip=chip, epoch=epoch)
    if abs(np.linalg.det(poly.linear)) <= 1e-12 * np.abs(poly.linear).max() ** 2:
        raise DegenerateError(
            f"the linear part of chip {chip} is singular",
            do="check that the stars cover the detector in x and in y",
        )
    constant = poly.constant * factor
    sign = np.array(parity, float)
    listed: list[tuple[str, float, Float]] = [
        (name, zero[a] + sign[a] * constant[a], sign[a] * poly.jacobian[a, 0] * factor)
        for a, name in enumerate(("V2REF", "V3REF"))
    ]
    for axis, prefix in enumerate(("CX", "CY")):
        # tables list CX10 before CX11: rising powers of x within an order
        for k, (i, j) in sorted(enumerate(poly.terms), key=lambda t: (sum(t[1]), t[1])):
            if i + j:
                name = idctab_column(prefix, i, j)
                listed.append(
                    (name, poly.values[axis, k] * factor, poly.jacobian[axis, k] * factor)
                )
    listed += _rates(solution, poly, factor)
    names, values, jacobian = zip(*listed, strict=True)
    return ChipNumbers(poly.chip, names, np.array(values, float), np.array(jacobian), constant)


def _rates(
    solution: Solution, poly: ChipPolynomial, factor: float
) -> list[tuple[str, float, Float]]:
    """Rates per pixel; the model has them per half size of the detector."""
    model = solution.model
    if model.time is None:
        return []
    number = poly.chip.number
    first = model.tdd_slice(number).start
    half_x, half_y = model.basis(number).half_size
    out = []
    for k, (axis, i, j) in enumerate(model.time.terms):
        scale = factor * half_x**-i * half_y**-j
        derivative = np.zeros(model.n_params)
        derivative[first + k] = scale
        value = float(np.asarray(solution.mean)[first + k]) * scale
        out.append((f"{RATES[axis, i, j]}{number}", value, derivative))
    return out
