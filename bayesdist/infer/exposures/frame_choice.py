"""Recommendation of a more general kind of frames if it reduces the scatter of the exposures."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.infer.solution.linear import Rejection, fit_linear, residuals
from bayesdist.model import DistortionModel
from bayesdist.model.frames import FRAME_KINDS

GAIN = 2.0  # factor by which the scatter must decrease
FITS = 3  # number of fits, each with the scatter of the previous one
MEDIAN_LENGTH = 1.1774  # median of the Rayleigh distribution, in sigma
ALIKE = 1.1  # largest scatter of the recommended frames, relative to the smallest


@dataclass(frozen=True)
class FrameChoice:
    """Recommended frames, and the scatter of the residuals with them and with the model's frames.

    The scatter is the median length of the residuals, corrected for degrees of freedom.
    """

    frames: str  # recommended kind of frames
    scatter: float  # with the recommended frames
    before: float  # with the frames of the model
    unit: str  # unit of u, v
    instead_of: str  # kind of frames of the model

    @property
    def sentence(self) -> str:
        """Recommendation with its reason."""
        return (
            f"set model.frames = '{self.frames}', with which the residuals of the exposures scatter"
            f" by {self.scatter:.2g} {self.unit} instead of {self.before:.2g} with "
            f"'{self.instead_of}'"
        )


def frames_that_help(matches: Matches, model: DistortionModel) -> FrameChoice | None:
    """Find the simplest frames that give about the smallest scatter of the residuals.

    All stars have the same weight; errors are not used.  Returns None for a single exposure, or if
    no more general frames than those of the model reduce the scatter by at least a factor of 2.
    """
    names = matches.exposure_names
    richer = FRAME_KINDS[FRAME_KINDS.index(model.frames) + 1 :]
    if len(names) < 2 or not richer:
        return None
    scatters = {}
    for frames in (model.frames, *richer):
        candidate = replace(model, frames=frames, exposures=names)
        if candidate.n_params > len(matches):  # a good fit would be meaningless
            continue
        try:
            scatters[frames] = _scatter(matches, candidate)
        except InputError:  # the frames absorb the drift, or there are too few stars
            continue
    before = scatters.pop(model.frames, np.inf)
    if not scatters or before < GAIN * min(scatters.values()):
        return None
    best = next(name for name, size in scatters.items() if size <= ALIKE * min(scatters.values()))
    return FrameChoice(best, scatters[best], before, model.unit, model.frames)


def _scatter(matches: Matches, model: DistortionModel) -> float:
    """Median length of the residuals, corrected for the model's degrees of freedom.

    The first fit rejects no matches; later ones reject them according to the previous scatter.
    """
    median = 1.0
    for _ in range(FITS):
        sigma = np.full(len(matches), max(median / MEDIAN_LENGTH, np.finfo(float).tiny))
        table = matches.with_errors((sigma, sigma))
        fit = fit_linear(table, model, rejection=Rejection(clip_abs=None))
        median = float(np.median(np.hypot(*residuals(fit, table).T)))
    return median * float(np.sqrt(2 * len(matches) / (2 * len(matches) - model.n_params)))
