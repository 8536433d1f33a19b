"""The calibrations that a product file holds: IDCTAB, SIP header, WISE meta-data."""

from __future__ import annotations

import os

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.calibration import Calibration, calibration_of_map
from bayesdist.errors import FormatError, InputError
from bayesdist.model import polynomial_terms
from bayesdist.products.formats.common.content import read_hdus
from bayesdist.products.idctab import IdcTab
from bayesdist.products.idctab_row_covariance import covariance_of_row
from bayesdist.products.sip import SIP_ORDERS, SipHeader
from bayesdist.products.sip_read import holds_sip, read_sip
from bayesdist.products.wise_meta import holds_wise_meta, read_wise_meta

__all__ = ["calibrations_of_idctab", "read_calibrations"]

Float = NDArray[np.float64]
Size = tuple[float, float]


def read_calibrations(
    path: str | os.PathLike[str],
    *,
    filter: str | None = None,
    epoch: float | None = None,
    size: Size | None = None,
) -> dict[int | None, Calibration]:
    """Calibrations of a file, by chip number; None where the file knows of no chips.

    Parameters
    ----------
    path : path-like
        The kind of file is told by its content.
    filter : str, optional
        Of an IDCTAB whose coefficients differ from filter to filter; the band of WISE meta-data,
        as in "W2".
    epoch : float, optional
        Decimal years, for the time-dependent terms of an IDCTAB.
    size : tuple of float, optional
        Columns and rows, for a SIP header that does not say.

    Returns
    -------
    dict of int or None to Calibration

    Raises
    ------
    InputError
        For a file of none of these kinds, a filter or band that it does not have or that has to be
        named, an epoch that it cannot be brought to, or a SIP header without a size.
    """
    name = str(path)
    try:
        hdus = read_hdus(path)
    except FormatError:
        hdus = ()
    if len(hdus) > 1 and "XREF" in hdus[1].header.values():
        return calibrations_of_idctab(IdcTab(hdus, name), filter=filter, epoch=epoch)
    if holds_sip(path):
        return {None: _of_sip(read_sip(path), name, size)}
    if holds_wise_meta(path):
        return {None: _of_wise(path, filter)}
    raise InputError(
        "is neither an IDCTAB, nor a SIP header, nor WISE meta-data, nor a fit or a posterior",
        where=name,
        do="give one of these, or a run directory",
    )


# -- IDCTAB --------------------------------------------------------------------------------------


def calibrations_of_idctab(
    tab: IdcTab, *, filter: str | None = None, epoch: float | None = None
) -> dict[int | None, Calibration]:
    """Every chip of an IDCTAB, with the covariance that the file may hold.

    Parameters
    ----------
    tab : IdcTab
    filter : str, optional
        Names of both wheels may be joined by a comma.
    epoch : float, optional
        Decimal years; without it the coefficients are those of the reference date.

    Returns
    -------
    dict of int or None to Calibration
    """
    names = None if filter is None else [part.strip() for part in filter.split(",")]
    chips = [1]
    if "DETCHIP" in tab.columns:
        chips = sorted({int(row["DETCHIP"]) for row in tab.rows})
    out: dict[int | None, Calibration] = {}
    for chip in chips:
        row = tab.row(chip, names)
        record = tab.rows[row]
        notes = []
        drifts = any(rate for key, rate in tab.tdd.items() if key != "TDD_DATE")
        if epoch is None and tab.tdd_scheme == "2015" and drifts:
            notes.append(f"at the reference date {tab.tdd['TDD_DATE']:g} of its drift")
        if epoch is None and tab.tdd_scheme in ("2014", "order", "default"):
            notes.append("without the drift that stwcs applies to it")
        out[chip] = calibration_of_map(
            lambda x, y, chip=chip: tab.evaluate(chip, x, y, filter=names, epoch=epoch),  # type: ignore[misc]
            tab.name,
            order=tab.norder,
            size=(float(record["XSIZE"]), float(record["YSIZE"])),
            reference_pixel=(float(record["XREF"]), float(record["YREF"])),
            unit="arcsec",
            monomial_cov=covariance_of_row(tab, row, chip, epoch),
            chip=chip,
            epoch=epoch,
            notes=tuple(notes),
        )
    return out


# -- SIP and WISE --------------------------------------------------------------------------------


def _of_sip(sip: SipHeader, name: str, size: Size | None) -> Calibration:
    found: Size | None = size if sip.size is None else (float(sip.size[0]), float(sip.size[1]))
    if found is None:
        raise InputError(
            "does not say how large the image is",
            where=name,
            do="add NAXIS1 and NAXIS2 (or IMAGEW and IMAGEH), or compare it with a file that says",
        )

    def positions(x: Float, y: Float) -> tuple[Float, Float]:
        xi, eta = sip.plane(x, y)
        return 3600.0 * xi, 3600.0 * eta

    return calibration_of_map(
        positions,
        name,
        order=_order(sip),
        size=found,
        reference_pixel=sip.crpix,
        unit="arcsec",
        monomial_cov=_sip_variances(sip, 3600.0 * sip.cd),
        correlated=False,
    )


def _of_wise(path: str | os.PathLike[str], band: str | None) -> Calibration:
    bands = {f"W{one.band}": one for one in read_wise_meta(path)}
    chosen = (band or "").upper()
    if band is not None and chosen not in bands:
        raise InputError(
            f"there is no band {band}", where=str(path), do=f"choose one of {', '.join(bands)}"
        )
    if band is None and len(bands) > 1:
        raise InputError(
            f"holds the bands {', '.join(bands)}",
            where=str(path),
            do="name one by --filter, or one for each file as in --filter W1:W2",
        )
    one = bands[chosen] if band is not None else next(iter(bands.values()))
    assert one.sip.size is not None
    return calibration_of_map(
        one.sip.forward,
        f"{path}, W{one.band}",
        order=_order(one.sip),
        size=(float(one.sip.size[0]), float(one.sip.size[1])),
        reference_pixel=one.sip.crpix,
        unit="pix",
        monomial_cov=_sip_variances(one.sip, np.eye(2)),
        correlated=False,
        notes=("without the SKEW of its CD matrix",) if one.skew else (),
    )


def _order(sip: SipHeader) -> int:
    """Order of the polynomial that programs apply."""
    return max(sip.order) if min(sip.order) >= SIP_ORDERS[0] else 1


def _sip_variances(sip: SipHeader, linear: Float) -> Float | None:
    """Variances of the header's sigmas, behind a linear map; None where there are none."""
    if not sip.sigma_a and not sip.sigma_b:
        return None
    terms = polynomial_terms(_order(sip))
    sigma = [float(s.get(t, 0.0)) for s in (sip.sigma_a, sip.sigma_b) for t in terms]
    turn = np.kron(linear, np.eye(len(terms)))
    return (turn * np.array(sigma) ** 2) @ turn.T
