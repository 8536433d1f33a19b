"""Matches in the layouts that other programs write, made with astropy and numpy alone.

The sky is that of astropy.wcs: pixels, a distortion of third order, a matrix, and a gnomonic
projection.  Nothing here is known to the package but the files.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import MaskedColumn, QTable, Table
from astropy.wcs import WCS

SIZE = (2048, 1024)
SCALE = 0.25  # arcsec in a pixel
SIGMA = 0.02  # pixels
POINT = (150.1, 2.2)
N = 400


@dataclass(frozen=True)
class Layout:
    """A file as a program writes it, and what is expected of it.

    Parameters
    ----------
    name : str
        Of the file.
    write : callable
        Writes the field to a path.
    taken : dict
        Columns that have to be taken, by quantity.
    origin : int
        Of the pixels in the file.
    chips : tuple of str
        Names of the chips, where there are several.
    options : tuple of str
        Of the command line, which the message of `init` names.
    """

    name: str
    write: Callable[[Field, Path], None]
    taken: dict[str, str] = field(default_factory=dict)
    origin: int = 1
    chips: tuple[str, ...] = ()
    options: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Field:
    """Stars on a detector, FITS 1-based pixels, and where they are on the sky."""

    x: np.ndarray
    y: np.ndarray
    xi: np.ndarray  # arcsec, on the plane of POINT
    eta: np.ndarray
    ra: np.ndarray
    dec: np.ndarray
    mag: np.ndarray
    rng: np.random.Generator


def plane_of(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Tangent plane (2, N) in arcsec of pixels: the truth."""
    dx, dy = x - 0.5 * SIZE[0], y - 0.5 * SIZE[1]
    dx, dy = (
        dx + 2e-6 * dx**2 - 1e-6 * dx * dy + 1e-9 * dx**3,
        dy - 3e-6 * dy**2 + 2e-6 * dx * dy - 1e-9 * dx**2 * dy,
    )
    return SCALE * np.array([-dx, dy])


def sky_of(xi: np.ndarray, eta: np.ndarray) -> np.ndarray:
    """Right ascension and declination (2, N), degrees, by astropy.wcs."""
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crval, wcs.wcs.crpix = POINT, (0.0, 0.0)
    wcs.wcs.cdelt = [1 / 3600, 1 / 3600]
    return np.array(wcs.wcs_pix2world(xi, eta, 1))


