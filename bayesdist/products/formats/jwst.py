"""JWST's distortion reference files, ASDF, as its pipeline reads them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, Literal

from bayesdist.errors import FormatError, InputError
from bayesdist.products.formats.common.asdf.format import Observatory
from bayesdist.products.formats.common.asdf.tree import (
    Detector,
    PlacedSettings,
    is_asdf,
    plain,
    tree_of,
)
from bayesdist.products.formats.common.content import Content
from bayesdist.products.formats.common.document import Finding

if TYPE_CHECKING:
    from bayesdist.products.formats.common.asdf.build import ChipTransform
    from bayesdist.products.formats.common.asdf.distortion import DistortionFile


class Settings(PlacedSettings):
    """Configuration of a JWST distortion reference file."""

    instrument: Literal["NIRCAM", "NIRISS", "FGS", "MIRI"]
    filter: str | None = None
    pupil: str | None = None
    exp_type: str | None = None


def _parse(content: Content) -> DistortionFile | None:
    """Any ASDF file that is not Roman's: of another kind it is refused."""
    if not is_asdf(content):
        return None
    # astropy.modeling takes longer to import than other files to read
    from bayesdist.products.formats.common.asdf.distortion import DistortionFile, transform_in

    tree = tree_of(content)
    if "roman" in tree:
        return None
    if "model" not in tree or not isinstance(tree.get("meta"), Mapping):
        named = ", ".join(sorted(set(tree) - {"asdf_library", "history"}))
        raise FormatError(
            f"is an ASDF file that holds {named or 'nothing'}, and not model and meta, as JWST's "
            "distortion has, or roman",
            where=content.name,
            do="give a distortion reference file of an imager",
        )
    meta = plain(tree["meta"])
    instrument = meta.setdefault("instrument", {})
    record = tree.get("bayesdist")
    return DistortionFile(
        content.name,
        "JWST",
        transform_in(tree, "model", content.name),
        meta,
        (str(meta.get("input_units", "")), str(meta.get("output_units", ""))),
        None if record is None else plain(record),
        detector_of(instrument.get("name"), instrument.get("detector")),
    )


def _tree(one: ChipTransform, detector: str, settings: Settings, _: str) -> dict[str, Any]:
    from bayesdist.products.formats.common.asdf.build import refuse_larger

    meta = meta_of(detector, settings.model_dump(), "products.jwst")
    refuse_larger(one, detector, detector_of(settings.instrument, detector), "products.jwst")
    return {"meta": meta, "model": one.model, "bayesdist": one.record}


_SHORT, _LONG = (
    ("NRCA1", "NRCA2", "NRCA3", "NRCA4", "NRCB1", "NRCB2", "NRCB3", "NRCB4"),
    (
        "NRCALONG",
        "NRCBLONG",
    ),
)
_SIDE = (2048.0, 2048.0)
# Scales: mean pixels of the FULL apertures in the SIAF (PRDOPSSOC-075).
_DETECTORS = {
    "NIRCAM": dict.fromkeys(_SHORT, Detector(_SIDE, 0.0311))
    | dict.fromkeys(_LONG, Detector(_SIDE, 0.0630)),
    "NIRISS": {"NIS": Detector(_SIDE, 0.0656)},
    "FGS": dict.fromkeys(("GUIDER1", "GUIDER2"), Detector(_SIDE, 0.0690)),
    "MIRI": {"MIRIMAGE": Detector((1032.0, 1024.0), 0.1109)},
}
# Of an exposure that takes an image of the sky.
EXPOSURE_TYPES = {
    "NIRCAM": "NRC_IMAGE",
    "NIRISS": "NIS_IMAGE",
    "FGS": "FGS_IMAGE",
    "MIRI": "MIR_IMAGE",
}


def detector_of(instrument: object, detector: object) -> Detector | None:
    """Size and scale of a detector; None if unknown."""
    return _DETECTORS.get(str(instrument), {}).get(str(detector))


def module_and_channel(detector: str) -> tuple[str, str]:
    """NIRCam's module and channel of a detector, as in NRCA1 and NRCBLONG."""
    return detector[3], "LONG" if detector in _LONG else "SHORT"


def instrument_meta(
    instrument: str, detector: str, filter: str | None, pupil: str | None, where: str
) -> dict[str, Any]:
    """Node meta.instrument; InputError for a detector that the instrument has not."""
    known = _DETECTORS[instrument]
    if detector not in known:
        raise InputError(
            f"the detector is {detector!r}, none of {instrument}",
            where=where,
            do=f"choose one of {', '.join(known)}",
        )
    meta: dict[str, Any] = {"name": instrument, "detector": detector}
    if instrument == "NIRCAM":
        meta["module"], meta["channel"] = module_and_channel(detector)
    if filter:
        meta["filter"] = filter
    if pupil:
        meta["pupil"] = pupil
    if instrument == "NIRCAM":
        # the data model asks for the pupils that the file is for
        meta["p_pupil"] = f"{pupil or 'ANY'}|"
    return meta


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


FORMAT = Observatory[Settings](
    "jwst", "JWST", _parse, lint_meta, lambda settings: settings.instrument, _tree
).format("a JWST distortion reference file", 7, Settings)
