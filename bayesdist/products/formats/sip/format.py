"""The SIP header as a format."""

from __future__ import annotations

from bayesdist.calibration.calibration import Calibration
from bayesdist.products.formats.common.content import Content
from bayesdist.products.formats.common.document import Choice, Finding, Format
from bayesdist.products.formats.sip.calibration import sip_calibration
from bayesdist.products.formats.sip.lint import lint_sip
from bayesdist.products.formats.sip.read import holds_sip, sip_of
from bayesdist.products.formats.wcs import describe_wcs

__all__ = ["FORMAT"]


def _parse(content: Content) -> Content | None:
    return content if holds_sip(content) else None


def _lint(content: Content) -> tuple[Finding, ...]:
    return lint_sip(sip_of(content))


def _calibration(content: Content, name: str, choice: Choice) -> Calibration:
    return sip_calibration(sip_of(content), name, size=choice.size)


FORMAT = Format("sip", "a SIP header", 3, _parse, describe_wcs, _lint, _calibration)
