"""Format of TPV headers: checks, and building by exact algebra, without a fit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.chip_map import ChipMap
from bayesdist.calibration.inverse import detector_grid
from bayesdist.calibration.orientation import placed_at, refuse_wide_planes
from bayesdist.calibration.plane import arcsec_per
from bayesdist.errors import InputError
from bayesdist.formats.tpv.head import (
    HIGHEST,
    POWERS,
    SIDE_FILE,
    TpvFile,
    TpvHead,
    pv_value,
    pv_values_of,
    tpv_calibration,
    tpv_of,
)
from bayesdist.products.common.cards import (
    convergence_cards,
    header_of,
    number_card,
    solution_cards,
    tangent_cards,
    text_card,
    wrapped_cards,
)
from bayesdist.products.common.coefficients import require_regular, substitution
from bayesdist.products.common.content import Content
from bayesdist.products.common.document import (
    PARAMETERS,
    BuildOptions,
    Built,
    Finding,
    Format,
    FormatSettings,
    finding_lines,
)
from bayesdist.products.common.parameters import parameters_content
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
    heads = tuple(_head(chip_map, number, arcsec, calibration) for number, chip_map in maps.items())
    name = options.named(NAME)
    side = f"{Path(name).stem}_parameters.fits"
    named = text_card(SIDE_FILE, side, "file with the covariance")
    cards = [str(card) for head in heads for card in (*head.header.cards, named, "END")]
    text = "\n".join(card.rstrip() for card in cards) + "\n"
    return (
        Built(side, PARAMETERS, parameters_content(calibration, options.epoch), calibration),
        Built(name, "TPV", text.encode("ascii"), heads),
    )


def _head(one: ChipMap, number: int, arcsec: float, calibration: Calibration) -> TpvHead:
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
