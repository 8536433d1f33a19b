"""stwcs without network or archive: the real header that astropy ships, with an IDCTAB of ours.

The header is that of HST exposure j94f05bgq (programme 10368, 47 Tuc, ACS/WFC F606W, 2005-03-07).
It is put back to its state before updatewcs: OCRVAL1 and its like are the original WCS.
"""

from __future__ import annotations

import contextlib
import io
import os
import warnings
from pathlib import Path
from unittest import mock

import astropy.wcs
import numpy as np
import pytest
from astropy.io import fits
from numpy.typing import ArrayLike, NDArray

FLT = Path(astropy.wcs.__file__).parent / "tests" / "data" / "j94f05bgq_flt.fits"
CHIP_OF_EXTENSION = {1: 2, 4: 1}
# A later copy, under the name of the original but corrected already.
_ALTERNATE = (
    "WCSNAME", "WCSAXES", "LONPOLE", "LATPOLE", "RESTFRQ", "RESTWAV",
    *(f"{k}{axis}" for k in ("CRPIX", "CDELT", "CUNIT", "CTYPE", "CRVAL") for axis in (1, 2)),
    *("CD1_1", "CD1_2", "CD2_1", "CD2_2"),
)  # fmt: skip
_WCS = ("CRVAL1", "CRVAL2", "CRPIX1", "CRPIX2", "CD1_1", "CD1_2", "CD2_1", "CD2_2")


def original_exposure(
    idctab: Path, date: str | None = None, **keywords: Path | str | float
) -> fits.HDUList:
    """The exposure before any distortion correction, pointing at an IDCTAB.

    Further keywords of the primary header are set as given: D2IMFILE and NPOLFILE, for one.
    """
    with fits.open(FLT) as source:
        primary = source[0].header.copy()
        extensions = {ext: source[ext].header.copy() for ext in CHIP_OF_EXTENSION}
    for keyword in (
        "UPWCSVER",
        "PYWCSVER",
        "DISTNAME",
        "SIPNAME",
        "NPOLFILE",
        "D2IMFILE",
        "OFFTAB",
    ):
        primary.remove(keyword, ignore_missing=True)
    primary["NEXTEND"] = 2
    for keyword, value in {"IDCTAB": idctab, **keywords}.items():
        primary[keyword] = str(value) if isinstance(value, Path) else value
    if date is not None:
        primary["DATE-OBS"] = date
    hdus = [fits.PrimaryHDU(header=primary)]
    for version, header in enumerate(extensions.values(), start=1):
        for keyword in list(header):
            if keyword.endswith("O") and keyword[:-1] in _ALTERNATE:
                del header[keyword]
            elif keyword[:2] in ("A_", "B_", "DP") or keyword.startswith(("CPDIS", "TDD", "IDC")):
                del header[keyword]
        for keyword in ("WCSNAME", "OCX10", "OCX11", "OCY10", "OCY11"):
            header.remove(keyword, ignore_missing=True)
        for keyword in _WCS:
            header[keyword] = header["O" + keyword]
        for axis, name in ((1, "RA---TAN"), (2, "DEC--TAN")):
            header[f"CTYPE{axis}"] = name
        header["EXTVER"] = version
        # nobody looks at the values
        hdus.append(fits.ImageHDU(np.zeros((2048, 4096), np.uint8), header=header, name="SCI"))
        hdus[-1].header["EXTVER"] = version
    return fits.HDUList(hdus)


def updated(hdus: fits.HDUList, path: Path) -> dict[int, astropy.wcs.WCS]:
    """HSTWCS of each chip, by chip number, after stwcs has put all corrections in."""
    pytest.importorskip("stwcs")  # not on Windows
    from stwcs.updatewcs import updatewcs
    from stwcs.wcsutil import HSTWCS

    with (
        mock.patch.dict(os.environ, ASTROMETRY_STEP_CONTROL="off"),
        warnings.catch_warnings(),
        contextlib.redirect_stdout(io.StringIO()),
    ):
        warnings.simplefilter("ignore")
        hdus.writeto(path, overwrite=True, output_verify="silentfix")
        updatewcs(str(path), use_db=False, checkfiles=False)
        with fits.open(path) as done:
            return {done[ext].header["CCDCHIP"]: HSTWCS(done, ext=ext) for ext in (1, 2)}


def solutions(
    folder: Path, idctab: Path, date: str | None = None, **files: Path
) -> dict[int, astropy.wcs.WCS]:
    """HSTWCS of each chip, of an IDCTAB, and of D2IMFILE and NPOLFILE where they are given."""
    hdus = original_exposure(idctab, date, **files)
    return updated(hdus, folder / f"{idctab.stem}_flt.fits")


def sky(
    folder: Path, idctab: Path, x: NDArray, y: NDArray, date: str | None = None, **files: Path
) -> dict[int, NDArray]:
    """Sky positions (N, 2) in degrees of pixels of each chip, as stwcs makes them."""
    found = solutions(folder, idctab, date, **files)
    return {chip: w.all_pix2world(np.stack([x, y], axis=1), 1) for chip, w in found.items()}


def archived_sky(x: NDArray, y: NDArray) -> dict[int, NDArray]:
    """The same from the solution that stands in the header of the archive (qbu1641sj)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return {
            chip: astropy.wcs.WCS(fits.getheader(FLT, ext)).all_pix2world(
                np.stack([x, y], axis=1), 1
            )
            for ext, chip in CHIP_OF_EXTENSION.items()
        }


def separation_mas(a: NDArray, b: NDArray) -> NDArray:
    """Distances of pairs of positions, in mas."""
    d_ra = (a[:, 0] - b[:, 0]) * np.cos(np.deg2rad(a[:, 1]))
    return np.hypot(d_ra, a[:, 1] - b[:, 1]) * 3.6e6


def gnomonic(positions: NDArray, centre: ArrayLike) -> NDArray:
    """Tangent-plane coordinates (N, 2) in arcseconds of sky positions (N, 2) in degrees."""
    ra, dec = np.deg2rad(positions).T
    ra0, dec0 = np.deg2rad(centre)
    d = np.sin(dec) * np.sin(dec0) + np.cos(dec) * np.cos(dec0) * np.cos(ra - ra0)
    xi = np.cos(dec) * np.sin(ra - ra0) / d
    eta = (np.sin(dec) * np.cos(dec0) - np.cos(dec) * np.sin(dec0) * np.cos(ra - ra0)) / d
    return np.rad2deg(np.stack([xi, eta], axis=1)) * 3600
