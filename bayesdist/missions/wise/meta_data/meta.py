"""Read the distortion entries of WISE meta-data: WSDC D-T033, Appendix B."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from astropy.io import fits

from bayesdist.calibration.calibration import Calibration
from bayesdist.errors import FormatError, InputError
from bayesdist.formats.sip.files import parsed
from bayesdist.formats.sip.format import sip_calibration
from bayesdist.formats.sip.header import SipHeader
from bayesdist.products.common.content import Content, read_content

_ENTRY = re.compile(r"\S*distort_(?:skew|(?:a|b|ap|bp)_)\S*")
_ENTRY_LINE = re.compile(r"\S*distort_(\S+)\s+(\d+)\s+(\S+)\s+([ir])\s+(\S+)\s*(.*)")
_KEYWORD = re.compile(r"SKEW|[AB]P?_(?:ORDER|\d_\d)|[AB]_DMAX")
# Entries that `write_wise_meta` writes as comment lines, which other programs skip.
_LIKE_ASIDE = re.compile(r"\\.*\s([AB]E_\d_\d|BDCLOS)\s+r\s.*")
_ASIDE = re.compile(r"\\\s+(\d+)\s+([AB]E_\d_\d|BDCLOS)\s+r\s+(\S+).*")
# Columns (and rows) of the arrays, and pixel scale in arcsec; W4 has pixels twice as wide.
ARRAYS = {1: (1016, 2.75), 2: (1016, 2.75), 3: (1016, 2.75), 4: (508, 5.5)}


@dataclass(frozen=True, eq=False)
class WiseBand:
    """Distortion entries of one band in a WISE meta-data file.

    Parameters
    ----------
    band : int
        Number of the band, 1 to 4.
    sip : SipHeader
        Distortion. The reference pixel is the middle of the array. Because the file has no sky
        position, CRVAL is zero and CD has the nominal scale.
    skew : float
        SKEW of the CD matrix, radians.
    printed : mapping of str to str
        Numbers as printed in the file, by keyword.
    comments : mapping of str to str
        Comments of the entries, by keyword.
    """

    band: int
    sip: SipHeader
    skew: float
    printed: Mapping[str, str]
    comments: Mapping[str, str]


def read_wise_meta(path: str | os.PathLike[str]) -> tuple[WiseBand, ...]:
    """Read the distortion entries of a WISE meta-data file.

    The layout is that of WSDC D-T033 ("WISE IOC Distortion Calibration"), Appendix B: name, band,
    keyword, type, value, comment. Other entries are skipped. So are comment lines, except for the
    standard deviations and the closure written by `write_wise_meta`.

    Parameters
    ----------
    path : path-like
        WISE meta-data file.

    Returns
    -------
    tuple of WiseBand
        Entries in the order of the bands.

    Raises
    ------
    FormatError
        If there are no such entries, or if an entry is malformed, inconsistent, repeated or
        missing.
    InputError
        If the file cannot be read.
    """
    return bands_of(read_content(path))


def bands_of(content: Content) -> tuple[WiseBand, ...]:
    """Bands in the content of a file; see `read_wise_meta`."""
    name, lines = content.name, content.text.splitlines()
    entries: dict[int, dict[str, tuple[str, str]]] = {}
    asides: dict[int, dict[str, str]] = {}
    for number, line in enumerate(lines, start=1):
        if _ENTRY.match(line):
            band, keyword, value, comment = _entry(line, f"{name}, line {number}")
            if keyword in entries.setdefault(band, {}):
                raise FormatError(
                    f"{keyword} of band {band} occurs a second time",
                    where=f"{name}, line {number}",
                    do="remove one",
                )
            entries[band][keyword] = value, comment
        elif aside := _ASIDE.fullmatch(line.rstrip()):
            asides.setdefault(int(aside[1]), {})[aside[2]] = aside[3]
        elif _LIKE_ASIDE.fullmatch(line.rstrip()):
            raise FormatError(
                "is not band, keyword, type, value of an error",
                where=f"{name}, line {number}",
                do="correct the line",
            )
    if not entries:
        raise FormatError(
            "there are no distortion entries", where=name, do="give a WISE meta-data file"
        )
    lost = asides.keys() - entries.keys()
    if lost:
        raise FormatError(
            f"errors are of band {min(lost)}, which has no entries", where=name, do="correct them"
        )
    return tuple(
        _wise_band(band, entries[band], asides.get(band, {}), name) for band in sorted(entries)
    )


def holds_wise_meta(content: Content) -> bool:
    """True if there are distortion entries of WISE meta-data, valid or not."""
    return any(_ENTRY.match(line) for line in content.text.splitlines())


def _entry(line: str, where: str) -> tuple[int, str, str, str]:
    """Band, keyword, value as printed and comment of one line."""
    match = _ENTRY_LINE.fullmatch(line.rstrip())
    if match is None:
        raise FormatError(
            "is not name, band, keyword, type, value, comment", where=where, do="correct the line"
        )
    name, band, keyword, _, value, comment = match.groups()
    if name.upper() != keyword:
        raise FormatError(
            f"the name says {name.upper()} and the keyword {keyword}", where=where, do="correct one"
        )
    if not _KEYWORD.fullmatch(keyword):
        raise FormatError(f"{keyword} is not a SIP keyword", where=where, do="correct the keyword")
    if int(band) not in ARRAYS:
        raise FormatError(f"band {band} is none of 1 to 4", where=where, do="correct the band")
    return int(band), keyword, value, " ".join(comment.split())


def monomial(p: int, q: int) -> str:
    """Name of u^p v^q as in the comments: u2.v, u.v, v3, and v0 for the constant."""
    if p == 0:
        return f"v{q}"
    if q == 0:
        return f"u{p}"
    return ".".join(n if k == 1 else f"{n}{k}" for n, k in (("u", p), ("v", q)))


def _wise_band(
    band: int, entries: dict[str, tuple[str, str]], asides: dict[str, str], where: str
) -> WiseBand:
    where = f"{where}, band {band}"
    header = fits.Header()
    values = {keyword: value for keyword, (value, _) in entries.items()}
    for keyword, value in (values | asides).items():
        try:
            header[keyword] = int(value) if keyword.endswith("_ORDER") else float(value)
        except ValueError:
            raise FormatError(
                f"value {value!r} is not a finite number",
                where=f"{where}, keyword {keyword}",
                do="correct the value",
            ) from None
    side, scale = ARRAYS[band]
    for axis, ctype in enumerate(("RA---TAN-SIP", "DEC--TAN-SIP"), start=1):
        header[f"CTYPE{axis}"] = ctype
        header[f"CRPIX{axis}"] = (side + 1) / 2
        header[f"CD{axis}_{axis}"] = (-1) ** axis * scale / 3600
        header[("IMAGEW", "IMAGEH")[axis - 1]] = side
    return WiseBand(
        band,
        parsed(header, where),
        float(header.get("SKEW", 0.0)),
        values,
        {keyword: comment for keyword, (_, comment) in entries.items()},
    )


def wise_calibration(bands: Sequence[WiseBand], name: str, band: str | None = None) -> Calibration:
    """Calibration of one band, such as "W2": (u, v) in corrected pixels from the array centre.

    `name` is the file, for error messages. InputError if the file does not have the band, or if it
    has several bands and none is named.
    """
    by_name = {f"W{entry.band}": entry for entry in bands}
    chosen = (band or "").upper()
    if band is not None and chosen not in by_name:
        raise InputError(
            f"there is no band {band}", where=name, do=f"choose one of {', '.join(by_name)}"
        )
    if band is None and len(by_name) > 1:
        raise InputError(
            f"holds the bands {', '.join(by_name)}",
            where=name,
            do="name one by filter (--filter W1, or W1:W2 for two files, on the command line)",
        )
    selected = by_name[chosen] if band is not None else next(iter(by_name.values()))
    notes = ("without the SKEW of its CD matrix",) if selected.skew else ()
    calibration = sip_calibration(
        selected.sip, f"{name}, W{selected.band}", pixels=True, notes=notes
    )
    return replace(calibration, detector=f"W{selected.band}")
