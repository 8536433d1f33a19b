"""`bayesdist wise rotate`: rotate or mirror the pixel frame of a SIP header or WISE meta-data."""

from __future__ import annotations

from pathlib import Path

from bayesdist.app.screen import number
from bayesdist.app.store.record import refuse_existing
from bayesdist.errors import InputError
from bayesdist.formats.sip.files import read_sip, write_sip
from bayesdist.formats.sip.header import SipHeader
from bayesdist.formats.sip.rotate import rotated_sip
from bayesdist.missions.wise.meta_data.meta import WiseBand, read_wise_meta, write_wise_meta
from bayesdist.products.registry import open_document


def rotate(
    path: str | Path,
    output: str | Path,
    *,
    degrees: float,
    mirror: bool,
    force: bool,
) -> str:
    """Write a SIP header or WISE meta-data in a rotated pixel frame; returns text to print."""
    path, output = Path(path), Path(output)
    refuse_existing(output, force)
    key = open_document(path).format.key
    if key == "sip":
        turned = rotated_sip(read_sip(path), degrees, mirror=mirror)
        write_sip(turned, output)
        lines = [_line("", turned)]
    elif key == "wise_meta":
        bands = {
            band.band: _turned(band, degrees, mirror, str(path)) for band in read_wise_meta(path)
        }
        write_wise_meta(output, bands)
        lines = [_line(f"W{band.band}: ", band.sip) for band in read_wise_meta(output)]
    else:
        raise InputError(
            "has no SIP keywords", where=str(path), do="give a SIP header or WISE meta-data"
        )
    mirrored = "mirrored and " if mirror else ""
    return "\n".join([f"{output}: {mirrored}rotated by {degrees:g} degrees", *lines])


def _turned(one: WiseBand, degrees: float, mirror: bool, where: str) -> SipHeader:
    if degrees % 90 != 0:
        raise InputError(
            f"the angle is {degrees:g}, but arrays in WISE meta-data are aligned with the axes",
            where=where,
            do="give a multiple of 90",
        )
    if one.skew != 0:
        # the skew would become a scale of the other axis and a rotation
        raise InputError(
            f"SKEW of band {one.band} is {one.skew:g} rad, which cannot be kept in a rotated frame",
            where=where,
            do="include it in A and B",
        )
    return rotated_sip(one.sip, degrees, mirror=mirror)


def _line(name: str, sip: SipHeader) -> str:
    maxima = {"A_DMAX": sip.a_dmax, "B_DMAX": sip.b_dmax, "worst closure": sip.closure}
    parts = [
        f"{name_of_value} {number(value)} px"
        for name_of_value, value in maxima.items()
        if value is not None
    ]
    return f"  {name}{', '.join(parts) or 'no maxima and no closure stated'}"
