"""The IDCTAB as a format."""

from __future__ import annotations

from bayesdist.calibration.calibration import Calibration
from bayesdist.products.formats.common.content import Content
from bayesdist.products.formats.common.document import Choice, Format
from bayesdist.products.formats.idctab.calibration import idctab_calibration
from bayesdist.products.formats.idctab.lint import lint_idctab
from bayesdist.products.formats.idctab.table import IdcTab
from bayesdist.products.formats.idctab.text import describe_idctab

__all__ = ["FORMAT"]


def _parse(content: Content) -> IdcTab | None:
    hdus = content.tables
    if len(hdus) < 2:
        return None
    columns = {str(value).strip() for value in hdus[1].header.values()}
    if not {"XREF", "YREF"} <= columns or not {"CX10", "A10"} & columns:
        return None
    return IdcTab(hdus, content.name)


def _calibration(tab: IdcTab, _: str, choice: Choice) -> Calibration:
    return idctab_calibration(tab, choice.filter)


FORMAT = Format("idctab", "an IDCTAB", 1, _parse, describe_idctab, lint_idctab, _calibration)
