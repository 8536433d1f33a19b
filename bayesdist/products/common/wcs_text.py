"""Text on the world coordinate systems of a file, as astropy.wcs reads them.

The functions of this module import astropy.wcs, which takes longer than reading most files.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from astropy.io import fits

from bayesdist.data.tangent import tangent_plane
from bayesdist.errors import InputError
from bayesdist.files.fits import RECORD
from bayesdist.products.common.cards import holds_wcs
from bayesdist.products.common.celestial import image_size, refuse_oversized
from bayesdist.products.common.content import Content, Hdu
from bayesdist.products.common.document import DistortionReader, Finding, finding_lines

if TYPE_CHECKING:
    from astropy.wcs import WCS

_WCS = re.compile(
    r"(CTYPE|CRVAL|CRPIX|CDELT|CUNIT|CROTA|LTV)\d+[A-Z]?$|(CD|PC|PV|PS|LTM)\d+_\d+[A-Z]?$|"
    r"(A|B|AP|BP)_(ORDER|\d_\d)$|(CPDIS|CPERR|D2IMDIS|D2IMERR)\d$|(DP|DQ|D2IM)\d$|(LON|LAT)POLE"
)

# keywords that drizzling adds to its output image
_TABLE_HDUS = ("D2IMARR", "WCSDVARR")
_TABLES = ("CPDIS1", "CPDIS2", "D2IMDIS1", "D2IMDIS2", "AXISCORR")


def describe_wcs(
    file: Content, extra: Sequence[Finding] = (), distortion: DistortionReader | None = None
) -> list[str]:
    """Lines of text on every world coordinate system of a file, with its findings.

    `extra` findings on the file are listed with those of its first system. HDUs that repeat the
    system of an earlier HDU are listed with that one. `distortion` describes the coefficients of a
    format and may raise FormatError.
    """
    extra = [*extra, *_truncated(file)]
    shown: dict[tuple[tuple[str, str], ...], list[Hdu]] = {}
    n_wcs = sum(holds_wcs(hdu.header) for hdu in file.hdus)
    for hdu in file.hdus:
        # the nodes of a table are described together with the image that uses it
        aside = n_wcs > 1 and hdu.label.partition(",")[0] in _TABLE_HDUS
        if holds_wcs(hdu.header) and not aside:
            shown.setdefault((*_wcs_cards(hdu.header), _extent(hdu.header)), []).append(hdu)
    groups = list(shown.values())
    if len(file.hdus) == 1:
        return _hdu_lines(file, groups[0][0], file.name, extra=extra, distortion=distortion)
    out = [f"{file.name}: {n_wcs} HDUs with a WCS, {len(groups)} different"]
    for first, *repeats in groups:
        out += ["", *_hdu_lines(file, first, _label(first), repeats, extra, distortion)]
        extra = ()
    return out


def _wcs_cards(header: fits.Header) -> tuple[tuple[str, str], ...]:
    """Cards that determine positions; of HDUs with equal cards only one is described."""
    cards = {(c.keyword, str(c.value)) for c in header.cards if _WCS.match(c.keyword)}
    return tuple(sorted(cards))


def _extent(header: fits.Header) -> tuple[str, str]:
    return "size", str(image_size(header))


def _truncated(file: Content) -> Iterator[Finding]:
    last = file.hdus[-1]
    location = f"HDU {last.number}"
    # headers alone may be kept in a file, whole records of each, and then none has data
    headers = last.state == "none" and len(file.hdus) > 1
    if headers and (len(file.raw) % RECORD or any(hdu.data for hdu in file.hdus)):
        yield Finding("error", location, "the file ends after this header: it is truncated")
    elif last.state == "cut":
        yield Finding("error", location, "the file ends before this HDU does: it is truncated")
    elif file.is_fits and last.state == "whole" and len(file.raw) % RECORD:
        yield Finding(
            "warning", location,
            f"the file ends within a record of {RECORD} bytes: it is truncated, and what "
            "followed is lost",
        )  # fmt: skip


def _label(hdu: Hdu) -> str:
    return f"HDU {hdu.number}" + (f" ({hdu.label})" if hdu.label else "")


def _hdu_lines(
    file: Content,
    hdu: Hdu,
    name: str,
    others: Sequence[Hdu] = (),
    extra: Sequence[Finding] = (),
    distortion: DistortionReader | None = None,
) -> list[str]:
    """Lines of text on one HDU."""
    header, text, terms = hdu.header, HeaderText(findings=list(extra)), list[str]()
    size = image_size(header)
    described = None if distortion is None else distortion(header, name)
    if described is not None:
        text.lines += described.lines
        terms += described.terms
        text.findings += described.findings
    else:
        extent = "unknown" if size is None else f"{size[0]} x {size[1]} px"
        text.lines.append(f"{name}: WCS, image size {extent}")
        if any(str(value).endswith("-SIP") for value in header["CTYPE*"].values()):
            text.add_finding(
                "warning",
                "CTYPE",
                "ends in -SIP, but there are no coefficients (A_ORDER, B_ORDER): positions are "
                "those of the linear part, and the distortion may be lost",
            )
    if others:
        text.lines.append(f"  same in   {', '.join(_label(repeat) for repeat in others)}")
    if hdu.state == "none":
        text.lines.append("  data      none: a header alone")
    systems = _systems(file, hdu, text)
    for wcs in systems:
        key = wcs.wcs.alt.strip()
        if len(systems) > 1 or key or wcs.wcs.name:
            title = f"WCS {key}" if key else "primary WCS"
            text.lines.append(f"  {title}{f', {wcs.wcs.name!r}' if wcs.wcs.name else ''}")
        text.lines += _axes(wcs, header, key, above="A_ORDER" in header and not key)
        if wcs.has_celestial:
            add_sky_lines(wcs, header, size, text)
    return [*text.lines, *terms, "", *finding_lines(text.findings)]


# -- the systems ----------------------------------------------------------------------------------
def _systems(file: Content, hdu: Hdu, text: HeaderText) -> list[WCS]:
    """Coordinate systems of a header that astropy.wcs can read."""
    out = []
    header = hdu.header
    primary = any(k.startswith(("CTYPE", "CRVAL")) and k[-1].isdigit() for k in header)
    table = "TABLE" in str(header.get("XTENSION", "")) and not header.get("ZIMAGE", False)
    if table or not (primary or "A_ORDER" in header or any(k[:5] == "CTYPE" for k in header)):
        text.add_finding("note", "columns", "a WCS of the columns of a table is not looked at")
        return []
    keys = {k[-1] for k in header if k.startswith(("CTYPE", "CRVAL")) and k[-1].isalpha()}
    for key in [*([" "] if primary or not keys else []), *sorted(keys)]:
        with _quiet_log():
            wcs = _system(file, header, key, text)
        if wcs is not None:
            out.append(wcs)
    return out


def _system(file: Content, header: fits.Header, key: str, text: HeaderText) -> WCS | None:
    from astropy.wcs import WCS

    system = f"WCS {key}".strip()
    refuse_oversized(header, file.name)
    stated = [k for k in _TABLES if k in header]
    fobj = file.opened
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        if stated and fobj is None:
            text.add_finding(
                "warning", ", ".join(stated),
                "the tables are extensions of the image, which are not here: positions are without "
                "them",
            )  # fmt: skip
            header = header.copy()
            for keyword in stated:
                del header[keyword]
        try:
            wcs = WCS(header, fobj, key=key)
            wcs.wcs.set()
        except Exception as error:  # report whatever astropy.wcs raises on this header
            text.add_finding("error", system, f"astropy.wcs cannot read it: {first_line(error)}")
            return None
    old = []
    for message in dict.fromkeys(str(w.message) for w in caught if _is_on_positions(w)):
        if "is deprecated" in message:
            old.append(message.partition("=")[0].strip())
            continue
        level = "warning" if message.startswith("Removed redundant") else "note"
        text.add_finding(level, system, f"astropy.wcs: {' '.join(message.split())}")
    if old:
        text.add_finding("note", ", ".join(old), "a deprecated form, which astropy.wcs still reads")
    wcs.pixel_shape = None  # `image_size` gives the size, even if NAXIS is zero
    return wcs


@contextmanager
def _quiet_log() -> Iterator[None]:
    """Suppress astropy's log messages on CTYPE, which the findings repeat."""
    from astropy import log

    before = log.level
    log.setLevel("ERROR")
    try:
        yield
    finally:
        log.setLevel(before)


