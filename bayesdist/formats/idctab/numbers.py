"""Numbers that an IDCTAB takes from a calibration, with their derivatives and covariance.

Calibrations of different filters come from different stars, but may be placed in one plane by a
common orientation with parameters p. Given p they are independent, so that

    Cov(a, b) = Cov(a, p) Cov(p)^-1 Cov(p, b)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.chip_map import ChipMap
from bayesdist.calibration.inverse import fitted_inverse
from bayesdist.errors import InputError
from bayesdist.formats.idctab.drift import RATES
from bayesdist.formats.idctab.table import idctab_column
from bayesdist.model import Chip, DistortionModel
from bayesdist.products.common.coefficients import propagated_sigma, require_regular
from bayesdist.utils.arrays import Float

INVERSE_NODES = 33  # points per axis at which the inverse is fitted


@dataclass(frozen=True, eq=False)
class ChipNumbers:
    """Fitted numbers of one chip, named as in an IDCTAB."""

    chip: Chip
    names: tuple[str, ...]  # V2REF, V3REF, CX10, CX11, ..., CY10, ..., keywords of fitted rates
    values: Float  # (P,), arcsec, arcsec/pix^n, arcsec/pix/yr
    jacobian: Float  # (P, D), derivatives with respect to the parameters of the solution
    constant: Float  # arcsec; (Xc, Yc) of the reference pixel, included in V2REF and V3REF

    def column(self, name: str) -> float:
        """Fitted value of one entry of `names`, such as 'CX10' or 'V2REF'."""
        return float(self.values[self.names.index(name)])

    def without_rates(self) -> ChipNumbers:
        """Numbers without the rates of the drift."""
        keep = [k for k, name in enumerate(self.names) if not name.startswith("TDD")]
        names = tuple(self.names[k] for k in keep)
        return ChipNumbers(self.chip, names, self.values[keep], self.jacobian[keep], self.constant)


@dataclass(frozen=True, eq=False)
class ChipInverse:
    """INVERSE row of one chip at the reference date of its drift."""

    values: dict[str, float]  # by column, pixels per arcsec^n
    sigmas: dict[str, float]  # of the values
    closure: float  # pixels; largest round-trip error over the chip


def check_time(model: DistortionModel, *, acs_wfc: bool) -> None:
    """Raise InputError for time dependence that stwcs would not apply.

    Leaving it out would be an unreported error. Rejected are time-dependent terms other than (u, 1,
    0), (v, 1, 0) and (v, 0, 1), several segments, and detectors other than ACS/WFC.
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
            f"an IDCTAB holds one reference date, but there are {model.time.n_segments} segments",
            where="model.tdd.breaks",
            do="fit each segment by itself and write a file for each",
        )


def chip_numbers(
    calibration: Calibration,
    chip: int,
    *,
    factor: float,
    parity: tuple[int, int],
    zero: tuple[float, float],
) -> ChipNumbers:
    """Numbers of one chip at the reference date of its drift.

    Parameters
    ----------
    calibration : Calibration
        Calibration of all chips.
    chip : int
        Chip number.
    factor : float
        Size of one unit of u, v in arcseconds.
    parity : tuple of int
        Signs of V2 and V3 relative to Xc and Yc.
    zero : tuple of float
        V2 and V3 of (u, v) = (0, 0), arcseconds.

    Returns
    -------
    ChipNumbers
        Numbers with their derivatives.

    Raises
    ------
    InputError
        If the chip is unknown.
    DegenerateError
        If the linear part is singular.
    """
    model = calibration.model
    coefficients, jacobian = calibration.coefficients(chip, reference_date(calibration))
    basis = model.basis(chip)
    values = basis.to_monomials(coefficients)
    by = np.einsum("kl,ald->akd", basis.monomial_matrix, jacobian.reshape(2, basis.n_terms, -1))
    require_regular(values[:, 1:3], chip)
    constant = values[:, 0] * factor
    listed: list[tuple[str, float, Float]] = [
        (name, zero[a] + parity[a] * constant[a], parity[a] * by[a, 0] * factor)
        for a, name in enumerate(("V2REF", "V3REF"))
    ]
    for axis, prefix in enumerate(("CX", "CY")):
        # tables list CX10 before CX11: ascending powers of x within an order
        for k, (i, j) in sorted(enumerate(basis.terms), key=lambda t: (sum(t[1]), t[1])):
            if i + j:
                name = idctab_column(prefix, i, j)
                listed.append((name, values[axis, k] * factor, by[axis, k] * factor))
    listed += _rates(calibration, chip, factor)
    names, numbers, derivatives = zip(*listed, strict=True)
    return ChipNumbers(
        model.chips[model.chip_code(chip)],
        names,
        np.array(numbers, float),
        np.array(derivatives),
        constant,
    )


