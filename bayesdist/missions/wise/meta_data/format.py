"""Format of WISE meta-data files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.plane import Plane
from bayesdist.errors import InputError
from bayesdist.formats.sip.build import sip_from_solution
from bayesdist.formats.sip.calibration import headers_read_back
from bayesdist.formats.sip.format import coefficient_lines
from bayesdist.formats.sip.header import SIP_ORDERS, worst_closure
from bayesdist.missions.wise.meta_data.build import wise_text
from bayesdist.missions.wise.meta_data.lint import lint_wise_band
from bayesdist.missions.wise.meta_data.meta import (
    ARRAYS,
    WiseBand,
    bands_of,
    holds_wise_meta,
    wise_calibration,
)
from bayesdist.products.common.content import Content
from bayesdist.products.common.document import (
    BuildOptions,
    Built,
    Finding,
    Format,
    FormatSettings,
    finding_lines,
)
from bayesdist.products.common.read_back import ReadBack

Bands = tuple[WiseBand, ...]


class Settings(FormatSettings):
    """Configuration of the entries of the band that the detector is named after."""

    def check(
        self,
        detector: str,
        size: tuple[float, float] | None,
        reference_pixel: tuple[float, float] | None,
    ) -> None:
        """Raise ValueError unless the chip is a full array with its middle as reference pixel."""
        band = _band(detector)
        if band is None:
            raise ValueError(
                "products.wise_meta is of a run of WISE W1, W2, W3 or W4, and detector.name is "
                f"{detector!r}; name the band there, or leave wise_meta out"
            )
        side, _ = ARRAYS[band]
        if size != (side, side) or reference_pixel not in (None, ((side + 1) / 2,) * 2):
            raise ValueError(
                f"products.wise_meta is of the whole array of W{band}, {side} x {side} pixels "
                f"about {(side + 1) / 2:g}, {(side + 1) / 2:g}; correct detector.size and "
                "model.reference_pixel, or leave wise_meta out"
            )


def _band(detector: str) -> int | None:
    """Number of the band that a detector is named after; None for other names."""
    return next((band for band in ARRAYS if detector == f"W{band}"), None)


def _parse(content: Content) -> tuple[str, Bands] | None:
    return (content.name, bands_of(content)) if holds_wise_meta(content) else None


def _describe(named: tuple[str, Bands]) -> list[str]:
    """Lines of text on the bands, each with its findings."""
    name, bands = named
    lines = [f"{name}: WISE meta-data, {', '.join(f'W{band.band}' for band in bands)}"]
    for band in bands:
        sip, (side, _) = band.sip, ARRAYS[band.band]
        size = sip.size or (side, side)
        lines += ["", f"W{band.band}: {size[0]} x {size[1]} px, A_ORDER {sip.order[0]}, "
                  f"B_ORDER {sip.order[1]}, SKEW {band.skew:g} rad"]  # fmt: skip
        lines += [
            f"  {prefix}_DMAX    {band.printed[f'{prefix}_DMAX']} px"
            for prefix in "AB"
            if f"{prefix}_DMAX" in band.printed
        ]
        if sip.has_inverse:
            lines.append(f"  closure   {worst_closure(sip, size):.2g} px at worst")
        lines += [*coefficient_lines(sip), "", *finding_lines(lint_wise_band(band))]
    return lines


def _lint(named: tuple[str, Bands]) -> list[Finding]:
    return [finding for band in named[1] for finding in lint_wise_band(band)]


def _read_back(
    files: Sequence[Built], calibration: Calibration, options: BuildOptions
) -> list[ReadBack]:
    """Positions from the entries, with the CD and zero point of the original header."""
    out = []
    for built in files:
        [band] = bands_of(Content(built.file_name, built.content))
        headers = {calibration.numbers[0]: band.sip}
        out.append(
            headers_read_back(built.file_name, headers, calibration, options, like=built.made)
        )
    return out


def _build(calibration: Calibration, _: Settings, options: BuildOptions) -> tuple[Built, ...]:
    """Build entries in WISE's form: linear terms in A and B, and an inverse of the same order."""
    band = _band(calibration.detector)
    if band is None:
        raise InputError(
            f"the detector is {calibration.detector!r}, no band of WISE",
            where="products.wise_meta",
            do="give a run whose detector.name is the band (W1, W2, W3, W4), or a file of WISE",
        )
    sip = sip_from_solution(
        replace(calibration, plane=Plane("free")),  # the entries cannot state a sky position
        epoch=options.epoch,
        inverse_order=max(calibration.model.order, SIP_ORDERS[0]),
        linear="sip",
        scale_arcsec=options.scale_arcsec,
    )
    name, content = f"w{band}.meta", wise_text({band: sip}).encode("ascii")
    [written] = bands_of(Content(name, content))  # the summary describes the rounded numbers
    summary = {
        "closure_pix": written.sip.closure,
        "a_dmax": written.sip.a_dmax,
        "b_dmax": written.sip.b_dmax,
    }
    return (Built(name, "WISE meta-data", content, sip, None, summary),)


FORMAT = Format(
    "wise_meta",
    "WISE meta-data",
    5,
    _parse,
    _describe,
    _lint,
    lambda named, name, choice: wise_calibration(named[1], name, choice.filter),
    Settings,
    _build,
    _read_back,
    highest_order=SIP_ORDERS[1],
    asks=("filter",),
)