def _is_on_positions(warning: warnings.WarningMessage) -> bool:
    """True for a warning about positions, but not about dates or the style of units."""
    from astropy.wcs import FITSFixedWarning

    message = str(warning.message)
    return issubclass(warning.category, FITSFixedWarning) and not message.startswith(
        ("'datfix'", "'obsfix'", "RADECSYS", "The WCS transformation has more axes")
    )


def _axes(wcs: WCS, header: fits.Header, key: str, *, above: bool) -> list[str]:
    """Lines on every axis; `above` is True if CRPIX and CRVAL have been given already."""
    w = wcs.wcs
    frame = f", {w.radesys}" if w.radesys else ""
    if w.radesys and np.isfinite(w.equinox) and w.radesys.startswith("FK"):
        frame += f" {w.equinox:g}"
    # as in the header: wcslib changes TPV to TAN with a distortion
    types = [str(header.get(f"CTYPE{k + 1}{key}", c)) for k, c in enumerate(w.ctype)]
    lines = [f"  axes      {', '.join(t.strip() or 'linear' for t in types)}{frame}"]
    if not above:
        values = [_with_unit(v, u) for v, u in zip(w.crval, w.cunit, strict=True)]
        lines += [
            f"  CRPIX     {', '.join(f'{v:.10g}' for v in w.crpix)}",
            f"  CRVAL     {', '.join(values)}",
        ]
    pv = pv_keywords(header, key)
    if pv:
        lines.append(f"  PV terms  {len(pv)}: {pv[0]}" + (f" to {pv[-1]}" if len(pv) > 1 else ""))
    return lines