def reference_date(calibration: Calibration) -> float | None:
    """Reference date of a drift with a single segment; None without drift."""
    time = calibration.model.time
    return None if time is None else time.epoch0[0]


def _rates(calibration: Calibration, chip: int, factor: float) -> list[tuple[str, float, Float]]:
    """Rates per pixel, converted from the model's rates per half size of the detector."""
    model = calibration.model
    if model.time is None:
        return []
    first = model.tdd_slice(chip).start
    half_x, half_y = model.basis(chip).half_size
    out = []
    for k, (axis, i, j) in enumerate(model.time.terms):
        scale = factor * half_x**-i * half_y**-j
        derivative = np.zeros(model.n_params)
        derivative[first + k] = scale
        value = float(np.asarray(calibration.solution.mean)[first + k]) * scale
        out.append((f"{RATES[axis, i, j]}{chip}", value, derivative))
    return out


def chip_inverse(calibration: Calibration, chip: int, factor: float) -> ChipInverse:
    """Least-squares inverse of a chip's polynomials, of the same order, over the whole chip.

    There is no constant term: (0, 0) corresponds to XREF, YREF in both directions. stwcs does not
    use INVERSE rows (ACS handbook 4.1.5). Other programs start their iterations from them, so the
    closure is reported. InputError if the map folds the chip onto itself.
    """
    stated = calibration.at(reference_date(calibration), origin="chip")[chip]
    chip_map: ChipMap = stated.transformed(factor * np.eye(2))
    try:
        inverse = fitted_inverse(
            chip_map, chip_map.basis.order, nodes=INVERSE_NODES, constant=False, linear=np.eye(2)
        )
    except InputError as error:
        raise InputError(
            f"the distortion of chip {chip} maps several pixels to one position",
            where="INVERSE rows",
            do="lower the order, fit stars over the whole chip, or leave out the inverse",
        ) from error
    sigma = np.zeros(2 * len(inverse.x_terms))
    if chip_map.cov is not None and inverse.jacobian is not None:
        sigma = propagated_sigma(inverse.jacobian, chip_map.cov)
    columns, values = [], []
    for axis, (prefix, terms) in enumerate((("CX", inverse.x_terms), ("CY", inverse.y_terms))):
        for (i, j), value in terms.items():
            columns.append(idctab_column(prefix, i, j))
            # add the position itself, which `inverse` leaves out
            values.append(value + ((i, j) == (1 - axis, axis)))
    closure, _ = inverse.misses(chip_map)
    return ChipInverse(
        dict(zip(columns, values, strict=True)),
        dict(zip(columns, sigma.tolist(), strict=True)),
        closure,
    )


def joint_covariance(
    calibrations: Sequence[Calibration], numbers: Sequence[Sequence[ChipNumbers]]
) -> Float:
    """Covariance of the numbers of all calibrations and chips, including common orientations."""
    jacobians = [np.concatenate([chip.jacobian for chip in chips]) for chips in numbers]
    ends = np.cumsum([len(j) for j in jacobians])
    places = [slice(int(e) - len(j), int(e)) for e, j in zip(ends, jacobians, strict=True)]
    out = np.zeros((int(ends[-1]), int(ends[-1])))
    for source, jacobian, place in zip(calibrations, jacobians, places, strict=True):
        out[place, place] = jacobian @ np.asarray(source.solution.cov, float) @ jacobian.T
    laid = [
        (k, source.plane.orientation, jacobians[k] @ source.with_plane)
        for k, source in enumerate(calibrations)
        if source.plane.orientation is not None and source.with_plane is not None
    ]
    for a, orientation, by_a in laid:
        for b, other_orientation, by_b in laid:
            if b > a and orientation is other_orientation:
                shared = by_a @ _inverse(orientation.cov) @ by_b.T
                out[places[a], places[b]] = shared
                out[places[b], places[a]] = shared.T
    return out


def _inverse(cov: Float) -> Float:
    """Pseudo-inverse of the covariance of an orientation; a fixed scale has zero variance."""
    sigma = np.sqrt(np.diag(cov))
    free = sigma > 0
    out = np.zeros_like(cov)
    pick = np.ix_(free, free)
    norm = np.outer(sigma[free], sigma[free])
    out[pick] = np.linalg.pinv(cov[pick] / norm, hermitian=True) / norm
    return out
