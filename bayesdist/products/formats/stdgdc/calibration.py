"""Calibration of an STDGDC file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bayesdist.arrays import Float
from bayesdist.calibration.calibration import Calibration, calibration_of_maps
from bayesdist.calibration.chip_map import fitted_map
from bayesdist.calibration.inverse import detector_grid
from bayesdist.calibration.plane import Plane
from bayesdist.errors import FormatError
from bayesdist.model import LookupTable
from bayesdist.products.formats.common.cards import named_in
from bayesdist.products.formats.common.parameters import stored_calibration, stored_in
from bayesdist.products.formats.stdgdc.file import CorrectedFrame, StdGdc

__all__ = ["stdgdc_calibration"]

_SLACK = 1e-9  # pixels: rounding of the check itself
_GRID = 129


def corrections(file: StdGdc) -> LookupTable:
    """Table of corrected less detector pixels: exactly bilinear, as programs use the file.

    FormatError for tables of different shapes, or with numbers that are not finite.
    """
    xgc, ygc = file.table("XGC"), file.table("YGC")
    if xgc.shape != ygc.shape:
        raise FormatError("XGC and YGC differ in shape", where=file.name, do="check the file")
    if not (np.isfinite(xgc).all() and np.isfinite(ygc).all()):
        raise FormatError(
            "XGC or YGC hold numbers that are not finite", where=file.name, do="check the file"
        )
    y, x = np.indices(xgc.shape, float)
    shifts = np.stack([xgc - (x + 1), ygc - (y + 1)])
    return LookupTable(_number(file), shifts, first=(1.0, 1.0), step=(1.0, 1.0))


def stdgdc_calibration(file: StdGdc, name: str, *, as_used: bool = False) -> Calibration:
    """Calibration of the tables; of a file of ours the one that it was made from.

    With `as_used` nothing but the tables counts, brought to the plane of a file of ours.
    FormatError where the parameters in the file and its tables differ by more than it states.
    """
    table = corrections(file)
    size = (float(file.size[0]), float(file.size[1]))
    hdu, frame = stored_in(file.content), CorrectedFrame.of_header(file.header)
    if hdu is None:
        frame = None
    if hdu is not None and frame is not None and not as_used:
        return _of_ours(file, stored_calibration(hdu, name), frame, table)

    def positions(x: Float, y: Float) -> tuple[Float, Float]:
        u, v = (x, y) if frame is None else frame.positions(np.stack([x, y]))
        return u, v

    stored = None if hdu is None or frame is None else stored_calibration(hdu, name)
    one = fitted_map(
        positions,
        name,
        order=1,
        size=size,
        reference_pixel=((size[0] + 1) / 2, (size[1] + 1) / 2),
        unit="pix" if stored is None else stored.unit,
    )
    found = calibration_of_maps(
        {table.chip: one},
        name,
        plane=Plane("detector") if stored is None else stored.plane,
        numbered="BDCHIP" in file.header,
        detector=named_in(file.header, "DETECTOR", name),
    )
    if stored is not None:
        return replace(found, before=(table,), scale=stored.scale, scale_from=stored.scale_from)
    return replace(found, before=(table,), scale=1.0, scale_from="pixels of the corrected frame")


def _of_ours(
    file: StdGdc, stored: Calibration, frame: CorrectedFrame, table: LookupTable
) -> Calibration:
    """Stored calibration, after a check of the tables; what else these have is its own table."""
    number, size = stored.numbers[0], stored.model.chips[0].size
    if file.header.get("BDTABLES", False):
        y, x = np.indices(table.shape, float)
        x, y = x.ravel() + 1, y.ravel() + 1
        there = np.stack([x, y]) + table.values.reshape(2, -1)
        rest = frame.positions(there) - stored.forward(x, y, chip=number).T
        after = replace(table, chip=number, values=rest.reshape(2, *table.shape))
        return replace(stored, after=(after,))
    x, y = detector_grid(size, _GRID)
    theirs = np.stack([x, y]) + table.evaluate(x, y).T
    ours = frame.corrected(stored.forward(x, y, chip=number).T)
    far = float(np.hypot(*(ours - theirs)).max())
    if not far <= 1.5 * float(file.header.get("BDWORST", 0.0)) + _SLACK:
        raise FormatError(
            f"its tables are off by {far:.2g} pixels from its parameters: one was changed",
            where=file.name,
            do="write the file again",
        )
    return stored


def _number(file: StdGdc) -> int:
    return int(file.header.get("BDCHIP", 1))
