"""Apertures of pysiaf, which looks for news on the net when it is imported: not here."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import requests

__all__ = ["aperture_of", "pysiaf_offline"]


def pysiaf_offline() -> Any:
    """The package pysiaf, imported without a connection."""

    def refuse(*_: Any, **__: Any) -> None:
        raise OSError("offline")

    asked, requests.get = requests.get, refuse
    level = logging.getLogger("pysiaf").level
    logging.getLogger("pysiaf").setLevel(logging.ERROR)
    try:
        import pysiaf
        import pysiaf.iando.read
    finally:
        requests.get = asked
        logging.getLogger("pysiaf").setLevel(level)
    return pysiaf


def aperture_of(path: Path | None, v2: float = 0.0, v3: float = 0.0, angle: float = 0.0) -> Any:
    """Aperture of a JWST imager of 2048 x 2048 pixels, with the coefficients of a table."""
    pysiaf = pysiaf_offline()
    aperture = pysiaf.JwstAperture()
    aperture.InstrName, aperture.AperName, aperture.observatory = "NIRISS", "NIS_CEN", "JWST"
    aperture.AperType = "FULLSCA"
    aperture.V2Ref, aperture.V3Ref, aperture.V3IdlYAngle = v2, v3, angle
    aperture.VIdlParity = -1
    aperture.XSciRef = aperture.YSciRef = 1024.5
    aperture.XSciSize = aperture.YSciSize = 2048
    aperture._initial_attributes_set = True
    if path is not None:
        rows = pysiaf.iando.read.read_siaf_distortion_coefficients(file_name=str(path))
        aperture.Sci2IdlDeg = int(max(rows["exponent_x"]))
        for row in rows:
            index = f"{row['exponent_x'] + row['exponent_y']}{row['exponent_y']}"
            for name in ("Sci2IdlX", "Sci2IdlY", "Idl2SciX", "Idl2SciY"):
                setattr(aperture, f"{name}{index}", float(row[name]))
    return aperture
