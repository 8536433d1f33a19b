"""Format entry of TPV headers."""

from __future__ import annotations

from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.orientation import placed_at
from bayesdist.products.formats.common.content import Content
from bayesdist.products.formats.common.document import (
    PARAMETERS,
    BuildOptions,
    Built,
    Choice,
    Format,
    FormatSettings,
    finding_lines,
)
from bayesdist.products.formats.common.parameters import parameters_content
from bayesdist.products.formats.sip.format import describe_wcs
from bayesdist.products.formats.tpv.calibration import tpv_calibration
from bayesdist.products.formats.tpv.head import HIGHEST, TpvFile, tpv_of
from bayesdist.products.formats.tpv.lint import lint_tpv

NAME, SIDE = "tpv.head", "tpv_parameters.fits"


class Settings(FormatSettings):
    """Configuration of TPV headers."""

    crval: tuple[float, float] | None = None


def _describe(file: TpvFile) -> list[str]:
    """Lines of text on each chip by astropy.wcs, and the findings of all."""
    content, findings = file.content, lint_tpv(file)
    orders = sorted({head.order for head in file.heads})
    order = " to ".join(str(n) for n in dict.fromkeys((orders[0], orders[-1])))
    radial = ", and powers of r" if any(head.radial for head in file.heads) else ""
    beside = f"; covariance in {file.side_file}" if file.side_file else ""
    title = f"TPV of order {order}{radial}{beside}"
    if content.is_fits or len(file.heads) == 1:
        first, *lines = describe_wcs(content, findings)
        return [first, f"  {title}", *lines]
    lines = [f"{content.name}: {len(file.heads)} chips, {title}"]
    for head in file.heads:
        text = head.header.tostring(sep="\n", endcard=False, padding=False)
        one = Content(f"chip {head.number}", text.encode("ascii", "replace"))
        lines += ["", *describe_wcs(one)]
    return [*lines, "", f"{content.name}, all chips", *finding_lines(findings)]


def _calibration(file: TpvFile, name: str, choice: Choice) -> Calibration:
    return tpv_calibration(file, name, size=choice.size, as_used=choice.as_used)


def _build(
    calibration: Calibration, settings: Settings, options: BuildOptions
) -> tuple[Built, ...]:
    """One text file with the headers of all chips, and the file with their covariance."""
    # no file that is read needs it
    from bayesdist.products.formats.tpv.build import tpv_cards, tpv_heads

    calibration = placed_at(calibration, settings.crval, options.scale_arcsec, where="products.tpv")
    heads = tpv_heads(calibration, epoch=options.epoch, scale_arcsec=options.scale_arcsec)
    cards = [card.rstrip() for head in heads for card in tpv_cards(head, SIDE)]
    return (
        Built(SIDE, PARAMETERS, parameters_content(calibration, options.epoch), calibration),
        Built(NAME, "TPV", ("\n".join(cards) + "\n").encode("ascii"), heads),
    )


FORMAT = Format(
    "tpv", "TPV headers", 31, tpv_of, _describe, lint_tpv, _calibration, Settings, _build,
    highest_order=HIGHEST,
)  # fmt: skip
