"""WISE meta-data as a format."""

from __future__ import annotations

from bayesdist.calibration.calibration import Calibration
from bayesdist.products.formats.common.content import Content
from bayesdist.products.formats.common.document import Choice, Finding, Format
from bayesdist.products.formats.wise.lint import lint_wise_band
from bayesdist.products.formats.wise.meta import (
    WiseBand,
    bands_of,
    holds_wise_meta,
    wise_calibration,
)
from bayesdist.products.formats.wise.text import describe_wise_meta

__all__ = ["FORMAT"]

Bands = tuple[WiseBand, ...]


def _parse(content: Content) -> tuple[str, Bands] | None:
    return (content.name, bands_of(content)) if holds_wise_meta(content) else None


def _describe(named: tuple[str, Bands]) -> list[str]:
    return describe_wise_meta(named[1], named[0])


def _lint(named: tuple[str, Bands]) -> list[Finding]:
    return [finding for band in named[1] for finding in lint_wise_band(band)]


def _calibration(named: tuple[str, Bands], name: str, choice: Choice) -> Calibration:
    return wise_calibration(named[1], name, choice.filter)


FORMAT = Format("wise_meta", "WISE meta-data", 5, _parse, _describe, _lint, _calibration)
