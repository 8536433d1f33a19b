"""Calibration files of a solution as the configuration asks for them, not yet written."""

from __future__ import annotations

from dataclasses import replace

from bayesdist.app.session import Session
from bayesdist.calibration.calibration import Calibration, calibration_of
from bayesdist.calibration.plane import Plane
from bayesdist.infer.solution import Solution
from bayesdist.products.formats.common.document import BuildOptions, Built
from bayesdist.products.registry import build

__all__ = ["calibration_for_files", "made_files"]


def made_files(session: Session, solution: Solution) -> dict[str, tuple[Built, ...]]:
    """Files by the key of their format."""
    calibration = calibration_for_files(session, solution)
    options = BuildOptions(session.epoch, session.scale_arcsec)
    return {
        key: build(key, calibration, settings, options)
        for key, settings in session.config.products.asked().items()
    }


def calibration_for_files(session: Session, solution: Solution) -> Calibration:
    """The calibration that the files hold, with what they have to say of the run it is from."""
    point = session.tangent_point
    plane = Plane() if point is None else Plane("sky", point=point, note=_sky_note(session))
    name = session.config.detector.name
    calibration = calibration_of(solution, str(session.run.path), plane=plane, detector=name)
    return replace(calibration, notes=(session.gauge_words,) if session.gauge_words else ())


def _sky_note(session: Session) -> str:
    """For which exposure a file is right on the sky, where they differ."""
    model = session.model
    if model.frames == "none" or len(model.exposures) < 2:
        return ""
    return f"On the sky it is exposure {model.exposures[0]}: others have frames of their own."
