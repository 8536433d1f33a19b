"""Distortion reference files of Roman's Wide Field Instrument: ASDF, as romancal reads them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import datetime
from typing import TYPE_CHECKING, Any

from bayesdist.errors import FormatError, InputError
from bayesdist.products.formats.common.asdf.format import Observatory
from bayesdist.products.formats.common.asdf.tree import (
    Detector,
    PlacedSettings,
    is_asdf,
    plain,
    tagged,
    tree_of,
)
from bayesdist.products.formats.common.content import Content
from bayesdist.products.formats.common.document import Finding

if TYPE_CHECKING:
    from astropy.time import Time

    from bayesdist.products.formats.common.asdf.build import ChipTransform
    from bayesdist.products.formats.common.asdf.distortion import DistortionFile

KEY = "coordinate_distortion_transform"


class Settings(PlacedSettings):
    """Configuration of a Roman WFI distortion reference file."""

    optical_element: str


def _parse(content: Content) -> DistortionFile | None:
    """ASDF files with the node roman: of another kind they are refused."""
    if not is_asdf(content) or b"\nroman:" not in content.raw:
        return None
    # astropy.modeling takes longer to import than other files to read
    from bayesdist.products.formats.common.asdf.distortion import DistortionFile, transform_in

    tree = tree_of(content).get("roman")
    if not isinstance(tree, Mapping) or KEY not in tree or "meta" not in tree:
        held = ", ".join(sorted(tree)) if isinstance(tree, Mapping) else "nothing"
        raise FormatError(
            f"holds {held or 'nothing'} under roman, and not meta and {KEY}",
            where=content.name,
            do="give a distortion reference file of the WFI",
        )
    meta = plain(tree["meta"])
    instrument = meta.setdefault("instrument", {})
    record = tree.get("bayesdist")
    return DistortionFile(
        content.name,
        "Roman",
        transform_in(tree, KEY, content.name),
        meta,
        units_of(meta),
        None if record is None else plain(record),
        detector_of(instrument.get("detector")),
    )


def _tree(one: ChipTransform, detector: str, settings: Settings, file: str) -> dict[str, Any]:
    from bayesdist.products.formats.common.asdf.build import refuse_larger

    meta = meta_of(detector, settings.model_dump(), "products.roman")
    refuse_larger(one, detector, detector_of(detector), "products.roman")
    return {"roman": tagged({"meta": meta, KEY: one.model, "bayesdist": one.record}, TAG, file)}


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
    from astropy.time import Time  # slow to import

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


FORMAT = Observatory[Settings](
    "roman", "Roman", _parse, lint_meta, lambda settings: "WFI", _tree
).format("a Roman distortion reference file", 6, Settings)
