"""maps.fits: uncertainty maps as images over the detector grid."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from bayesdist.assess import AreaMap, UncertaintyMap
from bayesdist.data import atomic_path

__all__ = ["write_maps"]

PREFIX = {"least squares": "LSQ", "posterior": "MIX"}


def write_maps(
    path: str | Path,
    maps: Sequence[UncertaintyMap],
    area: AreaMap | None = None,
    *,
    converged: bool = True,
    note: str = "",
) -> None:
    """Write uncertainty maps of one chip.

    Extensions LSQ_SIGMA_U, LSQ_SIGMA_V, LSQ_CORR hold the least-squares ones (outliers rejected),
    MIX_SIGMA_U, MIX_SIGMA_V, MIX_CORR those of the mixture posterior; AREA and AREA_SIGMA the
    relative pixel area.  A linear WCS gives the detector pixel of each grid point.

    Parameters
    ----------
    path : path
        Replaced atomically.
    maps : sequence of UncertaintyMap
    area : AreaMap, optional
    converged : bool
        Whether the posterior may be relied on; noted in the primary header.
    note : str
        What else has to be said of the posterior there.
    """
    hdus: list[fits.PrimaryHDU | fits.ImageHDU] = [fits.PrimaryHDU()]
    hdus[0].header["CREATOR"] = "bayesdist"
    hdus[0].header["BDCONV"] = (converged, "has the sampler converged?")
    if note:
        hdus[0].header["COMMENT"] = note
    for m in maps:
        prefix = PREFIX[m.kind]
        for name, values, unit in (
            ("SIGMA_U", m.sigma_u, m.unit),
            ("SIGMA_V", m.sigma_v, m.unit),
            ("CORR", m.correlation, ""),
        ):
            hdu = _image(f"{prefix}_{name}", values, m.x, m.y, unit)
            hdu.header["DETCHIP"] = (m.chip, "chip number")
            if m.epoch is not None:
                hdu.header["EPOCH"] = (m.epoch, "[yr] decimal year")
            hdus.append(hdu)
    if area is not None:
        hdus.append(_image("AREA", area.area, area.x, area.y, ""))
        hdus.append(_image("AREA_SIGMA", area.sigma, area.x, area.y, ""))
    with atomic_path(path) as temporary:
        fits.HDUList(hdus).writeto(temporary, checksum=True)


def _image(
    name: str,
    values: NDArray[np.float64],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    unit: str,
) -> fits.ImageHDU:
    hdu = fits.ImageHDU(np.ascontiguousarray(values), name=name)
    if unit:
        hdu.header["BUNIT"] = {"pix": "pixel"}.get(unit, unit)
    for k, (axis, grid) in enumerate((("X", x), ("Y", y)), start=1):
        hdu.header[f"CTYPE{k}"] = (axis, "detector pixel, FITS 1-based")
        hdu.header[f"CUNIT{k}"] = "pixel"
        hdu.header[f"CRPIX{k}"] = 1.0
        hdu.header[f"CRVAL{k}"] = float(grid[0])
        hdu.header[f"CDELT{k}"] = float(grid[1] - grid[0])
    return hdu
