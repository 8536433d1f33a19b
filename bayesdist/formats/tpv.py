"""TPV headers: polynomials of intermediate world coordinates, one per chip, as written by SCAMP.

With (X, Y) = CD (p - CRPIX) in degrees and r its length, PV1_m multiplies the m-th of

    1, X, Y, r, X^2, XY, Y^2, X^3, ..., Y^3, r^3, X^4, ...

(each odd order n is followed by r^n, up to order 7), and PV2_m the same term with X and Y
exchanged.  Headers are built from a solution by exact algebra, without a fit.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from astropy.io import fits
from numpy.typing import ArrayLike

from bayesdist.calibration.calibration import Calibration, calibration_of_maps
from bayesdist.calibration.chip_map import ChipMap, fitted_map
from bayesdist.calibration.inverse import detector_grid
from bayesdist.calibration.orientation import placed_at, refuse_wide_planes
from bayesdist.calibration.plane import ARCSEC, Plane, arcsec_per
from bayesdist.errors import FormatError, InputError
from bayesdist.model import polynomial_terms
from bayesdist.products.common.cards import (
    convergence_cards,
    header_of,
    number_card,
    solution_cards,
    tangent_cards,
    text_card,
    wrapped_cards,
)
from bayesdist.products.common.celestial import (
    TangentForm,
    cd_matrix,
    image_size,
    refuse_singular,
    tangent_form,
)
from bayesdist.products.common.coefficients import require_regular, substitution
from bayesdist.products.common.content import Content, readable
from bayesdist.products.common.document import (
    PARAMETERS,
    BuildOptions,
    Built,
    Choice,
    Finding,
    Format,
    FormatSettings,
    finding_lines,
    required_size,
)
from bayesdist.products.common.parameters import parameters_content, with_parameters
from bayesdist.products.common.rules import (
    NO_SIZE,
    LinearPart,
    copies,
    mixed_parities,
    no_side_file,
    of_part,
    too_wide,
)
from bayesdist.products.common.wcs_text import describe_wcs
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
            heads.append(_parsed_head(header, place, location))
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


def _parsed_head(header: fits.Header, place: int, where: str) -> TpvHead:
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


NAME = "tpv.head"
_GRID = 33  # points per axis over which CRDER is the rms error


class TpvSettings(FormatSettings):
    """Configuration of TPV headers."""

    crval: tuple[float, float] | None = None


def build(
    calibration: Calibration, settings: TpvSettings, options: BuildOptions
) -> tuple[Built, ...]:
    """Build one text file with the headers of all chips, and the file with their covariance.

    CD is the linear part at the reference pixel, and PV hold all other terms including the
    constants. CRVAL is therefore the tangent point, wherever it is in the image. If the tangent
    point is unknown, CRVAL is (0, 0) as a placeholder. InputError for an order above 7, or for a
    calibration with look-up tables.
    """
    location = "products.tpv"
    calibration = placed_at(calibration, settings.crval, options.scale_arcsec, where=location)
    model = calibration.model
    if model.order > HIGHEST:
        raise InputError(
            f"TPV holds polynomials up to order {HIGHEST}, but this one has order {model.order}",
            where=location,
            do="fit a lower order, or write it with order 7 (--order 7 of convert)",
        )
    if calibration.before or calibration.after:
        raise InputError(
            "TPV has no look-up tables",
            where=location,
            do="give the order of a polynomial that replaces them",
        )
    refuse_wide_planes(calibration, options.epoch, options.scale_arcsec, where=location)
    arcsec = arcsec_per(model.unit, options.scale_arcsec)
    maps = calibration.at(options.epoch, origin="stated")
    heads = tuple(
        _built_head(chip_map, number, arcsec, calibration) for number, chip_map in maps.items()
    )
    name = options.named(NAME)
    side = f"{Path(name).stem}_parameters.fits"
    named = text_card(SIDE_FILE, side, "file with the covariance")
    cards = [str(card) for head in heads for card in (*head.header.cards, named, "END")]
    text = "\n".join(card.rstrip() for card in cards) + "\n"
    return (
        Built(side, PARAMETERS, parameters_content(calibration, options.epoch), calibration),
        Built(name, "TPV", text.encode("ascii"), heads),
    )


def _built_head(one: ChipMap, number: int, arcsec: float, calibration: Calibration) -> TpvHead:
    """Header of a chip; `arcsec` is the size of one unit of its map."""
    poly = one.monomials()
    require_regular(poly.linear, number)
    cd = poly.linear * arcsec / 3600.0
    values = poly.values * arcsec / 3600.0
    back = np.asarray(np.linalg.inv(cd), float)
    in_plane = np.asarray(values @ substitution(one.basis.order, back).T, float)
    in_plane[:, 1:3] = np.eye(2)  # identity by the choice of CD, except for rounding
    pv = [pv_values_of(axis, poly.terms, in_plane[axis]) for axis in (0, 1)]
    size = (int(one.basis.size[0]), int(one.basis.size[1]))
    crval = calibration.plane.point or (0.0, 0.0)
    head = TpvHead(
        number, calibration.numbered, ("RA---TPV", "DEC--TPV"), one.basis.reference_pixel,
        (float(crval[0]), float(crval[1])), cd, (pv[0], pv[1]), size,
    )  # fmt: skip
    cards = _cards(head, one, arcsec, calibration)
    return replace(head, header=header_of(cards))


def _cards(head: TpvHead, one: ChipMap, arcsec: float, calibration: Calibration) -> list[str]:
    cards = [
        text_card("COMMENT", f"Distortion of chip {head.number}, by bayesdist."),
        *wrapped_cards("COMMENT", calibration.remarks),
        *convergence_cards(calibration.solution),
        *tangent_cards(
            head.ctype, head.crval, head.crpix, head.cd, "tangent plane with polynomial"
        ),
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
    plane = "sky" if calibration.plane.point is not None else calibration.plane.kind
    if plane != "sky":
        cards.append(
            text_card("COMMENT", "Where u, v lie on the sky is not known: CRVAL is a placeholder.")
        )
    return cards + solution_cards(plane, one.unit, arcsec, head.number, one.basis.size, one.epoch)


def _describe(file: TpvFile) -> list[str]:
    """Lines of text on each chip by astropy.wcs, followed by all findings."""
    content, findings = file.content, lint_tpv(file)
    orders = sorted({head.order for head in file.heads})
    order = " to ".join(str(n) for n in dict.fromkeys((orders[0], orders[-1])))
    radial = ", and powers of r" if any(head.radial for head in file.heads) else ""
    covariance_note = f"; covariance in {file.side_file}" if file.side_file else ""
    title = f"TPV of order {order}{radial}{covariance_note}"
    if content.is_fits or len(file.heads) == 1:
        first, *lines = describe_wcs(content, findings)
        return [first, f"  {title}", *lines]
    lines = [f"{content.name}: {len(file.heads)} chips, {title}"]
    for head in file.heads:
        text = head.header.tostring(sep="\n", endcard=False, padding=False)
        chip_content = Content(f"chip {head.number}", text.encode("ascii", "replace"))
        lines += ["", *describe_wcs(chip_content)]
    return [*lines, "", f"{content.name}, all chips", *finding_lines(findings)]


# -- checks ---------------------------------------------------------------------------------------
_LARGE = 0.3  # fraction of the distance from CRPIX; no camera has a larger distortion
_LINEAR = LinearPart("CD", "has the parity of a mirror image: east lies to the right of north")
_ROUGH = 4096  # pixels; size assumed for a header without one


def lint_tpv(file: TpvFile) -> tuple[Finding, ...]:
    """Findings in TPV headers."""
    out: list[Finding] = []
    several = len(file.heads) > 1
    for head in file.heads:
        findings = (*_types(head), *_first_terms(head), *_scale(head), *_copies(head))
        out += of_part(f"chip {head.number}" if several else "", findings)
    out += list(_mosaic(file))
    if file.side_file and file.content.path and file.content.beside(file.side_file) is None:
        out.append(no_side_file("BDPARAM", file.side_file, "with the covariance"))
    return tuple(out)


def _types(head: TpvHead) -> Iterator[Finding]:
    types = ", ".join(head.ctype)
    if not head.ctype[0].startswith(("RA", "GLON", "ELON")):
        yield Finding("error", "CTYPE1", f"the axes are {types}: PV1 belong to the longitude")
    if all(t.endswith("-TAN") for t in head.ctype):
        yield Finding(
            "warning", "CTYPE1",
            "is TAN with the PV of a TPV, as SCAMP used to write: wcslib treats it as TPV, but "
            "programs that follow the standard ignore the distortion",
        )  # fmt: skip
    elif not all(t.endswith("-TPV") for t in head.ctype):
        yield Finding("error", "CTYPE1", f"the axes are {types}: only one of them is TPV")
    if head.size is None:
        yield NO_SIZE


def _first_terms(head: TpvHead) -> Iterator[Finding]:
    for axis, pv in enumerate(head.pv, start=1):
        first = pv.get(1)
        if first is None:
            yield Finding(
                "error", f"PV{axis}_1",
                "is missing: astropy.wcs takes it for 0, which maps the axis to a line, and other "
                "programs for 1",
            )  # fmt: skip
        elif first < 0:
            yield Finding("error", f"PV{axis}_1", f"is {first:g}: the axis runs backwards (parity)")
        elif not 0.5 < first < 2:
            yield Finding("warning", f"PV{axis}_1", f"is {first:g}, but 1 is usual")
        second = pv.get(2, 0.0)
        if first is not None and abs(second) > abs(first):
            yield Finding(
                "error", f"PV{axis}_2",
                f"is {second:g}, larger than PV{axis}_1: the order of the coefficients of axis 2 "
                "is that of Y before X",
            )  # fmt: skip


def _scale(head: TpvHead) -> Iterator[Finding]:
    det = float(np.linalg.det(head.cd))
    smallest = 1e-12 * np.abs(head.cd).max() ** 2
    yield from _LINEAR.findings(det, smallest=smallest)
    if abs(det) <= smallest:
        return
    size = head.size or (_ROUGH, _ROUGH)
    width = np.sqrt(abs(det)) * max(size)
    if wide := too_wide(
        width, "CD", "makes the image {width:.3g} degrees wide: its unit is the degree"
    ):
        yield from wide
        return
    if 1 not in head.pv[0] or 1 not in head.pv[1]:
        return
    x, y = detector_grid((float(size[0]), float(size[1])), 17)
    at, in_plane = head.intermediate(x, y), np.stack(head.plane(x, y))
    constant = np.array([pv.get(0, 0.0) for pv in head.pv])[:, None]
    first = [{m: pv.get(m, 0.0) for m in (1, 2)} for pv in head.pv]
    linear = np.stack([pv_value(axis, first[axis], *at) for axis in (0, 1)])
    bend = float(np.hypot(*(in_plane - constant - linear)).max())
    half = float(np.hypot(*at).max())
    if bend > _LARGE * half:
        yield Finding(
            "error", "PV",
            f"bend the field by {bend:.3g} of {half:.3g} degrees: they multiply powers of degrees, "
            "not of arcseconds or pixels, and their order is that of TPV",
        )  # fmt: skip


def _copies(head: TpvHead) -> Iterator[Finding]:
    named = {
        f"PV{axis}_{m}": value
        for axis, pv in enumerate(head.pv, start=1)
        for m, value in pv.items()
        if m not in (1, 2)
    }
    yield from copies(named, "have one value: one may be a copy")
    if head.radial:
        yield Finding("note", "PV", "has powers of r, which no polynomial follows exactly")
    high = [k for pv in head.pv for k, c in pv.items() if c and k in POWERS and sum(POWERS[k]) > 1]
    if not high and not head.radial:
        yield Finding("note", "PV", "no term above the linear ones: there is no distortion")


def _mosaic(file: TpvFile) -> Iterator[Finding]:
    yield from mixed_parities(
        (float(np.linalg.det(head.cd)) for head in file.heads),
        "CD",
        "chips are of different parity: check their order",
    )
    points = {head.crval for head in file.heads}
    if len(points) > 1:
        yield Finding("note", "CRVAL", "chips touch the sky at different points")


FORMAT = Format(
    "tpv", "TPV headers", 31, tpv_of, _describe, lint_tpv, tpv_calibration, TpvSettings, build,
    highest_order=HIGHEST, needs_scale=lambda settings: True, asks=("size",),
)  # fmt: skip
