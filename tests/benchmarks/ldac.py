"""SExtractor's FITS_LDAC catalogues, written with astropy alone.

The header of the image stands as a text in the one row of the table LDAC_IMHEAD, the detections in
LDAC_OBJECTS.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.wcs import WCS
from numpy.typing import NDArray

from tests.benchmarks.dithered import PIXEL, REFERENCE_SIGMA, ROLLS, DitheredSky

__all__ = [
    "exposure_header",
    "read_head",
    "signal_to_noise",
    "write_catalogues",
    "write_references",
]

Float = NDArray[np.float64]

CARD = 80
YEAR, MJD = 2016.0, 57388.0


def exposure_header(sky: DitheredSky, exposure: int) -> fits.Header:
    """Image header with the commanded pointing as a linear WCS.

    The roll stands in LONPOLE and not in the CD matrix: SCAMP's polynomial is one of intermediate
    world coordinates, and only thus do these turn with the detector.
    """
    nx, ny = sky.chip.size
    ra, dec = sky.plane.all_pix2world(sky.commanded[exposure][None], 1)[0]
    cards = {
        "SIMPLE": True,
        "BITPIX": 16,
        "NAXIS": 2,
        "NAXIS1": int(nx),
        "NAXIS2": int(ny),
        "CTYPE1": "RA---TAN",
        "CTYPE2": "DEC--TAN",
        "CUNIT1": "deg",
        "CUNIT2": "deg",
        "CRVAL1": ra,
        "CRVAL2": dec,
        "CRPIX1": sky.chip.reference_pixel[0],
        "CRPIX2": sky.chip.reference_pixel[1],
        "CD1_1": -PIXEL,
        "CD1_2": 0.0,
        "CD2_1": 0.0,
        "CD2_2": PIXEL,
        "LONPOLE": 180.0 + np.degrees(sky.rolls[exposure]),
        "EQUINOX": 2000.0,
        "RADESYS": "ICRS",
        "DATE-OBS": f"{YEAR:.0f}-01-01T00:00:00",
        "MJD-OBS": MJD,
        "EXPTIME": 100.0,
        "INSTRUME": "SIMULATED",
        "ROLLSET": f"ROLL{exposure % len(ROLLS)}",
    }
    return fits.Header(list(cards.items()))


def signal_to_noise(mag: Float) -> Float:
    """Of the photons of a star with such an instrumental magnitude."""
    return np.asarray(10.0 ** (-0.2 * mag))


def write_catalogues(sky: DitheredSky, folder: Path) -> list[str]:
    """Write one catalogue for each exposure; their names."""
    d = sky.field.detections
    assert d.sigma is not None and d.mag is not None
    names = []
    for e in range(len(d.exposure_names)):
        rows = d.exposure == e
        flux = signal_to_noise(d.mag[rows]) ** 2
        columns = {
            "X_IMAGE": ("pixel", d.x[rows]),
            "Y_IMAGE": ("pixel", d.y[rows]),
            "ERRA_IMAGE": ("pixel", d.sigma[rows]),
            "ERRB_IMAGE": ("pixel", d.sigma[rows]),
            "ERRTHETA_IMAGE": ("deg", np.zeros(rows.sum())),
            "FLUX_AUTO": ("count", flux),
            "FLUXERR_AUTO": ("count", np.sqrt(flux)),
            "FLAGS": (None, np.zeros(rows.sum(), np.int16)),
        }
        names.append(f"{d.exposure_names[e]}.cat")
        _write(folder / names[-1], exposure_header(sky, e), columns)
    return names


def write_references(sky: DitheredSky, path: Path) -> None:
    """Write the reference stars."""
    world = sky.plane.all_pix2world(sky.references, 1)
    n = len(world)
    error = np.full(n, REFERENCE_SIGMA * PIXEL)
    columns = {
        "X_WORLD": ("deg", world[:, 0]),
        "Y_WORLD": ("deg", world[:, 1]),
        "ERRA_WORLD": ("deg", error),
        "ERRB_WORLD": ("deg", error),
        "ERRTHETA_WORLD": ("deg", np.zeros(n)),
        "MAG": ("mag", sky.reference_mags),
        "MAGERR": ("mag", np.full(n, 0.01)),
        "OBSDATE": ("yr", np.full(n, YEAR)),
        "FLAGS": (None, np.zeros(n, np.int16)),
    }
    header = fits.Header([("SIMPLE", True), ("BITPIX", 8), ("NAXIS", 0)])
    _write(path, header, columns)


def _write(path: Path, image: fits.Header, columns: dict[str, tuple[str | None, Float]]) -> None:
    """The three HDUs of a catalogue."""
    kinds = {"f": "1D", "i": "1I"}
    objects = fits.BinTableHDU.from_columns(
        [
            fits.Column(name, kinds[values.dtype.kind], unit, array=values)
            for name, (unit, values) in columns.items()
        ],
        name="LDAC_OBJECTS",
    )
    text = image.tostring(padding=True).encode("ascii")
    # astropy ends strings with zeros where SCAMP looks for the blanks of END: the row is bytes here
    row = np.array([(np.frombuffer(text, np.uint8),)], [("Field Header Card", "u1", (len(text),))])
    head = fits.BinTableHDU(row, name="LDAC_IMHEAD").header
    head["TFORM1"], head["TDIM1"] = f"{len(text)}A", f"({CARD}, {len(text) // CARD})"
    primary, whole = io.BytesIO(), io.BytesIO()
    fits.PrimaryHDU().writeto(primary)
    fits.HDUList([fits.PrimaryHDU(), objects]).writeto(whole)
    first = len(primary.getvalue())
    path.write_bytes(
        primary.getvalue() + head.tostring().encode("ascii") + text + whole.getvalue()[first:]
    )


def read_head(path: Path, image: fits.Header) -> WCS:
    """The solution that SCAMP wrote for an exposure, beside the header that it was given.

    Parameters
    ----------
    path : Path
        The .head file; it has no LONPOLE.
    image : astropy.io.fits.Header
    """
    text = path.read_bytes().decode("ascii", "ignore")  # its comments are in Latin 1
    header = fits.Header.fromstring(text, sep="\n")
    header["LONPOLE"] = image["LONPOLE"]
    return WCS(header)
