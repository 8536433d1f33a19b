"""Images with look-up tables in their headers: CPDISi = 'LOOKUP' with DPi records.

    p' = p + (table 1, table 2)(p),    (x, y) = CD (p' - CRPIX)

The tables are in pixels and are stored in extensions WCSDVARR of the same file. Node k (from 1) of
axis a is at pixel CRVALa + (k - CRPIXa) CDELTa. Files written by bayesdist have further extensions,
which other programs ignore: WCSDVERR with the standard errors of the nodes, and BDPARAM with the
parameters and their covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from astropy.io import fits

from bayesdist.calibration.calibration import Calibration, calibration_of_maps
from bayesdist.calibration.chip_map import ChipMap, fitted_map
from bayesdist.calibration.plane import ARCSEC, Plane
from bayesdist.errors import FormatError, InputError
from bayesdist.model import LookupTable
from bayesdist.products.common.celestial import TangentForm, refuse_singular, tangent_form
from bayesdist.products.common.content import Content, Hdu
from bayesdist.products.common.document import Choice, required_size
from bayesdist.products.common.linear_wcs import cd_matrix, image_size
from bayesdist.products.common.lookup_plane import Plane as TablePlane
from bayesdist.products.common.parameters import (
    largest_difference,
    refuse_changed,
    stored_calibration,
    stored_in,
)
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
