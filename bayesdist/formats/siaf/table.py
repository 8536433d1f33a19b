"""SIAF coefficient table, the companion file with its covariance, and their calibration.

    AperName , siaf_index , exponent_x , exponent_y , Sci2IdlX , Sci2IdlY , Idl2SciX , Idl2SciY

Each row gives the coefficients of x^exponent_x y^exponent_y. For Sci2Idl, x and y are pixels from
(XSciRef, YSciRef) and the result is in Ideal coordinates in arcsec; for Idl2Sci it is the reverse.
The table has neither a size nor a reference pixel; tables written by bayesdist state them in
comments.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bayesdist.calibration.calibration import Calibration, calibration_of_maps
from bayesdist.calibration.chip_map import fitted_map
from bayesdist.calibration.inverse import ExplicitInverse, detector_grid
from bayesdist.calibration.plane import Plane
from bayesdist.errors import FormatError, InputError, required
from bayesdist.files.documents import json_of
from bayesdist.files.faults import reason_of
from bayesdist.products.common.coefficients import Coefficients, evaluate
from bayesdist.products.common.content import Content, read_content
from bayesdist.products.common.document import Choice, MissingSizeError, ReadBack
from bayesdist.products.common.record import calibration_from
from bayesdist.utils.arrays import Float
from bayesdist.utils.text import number_of

NAMES = ("Sci2IdlX", "Sci2IdlY", "Idl2SciX", "Idl2SciY")
COLUMNS = ("AperName", "siaf_index", "exponent_x", "exponent_y", *NAMES)
KEYWORDS = ("XSciSize", "YSciSize", "XSciRef", "YSciRef")
HIGHEST = 9  # highest order: each power has one digit in siaf_index
SIDE = "siaf_covariance"  # first key of a covariance file
AGREEMENT = 1e-6  # pixels; tolerance between a table and its covariance file
_STATED = re.compile(r"#\s*(XSciSize|YSciSize|XSciRef|YSciRef)\s*=\s*(\S+)")
# comment text before the name of the covariance file
COVARIANCE = "The covariance of Sci2Idl is in"
# Size (columns, rows) and reference pixel (XSciRef, YSciRef) of full-frame apertures in the SIAF,
# by patterns of their full names. Subarrays and apertures of several detectors differ, and the
# reference pixel of the MIRI imager is not in the middle.
_FULL_FRAMES = {
    r"NRC[AB][1-5]_FULL(_WEDGE_(BAR|RND))?|NIS_CEN(_OSS)?|FGS[12]_FULL(_OSS)?": (
        (2048.0, 2048.0),
        (1024.5, 1024.5),
    ),
    r"MIRIM_FULL": ((1032.0, 1024.0), (693.5, 512.5)),
    r"WFI\d\d_FULL": ((4088.0, 4088.0), (2044.5, 2044.5)),
}


@dataclass(frozen=True)
class SiafRow:
    """Row of a table."""

    line: int
    index: str  # siaf_index, as stored
    powers: tuple[int, int]
    values: tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class SiafTable:
    """Parsed table, or a covariance file alone (which has no rows)."""

    name: str
    aperture: str
    rows: tuple[SiafRow, ...]
    stated: Mapping[str, float]  # values of KEYWORDS
    record: Mapping[str, Any] | None = None  # see `common.record`
    names_side_file: bool = False

    @property
    def order(self) -> int:
        """Largest total power."""
        return max(sum(row.powers) for row in self.rows)

    @property
    def size(self) -> tuple[float, float] | None:
        """Columns and rows: as stated, or else those of the named aperture."""
        if "XSciSize" in self.stated and "YSciSize" in self.stated:
            return self.stated["XSciSize"], self.stated["YSciSize"]
        return None if self._full_frame is None else self._full_frame[0]

    @property
    def _full_frame(self) -> tuple[tuple[float, float], tuple[float, float]] | None:
        """Size and reference pixel of a full-frame aperture; None for any other aperture."""
        items = _FULL_FRAMES.items()
        return next((facts for name, facts in items if re.fullmatch(name, self.aperture)), None)

    @property
    def states_reference(self) -> bool:
        """True if the table states the reference pixel or its aperture defines it."""
        stated = {"XSciRef", "YSciRef"} <= self.stated.keys()
        return stated or self._full_frame is not None

    def of_size(self, size: tuple[float, float] | None) -> SiafTable:
        """Table with the size given by the user; InputError if the file states another size."""
        if size is None:
            return self
        nominal = self.size
        if nominal is not None and tuple(nominal) != tuple(size):
            raise InputError(
                f"the image has {nominal[0]:g} x {nominal[1]:g} pixels, but {size[0]:g} x "
                f"{size[1]:g} are given",
                where=self.name,
                do="leave out the size, or give that of the aperture",
            )
        return replace(self, stated={**self.stated, "XSciSize": size[0], "YSciSize": size[1]})

    def reference_pixel(self, size: tuple[float, float]) -> tuple[float, float]:
        """XSciRef and YSciRef: as stated, or of the aperture, or else the middle of the image."""
        x, y = (size[0] + 1) / 2, (size[1] + 1) / 2
        if self._full_frame is not None:
            x, y = self._full_frame[1]
        return self.stated.get("XSciRef", x), self.stated.get("YSciRef", y)

    def terms(self, name: str) -> Coefficients:
        """Coefficients of one of NAMES by powers of x and y; the last of repeated rows is used."""
        k = NAMES.index(name)
        return {row.powers: row.values[k] for row in self.rows}

    def ideal(self, dx: Float, dy: Float) -> tuple[Float, Float]:
        """Ideal coordinates (N,) in arcsec at offsets (N,) from the reference pixel."""
        x, y = (evaluate(self.terms(name), dx, dy) for name in NAMES[:2])
        return x, y

    def pixels(self, x: Float, y: Float) -> tuple[Float, Float]:
        """Offsets (N,) from the reference pixel at Ideal coordinates (N,)."""
        dx, dy = (evaluate(self.terms(name), x, y) for name in NAMES[2:])
        return dx, dy

    @property
    def inverse(self) -> ExplicitInverse | None:
        """Idl2Sci as an inverse; None if its columns are zero or the size is unknown."""
        terms = [dict(self.terms(name)) for name in NAMES[2:]]
        if self.size is None or not any(any(column.values()) for column in terms):
            return None
        for axis, power in enumerate(((1, 0), (0, 1))):
            terms[axis][power] = terms[axis].get(power, 0.0) - 1.0
        return ExplicitInverse(self.reference_pixel(self.size), terms[0], terms[1])

    def closure(self) -> float | None:
        """Largest round-trip error through Sci2Idl and Idl2Sci in pixels; None if unknown."""
        residual = self.closure_residuals()
        return None if residual is None else float(np.hypot(*residual).max())

    def closure_residuals(self) -> Float | None:
        """Round-trip errors (2, N) of Sci2Idl and Idl2Sci on a grid, pixels; None if unknown."""
        size = self.size
        if size is None or self.inverse is None:
            return None
        x, y = detector_grid(size)
        x0, y0 = self.reference_pixel(size)
        back = self.inverse.pixels(*self.ideal(x - x0, y - y0))
        return np.stack([back[0] - x, back[1] - y])


# -- reading --------------------------------------------------------------------------------------


def holds_table(content: Content) -> bool:
    """True for a coefficient table or a covariance file, valid or not."""
    return _is_side(content) or any(_is_header(line) for line in content.text.splitlines())


def _is_side(content: Content) -> bool:
    return content.text.lstrip().startswith("{") and f'"{SIDE}"' in content.text[:200]


def _is_header(line: str) -> bool:
    cells = [cell.strip() for cell in line.split(",")]
    return cells[0] == "AperName" and "siaf_index" in cells


def side_name(name: str) -> str:
    """Name of the covariance file of a table."""
    return f"{Path(name).stem}_covariance.json"


def table_of(content: Content) -> SiafTable:
    """Table of a file, with the record of the covariance file in its folder if there is one.

    FormatError for missing columns or invalid values.
    """
    if _is_side(content):
        record = _record_of_side(content)
        return SiafTable(content.name, str(record["provenance"]["detector"]), (), {}, record)
    lines = content.text.splitlines()
    at = next(k for k, line in enumerate(lines) if _is_header(line))
    names = [cell.strip() for cell in lines[at].split(",")]
    missing = [column for column in COLUMNS if column not in names]
    if missing:
        raise FormatError(
            f"the columns {', '.join(missing)} are missing",
            where=content.name,
            do="give a table of distortion coefficients",
        )
    rows, apertures = [], []
    for number, line in enumerate(lines[at + 1 :], start=at + 2):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        cells = [cell.strip() for cell in line.split(",")]
        location = f"{content.name}, line {number}"
        if len(cells) != len(names):
            raise FormatError(
                f"has {len(cells)} values, but there are {len(names)} columns",
                where=location,
                do="fetch the file again",
            )
        cell_of = dict(zip(names, cells, strict=True))
        apertures.append(cell_of["AperName"])
        rows.append(_row(cell_of, number, location))
    if not rows:
        raise FormatError("there are no rows", where=content.name, do="fetch the file again")
    if len(set(apertures)) > 1:
        raise FormatError(
            f"holds the apertures {', '.join(dict.fromkeys(apertures))}",
            where=content.name,
            do="give a table of one aperture",
        )
    stated = {
        m[1]: _number(m[2], f"{content.name}, {m[1]}")
        for line in lines
        if (m := _STATED.match(line))
    }
    table = SiafTable(content.name, apertures[0], tuple(rows), stated)
    named = any(line.startswith(f"# {COVARIANCE} ") for line in lines)
    return replace(table, record=record_beside(content.name), names_side_file=named)


def _row(cells: Mapping[str, str], number: int, where: str) -> SiafRow:
    i, j = (_number(cells[key], where) for key in COLUMNS[2:4])
    values = [_number(cells[key], where) for key in NAMES]
    if not (i.is_integer() and j.is_integer() and i >= 0 and j >= 0 and i + j <= HIGHEST):
        raise FormatError(
            f"the powers are {i:g} and {j:g}", where=where, do=f"give 0 to {HIGHEST} in all"
        )
    return SiafRow(
        number,
        cells["siaf_index"].zfill(2),
        (int(i), int(j)),
        (values[0], values[1], values[2], values[3]),
    )


def _number(text: str, where: str) -> float:
    try:
        value = number_of(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise FormatError(f"{text!r} is not a finite number", where=where, do="correct the value")
    return value


def record_beside(name: str) -> Mapping[str, Any] | None:
    """Record of the covariance file in the folder of a table; None if there is none."""
    path = Path(name).with_name(side_name(name))
    return _record_of_side(read_content(path)) if os.path.lexists(path) else None


def _record_of_side(content: Content) -> Mapping[str, Any]:
    try:
        record = json_of(content.text, content.name)["bayesdist"]
    except (FormatError, KeyError, TypeError) as error:
        raise FormatError(
            f"is not an auxiliary file of a SIAF table ({reason_of(error)})",
            where=content.name,
            do="fetch the file again",
        ) from error
    calibration_from(record, content.name)  # raises if the record is incomplete
    return record


# -- calibration ----------------------------------------------------------------------------------


def departure(table: SiafTable, calibration: Calibration) -> float:
    """Largest distance over the detector between a calibration and the table, in pixels."""
    [chip] = calibration.model.chips
    x, y = detector_grid(chip.size, 65)
    x0, y0 = chip.reference_pixel
    far = calibration.forward(x, y, chip=chip.number).T - np.stack(table.ideal(x - x0, y - y0))
    return float(np.hypot(*far).max() / calibration.pixel()[0])


def siaf_read_back(table: SiafTable) -> ReadBack:
    """Ideal coordinates and round-trip errors of a table that states its size."""
    size = required(table.size, "a new table states no size")
    x0, y0 = table.reference_pixel(size)

    def forward(x: Float, y: Float, _: int, __: float | None) -> Float:
        return np.stack(table.ideal(x - x0, y - y0), axis=-1)

    def missed(x: Float, y: Float, _: int, __: float | None) -> Float:
        dx, dy = table.pixels(*table.ideal(x - x0, y - y0))
        return np.stack([dx + x0 - x, dy + y0 - y], axis=-1)

    return ReadBack(table.name, forward, missed, own_axes=True)


def siaf_calibration(table: SiafTable, _: str, choice: Choice) -> Calibration:
    """Calibration in Ideal coordinates, with the covariance of the companion file if both agree.

    MissingSizeError if neither the table, its aperture nor `choice` gives the size.
    """
    table = table.of_size(choice.size)
    notes: tuple[str, ...] = ()
    inverse = table.inverse if table.rows else None
    if inverse is not None:
        # the inverse of a calibration expects positions relative to that of the reference pixel
        cx, cy = (float(at[0]) for at in table.ideal(np.zeros(1), np.zeros(1)))
        inverse = replace(inverse, zero=(-cx, -cy))
    if table.record is not None:
        calibration = calibration_from(table.record, table.name)
        far = departure(table, calibration) if table.rows else 0.0
        if far <= AGREEMENT:
            inverses = {} if inverse is None else {calibration.numbers[0]: inverse}
            return replace(calibration, inverses=inverses)
        notes = (f"the side file is {far:.2g} px from the table: without its covariance",)
    elif table.names_side_file:
        notes = (f"its covariance is in {side_name(table.name)}, which is not here",)
    size = table.size
    if size is None:
        raise MissingSizeError(
            f"does not state the size of the image, and the aperture {table.aperture} is not a "
            "known full frame",
            where=table.name,
            do="give its size (--size XSciSize YSciSize), or write comments such as "
            "'# XSciSize = 320' and '# XSciRef = 160.5' into the table",
        )
    if table.order < 1:
        raise InputError("has no linear terms", where=table.name, do="check its rows")
    x0, y0 = table.reference_pixel(size)
    if not table.states_reference:
        notes = (*notes, f"XSciRef, YSciRef are not stated: taken as {x0:g}, {y0:g}, the middle")
    chip_map = fitted_map(
        lambda x, y: table.ideal(x - x0, y - y0),
        table.name,
        order=table.order,
        size=size,
        reference_pixel=(x0, y0),
        unit="arcsec",
    )
    return calibration_of_maps(
        {1: chip_map},
        table.name,
        plane=Plane("aperture"),
        detector=table.aperture,
        numbered=False,
        inverses={} if inverse is None else {1: inverse},
        notes=notes,
    )
