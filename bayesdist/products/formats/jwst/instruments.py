"""What JWST's data models ask of each imager, and the size and scale of its detectors."""

from __future__ import annotations

from typing import Any

from bayesdist.errors import InputError
from bayesdist.products.formats.common.asdf.distortion import Detector

__all__ = ["EXPOSURE_TYPES", "detector_of", "instrument_meta", "module_and_channel"]

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
