"""A calibration laid on the sky by a position that its user gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.further import scaled
from bayesdist.calibration.plane import Plane
from bayesdist.errors import InputError


def placed_at(
    calibration: Calibration,
    crval: tuple[float, float] | None,
    scale_arcsec: float | None,
    *,
    where: str,
) -> Calibration:
    """Calibration with (u, v) = (0, 0) at CRVAL (degrees), u to the east and v to the north.

    Pixels become arcseconds by their size.  Without a CRVAL the calibration stays as it is.
    InputError, that names the configuration `where`, for a plane that lies on the sky already, a
    CRVAL that is no position, and pixels of unknown size.
    """
    if crval is None:
        return calibration
    if calibration.plane.point is not None:
        raise InputError(
            "a crval is given for a plane that lies on the sky already",
            where=f"{where}.crval",
            do="leave it out",
        )
    if not (np.isfinite(crval).all() and -90 <= crval[1] <= 90):
        raise InputError(
            f"crval is {crval}, no right ascension and declination in degrees",
            where=f"{where}.crval",
            do="correct it, or leave it out",
        )
    if calibration.unit == "pix":
        if scale_arcsec is None:
            raise InputError(
                "a crval is given, and u and v are in pixels of unknown size",
                where="detector.scale_mas",
                do="give the pixel scale (of convert: --scale)",
            )
        calibration = _in_arcsec(calibration, scale_arcsec)
    plane = Plane("sky", point=(float(crval[0]), float(crval[1])), note=calibration.plane.note)
    return replace(calibration, plane=plane, with_plane=None)


def _in_arcsec(calibration: Calibration, pixel: float) -> Calibration:
    """Calibration in arcseconds; `pixel` is the size of one."""
    solution, model = calibration.solution, calibration.model
    return replace(
        calibration,
        solution=solution.transformed(
            replace(model, unit="arcsec"),
            lambda theta: pixel * theta[..., : model.n_params],
            pixel * np.eye(model.n_params),
        ),
        after=tuple(
            replace(
                table,
                values=pixel * table.values,
                sigma=None if table.sigma is None else pixel * table.sigma,
            )
            for table in calibration.after
        ),
        inverses={},
        scale=None if calibration.scale is None else pixel * calibration.scale,
        further=scaled(calibration.further, pixel),
    )
