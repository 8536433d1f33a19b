"""Transform, inverse and record of a distortion reference file, built from a calibration."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from astropy.modeling import Model

from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.inverse import detector_grid, fitted_inverse
from bayesdist.calibration.modeling import forward_transform, inverse_transform
from bayesdist.calibration.plane import Plane
from bayesdist.errors import InputError, required
from bayesdist.products.common.asdf.distortion import closure_of
from bayesdist.products.common.asdf.transforms import tables_of
from bayesdist.products.common.asdf.tree import Detector, PlacedSettings
from bayesdist.products.common.coefficients import require_regular
from bayesdist.products.common.document import BuildOptions
from bayesdist.products.common.record import CalibrationRecord, at_date, record_of
from bayesdist.utils.arrays import Float


@dataclass(frozen=True, eq=False)
class ChipTransform:
    """Transform of one chip with everything else that its file states."""

    calibration: Calibration  # calibration of the chip, in the frame of its aperture
    chip: int
    chip_name: str
    model: Model  # pixels to V2, V3, with its inverse
    record: CalibrationRecord
    closure: float  # pixels; largest error of the inverse

    @property
    def table_arrays(self) -> list[Float]:
        """Arrays of the look-up tables of the transform and of its inverse."""
        tables = [*tables_of(self.model), *tables_of(self.model.inverse)]
        return [array for table in tables for array in (table.lookup_table, *table.points)]


def chip_transforms(
    calibration: Calibration, settings: PlacedSettings, options: BuildOptions, where: str
) -> Iterator[ChipTransform]:
    """Yield the transform of each chip; `where` is the configuration section named in messages.

    Raises InputError if neither the settings nor the calibration give the position or orientation
    in V2, V3, and for the reasons given in `at_date` and `fitted_inverse`.
    """
    plane = _placed(calibration.plane, settings, where)
    matrix = required(plane.to_v2v3, "the plane of an aperture has no axes along V2 and V3")
    v2v3 = required(plane.v2v3, "the plane of an aperture has no position in V2 and V3")
    for nominal in calibration.model.chips:
        number = nominal.number
        dated = at_date(calibration, number, options.epoch, options.scale_arcsec, where=where)
        dated = replace(dated, plane=plane)
        chip = dated.chip(number, origin="stated")
        poly = chip.monomials()
        require_regular(poly.linear, number)
        model = forward_transform(poly, matrix, v2v3, dated.before)
        back = inverse_transform(
            fitted_inverse(chip, settings.inverse_order), matrix, v2v3, dated.before
        )
        closure = closure_of(model, back, *detector_grid(nominal.size))
        if not np.isfinite(closure):
            raise InputError(
                "the inverse of its look-up tables does not converge",
                where=where,
                do="check the tables: they change the order of neighbouring pixels",
            )
        model.inverse = back
        date = options.epoch if calibration.model.time is not None else None
        record = record_of(dated, calibration, epoch=date, closure=closure)
        yield ChipTransform(dated, number, nominal.name, model, record, closure)


def refuse_larger(one: ChipTransform, name: str, known: Detector | None, where: str) -> None:
    """Raise InputError if a chip has more pixels than the detector of this name, if it is known."""
    [chip] = one.calibration.model.chips
    if known is not None and any(a > b for a, b in zip(chip.size, known.size, strict=True)):
        (nx, ny), (most_x, most_y) = chip.size, known.size
        raise InputError(
            f"the chip has {nx:g} x {ny:g} pixels, but {name} {most_x:g} x {most_y:g}",
            where=where,
            do="name the detector that it is",
        )


def _placed(plane: Plane, settings: PlacedSettings, where: str) -> Plane:
    """Plane in an aperture: from the settings, or else from the calibration; default parity -1."""
    v2v3 = plane.v2v3 or (None, None)
    values = {
        "v2ref": settings.v2ref if settings.v2ref is not None else v2v3[0],
        "v3ref": settings.v3ref if settings.v3ref is not None else v2v3[1],
        "v3idlyangle": settings.v3idlyangle if settings.v3idlyangle is not None else plane.v3_angle,
    }
    missing = [name for name, value in values.items() if value is None]
    if missing:
        raise InputError(
            f"{' and '.join(missing)} of (u, v) = 0 {'is' if len(missing) == 1 else 'are'} not "
            "known",
            where=where,
            do="take them from the SIAF of the aperture",
        )
    v2, v3, angle = (float(value) for value in values.values() if value is not None)
    return Plane(
        "aperture",
        v2v3=(v2, v3),
        v3_angle=angle,
        parity=settings.parity or plane.parity or -1,
        orientation=plane.orientation,
    )
