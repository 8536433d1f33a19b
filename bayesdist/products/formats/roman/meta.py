"""Node meta of Roman's distortion reference files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import datetime
from typing import Any

from astropy.time import Time

from bayesdist.errors import InputError
from bayesdist.products.formats.common.asdf.distortion import Detector
from bayesdist.products.formats.common.document import Finding

__all__ = ["TAG", "detector_of", "lint_meta", "meta_of", "units_of"]

# The newest one that both romancal 1.1 and roman_datamodels 1.2 read.
TAG = "asdf://stsci.edu/datamodels/roman/tags/reference_files/distortion-1.3.0"
ELEMENTS = (
    "F062", "F087", "F106", "F129", "F146", "F158", "F184", "F213", "GRISM", "PRISM", "DARK",
)  # fmt: skip
DETECTORS = tuple(f"WFI{n:02d}" for n in range(1, 19))
_WFI = Detector((4088.0, 4088.0), 0.1075)  # mean pixel of the FULL apertures: 0.1059 to 0.1093
_REQUIRED = ("reftype", "description", "author", "pedigree", "useafter", "telescope", "origin")


def detector_of(name: object) -> Detector | None:
    """Size and scale of a detector of the WFI; None for any other."""
    return _WFI if name in DETECTORS else None


def units_of(meta: Mapping[str, Any]) -> tuple[str, str]:
    """Units of input and output: pixel and arcsec by the schema, where a file states none."""
    return str(meta.get("input_units", "pixel")), str(meta.get("output_units", "arcsec"))


def meta_of(detector: str, settings: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Node for one detector; InputError for values that the schema does not allow."""
    for key, value, allowed in (
        ("detector", detector, DETECTORS),
        ("optical_element", settings["optical_element"], ELEMENTS),
    ):
        if value not in allowed:
            raise InputError(
                f"{key} is {value!r}, none of the WFI",
                where=where,
                do=f"choose one of {', '.join(allowed)}",
            )
    return {
        "telescope": "ROMAN",
        "origin": "STSCI",
        "reftype": "DISTORTION",
        "pedigree": settings["pedigree"],
        "useafter": _time(settings["useafter"], where),
        "author": settings["author"],
        "description": settings["description"],
        "instrument": {
            "name": "WFI",
            "detector": detector,
            "optical_element": settings["optical_element"],
        },
        "input_units": "pixel",
        "output_units": "arcsec",
    }


def _time(text: str, where: str) -> Time:
    try:
        return Time(datetime.fromisoformat(text).isoformat(), format="isot", scale="utc")
    except ValueError as error:
        raise InputError(
            f"useafter is {text!r}", where=where, do="write it as in 2026-10-01T00:00:00"
        ) from error


def lint_meta(meta: Mapping[str, Any]) -> Iterator[Finding]:
    """Findings on what identifies a file."""
    instrument = meta["instrument"]
    missing = [f"meta.{key}" for key in _REQUIRED if not meta.get(key)]
    missing += [
        f"meta.instrument.{key}"
        for key in ("name", "detector", "optical_element")
        if not instrument.get(key)
    ]
    if missing:
        yield Finding(
            "warning", ", ".join(missing), "not there, and the schema of Roman's data models asks "
            "for it",
        )  # fmt: skip
    reftype = str(meta.get("reftype", ""))
    if reftype and reftype != "DISTORTION":
        yield Finding("error", "meta.reftype", f"is {reftype!r}, and not 'DISTORTION'")
