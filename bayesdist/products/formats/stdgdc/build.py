"""STDGDC file from a calibration: every pixel's corrected position, with its error."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from astropy.io import fits

from bayesdist.arrays import Float
from bayesdist.calibration.area import pixel_areas
from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.chip_map import ChipMap
from bayesdist.calibration.inverse import check_one_to_one, detector_grid
from bayesdist.errors import InputError
from bayesdist.model import LookupTable
from bayesdist.products.formats.common.cards import (
    convergence_cards,
    number_card,
    wrapped_cards,
)
from bayesdist.products.formats.common.content import hdus_of
from bayesdist.products.formats.common.parameters import parameters_hdu
from bayesdist.products.formats.stdgdc.file import EXTENSIONS, SIGMAS, CorrectedFrame, frame_of

__all__ = ["stdgdc_content"]

_BETWEEN = 997  # points along each axis, between pixels, at which the tables are checked
_LARGEST = 2**26  # pixels: beyond it a detector is a misprint


def stdgdc_content(
    calibration: Calibration,
    *,
    epoch: float | None = None,
    precision: str = "single",
    notes: Sequence[str] = (),
) -> tuple[bytes, float]:
    """Bytes of a file, and its largest error in pixels: of rounding, and between its nodes.

    `precision` is 'single' or 'double'.  InputError for a calibration of several chips.
    """
    if len(calibration.numbers) > 1:
        raise InputError(
            f"an STDGDC file is of one detector, and this one has the chips "
            f"{', '.join(map(str, calibration.numbers))}",
            where="products.stdgdc",
            do="convert them one by one with --chip",
        )
    number = calibration.numbers[0]
    one = calibration.with_tables(calibration.at(epoch, origin="stated"))[number]
    nx, ny = (int(n) for n in one.basis.size)
    if nx * ny > _LARGEST:
        raise InputError(f"the detector has {nx} x {ny} pixels", where="products.stdgdc")
    x, y = detector_grid(one.basis.size, 65)
    areas = np.linalg.det(one.slope(x, y)) / np.linalg.det(one.linear)
    U, V = one.at(x, y)
    check_one_to_one(U, V, 65, areas)
    frame = frame_of(one, calibration.scale)
    kind = np.float32 if precision == "single" else np.float64
    tables = _tables(one, frame, (nx, ny))
    planes = dict(zip(EXTENSIONS, (np.asarray(t, kind) for t in tables), strict=True))
    cov = one.covariance_at(*_mesh((nx, ny)))
    if cov is not None:
        sigmas = _sigmas(cov, frame, (nx, ny))
        planes |= dict(zip(SIGMAS, (np.asarray(t, np.float32) for t in sigmas), strict=True))
    worst = _error(one, frame, np.asarray(planes["XGC"], float), np.asarray(planes["YGC"], float))
    primary = fits.PrimaryHDU()
    header = primary.header
    for name in ("XGC", "YGC", "XCG", "YCG"):
        header[f"HIERARCH NDIM_{name}"] = nx if name[0] == "X" else ny
    for name in ("XGC", "YGC"):
        header[f"HIERARCH {name}_0"] = 0
    header["BDCHIP"] = number, "chip number"
    if one.before or one.after:
        header["BDTABLES"] = True, "XGC and YGC hold look-up tables, too"
    if calibration.detector:
        header["DETECTOR"] = calibration.detector
    if calibration.filter:
        header["FILTER"] = calibration.filter
    stated = frame.keywords() | {"BDWORST": (worst, "[pix] of rounding and between nodes")}
    cards = [
        *(number_card(keyword, *value) for keyword, value in stated.items()),
        *wrapped_cards("COMMENT", notes),
        *convergence_cards(calibration.solution),
    ]
    for card in cards:
        header.append(fits.Card.fromstring(card), end=True)
    images = [fits.ImageHDU(plane, name=name) for name, plane in planes.items()]
    hdus = hdus_of([primary, *images, parameters_hdu(calibration, epoch)])
    return b"".join(hdu.to_bytes() for hdu in hdus), worst


def _mesh(size: tuple[int, int]) -> tuple[Float, Float]:
    """Pixels of all nodes, row by row."""
    y, x = np.indices((size[1], size[0]), float)
    return x.ravel() + 1, y.ravel() + 1


def _tables(one: ChipMap, frame: CorrectedFrame, size: tuple[int, int]) -> tuple[Float, ...]:
    """Values of the five extensions."""
    shape = size[::-1]
    x, y = _mesh(size)
    there = frame.corrected(one.at(x, y)).reshape(2, *shape)
    area, _ = pixel_areas(one, np.arange(1.0, size[0] + 1), np.arange(1.0, size[1] + 1))
    area = area / abs(np.linalg.det(frame.similarity))
    back, _ = one.pixels(frame.positions(np.stack([x, y])))
    # beyond the image of the detector a map may have no inverse
    back = np.where(np.isfinite(back), back, np.stack([x, y]))
    return (*there, -2.5 * np.log10(area), *np.reshape(back, (2, *shape)))


def _sigmas(cov: Float, frame: CorrectedFrame, size: tuple[int, int]) -> tuple[Float, ...]:
    """Standard errors of the corrected positions, and their correlation."""
    shape = size[::-1]
    turn = np.linalg.inv(frame.similarity)
    cov = turn @ cov @ turn.T
    sx, sy = np.sqrt(cov[:, 0, 0]), np.sqrt(cov[:, 1, 1])
    product = sx * sy
    both = np.divide(cov[:, 0, 1], product, out=np.zeros_like(product), where=product > 0)
    return sx.reshape(shape), sy.reshape(shape), np.clip(both, -1.0, 1.0).reshape(shape)


def _error(one: ChipMap, frame: CorrectedFrame, xgc: Float, ygc: Float) -> float:
    """Largest distance of what the tables give from the map, at nodes and between them, pixels."""
    x, y = detector_grid(one.basis.size, _BETWEEN)
    table = LookupTable(1, np.stack([xgc, ygc]), first=(1.0, 1.0), step=(1.0, 1.0))
    return float(np.hypot(*(table.evaluate(x, y).T - frame.corrected(one.at(x, y)))).max())
