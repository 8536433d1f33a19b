"""Headers with CTYPE TPV, one per chip, the powers that PVi_m multiply, and their calibration.

With (X, Y) = CD (p - CRPIX) in degrees and r its length, PV1_m multiplies the m-th of

    1, X, Y, r, X^2, XY, Y^2, X^3, ..., Y^3, r^3, X^4, ...

(each odd order n is followed by r^n, up to order 7), and PV2_m the same term with X and Y
exchanged.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from astropy.io import fits
from numpy.typing import ArrayLike

from bayesdist.calibration.calibration import Calibration, calibration_of_maps
from bayesdist.calibration.chip_map import ChipMap, fitted_map
from bayesdist.calibration.inverse import detector_grid
from bayesdist.calibration.plane import ARCSEC, Plane
from bayesdist.errors import FormatError, InputError
from bayesdist.model import polynomial_terms
from bayesdist.products.common.celestial import TangentForm, refuse_singular, tangent_form
from bayesdist.products.common.content import Content, readable
from bayesdist.products.common.document import Choice, required_size
from bayesdist.products.common.linear_wcs import cd_matrix, image_size
from bayesdist.products.common.parameters import with_parameters
from bayesdist.utils.arrays import Float

Powers = tuple[int, int]

HIGHEST = 7  # highest order of a TPV
KEYWORD = re.compile(r"PV([12])_(\d+)$")


def _numbers() -> tuple[dict[int, Powers], dict[int, int]]:
    """Powers of X and Y by m, and powers of r by m."""
    powers, radial, m = {}, {}, 0
    for n in range(HIGHEST + 1):
        for term in polynomial_terms(n)[-(n + 1) :]:
            powers[m] = term
            m += 1
        if n % 2:
            radial[m] = n
            m += 1
    return powers, radial


POWERS, RADIAL = _numbers()
_NUMBER_OF = {term: m for m, term in POWERS.items()}


def pv_value(axis: int, pv: Mapping[int, float], X: ArrayLike, Y: ArrayLike) -> Float:
    """Polynomial of an axis (0 or 1) at intermediate coordinates X and Y, degrees."""
    first, second = (np.asarray(v, float) for v in ((X, Y) if axis == 0 else (Y, X)))
    r = np.hypot(first, second)
    out = np.zeros(first.shape)
    for m, value in pv.items():
        if m in RADIAL:
            out += value * r ** RADIAL[m]
        else:
            i, j = POWERS[m]
            out += value * first**i * second**j
    return out


def pv_values_of(axis: int, terms: tuple[Powers, ...], values: Float) -> dict[int, float]:
    """PVi_m of an axis by m, from the coefficients (K,) of powers of X and Y."""
    named = {
        _NUMBER_OF[term if axis == 0 else term[::-1]]: float(value)
        for term, value in zip(terms, values, strict=True)
    }
    return dict(sorted(named.items()))


SIDE_FILE = "BDPARAM"  # keyword with the name of the file that has the covariance
# from this m on, wcslib and astropy.wcs interpret the PV of a TAN as those of a TPV
_BEYOND_TAN = 5
_CHIP = ("BDCHIP", "CCDNUM", "CCDCHIP", "EXTVER")


@dataclass(frozen=True, eq=False)
class TpvHead:
    """World coordinates of one chip."""

    number: int  # chip number; the position in the file if no keyword states it
    numbered: bool
    ctype: tuple[str, str]
    crpix: tuple[float, float]
    crval: tuple[float, float]  # degrees
    cd: Float  # (2, 2), degrees per pixel
    pv: tuple[Mapping[int, float], Mapping[int, float]]  # PV1_m and PV2_m by m
    size: tuple[int, int] | None = None
    header: fits.Header = field(default_factory=fits.Header)

    @property
    def order(self) -> int:
        """Largest total power with a non-zero coefficient, at least 1."""
        orders = [sum(POWERS[m]) for pv in self.pv for m, c in pv.items() if c and m in POWERS]
        return max(1, *orders) if orders else 1

    @property
    def radial(self) -> bool:
        """True if a power of r has a non-zero coefficient."""
        return any(pv.get(m, 0.0) for pv in self.pv for m in RADIAL)

    def intermediate(self, x: ArrayLike, y: ArrayLike) -> Float:
        """Intermediate coordinates (2, N) of FITS 1-based pixels (N,), degrees."""
        offset = np.stack([np.asarray(x, float), np.asarray(y, float)])
        offset = offset - np.array(self.crpix)[:, None]
        return np.asarray(self.cd @ offset)

    def plane(self, x: ArrayLike, y: ArrayLike) -> tuple[Float, Float]:
        """Positions xi, eta (N,) of FITS 1-based pixels on the tangent plane of CRVAL, degrees."""
        at = self.intermediate(x, y)
        return pv_value(0, self.pv[0], *at), pv_value(1, self.pv[1], *at)


@dataclass(frozen=True, eq=False)
class TpvFile:
    """Headers of a file, one per chip."""

    content: Content
    heads: tuple[TpvHead, ...]

    @property
    def side_file(self) -> str:
        """Name of the file with the parameters; empty if none is named."""
        return str(self.heads[0].header.get(SIDE_FILE, "")).strip()


def tpv_of(content: Content) -> TpvFile | None:
    """TPV headers in the content of a file; None if there are none."""
    headers = [h for h in _headers(content) if holds_tpv(h)]
    if not headers:
        return None
    heads = []
    for place, header in enumerate(headers, start=1):
        location = content.name if len(headers) == 1 else f"{content.name}, TPV header {place}"
        with readable(location):
            heads.append(_head(header, place, location))
    numbers = [head.number for head in heads]
    if len(set(numbers)) < len(numbers):
        raise FormatError(
            f"has several headers of chip {max(numbers, key=numbers.count)}",
            where=content.name,
            do="number the chips by BDCHIP or CCDNUM",
        )
    return TpvFile(content, tuple(heads))


def holds_tpv(header: fits.Header) -> bool:
    """True for a header with celestial axes of type TPV, or TAN with SCAMP's PV."""
    types = [str(header.get(f"CTYPE{k}", "")) for k in (1, 2)]
    if "A_ORDER" in header or "CPDIS1" in header or "CPDIS2" in header:
        return False
    if any(t.endswith("TPV") for t in types):
        return True
    numbers = [int(match[2]) for keyword in header if (match := KEYWORD.match(keyword))]
    return all(t.endswith("-TAN") for t in types) and max(numbers, default=0) >= _BEYOND_TAN


