"""Distortion reference files of Roman's Wide Field Instrument in ASDF, as read by romancal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import datetime
from typing import TYPE_CHECKING, Any

from bayesdist.errors import FormatError, InputError
from bayesdist.products.common.asdf.format import Observatory
from bayesdist.products.common.asdf.tree import (
    KnownDetector,
    PlacedSettings,
    ReferenceMeta,
    tagged,
    tree_of,
)
from bayesdist.products.common.content import Content
from bayesdist.products.common.document import Finding
from bayesdist.products.common.rules import missing_entries, other_type

if TYPE_CHECKING:
    from astropy.time import Time

KEY = "coordinate_distortion_transform"


class RomanSettings(PlacedSettings):
    """Configuration of a Roman WFI distortion reference file."""

    optical_element: str


def _node(content: Content) -> tuple[Mapping[str, Any], str] | None:
    """Node "roman" of an ASDF file, None without it; FormatError if it has no distortion."""
    if b"\nroman:" not in content.raw:
        return None
    tree = tree_of(content).get("roman")
    if not isinstance(tree, Mapping) or KEY not in tree or "meta" not in tree:
        held = ", ".join(sorted(tree)) if isinstance(tree, Mapping) else "nothing"
        raise FormatError(
            f"holds {held or 'nothing'} under roman, instead of meta and {KEY}",
            where=content.name,
            do="give a distortion reference file of the WFI",
        )
    return tree, KEY


# Newest version that both romancal 1.1 and roman_datamodels 1.2 can read.
TAG = "asdf://stsci.edu/datamodels/roman/tags/reference_files/distortion-1.3.0"
ELEMENTS = (
    "F062", "F087", "F106", "F129", "F146", "F158", "F184", "F213", "GRISM", "PRISM", "DARK",
)  # fmt: skip
DETECTORS = tuple(f"WFI{n:02d}" for n in range(1, 19))
# mean pixel scale of the FULL apertures, which range from 0.1059 to 0.1093
_WFI = KnownDetector((4088.0, 4088.0), 0.1075)
_REQUIRED = ("reftype", "description", "author", "pedigree", "useafter", "telescope", "origin")


def _meta(detector: str, settings: RomanSettings) -> ReferenceMeta:
    """Node meta of the file of one detector; InputError for values outside the schema."""
    for key, value, allowed in (
        ("detector", detector, DETECTORS),
        ("optical_element", settings.optical_element, ELEMENTS),
    ):
        if value not in allowed:
            raise InputError(
                f"{key} is {value!r}, none of the WFI",
                where="products.roman",
                do=f"choose one of {', '.join(allowed)}",
            )
    return {
        "telescope": "ROMAN",
        "origin": "STSCI",
        "reftype": "DISTORTION",
        **settings.identity(),
        "useafter": _time(settings.useafter),
        "instrument": {
            "name": "WFI",
            "detector": detector,
            "optical_element": settings.optical_element,
        },
        "input_units": "pixel",
        "output_units": "arcsec",
    }


def _time(text: str) -> Time:
    from astropy.time import Time  # slow to import

    try:
        return Time(datetime.fromisoformat(text).isoformat(), format="isot", scale="utc")
    except ValueError as error:
        raise InputError(
            f"useafter is {text!r}", where="products.roman", do="write it as in 2026-10-01T00:00:00"
        ) from error


def lint_meta(meta: Mapping[str, Any]) -> Iterator[Finding]:
    """Findings on the metadata that identify a file."""
    yield from missing_entries(
        meta,
        _REQUIRED,
        ("name", "detector", "optical_element"),
        "not there, and the schema of Roman's data models asks for it",
    )
    yield from other_type(str(meta.get("reftype", "")), "DISTORTION", "meta.reftype")


FORMAT = Observatory[RomanSettings](
    "roman",
    "Roman",
    _node,
    lambda instrument: _WFI if instrument.get("detector") in DETECTORS else None,
    lint_meta,
    _meta,
    lambda meta, model, record, file: {
        "roman": tagged({"meta": meta, KEY: model, "bayesdist": record}, TAG, file)
    },
    units=("pixel", "arcsec"),  # as defined by the schema
).format("a Roman distortion reference file", 6, RomanSettings)