def _with_unit(value: float, unit: object) -> str:
    return f"{value:.10g} {unit}".strip()


# -- positions on the sky, and distortion ---------------------------------------------------------
_NODES = 9  # points per axis that are projected to the sky and back
_PV_OF_TAN = 5  # number of PV keywords in a standard TAN; more mean a TPV in SCAMP's older form
_BACK = 1e-3  # pixels; largest round-trip error of points that count as recovered


@dataclass
class HeaderText:
    """Lines of text on one header, and its findings."""

    lines: list[str] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)

    def add_finding(self, level: str, where: str, message: str) -> None:
        """Add a finding of a level, with its place and message."""
        self.findings.append(Finding(level, where, message))


def first_line(error: Exception) -> str:
    """First line of an astropy.wcs error message, without wcslib's heading."""
    all_lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    lines = [line for line in all_lines if not line.startswith("ERROR ")] or all_lines
    return (lines[0] if lines else type(error).__name__).rstrip(".")


def pv_keywords(header: fits.Header, key: str) -> list[str]:
    """Keywords PVi_m of a system, which is identified by its letter."""
    return [k for k in header if re.fullmatch(rf"PV\d+_\d+{key}", k)]


def add_sky_lines(
    wcs: WCS, header: fits.Header, size: tuple[int, int] | None, text: HeaderText
) -> None:
    """Add lines on sky position, scale, parity, distortion and round-trip error of pixels."""
    key = wcs.wcs.alt.strip()
    system = f"WCS {key}".strip()
    celestial = wcs.celestial if wcs.naxis > 2 else wcs
    n = size or (1, 1)
    centre = np.array([(k + 1) / 2 for k in n]) if size else np.asarray(celestial.wcs.crpix)
    place = "centre" if size else "at CRPIX"
    steps = centre + np.array([[0, 0], [0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5]])
    ra, dec = _world(celestial, steps)
    if not np.isfinite([ra, dec]).all():
        middle = "the centre of the image" if size else "CRPIX"
        text.add_finding("warning", system, f"astropy.wcs has no sky position at {middle}")
        _distortion(celestial, header, size, text, system)
        return
    text.lines.append(f"  {place:<9} {_position(celestial, ra[0], dec[0])}")
    try:
        xi, eta = tangent_plane(ra[1:], dec[1:], (float(ra[0]), float(dec[0])))
    except InputError:
        text.add_finding("warning", system, "one pixel is as large as the sky")
        return
    slope = np.array([[xi[0] - xi[1], xi[2] - xi[3]], [eta[0] - eta[1], eta[2] - eta[3]]])
    across, up = np.hypot(*slope)
    angle = np.degrees(np.arctan2(slope[0, 1], slope[1, 1]))
    mirrored = np.linalg.det(slope) > 0
    text.lines += [
        f"  pixel     {across:.8g} x {up:.8g} arcsec, +y at position angle {angle:.4g} deg, "
        f"{'a mirror image of the sky' if mirrored else 'parity as on the sky'}"
    ]
    if size is not None:
        text.lines.append(f"  field     {_field(celestial, size)}")
    if not key:  # astropy.wcs applies the tables to every alternate system
        text.lines += list(_tables(wcs))
    _distortion(celestial, header, size, text, system)