def _headers(content: Content) -> list[fits.Header]:
    """Headers of a FITS file, or of a text file with an END after each header."""
    lines = content.text.splitlines()
    if content.is_fits or len(lines) < 2 or "CTYPE1" not in content.text:
        return [hdu.header for hdu in content.hdus]
    out, cards = [], list[str]()
    for line in [*lines, "END"]:
        if line.strip() != "END":
            # replaces Latin-1 characters in comments
            cards.append(line.encode("ascii", "replace").decode())
        elif any(cards):
            with readable(content.name):
                out.append(fits.Header.fromstring("\n".join(cards), sep="\n"))
            cards = []
    return out


def _head(header: fits.Header, place: int, where: str) -> TpvHead:
    pv: tuple[dict[int, float], dict[int, float]] = ({}, {})
    for keyword in header:
        if (match := KEYWORD.match(keyword)) is not None:
            m = int(match[2])
            if m not in POWERS and m not in RADIAL:
                raise FormatError(
                    "is of an order above 7, which TPV cannot represent",
                    where=f"{where}, keyword {keyword}",
                    do="remove it, or lower the order",
                )
            pv[int(match[1]) - 1][m] = _number(header, keyword, where)
    keyword = next((k for k in _CHIP if isinstance(header.get(k), int)), None)
    return TpvHead(
        number=place if keyword is None else int(header[keyword]),
        numbered=keyword is not None,
        ctype=(str(header["CTYPE1"]), str(header["CTYPE2"])),
        crpix=(_number(header, "CRPIX1", where), _number(header, "CRPIX2", where)),
        crval=(_number(header, "CRVAL1", where), _number(header, "CRVAL2", where)),
        cd=cd_matrix(header, where),
        pv=pv,
        size=image_size(header),
        header=header,
    )


def _number(header: fits.Header, keyword: str, where: str) -> float:
    value = header.get(keyword)
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        problem = "is missing" if value is None else f"value {value!r} is not a finite number"
        raise FormatError(problem, where=f"{where}, keyword {keyword}", do="correct the header")
    return float(value)


# -- calibration ----------------------------------------------------------------------------------

_RADIAL_ORDER = 9  # order of the polynomial that approximates odd powers of r
_EXACT = 1e-9  # pixels; with a smaller difference the map counts as exactly polynomial