def field_of(seed: int = 3, n: int = N) -> Field:
    """Stars over the whole detector, with errors of their centroids and a few false matches."""
    rng = np.random.default_rng(seed)
    x, y = 0.5 + rng.uniform(size=(2, n)) * np.array(SIZE)[:, None]
    xi, eta = plane_of(x, y)
    xi[: n // 40] += rng.normal(0, 1.0, n // 40)  # false matches
    ra, dec = sky_of(xi, eta)
    mag = rng.uniform(15, 20, n)
    return Field(x + rng.normal(0, SIGMA, n), y + rng.normal(0, SIGMA, n), xi, eta, ra, dec, mag,
                 rng)  # fmt: skip


def _sextractor(f: Field) -> Table:
    n = len(f.x)
    return Table(
        {"NUMBER": np.arange(1, n + 1), "XWIN_IMAGE": f.x, "YWIN_IMAGE": f.y,
         "FLUX_AUTO": 10 ** (-0.4 * (f.mag - 25)), "MAG_AUTO": f.mag,
         "MAGERR_AUTO": np.full(n, 0.01), "FLAGS": np.zeros(n, int),
         "ALPHA_J2000": f.ra, "DELTA_J2000": f.dec}
    )  # fmt: skip


def ascii_head(f: Field, path: Path) -> None:
    table = _sextractor(f)
    head = [f"# {k:3d} {name:20s} description" for k, name in enumerate(table.colnames, 1)]
    rows = [" ".join(f"{v:.10g}" if isinstance(v, float) else str(v) for v in row)
            for row in table.as_array().tolist()]  # fmt: skip
    path.write_text("\n".join([*head, *rows]) + "\n")


def ldac(f: Field, path: Path) -> None:
    text = np.array(["SIMPLE  =                    T"])
    card = fits.Column("Field Header Card", "80A", array=text)
    head = fits.BinTableHDU.from_columns([card], name="LDAC_IMHEAD")
    objects = fits.BinTableHDU(_sextractor(f).as_array(), name="LDAC_OBJECTS")
    fits.HDUList([fits.PrimaryHDU(), head, objects]).writeto(path)


def photutils(f: Field, path: Path) -> None:
    table = QTable(
        {"id": np.arange(len(f.x)), "xcentroid": f.x - 1, "ycentroid": f.y - 1,
         "kron_flux": 10 ** (-0.4 * (f.mag - 25)), "ra": f.ra * u.deg, "dec": f.dec * u.deg},
        meta={"version": {"photutils": "1.13.0", "astropy": "6.1"}},
    )  # fmt: skip
    table.write(path, format="ascii.ecsv")


def photutils_psf(f: Field, path: Path) -> None:
    table = QTable(
        {"id": np.arange(len(f.x)), "group_id": np.arange(len(f.x)), "x_init": np.round(f.x) - 1,
         "y_init": np.round(f.y) - 1, "x_fit": f.x - 1, "y_fit": f.y - 1,
         "flux_fit": 10 ** (-0.4 * (f.mag - 25)), "x_err": np.full(len(f.x), 0.02),
         "y_err": np.full(len(f.x), 0.02), "skycoord": SkyCoord(f.ra * u.deg, f.dec * u.deg)}
    )  # fmt: skip
    table.write(path, format="ascii.ecsv")


def daophot(f: Field, path: Path) -> None:
    """As IRAF's allstar writes it, with two columns of the match at the end."""
    names = ["ID", "XCENTER", "YCENTER", "MAG", "MERR", "RA", "DEC"]
    units = ["##", "pixels", "pixels", "magnitudes", "magnitudes", "degrees", "degrees"]
    formats = ["%-9d", "%-10.3f", "%-10.3f", "%-12.3f", "%-14.3f", "%-14.8f", "%-14.8f"]
    wide = [9, 10, 10, 12, 14, 14, 14]

    def line(cells: list[str], mark: str = "") -> str:
        padded = [f"{cell:<{width}}" for cell, width in zip(cells, wide, strict=True)]
        return mark + f"{cells[0]:<{wide[0] - len(mark)}}" + "".join(padded[1:])

    out = ["#K IRAF       = NOAO/IRAFV2.16          version    %-23s     ",
           line(names, "#N "), line(units, "#U "), line(formats, "#F "), "#"]  # fmt: skip
    for k, (x, y, m, ra, dec) in enumerate(zip(f.x, f.y, f.mag, f.ra, f.dec, strict=True)):
        out.append(line([str(k + 1), f"{x:.3f}", f"{y:.3f}", f"{m:.3f}", "0.010", f"{ra:.8f}",
                         f"{dec:.8f}"]))  # fmt: skip
    path.write_text("\n".join(out) + "\n")


def gaia_table(f: Field, *, epoch: float | None = 2016.0) -> Table:
    """Columns of the Gaia archive: mas, and mas / yr, which a CSV does not say."""
    n = len(f.x)
    table = Table(
        {"x": f.x, "y": f.y, "source_id": 4_000_000_000_000_000_000 + np.arange(n),
         "ref_epoch": np.full(n, 2016.0), "ra": f.ra, "ra_error": np.full(n, 0.1), "dec": f.dec,
         "dec_error": np.full(n, 0.1), "parallax": np.full(n, 1e-6),
         "parallax_error": np.full(n, 0.1), "pmra": f.rng.normal(0, 5, n),
         "pmra_error": np.full(n, 0.1), "pmdec": f.rng.normal(0, 5, n),
         "pmdec_error": np.full(n, 0.1), "phot_g_mean_mag": f.mag}
    )  # fmt: skip
    if epoch is not None:
        table["epoch"] = epoch
    return table


def gaia(f: Field, path: Path) -> None:
    """The exposure was taken at the epoch of the catalogue; some stars have no motion."""
    table = gaia_table(f)
    for name in ("pmra", "pmra_error", "pmdec", "pmdec_error", "parallax", "parallax_error"):
        table[name] = MaskedColumn(table[name], mask=np.arange(len(table)) % 50 == 0)
    table.write(path, format="ascii.csv")


def vizier(f: Field, path: Path) -> None:
    """CDS X-match: Gaia's columns under the names of VizieR."""
    n = len(f.x)
    Table(
        {"angDist": f.rng.uniform(0, 0.2, n), "X_IMAGE": f.x, "Y_IMAGE": f.y, "RA_ICRS": f.ra,
         "e_RA_ICRS": np.full(n, 0.1), "DE_ICRS": f.dec, "e_DE_ICRS": np.full(n, 0.1),
         "Plx": np.full(n, 0.5), "pmRA": np.zeros(n), "pmDE": np.zeros(n), "Gmag": f.mag}
    ).write(path, format="ascii.tab")  # fmt: skip


def _wise(f: Field) -> Table:
    n = len(f.x)
    return Table(
        {"designation": [f"J{k:06d}" for k in range(n)],
         "ra": f.ra * u.deg, "dec": f.dec * u.deg,
         "sigra": np.full(n, 0.0071) * u.arcsec, "sigdec": np.full(n, 0.0071) * u.arcsec,
         "w1x": f.x * u.pix, "w1y": f.y * u.pix, "w1mpro": f.mag * u.mag,
         "mjd": np.full(n, 55250.5), "frame_num": np.full(n, 148)}
    )  # fmt: skip


def ipac(f: Field, path: Path) -> None:
    _wise(f).write(path, format="ascii.ipac")


def votable(f: Field, path: Path) -> None:
    n = len(f.x)
    Table(
        {"x": f.x * u.pix, "y": f.y * u.pix, "RAJ2000": f.ra * u.deg, "DEJ2000": f.dec * u.deg,
         "mag": f.mag * u.mag, "detector": np.full(n, "VIS")}
    ).write(path, format="votable")  # fmt: skip


def pandas_csv(f: Field, path: Path) -> None:
    import pandas

    frame = pandas.DataFrame(
        {"x_pix": f.x, "y_pix": f.y, "RA_deg": f.ra, "Dec_deg": f.dec, "g_mag": f.mag}
    )
    frame.to_csv(path)  # with its index, a column without a name


def pandas_missing(f: Field, path: Path) -> None:
    import pandas

    dec = np.where(np.arange(len(f.x)) % 40 == 7, np.nan, f.dec)
    frame = pandas.DataFrame({"x": f.x, "y": f.y, "ra": f.ra, "dec": dec, "mag": f.mag})
    frame.to_csv(path, index=False)


def lsst(f: Field, path: Path) -> None:
    n = len(f.x)
    Table(
        {"sourceId": np.arange(n), "coord_ra": f.ra, "coord_dec": f.dec,
         "slot_Centroid_x": f.x - 1, "slot_Centroid_y": f.y - 1,
         "instFlux": 10 ** (-0.4 * (f.mag - 27)), "visit": np.full(n, 192350),
         "detector": np.full(n, 94), "band": np.full(n, "r")}
    ).write(path)  # fmt: skip


def _des(f: Field) -> Table:
    n = len(f.x)
    return Table(
        {"XWIN_IMAGE": f.x, "YWIN_IMAGE": f.y, "RA": f.ra, "DEC": f.dec, "MAG_PSF": f.mag,
         "EXPNUM": np.full(n, 229658), "BAND": np.full(n, "r")}
    )  # fmt: skip


def _half(f: Field) -> np.ndarray:
    return np.arange(len(f.x)) % 2


def des(f: Field, path: Path) -> None:
    table = _des(f)
    table["ccd"] = np.array([25, 31])[_half(f)]
    table["DEC"] += 0.2 * _half(f)
    table.write(path)


def des_positions(f: Field, path: Path) -> None:
    table = _des(f)
    table["detpos"] = np.array(["S1", "N4"])[_half(f)]
    table["DEC"] += 0.2 * _half(f)
    table.write(path)


def plane_csv(f: Field, path: Path) -> None:
    Table({"X": f.x, "Y": f.y, "XI": f.xi, "ETA": f.eta, "E_XI": np.full(len(f.x), 0.007),
           "E_ETA": np.full(len(f.x), 0.007)}).write(path, format="ascii.csv")  # fmt: skip


def commented_header(f: Field, path: Path) -> None:
    """numpy.savetxt with a header."""
    np.savetxt(path, np.column_stack([f.x, f.y, f.ra, f.dec, f.mag]), fmt="%.9f",
               header="x y RA Dec mag")  # fmt: skip


def sexagesimal(f: Field, path: Path) -> None:
    sky = SkyCoord(f.ra * u.deg, f.dec * u.deg)
    Table({"x": f.x, "y": f.y, "ra": sky.ra.to_string("hour", sep=":", precision=7),
           "dec": sky.dec.to_string(sep=":", precision=6, alwayssign=True),
           "mag": f.mag}).write(path, format="ascii.csv")  # fmt: skip


def radians(f: Field, path: Path) -> None:
    """As afw tables in FITS have them."""
    Table(
        {"base_SdssCentroid_x": (f.x - 1) * u.pix, "base_SdssCentroid_y": (f.y - 1) * u.pix,
         "coord_ra": np.radians(f.ra) * u.rad, "coord_dec": np.radians(f.dec) * u.rad,
         "base_PsfFlux_instFlux": 10 ** (-0.4 * (f.mag - 27))}
    ).write(path)  # fmt: skip


def own_names(f: Field, path: Path) -> None:
    """Names that nobody can know."""
    Table({"col_px": f.x, "row_px": f.y, "lon": f.ra, "lat": f.dec, "m": f.mag}).write(
        path, format="ascii.csv"
    )


SKY = {"ra": "ra", "dec": "dec"}

LAYOUTS = (
    Layout("ascii_head.cat", ascii_head,
           {"x": "XWIN_IMAGE", "y": "YWIN_IMAGE", "ra": "ALPHA_J2000", "mag": "MAG_AUTO"}),
    Layout("ldac.cat", ldac, {"x": "XWIN_IMAGE", "dec": "DELTA_J2000"}),
    Layout("ldac.fits", ldac, {"x": "XWIN_IMAGE", "dec": "DELTA_J2000"}),
    Layout("photutils.ecsv", photutils, {"x": "xcentroid", "flux": "kron_flux"}, origin=0),
    Layout("photutils_psf.ecsv", photutils_psf, {"x": "x_fit", "ra": "skycoord.ra"}, origin=0),
    Layout("allstar.als", daophot, {"x": "XCENTER", "y": "YCENTER", "mag": "MAG"}),
    Layout("gaia.csv", gaia, {"x": "x", "pm_ra": "pmra", "mag": "phot_g_mean_mag"}),
    Layout("xmatch.tsv", vizier, {"x": "X_IMAGE", "ra": "RA_ICRS", "sigma_ra": "e_RA_ICRS"}),
    Layout("wise.tbl", ipac, {"x": "w1x", "sigma_dec": "sigdec", "epoch": "mjd"}),
    Layout("wise.txt", ipac, {"x": "w1x", "sigma_dec": "sigdec", "epoch": "mjd"}),
    Layout("topcat.vot", votable, {"ra": "RAJ2000", "dec": "DEJ2000"}, chips=()),
    Layout("topcat.xml", votable, {"ra": "RAJ2000", "dec": "DEJ2000"}, chips=()),
    Layout("pandas.csv", pandas_csv, {"x": "x_pix", "ra": "RA_deg", "dec": "Dec_deg"}),
    Layout("missing.csv", pandas_missing, {"x": "x", "dec": "dec"}),
    Layout("lsst.parquet", lsst,
           {"x": "slot_Centroid_x", "chip": "detector", "flux": "instFlux"}, origin=0),
    Layout("afw.fits", radians, {"x": "base_SdssCentroid_x", "ra": "coord_ra"}, origin=0),
    Layout("des.fits", des, {"chip": "ccd", "exposure": "EXPNUM"}, chips=("chip 25", "chip 31")),
    Layout("detpos.fits", des_positions, {"chip": "detpos"}, chips=("N4", "S1")),
    Layout("plane.csv", plane_csv, {"u": "XI", "v": "ETA", "sigma_u": "E_XI"}),
    Layout("savetxt.dat", commented_header, {"x": "x", "ra": "RA"}),
    Layout("sexagesimal.csv", sexagesimal, {"ra": "ra"}),
    Layout("own_names.csv", own_names, {"x": "col_px"},
           options=("--columns", "x=col_px,y=row_px,ra=lon,dec=lat,mag=m")),
)  # fmt: skip