def _world(wcs: WCS, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Longitudes and latitudes (N,) of pixels (N, 2), NaN if there is no sky position."""
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            world = np.asarray(wcs.all_pix2world(pixels, 1), float)
        except Exception:  # if one point is beyond the map, astropy raises an error for all points
            return np.full(len(pixels), np.nan), np.full(len(pixels), np.nan)
    return world[:, wcs.wcs.lng], world[:, wcs.wcs.lat]


def _position(wcs: WCS, lon: float, lat: float) -> str:
    """Position in degrees, and in sexagesimal form if it is in RA and Dec."""
    from astropy.coordinates import SkyCoord

    names = [wcs.wcs.ctype[k][:4].rstrip("-") for k in (wcs.wcs.lng, wcs.wcs.lat)]
    text = f"{names[0]} {lon:.8g}, {names[1]} {lat:.8g} deg"
    if names == ["RA", "DEC"]:
        at = SkyCoord(lon, lat, unit="deg")
        text += f" ({at.to_string('hmsdms', precision=2)})"
    return text


def _field(wcs: WCS, size: tuple[int, int]) -> str:
    """Width and height through the centre, as sums of steps on the sky."""
    from astropy.coordinates import SkyCoord

    out = []
    for axis in (0, 1):
        pixels = np.tile([(k + 1) / 2 for k in size], (_NODES, 1))
        pixels[:, axis] = np.linspace(0.5, size[axis] + 0.5, _NODES)
        lon, lat = _world(wcs, pixels)
        if not np.isfinite([lon, lat]).all():
            return "reaches beyond the sky of this projection"
        at = SkyCoord(lon, lat, unit="deg")
        out.append(float(at[:-1].separation(at[1:]).deg.sum()))
    unit, factor = ("deg", 1) if max(out) >= 2 else ("arcmin", 60) if max(out) > 1 / 30 else (
        "arcsec", 3600)  # fmt: skip
    return f"{out[0] * factor:.5g} x {out[1] * factor:.5g} {unit}"


def _tables(wcs: WCS) -> Iterator[str]:
    """Lines on look-up tables that astropy.wcs applies."""
    kinds = (
        ("D2IM", "pixels, before the polynomial", (wcs.det2im1, wcs.det2im2)),
        ("CPDIS", "pixels, after it", (wcs.cpdis1, wcs.cpdis2)),
    )
    for name, unit, pair in kinds:
        for axis, table in enumerate(pair, start=1):
            if table is not None:
                rows, columns = table.data.shape
                yield (
                    f"  {name}{axis:<{9 - len(name)}} table of {columns} x {rows} nodes, "
                    f"{table.data.min():.4f} to {table.data.max():.4f} {unit}"
                )


def _distortion(
    wcs: WCS, header: fits.Header, size: tuple[int, int] | None, text: HeaderText, where: str
) -> None:
    """Add lines on the distortion in pixels and on its round-trip error."""
    from astropy.wcs import NoConvergence

    if size is None:
        return
    x, y = np.meshgrid(*(np.linspace(1, n, _NODES) for n in size))
    pixels = np.column_stack([x.ravel(), y.ravel()])
    if wcs.has_distortion:
        moved = np.hypot(*(wcs.pix2foc(pixels, 1) - pixels).T).max()
        tables = ", tables included" if any(_tables(wcs)) else ""
        text.lines.append(f"  moves     pixels by up to {moved:.4g} px{tables}")
    lon, lat = _world(wcs, pixels)
    if (plain := _without_pv_terms(header, wcs)) is not None:
        flat = plain.wcs_world2pix(np.column_stack([lon, lat]), 1)
        moved = np.nanmax(np.hypot(*(flat - pixels).T), initial=0.0)
        text.lines.append(f"  moves     pixels by up to {moved:.4g} px, by the PV terms")
    on_sky = np.isfinite(lon) & np.isfinite(lat)
    if not on_sky.all():
        text.add_finding("note", where, f"{(~on_sky).mean():.0%} of the image is beyond the sky")
    if not on_sky.any():
        return
    world = np.column_stack([lon, lat] if wcs.wcs.lng == 0 else [lat, lon])[on_sky]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            back = wcs.all_world2pix(world, 1, tolerance=1e-6, maxiter=50)
    except NoConvergence:
        text.add_finding(
            "warning", where, "astropy.wcs does not find all pixels back from the sky: it iterates "
            "on the distortion, which does not converge",
        )  # fmt: skip
        return
    except Exception as error:  # as above: report what astropy.wcs raises
        text.add_finding("warning", where, f"astropy.wcs has no way back: {first_line(error)}")
        return
    off = float(np.hypot(*(back - pixels[on_sky]).T).max())
    text.lines.append(f"  to sky and back  {off:.2g} px at most, by astropy.wcs")
    if not off <= _BACK:
        text.add_finding("warning", where, f"pixels come back from the sky up to {off:.3g} px off")


def _without_pv_terms(header: fits.Header, wcs: WCS) -> WCS | None:
    """WCS without the distortion of TPV; None for a WCS of another kind."""
    from astropy.wcs import WCS

    types = [str(header.get(f"CTYPE{k}", "")) for k in (1, 2)]
    scamp = all(t.endswith("-TAN") for t in types) and len(pv_keywords(header, "")) > _PV_OF_TAN
    if wcs.wcs.alt.strip() or wcs.sip is not None or wcs.naxis != 2 or wcs.wcs.lng != 0:
        return None
    if not scamp and not all(t.endswith("-TPV") for t in types):
        return None
    plain = WCS(naxis=2)
    plain.wcs.ctype = [t[:-3] + "TAN" for t in types]
    plain.wcs.crval, plain.wcs.crpix = wcs.wcs.crval, wcs.wcs.crpix
    plain.wcs.cd = wcs.pixel_scale_matrix
    plain.wcs.lonpole = wcs.wcs.lonpole
    return plain
