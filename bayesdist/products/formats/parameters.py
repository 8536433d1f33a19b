"""Tables of parameters that stand beside text files, as a format."""

from __future__ import annotations

from bayesdist.calibration.calibration import Calibration
from bayesdist.products.formats.common.content import Content
from bayesdist.products.formats.common.document import Choice, Format, finding_lines
from bayesdist.products.formats.common.parameters import stored_calibration, stored_in

__all__ = ["FORMAT"]


def _parse(content: Content) -> Content | None:
    hdu = stored_in(content)
    return content if hdu is not None and hdu.number == len(content.tables) - 1 == 1 else None


def _calibration(content: Content, name: str, _: Choice) -> Calibration:
    hdu = stored_in(content)
    assert hdu is not None
    return stored_calibration(hdu, name)


def _describe(content: Content) -> list[str]:
    """Lines of text on the table."""
    found = _calibration(content, content.name, Choice())
    chips = ", ".join(f"{c.number} ({c.size[0]:g} x {c.size[1]:g} px)" for c in found.model.chips)
    return [
        f"{content.name}: parameters of a calibration, by bayesdist",
        f"  order     {found.model.order}, u and v in {found.unit}",
        f"  chips     {chips}",
        f"  errors    {found.errors}",
        "",
        *finding_lines(()),
    ]


FORMAT = Format(
    "parameters",
    "a table of parameters by bayesdist",
    30,
    _parse,
    _describe,
    calibration=_calibration,
)
