"""All chips of a calibration in one plane: each a polynomial whose constant is where the chip lies.

Of an IDCTAB this is the plane of Xc and Yc of the reference chip,

    Xc + p0 (V2REF - V2REF_ref),   Yc + p1 (V3REF - V3REF_ref)

in arcseconds from that chip's zero point, as stwcs combines chips; of a fit or posterior it is the
plane of (u, v), counted from the zero point of the first chip.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.calibration import Calibration, calibration_of_map
from bayesdist.assess.solution import Place, Solution, place_of
from bayesdist.errors import InputError
from bayesdist.products.idctab import IdcTab
from bayesdist.products.idctab_row_covariance import covariance_of_row
from bayesdist.products.parity import parity_of

__all__ = ["chips_of_idctab", "chips_of_solution", "scale_of_idctab"]

Float = NDArray[np.float64]
Chips = dict[int, Calibration]

# The chip to whose zero point stwcs refers both chips of ACS/WFC and of WFC3/UVIS.
_REFERENCE = 2


def chips_of_idctab(tab: IdcTab, *, filter: str | None = None, epoch: float | None = None) -> Chips:
    """Every chip of an IDCTAB in the plane of its reference chip.

    Parameters
    ----------
    tab : IdcTab
    filter : str, optional
        Names of both wheels may be joined by a comma.
    epoch : float, optional
        Decimal years, for the time-dependent terms of the 2015 scheme; without it they are left
        out.

    Returns
    -------
    dict of int to Calibration
        In arcseconds, the reference chip first; with covariances where the file has them.

    Raises
    ------
    InputError
        As `IdcTab.row` and `IdcTab.evaluate`; for two chips of an unknown detector.
    """
    names = _names(filter)
    numbers = [1]
    if "DETCHIP" in tab.columns:
        numbers = sorted({max(int(n), 1) for n in tab.rows["DETCHIP"]})
    reference = _REFERENCE if _REFERENCE in numbers else numbers[0]
    numbers.sort(key=lambda n: n != reference)
    base = tab.row(reference, names)
    parity = parity_of(tab.instrument, tab.detector) if len(numbers) > 1 else (1, 1)
    notes = []
    drifts = any(rate for name, rate in tab.tdd.items() if name != "TDD_DATE")
    if epoch is None and tab.tdd_scheme == "2015" and drifts:
        notes.append(f"at the reference date {tab.tdd['TDD_DATE']:g} of its drift")
    if epoch is None and tab.tdd_scheme in ("2014", "order", "default"):
        notes.append("without the drift that stwcs applies to it")
    out = {}
    for chip in numbers:
        row = tab.row(chip, names)
        record = tab.rows[row]
        shift = [
            sign * (float(record[name]) - float(tab.rows[base][name])) if chip != reference else 0.0
            for sign, name in zip(parity, ("V2REF", "V3REF"), strict=True)
        ]

        def positions(
            x: Float, y: Float, chip: int = chip, shift: list[float] = shift
        ) -> tuple[Float, Float]:
            X, Y = tab.evaluate(chip, x, y, filter=names, epoch=epoch)
            return X + shift[0], Y + shift[1]

        out[chip] = calibration_of_map(
            positions,
            tab.name,
            order=tab.norder,
            size=(float(record["XSIZE"]), float(record["YSIZE"])),
            reference_pixel=(float(record["XREF"]), float(record["YREF"])),
            unit="arcsec",
            monomial_cov=covariance_of_row(
                tab, row, chip, epoch, reference_row=base, reference_chip=reference
            ),
            chip=chip,
            epoch=epoch,
            notes=tuple(notes),
        )
    return out


def scale_of_idctab(tab: IdcTab, filter: str | None = None) -> float:
    """SCALE of an IDCTAB: the default size of a corrected pixel, arcseconds.

    Raises
    ------
    InputError
        As `IdcTab.row`, and for a SCALE that is not positive.
    """
    chips = [max(int(n), 1) for n in tab.rows["DETCHIP"]] if "DETCHIP" in tab.columns else [1]
    scale = round(float(tab.rows[tab.row(chips[0], _names(filter))]["SCALE"]), 8)
    if not scale > 0:
        raise InputError(f"is {scale}", where=f"{tab.name}, column SCALE", do="give --scale")
    return scale


def _names(filter: str | None) -> list[str] | None:
    return None if filter is None else [part.strip() for part in filter.split(",")]


def chips_of_solution(solution: Solution, name: str, *, epoch: float | None = None) -> Chips:
    """Every chip of a fit or posterior, from the zero point of its first chip.

    Parameters
    ----------
    solution : Solution
    name : str
        What to call it.
    epoch : float, optional
        Decimal years; needed by a model with time dependence.

    Returns
    -------
    dict of int to Calibration
        In the unit of u, v.  The zero point of the first chip is exact by definition, and what the
        others' places share with it does not count.

    Raises
    ------
    InputError
        For a missing epoch.
    """
    model = solution.model
    if model.time is not None and epoch is None:
        raise InputError("depends on time and no date is given", where=name, do="give --epoch")
    epoch = None if model.time is None else epoch
    places = {c.number: place_of(model, epoch=epoch, chip=c.number) for c in model.chips}
    first = places[model.chips[0].number]
    zero = first.basis.evaluate(*np.array(first.chip.reference_pixel)[:, None])[0]
    origin = first.polynomial(solution.mean) @ zero
    by_origin = np.einsum("akd,k->ad", _jacobian(solution, first), zero)
    convergence = getattr(solution, "convergence", None)
    notes = () if convergence is None or convergence.converged else ("has not converged",)
    out = {}
    for number, place in places.items():
        coefficients = place.polynomial(solution.mean)
        coefficients[:, 0] -= origin  # the first basis function is 1
        jacobian = _jacobian(solution, place)
        jacobian[:, 0] -= by_origin
        flat = jacobian.reshape(-1, model.n_params)
        out[number] = Calibration(
            name,
            place.basis,
            model.unit,
            coefficients,
            flat @ np.asarray(solution.cov, float) @ flat.T,
            chip=number,
            epoch=place.epoch,
            notes=notes,
        )
    return out


def _jacobian(solution: Solution, place: Place) -> Float:
    """Derivatives (2, K, D) of a chip's polynomial by all parameters."""
    model = solution.model
    [(columns, d)] = model.effective_jacobian(solution.mean, place.group)
    out = np.zeros((2, place.basis.n_terms, model.n_params))
    out[:, :, columns] = d
    return out
