"""FITS files of maps over the detector: position uncertainties and pixel areas.

A pixel area map of one chip is written to the primary HDU, as in the observatory's files. Maps of
several chips are written to extensions SCI,1 and so on, in the order of the extensions of an
exposure. Standard deviations follow as extensions ERR.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from astropy.io import fits

from bayesdist.assess import AreaMap, UncertaintyMap
from bayesdist.assess.maps import RELATIVE
from bayesdist.calibration.area import PixelAreaMap
from bayesdist.errors import InputError
from bayesdist.files.atomic import atomic_path
from bayesdist.products.common.cards import append_cards, set_text, wrapped_cards
from bayesdist.utils.arrays import Float

PREFIX = {"least squares": "LSQ", "posterior": "MIX", RELATIVE: "REL"}


def write_maps(
    path: str | Path,
    maps: Sequence[UncertaintyMap],
    areas: Sequence[AreaMap] = (),
    *,
    converged: bool = True,
    notes: Sequence[str] = (),
) -> None:
    """Write uncertainty maps of all chips of a detector atomically as maps.fits.

    Extensions LSQ_SIGMA_U, LSQ_SIGMA_V and LSQ_CORR hold the least-squares results (outliers
    rejected), and MIX_SIGMA_U, MIX_SIGMA_V and MIX_CORR those of the mixture posterior. If the
    gauge matters, REL_SIGMA_U and so on hold the gauge-independent uncertainty of relative
    positions. AREA and AREA_SIGMA are the relative pixel area and its standard deviation. With
    several chips, the chip number follows each name, as in MIX_SIGMA_U_2. A linear WCS gives the
    detector pixel of each grid point. `converged` and `notes` describe the posterior and are
    written to the primary header.
    """
    hdus: list[fits.PrimaryHDU | fits.ImageHDU] = [fits.PrimaryHDU()]
    hdus[0].header["CREATOR"] = "bayesdist"
    hdus[0].header["BDCONV"] = (converged, "has the sampler converged?")
    for note in notes:
        if note:
            append_cards(hdus[0], wrapped_cards("COMMENT", [note]))
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
    values: Float,
    x: Float,
    y: Float,
    unit: str,
) -> fits.ImageHDU:
    hdu = fits.ImageHDU(np.ascontiguousarray(values), name=name)
    if unit:
        set_text(hdu.header, "BUNIT", {"pix": "pixel"}.get(unit, unit))
    for k, (axis, grid) in enumerate((("X", x), ("Y", y)), start=1):
        hdu.header[f"CTYPE{k}"] = (axis, "detector pixel, FITS 1-based")
        hdu.header[f"CUNIT{k}"] = "pixel"
        hdu.header[f"CRPIX{k}"] = 1.0
        hdu.header[f"CRVAL{k}"] = float(grid[0])
        hdu.header[f"CDELT{k}"] = float(grid[1] - grid[0])
    return hdu


def write_pam(
    path: str | os.PathLike[str],
    maps: Sequence[PixelAreaMap],
    *,
    instrument: str = "",
    detector: str = "",
    source: str = "",
) -> None:
    """Write pixel area maps of an image atomically.

    Parameters
    ----------
    path : path-like
        Output file.
    maps : sequence of PixelAreaMap
        One map per chip, in the order of the exposure's extensions.
    instrument, detector : str
        INSTRUME and DETECTOR; omitted if empty.
    source : str
        Name of the calibration, for the header.

    Raises
    ------
    InputError
        If `maps` is empty, or the file cannot be written.
    """
    if not maps:
        raise InputError("there is no map to write", where=str(path), do="give one for each chip")
    primary = fits.PrimaryHDU()
    hdus: list[fits.PrimaryHDU | fits.ImageHDU] = [primary]
    for version, area_map in enumerate(maps, start=1):
        planes = [("SCI", area_map.area), ("ERR", area_map.sigma)]
        for name, values in planes:
            if values is None:
                continue
            data = values.astype(np.float32)
            if len(maps) == 1 and name == "SCI":
                primary.data = data
                _describe(primary.header, area_map)
                continue
            hdu = fits.ImageHDU(data, name=name)
            hdu.header["EXTVER"] = version
            _describe(hdu.header, area_map)
            hdus.append(hdu)
    for keyword, text in (("INSTRUME", instrument), ("DETECTOR", detector)):
        if text:
            set_text(primary.header, keyword, text)
    primary.header["FILETYPE"] = "PIXEL AREA MAP"
    primary.header["CREATOR"] = "bayesdist"
    if source:
        set_text(primary.header, "BDSOURCE", Path(source).name[:60], "the calibration")
    with atomic_path(path) as temporary:
        fits.HDUList(hdus).writeto(temporary, checksum=True)


def _describe(header: fits.Header, one: PixelAreaMap) -> None:
    header["CCDCHIP"] = (one.chip, "chip number")
    header["PAMSCALE"] = (one.scale, f"[{one.unit}] pixel whose area counts as 1")
    for k, (ltv, ltm) in enumerate(zip(one.image.ltv, one.image.ltm, strict=True), start=1):
        header[f"LTV{k}"] = (ltv, "pixel of this image less that of the chip")
        header[f"LTM{k}_{k}"] = ltm
    if one.epoch is not None:
        header["EPOCH"] = (one.epoch, "[yr] date of the distortion")
