"""Calibration of TPV headers."""

from __future__ import annotations

import numpy as np

from bayesdist.arrays import Float
from bayesdist.calibration.calibration import Calibration, calibration_of_maps
from bayesdist.calibration.chip_map import ChipMap, fitted_map
from bayesdist.calibration.inverse import detector_grid
from bayesdist.calibration.plane import ARCSEC, Plane
from bayesdist.errors import FormatError, InputError
from bayesdist.products.formats.common.document import Choice, required_size
from bayesdist.products.formats.common.parameters import with_parameters
from bayesdist.products.formats.tpv.head import TpvFile, TpvHead

_RADIAL_ORDER = 9  # of the polynomial that stands for odd powers of r
_EXACT = 1e-9  # pixels: below it a map is the polynomial that it was taken for


def tpv_calibration(file: TpvFile, name: str, choice: Choice) -> Calibration:
    """Calibration of the headers, with the covariance of the file beside them where it is there.

    As used, nothing but the headers counts.  Powers of r are no polynomials: a note says how well
    they are followed.  MissingSizeError for headers without a size where none is chosen;
    FormatError for headers without PV1_1 or PV2_1, or about several points of the sky; and where
    the parameters beside them are others.
    """
    _check(file, name)
    maps, notes = {}, list[str]()
    order = max(_RADIAL_ORDER if head.radial else head.order for head in file.heads)
    header = file.heads[0].header
    unit = str(header.get("BDUNIT", "arcsec"))
    factor = 3600.0 / float(header.get("BDARCS", ARCSEC.get(unit, 1.0)))
    for head in file.heads:
        one, worst = _map(head, name, order, choice.size, unit, factor)
        maps[head.number] = one
        if head.radial:
            notes.append(
                f"powers of r of chip {head.number} are followed by a polynomial of order "
                f"{order}, {worst:.2g} pix off at worst"
            )
    kind = str(header.get("BDPLANE", "sky"))
    plane = Plane(kind, point=file.heads[0].crval if kind == "sky" else None)
    found = calibration_of_maps(
        maps, name, plane=plane, numbered=all(h.numbered for h in file.heads), notes=tuple(notes)
    )
    if choice.as_used:
        return found
    beside = file.content if file.content.is_fits else file.content.beside(file.side_file)
    return with_parameters(found, beside, file.side_file)


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
                do="give headers of one CRVAL, as of one exposure of a mosaic",
            )


def _map(
    head: TpvHead,
    name: str,
    order: int,
    given: tuple[float, float] | None,
    unit: str,
    factor: float,
) -> tuple[ChipMap, float]:
    """Map of one chip in the unit, `factor` of them in a degree, and its miss in pixels."""
    size = required_size(head.size, given, name)

    def positions(x: Float, y: Float) -> Float:
        return factor * np.stack(head.plane(x, y))

    one = fitted_map(positions, name, order=order, size=size, reference_pixel=head.crpix, unit=unit)
    x, y = detector_grid(size, 65)
    far = np.hypot(*(one.at(x, y) - positions(x, y)))
    worst = float(far.max() / np.sqrt(abs(np.linalg.det(factor * head.cd))))
    return one, 0.0 if worst < _EXACT else worst
