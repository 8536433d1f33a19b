"""Text on WISE meta-data."""

from __future__ import annotations

from collections.abc import Iterable

from bayesdist.products.formats.common.document import finding_lines
from bayesdist.products.formats.sip.header import worst_closure
from bayesdist.products.formats.sip.text import coefficient_lines
from bayesdist.products.formats.wise.lint import lint_wise_band
from bayesdist.products.formats.wise.meta import ARRAYS, WiseBand

__all__ = ["describe_wise_meta"]


def describe_wise_meta(bands: Iterable[WiseBand], name: str) -> list[str]:
    """Lines of text on its bands, each with its contradictions."""
    bands = tuple(bands)
    lines = [f"{name}: WISE meta-data, {', '.join(f'W{one.band}' for one in bands)}"]
    for one in bands:
        sip, (side, _) = one.sip, ARRAYS[one.band]
        size = sip.size or (side, side)
        lines += ["", f"W{one.band}: {size[0]} x {size[1]} px, A_ORDER {sip.order[0]}, "
                  f"B_ORDER {sip.order[1]}, SKEW {one.skew:g} rad"]  # fmt: skip
        lines += [
            f"  {prefix}_DMAX    {one.printed[f'{prefix}_DMAX']} px"
            for prefix in "AB"
            if f"{prefix}_DMAX" in one.printed
        ]
        if sip.has_inverse:
            lines.append(f"  closure   {worst_closure(sip, size):.2g} px at worst")
        lines += [*coefficient_lines(sip), "", *finding_lines(lint_wise_band(one))]
    return lines
