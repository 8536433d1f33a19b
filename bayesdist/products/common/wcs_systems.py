"""Text on the WCS of a FITS file or a text file of cards, as astropy.wcs reads it."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
from astropy import log
from astropy.io import fits
from astropy.wcs import WCS, FITSFixedWarning

from bayesdist.files.fits import RECORD
from bayesdist.products.common.cards import holds_wcs
from bayesdist.products.common.celestial import refuse_oversized
from bayesdist.products.common.content import Content, Hdu
from bayesdist.products.common.document import DistortionReader, Finding, finding_lines
from bayesdist.products.common.linear_wcs import image_size
from bayesdist.products.common.wcs_sky import (
    HeaderText,
    add_sky_lines,
    first_line,
    pv_keywords,
)

_WCS = re.compile(
    r"(CTYPE|CRVAL|CRPIX|CDELT|CUNIT|CROTA|LTV)\d+[A-Z]?$|(CD|PC|PV|PS|LTM)\d+_\d+[A-Z]?$|"
    r"(A|B|AP|BP)_(ORDER|\d_\d)$|(CPDIS|CPERR|D2IMDIS|D2IMERR)\d$|(DP|DQ|D2IM)\d$|(LON|LAT)POLE"
)

# keywords that drizzling adds to its output image
_TABLE_HDUS = ("D2IMARR", "WCSDVARR")
_TABLES = ("CPDIS1", "CPDIS2", "D2IMDIS1", "D2IMDIS2", "AXISCORR")


def _wcs_cards(header: fits.Header) -> tuple[tuple[str, str], ...]:
    """Cards that determine positions; of HDUs with equal cards only one is described."""
    cards = {(c.keyword, str(c.value)) for c in header.cards if _WCS.match(c.keyword)}
    return tuple(sorted(cards))


def describe_systems(
    file: Content, extra: Sequence[Finding], distortion: DistortionReader | None
) -> list[str]:
    """Lines of text on a file; see `bayesdist.products.common.wcs_text.describe_wcs`."""
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
    before = log.level
    log.setLevel("ERROR")
    try:
        yield
    finally:
        log.setLevel(before)


def _is_on_positions(warning: warnings.WarningMessage) -> bool:
    """True for a warning about positions, but not about dates or the style of units."""
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
