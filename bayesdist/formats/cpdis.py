"""Images with look-up tables in their headers: CPDISi = 'LOOKUP' with DPi records (FITS Paper IV).

    p' = p + (table 1, table 2)(p),    (x, y) = CD (p' - CRPIX)

The tables are in pixels and are stored in extensions WCSDVARR of the same file. Node k (from 1) of
axis a is at pixel CRVALa + (k - CRPIXa) CDELTa. Files written by bayesdist have further extensions,
which other programs ignore: WCSDVERR with the standard errors of the nodes, and BDPARAM with the
parameters and their covariance.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from astropy.io import fits
from pydantic import PositiveFloat

from bayesdist.calibration.calibration import Calibration, calibration_of_maps
from bayesdist.calibration.chip_map import ChipMap, fitted_map
from bayesdist.calibration.inverse import detector_grid
from bayesdist.calibration.orientation import placed_at, refuse_wide_planes
from bayesdist.calibration.plane import ARCSEC, Plane, arcsec_per
from bayesdist.errors import FormatError, InputError
from bayesdist.model import LookupTable
from bayesdist.products.common.cards import (
    append_cards,
    convergence_cards,
    node_cards,
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
from bayesdist.products.common.coefficients import require_regular
from bayesdist.products.common.content import Content, Hdu, TablePlane, fits_bytes
from bayesdist.products.common.document import (
    BuildOptions,
    Built,
    Choice,
    Finding,
    Format,
    FormatSettings,
    MissingSizeError,
    required_size,
)
from bayesdist.products.common.parameters import (
    largest_difference,
    parameters_hdu,
    refuse_changed,
    stored_calibration,
    stored_in,
)
from bayesdist.products.common.rules import (
    NO_SIZE,
    LinearPart,
    Missing,
    missing,
    no_grid,
    not_finite,
    of_part,
    too_wide,
)
from bayesdist.products.common.wcs_text import describe_wcs
from bayesdist.utils.arrays import Float

TABLES, ERRORS = "WCSDVARR", "WCSDVERR"
_DEGREES = {"deg": 1.0, "arcsec": 1 / 3600, "mas": 1 / 3.6e6, "rad": 180 / np.pi, "": 1.0}


@dataclass(frozen=True, eq=False)
class CpdisImage:
    """Image with look-up tables."""

    hdu: Hdu
    tables: dict[tuple[str, int], Hdu]  # table extensions of the file, by EXTNAME and EXTVER
    place: int  # position among the images of the file, from 1
    where: str  # for messages

    @cached_property
    def header(self) -> fits.Header:
        """Header of the image."""
        return self.hdu.header

    @property
    def number(self) -> int:
        """Chip number; the position of the image in the file if the header does not state it."""
        return next(
            (int(self.header[k]) for k in ("BDCHIP", "CCDCHIP") if k in self.header), self.place
        )

    def function(self, axis: int) -> str:
        """CPDIS of an axis (1 or 2), in capitals; empty if there is none."""
        return str(self.header.get(f"CPDIS{axis}", "")).strip().upper()

    def version(self, axis: int) -> int:
        """EXTVER of the table of an axis; 1 if no record states it, as in astropy.wcs."""
        return int(self.header.get(f"DP{axis}.EXTVER", 1))

    def axes(self, axis: int) -> tuple[int | None, ...]:
        """Image axes that the axes of the table correspond to; None for a missing record."""
        stated = (self.header.get(f"DP{axis}.AXIS.{k}") for k in (1, 2))
        return tuple(None if value is None else int(value) for value in stated)

    def plane(self, axis: int) -> TablePlane | None:
        """Table of an axis; None if there is no LOOKUP function or no extension."""
        if self.function(axis) != "LOOKUP":
            return None
        version = self.version(axis)
        hdu = self.tables.get((TABLES, version))
        return None if hdu is None else TablePlane(hdu, TABLES, f"{self.where}, {TABLES},{version}")

    def table(self) -> LookupTable:
        """Tables of both axes; FormatError if they cannot be read."""
        planes = [self.plane(axis) for axis in (1, 2)]
        for axis, plane in enumerate(planes, start=1):
            function = self.function(axis)
            if function and function != "LOOKUP":
                raise FormatError(
                    f"CPDIS{axis} is {function}, not a look-up table", where=self.where,
                    do="give a header with CPDIS LOOKUP",
                )  # fmt: skip
            if function and plane is None:
                raise FormatError(
                    f"has no extension {TABLES},{self.version(axis)} for CPDIS{axis}",
                    where=self.where, do="give the whole file",
                )  # fmt: skip
            if function and self.axes(axis) != (1, 2):
                raise FormatError(
                    f"the records DP{axis}.AXIS are {self.axes(axis)}, which not all programs read",
                    where=self.where, do="write the table with axes 1, 2",
                )  # fmt: skip
        present = [p for p in planes if p is not None]
        if not all(np.isfinite(plane.values).all() for plane in present):
            raise FormatError(
                "has nodes that are not finite", where=self.where, do="give the whole file"
            )
        first = present[0]
        for second in present[1:]:
            grid = (first.values.shape, first.first, first.step)
            if (second.values.shape, second.first, second.step) != grid:
                raise FormatError(
                    "the tables of the two axes are on different grids", where=self.where,
                    do="give both on one grid",
                )  # fmt: skip
        zero = np.zeros(first.values.shape)
        values = [zero if p is None or self._dropped(a) else p.values
                  for a, p in enumerate(planes, start=1)]  # fmt: skip
        return LookupTable(self.number, np.stack(values), first=first.first, step=first.step)

    def _dropped(self, axis: int) -> bool:
        """True if astropy.wcs ignores the table because its CPERR is negative."""
        return float(self.header.get(f"CPERR{axis}", 0.0)) < 0

    @property
    def crpix(self) -> tuple[float, float]:
        """Reference pixel."""
        return float(self.header.get("CRPIX1", 0.0)), float(self.header.get("CRPIX2", 0.0))

    @property
    def size(self) -> tuple[int, int] | None:
        """Columns and rows of the image."""
        return image_size(self.header)

    @cached_property
    def _form(self) -> tuple[TangentForm | None, str]:
        refuse_singular(cd_matrix(self.header, self.where), self.where)
        try:
            return tangent_form(self.header, self.where), ""
        except FormatError:
            raise
        except InputError as error:
            return (
                None,
                f"{self.where} {error.cause}: u, v are on the plane of its projection, and "
                "not on the sky",
            )

    @property
    def form(self) -> TangentForm | None:
        """Tangent form of the header; None if it has no celestial axes or another projection."""
        return self._form[0]

    @property
    def note(self) -> str:
        """Reason why celestial axes have no tangent form; empty if they have one."""
        return self._form[1]

    @property
    def cd(self) -> Float:
        """Degrees of u and v per pixel (2, 2)."""
        if self.form is not None:
            return np.asarray(self.form.turn @ self.form.cd)
        units = [str(self.header.get(f"CUNIT{k}", "deg")).strip() for k in (1, 2)]
        factors = [_DEGREES.get(unit, 1.0) for unit in units]
        return cd_matrix(self.header, self.where) * np.array(factors)[:, None]

    @property
    def plane_of_sky(self) -> Plane:
        """Plane of the intermediate coordinates."""
        kind = str(self.header.get("BDPLANE", "")).strip()
        if kind not in ("", "sky") or self.form is None:
            return Plane(kind if kind not in ("", "sky") else "free")
        return Plane("sky", point=self.form.point)

    def check(self, opened: fits.HDUList | None, size: tuple[float, float]) -> None:
        """Compare positions with those of astropy.wcs; InputError if they differ."""
        if self.form is None:
            return
        table, cd, crpix = self.table(), self.cd, np.array(self.crpix)[:, None]

        def positions(x: Float, y: Float) -> Float:
            return np.asarray(cd @ (np.stack([x, y]) + table.evaluate(x, y).T - crpix))

        self.form.check(positions, size, self.header, self.where, opened)


@dataclass(frozen=True, eq=False)
class CpdisFile:
    """File of images with CPDIS look-up tables."""

    content: Content
    images: tuple[CpdisImage, ...]

    @property
    def name(self) -> str:
        """Name of the file, for messages."""
        return self.content.name


def cpdis_of(content: Content) -> CpdisFile | None:
    """CPDIS images of a file; None if there are none, or if the file also has SIP or TPV terms."""
    hdus = content.hdus
    mine = [hdu for hdu in hdus if {"CPDIS1", "CPDIS2"} & set(hdu.header)]
    if not mine or any("A_ORDER" in hdu.header for hdu in mine):
        return None
    if any(str(hdu.header.get("CTYPE1", "")).endswith("TPV") for hdu in mine):
        return None
    tables = {
        (hdu.name, int(hdu.header.get("EXTVER", 1))): hdu
        for hdu in hdus
        if hdu.name in (TABLES, ERRORS) and hdu.state == "whole"
    }
    images = tuple(
        CpdisImage(hdu, tables, k, content.name + (f", {hdu.label}" if len(mine) > 1 else ""))
        for k, hdu in enumerate(mine, start=1)
    )
    return CpdisFile(content, images)


def cpdis_calibration(file: CpdisFile, name: str, choice: Choice) -> Calibration:
    """Calibration of the tables and linear parts, or the stored calibration of a bayesdist file.

    With ``choice.as_used``, only header and tables are used. MissingSizeError if neither the header
    nor `choice` gives the size; FormatError if tables cannot be read or differ from the stored
    parameters.
    """
    first = file.images[0]
    unit = str(first.header.get("BDUNIT", "arcsec"))
    factor = 3600.0 / float(first.header.get("BDARCS", ARCSEC.get(unit, 1.0)))
    points = {image.plane_of_sky.point for image in file.images}
    if len(points) > 1:
        raise InputError(
            "its images touch the sky at different points", where=name, do="give one by itself"
        )
    maps = {
        picture.number: _linear(picture, name, choice.size, unit, factor) for picture in file.images
    }
    for image in file.images:
        image.check(file.content.opened, required_size(image.size, choice.size, name))
    tables = tuple(image.table() for image in file.images)
    calibration = calibration_of_maps(
        maps,
        name,
        plane=first.plane_of_sky,
        before=tables,
        notes=tuple(image.note for image in file.images if image.note),
    )
    hdu = stored_in(file.content)
    if hdu is None or choice.as_used:
        return calibration
    return _of_ours(file, stored_calibration(hdu, name), calibration)


def _linear(
    image: CpdisImage, name: str, given: tuple[float, float] | None, unit: str, factor: float
) -> ChipMap:
    """Map of one image without its tables; `factor` is the size of a degree in `unit`."""
    cd, crpix = factor * image.cd, image.crpix
    return fitted_map(
        lambda x, y: cd @ np.stack([x - crpix[0], y - crpix[1]]),
        name,
        order=1,
        size=required_size(image.size, given, name),
        reference_pixel=crpix,
        unit=unit,
        chip=image.number,
    )


def _of_ours(file: CpdisFile, stored: Calibration, found: Calibration) -> Calibration:
    """Stored calibration, with its look-up tables taken from the file, or after a check of them."""
    header = file.images[0].header
    if header.get("BDTABLES", False) and stored.model.order == 1:
        return replace(stored, before=found.before)
    if header.get("BDTABLES", False):
        return replace(stored, after=tuple(_rest(stored, found, t) for t in found.before))
    for image in file.images:
        off = largest_difference(stored, found, image.number, 129)
        refuse_changed(off, image.header, image.where)
    return stored


def _rest(stored: Calibration, found: Calibration, table: LookupTable) -> LookupTable:
    """Table of the residuals of the polynomial at the nodes, in the unit of the plane."""
    x, y = (v.ravel() for v in np.meshgrid(*table.nodes()))
    residual = found.forward(x, y, chip=table.chip) - stored.forward(x, y, chip=table.chip)
    return replace(table, values=residual.T.reshape(2, *table.shape))


_CLOSE = 1e-4  # pixels; target error between nodes if no step is requested
_STEPS = (64.0, 32.0, 16.0, 8.0, 4.0)  # pixels
_MOST = 1025  # largest number of nodes per axis
_CHECK = 397  # points per axis at which the tables are compared with the map


class CpdisSettings(FormatSettings):
    """Configuration of a file with CPDIS look-up tables."""

    # pixels between nodes; by default, fine enough for an error of 1e-4 pixels
    step: PositiveFloat | None = None
    crval: tuple[float, float] | None = None


def build(
    calibration: Calibration, settings: CpdisSettings, options: BuildOptions
) -> tuple[Built, ...]:
    """Build the file; its summary gives the largest rounding and interpolation error in pixels."""
    scale = options.scale_arcsec
    calibration = placed_at(calibration, settings.crval, scale, where="products.cpdis")
    refuse_wide_planes(calibration, options.epoch, scale, where="products.cpdis")
    plane, unit = calibration.plane, calibration.unit
    arcsec = arcsec_per(unit, scale)
    maps = calibration.with_tables(calibration.at(options.epoch, origin="stated"))
    images, tables, worst = [], [], 0.0
    for k, (number, chip_map) in enumerate(maps.items()):
        linear, crpix = _linear_part(chip_map, number)
        table, off = _sampled(chip_map, linear, crpix, settings.step)
        worst = max(worst, off)
        versions = (2 * k + 1, 2 * k + 2)
        ctype, crval = ("RA---TAN", "DEC--TAN"), plane.point or (0.0, 0.0)
        cards = tangent_cards(ctype, crval, crpix, linear * arcsec / 3600)
        if plane.point is None:
            cards.append(text_card("COMMENT", "CRVAL is a placeholder."))
        cards += _record_cards(table, versions)
        cards.append(number_card("BDWORST", off, "[pix] of rounding and between nodes"))
        if chip_map.before or chip_map.after:
            cards.append(number_card("BDTABLES", 1, "look-up tables are in it"))
        cards += solution_cards(plane.kind, unit, arcsec, number, chip_map.basis.size)
        cards += wrapped_cards("COMMENT", calibration.remarks)
        cards += convergence_cards(calibration.solution)
        image = fits.ImageHDU(name="SCI", ver=k + 1)
        append_cards(image, cards)
        images.append(image)
        sigma = _sigma(chip_map, linear, table)
        for axis, version in enumerate(versions):
            tables.append(_table_hdu(TABLES, version, table.values[axis], table))
            if sigma is not None:
                tables.append(_table_hdu(ERRORS, version, sigma[axis], table))
    parameters = parameters_hdu(calibration, options.epoch)
    content = fits_bytes([fits.PrimaryHDU(), *images, *tables, parameters])
    return (Built("cpdis.fits", "CPDIS", content, calibration, None, {"tables_pix": worst}),)


def _linear_part(one: ChipMap, number: int) -> tuple[Float, tuple[float, float]]:
    """Linear part (2, 2) of the polynomial, and the pixel at which it gives (u, v) = 0."""
    poly = one.monomials()
    require_regular(poly.linear, number)
    zero = np.array(one.basis.reference_pixel) - np.linalg.solve(poly.linear, poly.constant)
    return poly.linear, (float(zero[0]), float(zero[1]))


def _sampled(
    one: ChipMap, linear: Float, crpix: tuple[float, float], step: float | None
) -> tuple[LookupTable, float]:
    """Table of the shifts in single precision, and its largest error in pixels."""
    if one.basis.order == 1 and len(one.before) == 1 and not one.after:
        table = one.before[0]
        return _checked(one, linear, crpix, table.first, table.step, table.shape[::-1])
    for asked in _STEPS if step is None else (step,):
        counts = [int(min(max(np.ceil(n / asked), 1), _MOST - 1)) + 1 for n in one.basis.size]
        steps = [n / (count - 1) for n, count in zip(one.basis.size, counts, strict=True)]
        sampled = _checked(
            one, linear, crpix, (0.5, 0.5), (steps[0], steps[1]), (counts[0], counts[1])
        )
        if sampled[1] <= _CLOSE:
            break
    return sampled


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
    """Standard errors (2, ny, nx) of the nodes in pixels; None for a map without covariance."""
    cov = one.covariance_at(*(v.ravel() for v in np.meshgrid(*table.nodes())))
    if cov is None:
        return None
    back = np.linalg.inv(linear)
    moved = back @ cov @ back.T
    return np.sqrt(moved.diagonal(axis1=1, axis2=2)).T.reshape(2, *table.shape)


def _record_cards(table: LookupTable, versions: tuple[int, int]) -> list[str]:
    """Cards of CPDIS, CPERR and the DP records."""
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
    append_cards(hdu, node_cards(table))
    hdu.header["BUNIT"] = "pixel"
    return hdu


def _describe(file: CpdisFile) -> list[str]:
    """Lines of text on the images as read by astropy.wcs, and on their tables."""
    first, *lines = describe_wcs(file.content, lint_cpdis(file))
    added = []
    for image in file.images:
        for axis in (1, 2):
            plane = image.plane(axis)
            if plane is not None and plane.values.ndim == 2:
                ny, nx = plane.values.shape
                added.append(
                    f"  CPDIS{axis}    {nx} x {ny} nodes, first at pixel ({plane.first[0]:g}, "
                    f"{plane.first[1]:g}), step {plane.step[0]:g} x {plane.step[1]:g}"
                )
        if "BDWORST" in image.header:
            added.append(f"  precision {image.header['BDWORST']:.2g} px")
    return [first, *added, *lines]


# -- checks ---------------------------------------------------------------------------------------
_TINY = 1e-3  # pixels; if all shifts are smaller, the table is probably in another unit
_ASKEW = 0.75  # steps; half the difference between the margins at both ends that is reported
# expected sign of det(CD) by CTYPE1: RA increases to the left, solar longitude to the right
_HANDED = {"RA--": -1, "HPLN": 1}
_LINEAR = LinearPart("CD", "has the parity of a mirror image")


def lint_cpdis(file: CpdisFile) -> tuple[Finding, ...]:
    """Findings in a file with CPDIS look-up tables."""
    out: list[Finding] = []
    for image in file.images:
        part = image.hdu.label if len(file.images) > 1 else ""
        findings = (
            *_records(image),
            *_tables(image),
            *_linear_findings(image),
            *_alternates(image),
        )
        out += of_part(part, findings)
    if not [f for f in out if f.level == "error"]:
        try:
            cpdis_calibration(file, file.name, Choice())
        except MissingSizeError:
            out.append(NO_SIZE)
        except FormatError as error:
            out.append(Finding("error", "BDPARAM", error.cause))
    return tuple(out)


def _records(image: CpdisImage) -> Iterator[Finding]:
    for axis in (1, 2):
        function = image.function(axis)
        if not function:
            yield Missing(f"CPDIS{axis}", ": that axis has no distortion", "warning").finding
            continue
        if function != "LOOKUP":
            yield Finding(
                "error", f"CPDIS{axis}", f"is {function}: astropy.wcs leaves it out with a warning"
            )
            continue
        shared = ", and taken for 1: both axes share a table"
        yield from missing(image.header, [Missing(f"DP{axis}.EXTVER", shared, "warning")])
        axes = image.axes(axis)
        if None in axes:
            yield Missing(f"DP{axis}.AXIS", ", and astropy.wcs stops without it").finding
        elif axes != (1, 2):
            yield Finding(
                "error", f"DP{axis}.AXIS",
                f"says {axes}: astropy.wcs transposes the table of axis 1 and not its registration",
            )  # fmt: skip
        if image.plane(axis) is None:
            yield Finding(
                "error", f"DP{axis}.EXTVER",
                f"there is no extension {TABLES},{image.version(axis)}, and astropy.wcs stops",
            )  # fmt: skip
        if float(image.header.get(f"CPERR{axis}", 0.0)) < 0:
            yield Finding(
                "error", f"CPERR{axis}", "is below zero, and astropy.wcs leaves the table out"
            )
    are_tables = image.function(1) == image.function(2) == "LOOKUP"
    if are_tables and image.version(1) == image.version(2):
        yield Finding("warning", "DP2.EXTVER", "both axes have the table of one extension")


def _tables(image: CpdisImage) -> Iterator[Finding]:
    planes = {axis: p for axis in (1, 2) if (p := image.plane(axis)) is not None}
    largest = []
    for axis, plane in planes.items():
        location = f"{TABLES},{image.version(axis)}"
        values = plane.values
        unusable = no_grid(values, location) or not_finite(
            values, location, "holds nodes that are not finite"
        )
        if unusable:
            yield from unusable
            return
        largest.append(float(np.abs(values).max()))
        if plane.missing:
            yield Finding(
                "warning", location,
                f"{', '.join(plane.missing)} missing: the registration is then that of "
                "astropy.wcs, another one since its version 6.1 than before",
            )  # fmt: skip
        else:
            yield from _registration(image, plane, location)
        sigma = image.tables.get((ERRORS, image.version(axis)))
        if sigma is None and any((ERRORS, image.version(k)) in image.tables for k in (1, 2)):
            yield Finding(
                "warning", f"{ERRORS},{image.version(axis)}",
                "is missing, although the other axis has errors",
            )  # fmt: skip
        if sigma is not None and (
            sigma.image.shape != values.shape or not (sigma.image >= 0).all()
        ):
            yield Finding(
                "warning", f"{ERRORS},{image.version(axis)}", "is not a table of node errors"
            )
    if largest and 0 < max(largest) < _TINY:
        yield Finding(
            "warning", TABLES, f"hold shifts of {max(largest):.2g} at most: their unit is the pixel"
        )


def _registration(image: CpdisImage, plane: TablePlane, where: str) -> Iterator[Finding]:
    """Findings on nodes that are nearer to one edge of the image than to the other."""
    if image.size is None:
        return
    for axis, (n, first, step, size) in enumerate(
        zip(plane.nodes.shape[::-1], plane.first, plane.step, image.size, strict=True)
    ):
        if step <= 0:
            yield Finding("error", where, f"CDELT{axis + 1} is {step:g}, not a step between nodes")
            continue
        low, high = first - 0.5, size + 0.5 - (first + (n - 1) * step)
        if abs(low - high) / 2 > _ASKEW * step or max(low, high) > 1.5 * step:
            yield Finding(
                "warning", where,
                f"the nodes along {'xy'[axis]} begin {low:.4g} pixels inside the image and end "
                f"{high:.4g} inside, in steps of {step:g}: they may be registered a node off",
            )  # fmt: skip


def _linear_findings(image: CpdisImage) -> Iterator[Finding]:
    det = float(np.linalg.det(image.cd))
    width = np.sqrt(abs(det)) * max(image.size or (0,))
    if det == 0:
        yield from _LINEAR.findings(det)
    elif "-" not in str(image.header.get("CTYPE1", "")):  # as in RA---TAN
        yield Finding(
            "note",
            "CTYPE",
            "names no position on the sky: u, v are on a plane of unknown position, and CD is in "
            "degrees unless CUNIT says otherwise",
        )
    elif wide := too_wide(width, "CD", "makes the image wider than the sky: check its unit"):
        yield from wide
    else:
        yield from _LINEAR.findings(
            det, mirror=-_HANDED.get(str(image.header.get("CTYPE1", ""))[:4], 0)
        )


def _alternates(image: CpdisImage) -> Iterator[Finding]:
    """Findings on alternate coordinate systems, to which not all programs apply the tables."""
    keys = sorted({k[-1] for k in image.header if k[:5] == "CTYPE" and k[-1].isalpha()})
    without = [k for k in keys if f"CPDIS1{k}" not in image.header]
    if without:
        yield Finding(
            "warning", ", ".join(f"CPDIS1{k}" for k in without),
            "is missing: the standard leaves such a system without the tables, and astropy.wcs "
            "up to its version 8.0 applies those of the primary one",
        )  # fmt: skip
    if len(without) < len(keys):
        stated = ", ".join(f"CPDIS1{k}" for k in keys if k not in without)
        yield Finding("note", stated, "astropy.wcs up to its version 8.0 cannot read that system")


FORMAT = Format(
    "cpdis", "an image with CPDIS look-up tables", 33, cpdis_of, _describe, lint_cpdis,
    cpdis_calibration, CpdisSettings, build, holds_tables=True, needs_scale=lambda settings: True,
    asks=("size",),
)  # fmt: skip