def tpv_calibration(file: TpvFile, name: str, choice: Choice) -> Calibration:
    """Calibration of the headers, with the covariance of their parameter file if that exists.

    With ``choice.as_used``, only the headers are used. Odd powers of r are not polynomials; a note
    states how well they are approximated. MissingSizeError if neither the headers nor `choice` give
    the size; FormatError for headers without PV1_1 or PV2_1, for headers with several tangent
    points, and if the stored parameters disagree with the headers.
    """
    _check(file, name)
    maps, notes = {}, list[str]()
    forms = {head.number: _form(head, name) for head in file.heads}
    order = max(_RADIAL_ORDER if head.radial else head.order for head in file.heads)
    header = file.heads[0].header
    unit = str(header.get("BDUNIT", "arcsec"))
    factor = 3600.0 / float(header.get("BDARCS", ARCSEC.get(unit, 1.0)))
    for head in file.heads:
        chip_map, worst = _map(head, name, order, choice.size, unit, factor, forms[head.number])
        maps[head.number] = chip_map
        if head.radial:
            notes.append(
                f"powers of r of chip {head.number} are followed by a polynomial of order "
                f"{order}, {worst:.2g} pix off at worst"
            )
    kind = str(header.get("BDPLANE", "sky"))
    plane = Plane(kind, point=forms[file.heads[0].number].point if kind == "sky" else None)
    calibration = calibration_of_maps(
        maps, name, plane=plane, numbered=all(h.numbered for h in file.heads), notes=tuple(notes)
    )
    if choice.as_used:
        return calibration
    parameter_content = (
        file.content if file.content.is_fits else file.content.beside(file.side_file)
    )
    return with_parameters(calibration, parameter_content, file.side_file)


def _form(head: TpvHead, name: str) -> TangentForm:
    """Tangent form of a header; FormatError if it has no celestial axes."""
    refuse_singular(head.cd, name)
    form = tangent_form(head.header, name)
    if form is None:
        raise FormatError(
            f"has the axes {', '.join(head.ctype)}, which are not positions on the sky",
            where=name,
            do="correct CTYPE",
        )
    if (form.wcs.wcs.get_cdelt() != 1).any():
        raise InputError(
            "does not state its linear part as CD in degrees: programs disagree on the unit in "
            "which PV are then applied (wcslib applies them before CDELT)",
            where=name,
            do="write CD in degrees, CUNIT 'deg' and no CDELT",
        )
    return form


def _check(file: TpvFile, name: str) -> None:
    first = file.heads[0]
    for head in file.heads:
        for axis in (1, 2):
            if head.pv[axis - 1].get(1) is None:
                raise FormatError(
                    f"has no PV{axis}_1, which some programs take for 0 and some for 1",
                    where=name,
                    do=f"write PV{axis}_1 = 1.0 where that is meant",
                )
        if not head.ctype[0].startswith(("RA", "GLON", "ELON")):
            raise FormatError(
                f"has the axes {', '.join(head.ctype)}", where=name, do="name the longitude first"
            )
        if not np.allclose(head.crval, first.crval, rtol=0, atol=1e-12):
            raise InputError(
                f"its chips {first.number} and {head.number} touch the sky at different points",
                where=name,
                do="give headers with the same CRVAL, as from one exposure of a mosaic",
            )


def _map(
    head: TpvHead,
    name: str,
    order: int,
    given: tuple[float, float] | None,
    unit: str,
    factor: float,
    form: TangentForm,
) -> tuple[ChipMap, float]:
    """Map of one chip and its largest error in pixels; `factor` is a degree in `unit`."""
    size = required_size(head.size, given, name)

    def positions(x: Float, y: Float) -> Float:
        at = form.cd @ (np.stack([x, y]) - np.array(head.crpix)[:, None])
        plane = np.stack([pv_value(axis, head.pv[axis], *at) for axis in (0, 1)])
        return np.asarray(factor * (form.turn @ plane))

    form.check(lambda x, y: positions(x, y) / factor, size, head.header, name)
    chip_map = fitted_map(
        positions, name, order=order, size=size, reference_pixel=head.crpix, unit=unit
    )
    x, y = detector_grid(size, 65)
    far = np.hypot(*(chip_map.at(x, y) - positions(x, y)))
    worst = float(far.max() / np.sqrt(abs(np.linalg.det(factor * form.cd))))
    return chip_map, 0.0 if worst < _EXACT else worst
