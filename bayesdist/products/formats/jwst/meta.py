"""Node meta of JWST's distortion reference files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from bayesdist.products.formats.common.document import Finding
from bayesdist.products.formats.jwst.instruments import (
    EXPOSURE_TYPES,
    instrument_meta,
    module_and_channel,
)

__all__ = ["lint_meta", "meta_of"]

# What the data model asks of every reference file, and of the distortion of NIRCam.
_REQUIRED = ("reftype", "description", "author", "pedigree", "useafter", "telescope")
_NIRCAM = ("module", "channel", "p_pupil")


def meta_of(detector: str, settings: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Node for one detector; InputError as for `instrument_meta`."""
    instrument = settings["instrument"]
    return {
        "telescope": "JWST",
        "reftype": "distortion",
        "model_type": "DistortionModel",
        "pedigree": settings["pedigree"],
        "useafter": settings["useafter"],
        "author": settings["author"],
        "description": settings["description"],
        "instrument": instrument_meta(
            instrument, detector, settings["filter"], settings["pupil"], where
        ),
        "exposure": {"type": settings["exp_type"] or EXPOSURE_TYPES[instrument]},
        "input_units": "pix",
        "output_units": "arcsec",
    }


def lint_meta(meta: Mapping[str, Any]) -> Iterator[Finding]:
    """Findings on what identifies a file."""
    instrument = meta["instrument"]
    missing = [f"meta.{key}" for key in _REQUIRED if not meta.get(key)]
    missing += [f"meta.instrument.{key}" for key in ("name", "detector") if not instrument.get(key)]
    if instrument.get("name") == "NIRCAM":
        missing += [f"meta.instrument.{key}" for key in _NIRCAM if not instrument.get(key)]
    if missing:
        yield Finding(
            "warning", ", ".join(missing), "not there, and JWST's DistortionModel asks for it"
        )
    if not meta.get("exposure", {}).get("type"):
        yield Finding("note", "meta.exposure.type", "is missing; files are chosen by it")
    reftype = str(meta.get("reftype", ""))
    if reftype and reftype.lower() != "distortion":
        yield Finding("error", "meta.reftype", f"is {reftype!r}, and not 'distortion'")
    detector = str(instrument.get("detector", ""))
    if instrument.get("name") == "NIRCAM" and detector.startswith("NRC") and len(detector) > 3:
        stated = instrument.get("module"), instrument.get("channel")
        for key, value, right in zip(
            ("module", "channel"), stated, module_and_channel(detector), strict=True
        ):
            if value and value != right:
                yield Finding(
                    "error", f"meta.instrument.{key}", f"is {value!r}, and {detector} is of {right}"
                )
