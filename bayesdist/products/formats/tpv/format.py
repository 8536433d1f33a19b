"""Format entry of TPV headers."""

from __future__ import annotations

from bayesdist.products.formats.common.content import Content
from bayesdist.products.formats.common.document import Format, finding_lines
from bayesdist.products.formats.sip.format import describe_wcs
from bayesdist.products.formats.tpv.build import Settings, build
from bayesdist.products.formats.tpv.calibration import tpv_calibration
from bayesdist.products.formats.tpv.head import HIGHEST, TpvFile, tpv_of
from bayesdist.products.formats.tpv.lint import lint_tpv


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


FORMAT = Format(
    "tpv", "TPV headers", 31, tpv_of, _describe, lint_tpv, tpv_calibration, Settings, build,
    highest_order=HIGHEST,
)  # fmt: skip
