"""TPV headers from a calibration: exact algebra, no fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.chip_map import ChipMap
from bayesdist.calibration.inverse import detector_grid
from bayesdist.calibration.plane import ARCSEC
from bayesdist.errors import InputError
from bayesdist.products.formats.common.cards import (
    convergence_cards,
    header_of,
    number_card,
    text_card,
    wrapped_cards,
)
from bayesdist.products.formats.common.coefficients import require_regular
from bayesdist.products.formats.tpv.head import (
    HIGHEST,
    SIDE_FILE,
    TpvHead,
    pv_values_of,
    substitution,
)

__all__ = ["tpv_cards", "tpv_heads"]

_GRID = 33  # points of each axis over which CRDER is the rms error


def tpv_heads(
    calibration: Calibration,
    *,
    epoch: float | None = None,
    scale_arcsec: float | None = None,
) -> tuple[TpvHead, ...]:
    """Headers of all chips at a date, with their cards.

    CD is the linear part at the reference pixel, and PV hold the rest, the constants too: so CRVAL
    is the point at which the plane touches the sky, whatever pixel lies there.  Without it CRVAL is
    (0, 0), a placeholder.  InputError for an order above 7, or a calibration with look-up tables.
    """
    where = "products.tpv"
    model, point = calibration.model, calibration.plane.point
    if model.order > HIGHEST:
        raise InputError(
            f"TPV holds polynomials up to order {HIGHEST}, and this one has order {model.order}",
            where=where,
            do="fit a lower order, or convert with --order 7, which says what is lost",
        )
    if calibration.before or calibration.after:
        raise InputError(
            "TPV has no look-up tables", where=where, do="convert it, which says what is lost"
        )
    arcsec = ARCSEC[model.unit] if model.unit != "pix" else (scale_arcsec or 1.0)
    at = point or (0.0, 0.0)
    kind = "sky" if point is not None else calibration.plane.kind
    return tuple(
        _head(one, number, arcsec, at, kind, calibration)
        for number, one in calibration.at(epoch, origin="stated").items()
    )


def _head(
    one: ChipMap,
    number: int,
    arcsec: float,
    crval: tuple[float, float],
    plane: str,
    calibration: Calibration,
) -> TpvHead:
    poly = one.monomials()
    require_regular(poly.linear, number)
    cd = poly.linear * arcsec / 3600.0
    values = poly.values * arcsec / 3600.0
    back = np.asarray(np.linalg.inv(cd), float)
    in_plane = np.asarray(values @ substitution(one.basis.order, back).T, float)
    in_plane[:, 1:3] = np.eye(2)  # by the choice of CD, but for rounding
    pv = [pv_values_of(axis, poly.terms, in_plane[axis]) for axis in (0, 1)]
    size = (int(one.basis.size[0]), int(one.basis.size[1]))
    head = TpvHead(
        number, calibration.numbered, ("RA---TPV", "DEC--TPV"), one.basis.reference_pixel,
        (float(crval[0]), float(crval[1])), cd, (pv[0], pv[1]), size,
    )  # fmt: skip
    cards = _cards(head, one, arcsec, plane, calibration)
    return replace(head, header=header_of(cards))


def _cards(
    head: TpvHead, one: ChipMap, arcsec: float, plane: str, calibration: Calibration
) -> list[str]:
    cards = [
        text_card("COMMENT", f"Distortion of chip {head.number}, by bayesdist."),
        *wrapped_cards("COMMENT", filter(None, [*calibration.notes, calibration.plane.note])),
        *convergence_cards(calibration.solution),
        number_card("WCSAXES", 2),
        text_card("CTYPE1", head.ctype[0], "tangent plane with polynomial"),
        text_card("CTYPE2", head.ctype[1]),
        text_card("CUNIT1", "deg"),
        text_card("CUNIT2", "deg"),
        text_card("RADESYS", "ICRS"),
        *(number_card(f"CRVAL{k}", v, "[deg]") for k, v in enumerate(head.crval, 1)),
        *(number_card(f"CRPIX{k}", v, "[pix]") for k, v in enumerate(head.crpix, 1)),
        *(
            number_card(f"CD{i + 1}_{j + 1}", float(head.cd[i, j]), "[deg/pix]")
            for i in (0, 1)
            for j in (0, 1)
        ),
        number_card("LONPOLE", 180.0, "[deg] north is up also at a pole"),
    ]
    for axis, pv in enumerate(head.pv, start=1):
        cards += [number_card(f"PV{axis}_{m}", value) for m, value in pv.items()]
    cov = one.covariance_at(*detector_grid(one.basis.size, _GRID))
    if cov is not None:
        rms = np.sqrt(cov.mean(axis=0).diagonal()) * arcsec / 3600.0
        cards += [
            number_card(f"CRDER{k}", float(v), "[deg] rms error by the solution")
            for k, v in enumerate(rms, 1)
        ]
    if plane != "sky":
        cards.append(
            text_card("COMMENT", "Where u, v lie on the sky is not known: CRVAL is a placeholder.")
        )
    cards += [
        text_card("BDPLANE", plane, "plane of u, v"),
        text_card("BDUNIT", one.unit, "unit of u, v in the solution"),
        number_card("BDARCS", float(arcsec), "[arcsec] in one of these units"),
        number_card("BDCHIP", head.number, "chip number"),
    ]
    if one.epoch is not None:
        cards.append(number_card("BDEPOCH", float(one.epoch), "[yr] date of the coefficients"))
    columns, rows = map(int, one.basis.size)
    return [
        *cards,
        number_card("IMAGEW", columns, "[pix] columns of the detector"),
        number_card("IMAGEH", rows, "[pix] rows of the detector"),
    ]


def tpv_cards(head: TpvHead, side_file: str) -> list[str]:
    """Cards of a header that names the file with its covariance, END included."""
    cards = [str(card) for card in head.header.cards]
    if side_file:
        cards.append(text_card(SIDE_FILE, side_file, "file with the covariance"))
    return [*cards, "END".ljust(80)]
