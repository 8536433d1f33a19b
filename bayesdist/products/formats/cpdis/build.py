"""FITS file with CPDIS look-up tables from a calibration, on nodes as fine as is asked for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from astropy.io import fits

from bayesdist.arrays import Float
from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.chip_map import ChipMap
from bayesdist.calibration.inverse import detector_grid
from bayesdist.calibration.plane import ARCSEC
from bayesdist.model import LookupTable
from bayesdist.products.formats.common.cards import (
    convergence_cards,
    number_card,
    text_card,
    wrapped_cards,
)
from bayesdist.products.formats.common.coefficients import require_regular
from bayesdist.products.formats.common.content import hdus_of
from bayesdist.products.formats.common.parameters import parameters_hdu
from bayesdist.products.formats.cpdis.file import ERRORS, TABLES

__all__ = ["cpdis_content"]

_CLOSE = 1e-4  # pixels: error between nodes that is aimed at where no step is asked for
_STEPS = (64.0, 32.0, 16.0, 8.0, 4.0)  # pixels
_MOST = 1025  # nodes of an axis
_CHECK = 397  # points of each axis at which the tables are compared with the map


def cpdis_content(
    calibration: Calibration,
    *,
    epoch: float | None = None,
    step: float | None = None,
    scale_arcsec: float | None = None,
    notes: Sequence[str] = (),
) -> tuple[bytes, float]:
    """Bytes of a file, and its largest error in pixels: of rounding, and between its nodes.

    `step` is pixels between nodes; by default as many as leave 1e-4 pixels, at least 4.
    """
    arcsec = ARCSEC[calibration.unit] if calibration.unit != "pix" else (scale_arcsec or 1.0)
    maps = calibration.with_tables(calibration.at(epoch, origin="stated"))
    images, tables, worst = [], [], 0.0
    for k, (number, one) in enumerate(maps.items()):
        linear, crpix = _linear_part(one, number)
        table, off = _sampled(one, linear, crpix, step)
        worst = max(worst, off)
        versions = (2 * k + 1, 2 * k + 2)
        cards = [
            *_wcs_cards(calibration, linear * arcsec / 3600, crpix),
            *_record_cards(table, versions),
            number_card("BDWORST", off, "[pix] of rounding and between nodes"),
            *(
                [number_card("BDTABLES", 1, "look-up tables are in it")]
                if one.before or one.after
                else []
            ),
            text_card("BDPLANE", calibration.plane.kind, "plane of u, v"),
            text_card("BDUNIT", calibration.unit, "unit of u, v in the solution"),
            number_card("BDARCS", float(arcsec), "[arcsec] in one of these units"),
            number_card("BDCHIP", number, "chip number"),
            number_card("IMAGEW", int(one.basis.size[0]), "[pix] columns of the detector"),
            number_card("IMAGEH", int(one.basis.size[1]), "[pix] rows of the detector"),
            *wrapped_cards("COMMENT", notes),
            *convergence_cards(calibration.solution),
        ]
        image = fits.ImageHDU(name="SCI", ver=k + 1)
        for card in cards:
            image.header.append(fits.Card.fromstring(card), end=True)
        images.append(image)
        sigma = _sigma(one, linear, table)
        for axis, version in enumerate(versions):
            tables.append(_table_hdu(TABLES, version, table.values[axis], table))
            if sigma is not None:
                tables.append(_table_hdu(ERRORS, version, sigma[axis], table))
    made = hdus_of([fits.PrimaryHDU(), *images, *tables, parameters_hdu(calibration, epoch)])
    return b"".join(hdu.to_bytes() for hdu in made), worst


def _linear_part(one: ChipMap, number: int) -> tuple[Float, tuple[float, float]]:
    """Linear part (2, 2) of the polynomial, and the pixel at which it has (u, v) = 0."""
    poly = one.monomials()
    require_regular(poly.linear, number)
    zero = np.array(one.basis.reference_pixel) - np.linalg.solve(poly.linear, poly.constant)
    return poly.linear, (float(zero[0]), float(zero[1]))


def _sampled(
    one: ChipMap, linear: Float, crpix: tuple[float, float], step: float | None
) -> tuple[LookupTable, float]:
    """Table of the shifts in single precision, and its largest error, pixels."""
    if one.basis.order == 1 and len(one.before) == 1 and not one.after:
        table = one.before[0]
        return _checked(one, linear, crpix, table.first, table.step, table.shape[::-1])
    for asked in _STEPS if step is None else (step,):
        counts = [int(min(max(np.ceil(n / asked), 1), _MOST - 1)) + 1 for n in one.basis.size]
        steps = [n / (count - 1) for n, count in zip(one.basis.size, counts, strict=True)]
        found = _checked(
            one, linear, crpix, (0.5, 0.5), (steps[0], steps[1]), (counts[0], counts[1])
        )
        if found[1] <= _CLOSE:
            break
    return found


def _checked(
    one: ChipMap,
    linear: Float,
    crpix: tuple[float, float],
    first: tuple[float, float],
    step: tuple[float, float],
    counts: tuple[int, int],
) -> tuple[LookupTable, float]:
    def shifts(x: Float, y: Float) -> Float:
        moved = np.linalg.solve(linear, one.at(x, y)) + np.array(crpix)[:, None]
        return moved - np.stack([x, y])

    x, y = np.meshgrid(*(f + s * np.arange(n) for f, s, n in zip(first, step, counts, strict=True)))
    values = shifts(x.ravel(), y.ravel()).reshape(2, *x.shape).astype(np.float32)
    table = LookupTable(one.chip or 1, np.asarray(values, float), first=first, step=step)
    x, y = detector_grid(one.basis.size, _CHECK)
    off = np.hypot(*(table.evaluate(x, y).T - shifts(x, y)))
    return table, float(off.max())


def _sigma(one: ChipMap, linear: Float, table: LookupTable) -> Float | None:
    """Standard errors (2, ny, nx) of the nodes, pixels; None without errors."""
    cov = one.covariance_at(*(v.ravel() for v in np.meshgrid(*table.nodes())))
    if cov is None:
        return None
    back = np.linalg.inv(linear)
    moved = back @ cov @ back.T
    return np.sqrt(moved.diagonal(axis1=1, axis2=2)).T.reshape(2, *table.shape)


def _wcs_cards(calibration: Calibration, cd: Float, crpix: tuple[float, float]) -> list[str]:
    known = calibration.plane.point
    at = known or (0.0, 0.0)
    return [
        number_card("WCSAXES", 2),
        text_card("CTYPE1", "RA---TAN"),
        text_card("CTYPE2", "DEC--TAN"),
        text_card("CUNIT1", "deg"),
        text_card("CUNIT2", "deg"),
        text_card("RADESYS", "ICRS"),
        *(number_card(f"CRVAL{k}", float(v), "[deg]") for k, v in enumerate(at, 1)),
        *(number_card(f"CRPIX{k}", v, "[pix]") for k, v in enumerate(crpix, 1)),
        *(
            number_card(f"CD{i + 1}_{j + 1}", float(cd[i, j]), "[deg/pix]")
            for i in (0, 1)
            for j in (0, 1)
        ),
        number_card("LONPOLE", 180.0, "[deg] north is up also at a pole"),
        *([] if known else [text_card("COMMENT", "CRVAL is a placeholder.")]),
    ]


def _record_cards(table: LookupTable, versions: tuple[int, int]) -> list[str]:
    """Cards of CPDIS and of the DP records."""
    cards = []
    for axis, version in enumerate(versions, start=1):
        largest = float(np.abs(table.values[axis - 1]).max())
        cards += [
            text_card(f"CPDIS{axis}", "LOOKUP", "prior distortion by a table"),
            number_card(f"CPERR{axis}", largest, "[pix] largest correction"),
            *(
                text_card(f"DP{axis}", f"{field}: {value:.1f}")
                for field, value in (
                    ("EXTVER", version), ("NAXES", 2), ("AXIS.1", 1), ("AXIS.2", 2),
                )
            ),
        ]  # fmt: skip
    return cards


def _table_hdu(name: str, version: int, plane: Float, table: LookupTable) -> fits.ImageHDU:
    hdu = fits.ImageHDU(np.asarray(plane, np.float32), name=name, ver=version)
    for axis in (0, 1):
        for keyword, value, comment in (
            ("CRPIX", 1.0, "node, from 1"),
            ("CRVAL", table.first[axis], "[pixel] of that node, from 1"),
            ("CDELT", table.step[axis], "[pixel] between nodes"),
        ):
            card = number_card(f"{keyword}{axis + 1}", float(value), comment)
            hdu.header.append(fits.Card.fromstring(card), end=True)
    hdu.header["BUNIT"] = "pixel"
    return hdu
