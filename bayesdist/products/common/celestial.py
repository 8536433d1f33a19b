"""World coordinates of a FITS header, reduced to a tangent plane with north up.

`astropy.wcs` interprets the header: projection, axis order, units, PC, CD or CROTA2, LONPOLE and
celestial system. A TAN projection is converted exactly to xi (east) and eta (north) in degrees,
around a tangent point in the equatorial system; every other projection is refused. Positions
computed from the parsed distortion are then compared with those of astropy.wcs on a grid of pixels.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from astropy.io import fits

from bayesdist.calibration.inverse import detector_grid
from bayesdist.data.tangent import plane_axes, separation, sky_of_plane
from bayesdist.errors import FormatError, InputError
from bayesdist.files.faults import reason_of
from bayesdist.model.basis import MAX_ORDER
from bayesdist.products.common.cards import card_images, header_of, keyword_of
from bayesdist.utils.arrays import Float

if TYPE_CHECKING:
    from astropy.wcs import WCS

TOLERANCE_MAS = 0.01  # largest allowed distance between positions computed here and by astropy.wcs
_GRID = 17  # points per axis at which positions are compared
# Look-up tables need the opened file; inverses do not change positions.
_TABLES = re.compile(r"(D2IM\w*|CPDIS\d|CPERR\d|CQDIS\d|CQERR\d|DP\d|DQ\d)$")
# Largest values of keywords for which astropy.wcs allocates memory that grows with their square.
_LARGEST = {
    **dict.fromkeys(("A_ORDER", "B_ORDER", "AP_ORDER", "BP_ORDER"), MAX_ORDER),
    "WCSAXES": 99,  # largest number of axes that CDi_j and CTYPEn can address (FITS 4.0, 8.2)
}
_INVERSE = re.compile(r"(AP|BP)_")
_SAMPLE = (
    "sample it through astropy.wcs and fit a polynomial: `bayesdist convert FILE --sample --to sip`"
)
_NAMES = {
    "TNX": "a TNX of IRAF (TAN with a polynomial in WAT keywords)",
    "ZPX": "a ZPX of IRAF (ZPN with a polynomial in WAT keywords)",
    "DSS": "a plate solution of the Digitized Sky Survey (AMDX and AMDY keywords)",
}
_NO_AREA = "the linear terms make a pixel without an area"
HELD_PROJECTIONS = ("TAN", "TPV")


@dataclass(frozen=True, eq=False)
class TangentForm:
    """Linear part of a header, and the transformation from its coordinates to a tangent plane."""

    wcs: WCS  # without look-up tables
    cd: Float  # (2, 2), degrees per pixel, along the axes of the header
    native_turn: Float  # (2, 2), from these axes to east and north in the header's celestial system
    system_turn: Float  # (2, 2), from east and north in that system to those of RA and Dec
    native_point: tuple[float, float]  # longitude and latitude of the tangent point, degrees
    point: tuple[float, float]  # RA and Dec of the tangent point, degrees

    @property
    def turn(self) -> Float:
        """Matrix (2, 2) from the axes of the header to xi and eta."""
        return np.asarray(self.system_turn @ self.native_turn)

    def check(
        self,
        positions: Callable[[Float, Float], Float],
        size: tuple[float, float],
        header: fits.Header,
        where: str,
        opened: fits.HDUList | None = None,
    ) -> None:
        """Compare positions with those of astropy.wcs on a grid over the image.

        Parameters
        ----------
        positions : callable
            ``positions(x, y)`` returns xi and eta (2, N) in degrees for FITS 1-based pixels (N,).
        size : tuple of float
            Columns and rows of the image.
        header : Header
            Header of the image.
        where : str
            Name of the file, for error messages.
        opened : HDUList, optional
            The file with the look-up tables of the header. If None, tables are left out.

        Raises
        ------
        InputError
            If any position differs by more than 0.01 mas.
        """
        wcs = wcs_of(
            _without(header, _INVERSE, *([_TABLES] if opened is None else [])), where, opened
        )
        x, y = detector_grid(size, _GRID)
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            world = np.asarray(wcs.all_pix2world(np.column_stack([x, y]), 1), float)
        xi, eta = self.system_turn.T @ positions(x, y)
        lon, lat = sky_of_plane(3600.0 * xi, 3600.0 * eta, self.native_point)
        by_astropy = world[:, self.wcs.wcs.lng], world[:, self.wcs.wcs.lat]
        off = 3.6e6 * separation((lon, lat), *by_astropy)
        pixel = 3.6e6 * float(np.sqrt(abs(np.linalg.det(self.cd))))
        if not off.max() <= TOLERANCE_MAS:
            raise InputError(
                f"is read as positions up to {off.max() / pixel:.3g} pixels off those by "
                "astropy.wcs, so its keywords contain something that is not supported",
                where=where,
                do=_SAMPLE,
            )


def tangent_form(header: fits.Header, where: str) -> TangentForm | None:
    """Tangent form of the primary world coordinates of a header.

    Parameters
    ----------
    header : Header
        Header of the image; its look-up tables are ignored.
    where : str
        Name of the file, for error messages.

    Returns
    -------
    TangentForm or None
        None if the header has no celestial axes.

    Raises
    ------
    InputError
        If the projection is not TAN, if the celestial system is neither equatorial nor galactic, or
        if astropy.wcs cannot read the header.
    FormatError
        If CRVAL is not a position on the sky, or if the linear part is singular.
    """
    code = projection_code(header)
    if code and code not in HELD_PROJECTIONS:
        refuse_projection(code, where)
    if str(header.get("CTYPE1", "")).startswith("RA") and not header.get("CUNIT1"):
        _refuse_point(header.get("CRVAL1", 0.0), header.get("CRVAL2", 0.0), where)
    wcs = wcs_of(_without(header, _TABLES, _INVERSE), where)
    w = wcs.wcs
    if w.lng < 0 or w.lat < 0:
        return None
    if wcs.naxis != 2:
        raise InputError(
            f"has {wcs.naxis} axes, but only images with two celestial axes are supported",
            where=where,
            do="write the header of the two celestial axes: astropy.wcs.WCS(header).celestial",
        )
    cd = np.asarray(w.get_cdelt()[:, None] * w.get_pc(), float)
    angle = np.radians(w.lonpole - 180.0)
    c, s = np.cos(angle), np.sin(angle)
    # The native longitude phi is atan2(x, -y); LONPOLE is the native longitude of the celestial
    # pole.
    native = np.array([[c, s], [-s, c]]) @ np.eye(2)[[w.lng, w.lat]]
    lon, lat = float(w.crval[w.lng]), float(w.crval[w.lat])
    _refuse_point(lon, lat, where)
    system, point = _equatorial(w, lon, lat, where)
    return TangentForm(wcs, cd, native, system, (lon, lat), point)


def refuse_singular(cd: Float, where: str) -> None:
    """Raise FormatError if the linear part (2, 2) of a header is singular.

    wcslib replaces a row of zeros by that of a unit matrix, so it does not notice.
    """
    if np.linalg.det(cd) == 0:
        raise FormatError(_NO_AREA, where=where, do="correct the header")


def _refuse_point(lon: float, lat: float, where: str) -> None:
    """Raise FormatError if longitude and latitude are not a position on the sky."""
    if not (abs(lon) <= 360 and abs(lat) <= 90):
        raise FormatError(
            f"the plane touches the sky at ({lon:g}, {lat:g}) degrees, which is not a position on "
            "the sphere",
            where=where,
            do="correct CRVAL or CUNIT",
        )


def projection_code(header: fits.Header) -> str:
    """Three-letter projection code in CTYPE, DSS for a plate solution, or an empty string."""
    types = [str(header.get(f"CTYPE{k}", "")).strip().upper() for k in (1, 2)]
    for text in types:
        match = re.match(r".{4}-(\w{3})(-|$)", text)
        if match is not None:
            return match[1]
    return "DSS" if "AMDX1" in header and "PLTRAH" in header else ""


def refuse_projection(code: str, where: str) -> None:
    """Raise InputError for a projection that is not supported, given by its code, as 'ZEA'."""
    name = _NAMES.get(code, f"{_article(code)} {code} projection")
    raise InputError(f"is {name}, but bayesdist supports only TAN", where=where, do=_SAMPLE)


def _article(code: str) -> str:
    """Indefinite article of a projection code."""
    return "an" if code[0] in "AEIO" else "a"


def _without(header: fits.Header, *patterns: re.Pattern[str]) -> fits.Header:
    """Header without keywords that match one of the patterns."""
    return header_of(
        card
        for card in card_images(header)
        if not any(pattern.match(keyword_of(card)) for pattern in patterns)
    )


def refuse_oversized(header: fits.Header, where: str) -> None:
    """Raise FormatError for orders and numbers of axes that no header needs.

    astropy.wcs allocates memory that grows with their square. It accepts these numbers as strings
    as well.
    """
    for keyword, largest in _LARGEST.items():
        try:
            stated = float(str(header.get(keyword, 0)))
        except (ValueError, fits.VerifyError):
            continue  # astropy.wcs refuses it later
        if stated > largest:
            raise FormatError(
                f"is {stated:g}, but at most {largest} is supported",
                where=f"{where}, keyword {keyword}",
                do="correct the keyword",
            )


def wcs_of(header: fits.Header, where: str, opened: fits.HDUList | None = None) -> WCS:
    """WCS of a header by astropy.wcs, with the look-up tables of the file `opened`, if given.

    Raises InputError if astropy.wcs refuses the header.
    """
    from astropy import log
    from astropy.wcs import WCS, SingularMatrixError  # slow to import

    refuse_oversized(header, where)
    before = log.level
    log.setLevel("ERROR")  # astropy logs a remark on CTYPE without -SIP
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            wcs = WCS(header, opened)
            wcs.wcs.set()
    except SingularMatrixError as error:
        raise FormatError(_NO_AREA, where=where, do="correct the header") from error
    except Exception as error:  # astropy.wcs raises many kinds of exceptions
        lines = [line for line in str(error).splitlines() if not line.startswith("ERROR")]
        reason = lines[0].rstrip(".") if lines else reason_of(error)
        raise InputError(
            f"is a header that astropy.wcs cannot read ({reason})",
            where=where,
            do="correct the header",
        ) from error
    finally:
        log.setLevel(before)
    return wcs


def _equatorial(w: object, lon: float, lat: float, where: str) -> tuple[Float, tuple[float, float]]:
    """Rotation (2, 2) to RA and Dec, and RA and Dec of the tangent point."""
    system = str(w.lngtyp).strip()  # type: ignore[attr-defined]
    frame = str(w.radesys).strip().upper()  # type: ignore[attr-defined]
    equinox = float(w.equinox)  # type: ignore[attr-defined]
    if system == "RA":
        if frame in ("", "ICRS") or (frame == "FK5" and equinox == 2000.0):
            return np.eye(2), (lon, lat)
        stated = f"{frame}{f' of equinox {equinox:g}' if np.isfinite(equinox) else ''}"
        raise InputError(
            f"has right ascension and declination of {stated}, but bayesdist supports only ICRS",
            where=where,
            do=_SAMPLE,
        )
    if system == "GLON":
        return _from_galactic(lon, lat)
    names = {"ELON": "ecliptic", "HPLN": "helioprojective", "HGLN": "heliographic",
             "SLON": "supergalactic", "TLON": "terrestrial"}  # fmt: skip
    raise InputError(
        f"has {names.get(system, 'celestial')} coordinates ({system}), but bayesdist supports only "
        "right ascension and declination",
        where=where,
        do=_SAMPLE,
    )


def _from_galactic(lon: float, lat: float) -> tuple[Float, tuple[float, float]]:
    """Rotation of east and north from galactic to ICRS, and RA and Dec of a galactic position."""
    from astropy.coordinates import CartesianRepresentation, Galactic, SkyCoord

    axes = SkyCoord(Galactic(CartesianRepresentation(np.eye(3))))
    # columns are the galactic axes in ICRS
    matrix = np.asarray(axes.icrs.cartesian.xyz.value, float)
    east, north, outwards = plane_axes((lon, lat))
    x, y, z = matrix @ outwards
    ra, dec = np.degrees(np.arctan2(y, x)) % 360.0, np.degrees(np.arctan2(z, np.hypot(x, y)))
    turn = plane_axes((ra, dec))[:2] @ matrix @ np.stack([east, north], axis=1)
    return turn, (float(ra), float(dec))


def sky_of_header(header: fits.Header, x: Float, y: Float) -> tuple[Float, Float]:
    """RA and Dec (N,) in degrees of FITS 1-based pixels, computed by astropy.wcs."""
    from astropy.wcs import WCS, FITSFixedWarning

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FITSFixedWarning)
        ra, dec = WCS(header).all_pix2world(x, y, 1)
    return np.asarray(ra), np.asarray(dec)


CD_KEYWORDS = ("CD1_1", "CD1_2", "CD2_1", "CD2_2")
# Keywords that other headers have instead of a CD matrix.
LINEAR_KEYWORDS = (
    *("PC1_1", "PC1_2", "PC2_1", "PC2_2"),
    *("CDELT1", "CDELT2", "CROTA1", "CROTA2"),
)


def cd_matrix(header: fits.Header, where: str) -> Float:
    """CD matrix (2, 2), also from PC and CDELT or from CROTA2 (FITS 4.0, section 8.1).

    As in wcslib, CD takes precedence over PC, and PC over CROTA2.
    """
    if any(keyword in header for keyword in CD_KEYWORDS):
        return np.array([finite_number(header, k, where, 0.0) for k in CD_KEYWORDS]).reshape(2, 2)
    scale = np.array([finite_number(header, k, where, 1.0) for k in ("CDELT1", "CDELT2")])
    if "CROTA2" in header and not any(keyword in header for keyword in LINEAR_KEYWORDS[:4]):
        angle = np.deg2rad(finite_number(header, "CROTA2", where))
        c, s = np.cos(angle), np.sin(angle)
        return np.array([[scale[0] * c, -scale[1] * s], [scale[0] * s, scale[1] * c]])
    pc = [
        finite_number(header, k, where, d)
        for k, d in zip(LINEAR_KEYWORDS[:4], (1.0, 0.0, 0.0, 1.0), strict=True)
    ]
    return scale[:, None] * np.array(pc).reshape(2, 2)


def image_size(header: fits.Header) -> tuple[int, int] | None:
    """Columns and rows stated in a header; None if it states none.

    A side of one pixel counts as a placeholder.

    A compressed image is a table with its size in ZNAXIS. HST headers have NPIX if all pixels have
    one value and there are no data.
    """
    pairs = [("ZNAXIS1", "ZNAXIS2"), ("IMAGEW", "IMAGEH"), ("NPIX1", "NPIX2")]
    if "TABLE" not in str(header.get("XTENSION", "")):
        pairs.insert(0, ("NAXIS1", "NAXIS2"))
    for names in pairs:
        n = [header.get(name, 0) for name in names]
        if all(isinstance(k, int | float) and k > 1 for k in n):
            return int(n[0]), int(n[1])
    return None


def finite_number(
    header: fits.Header, keyword: str, where: str, default: float | None = None
) -> float:
    """Value of a keyword, or the default.

    Raises FormatError if the keyword is missing and has no default, or if its value is not a finite
    number.
    """
    value = header.get(keyword, default)
    if value is None:
        raise FormatError("is missing", where=f"{where}, keyword {keyword}", do="add the keyword")
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise FormatError(
            f"value {value!r} is not a finite number",
            where=f"{where}, keyword {keyword}",
            do="correct the value",
        )
    return float(value)
