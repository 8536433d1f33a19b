"""JWST distortion reference files in ASDF, as read by the JWST pipeline."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Literal

from bayesdist.errors import FormatError, InputError
from bayesdist.products.common.asdf.format import Observatory
from bayesdist.products.common.asdf.tree import (
    InstrumentMeta,
    KnownDetector,
    PlacedSettings,
    ReferenceMeta,
    tree_of,
)
from bayesdist.products.common.content import Content
from bayesdist.products.common.document import Finding
from bayesdist.products.common.rules import missing_entries


class JwstSettings(PlacedSettings):
    """Configuration of a JWST distortion reference file."""

    instrument: Literal["NIRCAM", "NIRISS", "FGS", "MIRI"]
    filter: str | None = None
    pupil: str | None = None
    exp_type: str | None = None


def _node(content: Content) -> tuple[Mapping[str, Any], str] | None:
    """Root node of an ASDF file, None for a Roman file; FormatError for any other content."""
    tree = tree_of(content)
    if "roman" in tree:
        return None
    if "model" not in tree or not isinstance(tree.get("meta"), Mapping):
        named = ", ".join(sorted(set(tree) - {"asdf_library", "history"}))
        raise FormatError(
            f"is an ASDF file that holds {named or 'nothing'}, instead of model and meta (as in "
            "JWST's distortion files) or roman",
            where=content.name,
            do="give a distortion reference file of an imager",
        )
    return tree, "model"


_SHORT = ("NRCA1", "NRCA2", "NRCA3", "NRCA4", "NRCB1", "NRCB2", "NRCB3", "NRCB4")
_LONG = ("NRCALONG", "NRCBLONG")
_SIDE = (2048.0, 2048.0)
# Pixel scales: mean over the FULL apertures in the SIAF (PRDOPSSOC-075).
_DETECTORS = {
    "NIRCAM": dict.fromkeys(_SHORT, KnownDetector(_SIDE, 0.0311))
    | dict.fromkeys(_LONG, KnownDetector(_SIDE, 0.0630)),
    "NIRISS": {"NIS": KnownDetector(_SIDE, 0.0656)},
    "FGS": dict.fromkeys(("GUIDER1", "GUIDER2"), KnownDetector(_SIDE, 0.0690)),
    "MIRI": {"MIRIMAGE": KnownDetector((1032.0, 1024.0), 0.1109)},
}
# Types of exposures that take direct images.
EXPOSURE_TYPES = {
    "NIRCAM": "NRC_IMAGE",
    "NIRISS": "NIS_IMAGE",
    "FGS": "FGS_IMAGE",
    "MIRI": "MIR_IMAGE",
}


def _detector(instrument: Mapping[str, Any]) -> KnownDetector | None:
    name, detector = str(instrument.get("name")), str(instrument.get("detector"))
    return _DETECTORS.get(name, {}).get(detector)


def module_and_channel(detector: str) -> tuple[str, str]:
    """NIRCam module and channel of a detector, from names such as NRCA1 and NRCBLONG."""
    return detector[3], "LONG" if detector in _LONG else "SHORT"


def _instrument(detector: str, settings: JwstSettings) -> InstrumentMeta:
    """Node meta.instrument; InputError for a detector that the instrument does not have."""
    instrument = settings.instrument
    detectors = _DETECTORS[instrument]
    if detector not in detectors:
        raise InputError(
            f"the detector is {detector!r}, none of {instrument}",
            where="products.jwst",
            do=f"choose one of {', '.join(detectors)}",
        )
    meta: InstrumentMeta = {"name": instrument, "detector": detector}
    if instrument == "NIRCAM":
        meta["module"], meta["channel"] = module_and_channel(detector)
    if settings.filter:
        meta["filter"] = settings.filter
    if settings.pupil:
        meta["pupil"] = settings.pupil
    if instrument == "NIRCAM":
        # the data model requires the pupils for which the file is valid
        meta["p_pupil"] = f"{settings.pupil or 'ANY'}|"
    return meta


# Keywords that the data model requires of every reference file, and of NIRCam distortion files.
_REQUIRED = ("reftype", "description", "author", "pedigree", "useafter", "telescope")
_NIRCAM = ("module", "channel", "p_pupil")


def _meta(detector: str, settings: JwstSettings) -> ReferenceMeta:
    """Node meta of the file of one detector."""
    return {
        "telescope": "JWST",
        "reftype": "distortion",
        "model_type": "DistortionModel",
        **settings.identity(),
        "instrument": _instrument(detector, settings),
        "exposure": {"type": settings.exp_type or EXPOSURE_TYPES[settings.instrument]},
        "input_units": "pix",
        "output_units": "arcsec",
    }


def lint_meta(meta: Mapping[str, Any]) -> Iterator[Finding]:
    """Findings on the metadata that identify a file."""
    instrument = meta["instrument"]
    yield from missing_entries(
        meta,
        _REQUIRED,
        ("name", "detector", *(_NIRCAM if instrument.get("name") == "NIRCAM" else ())),
        "not there, and JWST's DistortionModel asks for it",
    )
    if not meta.get("exposure", {}).get("type"):
        yield Finding("note", "meta.exposure.type", "is missing, although files are selected by it")
    reftype = str(meta.get("reftype", ""))
    if reftype and reftype.lower() != "distortion":
        yield Finding("error", "meta.reftype", f"is {reftype!r}, not 'distortion'")
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


FORMAT = Observatory[JwstSettings](
    "jwst",
    "JWST",
    _node,
    _detector,
    lint_meta,
    _meta,
    lambda meta, model, record, _: {"meta": meta, "model": model, "bayesdist": record},
).format("a JWST distortion reference file", 7, JwstSettings)
