"""Files of pixel area maps.

The image stands in the primary HDU for one chip, as the observatory's files have it, and in
extensions SCI, 1 and on for several, in the order of an exposure's own.  Standard deviations follow
as ERR.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from astropy.io import fits

from bayesdist.calibration.area import PixelAreaMap
from bayesdist.errors import InputError
from bayesdist.files import atomic_path

__all__ = ["write_pam"]


def write_pam(
    path: str | os.PathLike[str],
    maps: Sequence[PixelAreaMap],
    *,
    instrument: str = "",
    detector: str = "",
    source: str = "",
) -> None:
    """Write pixel area maps of an image, whole or not at all.

    `maps`: one for each chip, in the order of the exposure's extensions. `instrument`, `detector`:
    INSTRUME and DETECTOR; left out where empty. `source`: the calibration, for the header.
    InputError without maps, or when the file cannot be written.
    """
    if not maps:
        raise InputError("there is no map to write", where=str(path), do="give one for each chip")
    primary = fits.PrimaryHDU()
    hdus: list[fits.PrimaryHDU | fits.ImageHDU] = [primary]
    for version, one in enumerate(maps, start=1):
        planes = [("SCI", one.area), ("ERR", one.sigma)]
        for name, values in planes:
            if values is None:
                continue
            data = values.astype(np.float32)
            if len(maps) == 1 and name == "SCI":
                primary.data = data
                _describe(primary.header, one)
                continue
            hdu = fits.ImageHDU(data, name=name)
            hdu.header["EXTVER"] = version
            _describe(hdu.header, one)
            hdus.append(hdu)
    for keyword, text in (("INSTRUME", instrument), ("DETECTOR", detector)):
        if text:
            primary.header[keyword] = text
    primary.header["FILETYPE"] = "PIXEL AREA MAP"
    primary.header["CREATOR"] = "bayesdist"
    if source:
        primary.header["BDSOURCE"] = (Path(source).name[:60], "the calibration")
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
