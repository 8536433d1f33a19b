"""maps.fits: uncertainty maps as images over the detector grid."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from bayesdist.assess import AreaMap, UncertaintyMap
from bayesdist.assess.maps import RELATIVE
from bayesdist.files import atomic_path

__all__ = ["write_maps"]

PREFIX = {"least squares": "LSQ", "posterior": "MIX", RELATIVE: "REL"}


def write_maps(
    path: str | Path,
    maps: Sequence[UncertaintyMap],
    areas: Sequence[AreaMap] = (),
    *,
    converged: bool = True,
    notes: Sequence[str] = (),
) -> None:
    """Write uncertainty maps of all chips of a detector as maps.fits, replaced atomically.

    Extensions LSQ_SIGMA_U, LSQ_SIGMA_V, LSQ_CORR hold the least-squares ones (outliers rejected),
    MIX_SIGMA_U, MIX_SIGMA_V, MIX_CORR those of the mixture posterior, REL_SIGMA_U and so on those
    of its relative positions, whatever the gauge, where the gauge matters; AREA and AREA_SIGMA the
    relative pixel area.  Where there are several chips, the number of the chip follows each name,
    as in MIX_SIGMA_U_2.  A linear WCS gives the detector pixel of each grid point.  `converged` and
    `notes` on the posterior go to the primary header.
    """
    hdus: list[fits.PrimaryHDU | fits.ImageHDU] = [fits.PrimaryHDU()]
    hdus[0].header["CREATOR"] = "bayesdist"
    hdus[0].header["BDCONV"] = (converged, "has the sampler converged?")
    for note in notes:
        if note:
            hdus[0].header["COMMENT"] = note
    chips = list(dict.fromkeys(m.chip for m in maps))
    ends = {chip: f"_{chip}" if len(chips) > 1 else "" for chip in chips}
    for m in sorted(maps, key=lambda m: chips.index(m.chip)):  # stable within a chip
        prefix = PREFIX[m.kind]
        for name, values, unit in (
            ("SIGMA_U", m.sigma_u, m.unit),
            ("SIGMA_V", m.sigma_v, m.unit),
            ("CORR", m.correlation, ""),
        ):
            hdu = _image(f"{prefix}_{name}{ends[m.chip]}", values, m.x, m.y, unit)
            hdu.header["DETCHIP"] = (m.chip, "chip number")
            if m.epoch is not None:
                hdu.header["EPOCH"] = (m.epoch, "[yr] decimal year")
            hdus.append(hdu)
    for a in areas:
        for name, values in (("AREA", a.area), ("AREA_SIGMA", a.sigma)):
            hdu = _image(f"{name}{ends[a.chip]}", values, a.x, a.y, "")
            if len(chips) > 1:
                hdu.header["DETCHIP"] = (a.chip, "chip number")
            hdus.append(hdu)
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
