"""Choice of frames that bring the stars of several exposures together, where a model's do not."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.infer.solution.linear import Rejection, fit_linear, residuals
from bayesdist.model import DistortionModel
from bayesdist.model.frames import FRAME_KINDS

GAIN = 2.0  # factor by which the scatter must shrink
FITS = 3
MEDIAN_LENGTH = 1.1774  # standard deviations, of the length of two normal numbers
ALIKE = 1.1  # largest scatter of the chosen frames, relative to the least of any


@dataclass(frozen=True)
class FrameChoice:
    """Recommended frames, with the scatter of the residuals by them and by the model's.

    Both are median lengths in the unit of u, v, corrected for degrees of freedom.
    """

    frames: str
    scatter: float
    before: float  # with the model's frames
    unit: str
    instead_of: str

    @property
    def sentence(self) -> str:
        """Recommendation with its reason."""
        return (
            f"set model.frames = '{self.frames}', with which the residuals of the exposures scatter"
            f" by {self.scatter:.2g} {self.unit} in place of {self.before:.2g} with "
            f"'{self.instead_of}'"
        )


def frames_that_help(matches: Matches, model: DistortionModel) -> FrameChoice | None:
    """Simplest frames with which stars scatter as little as with any, if that is far less.

    Errors are not used: all stars count alike.  None for one exposure, and where no richer frames
    make the scatter half as large.
    """
    names = matches.exposure_names
    richer = FRAME_KINDS[FRAME_KINDS.index(model.frames) + 1 :]
    if len(names) < 2 or not richer:
        return None
    found = {}
    for frames in (model.frames, *richer):
        one = replace(model, frames=frames, exposures=names)
        if one.n_params > len(matches):  # the part that the frames absorb would look like agreement
            continue
        try:
            found[frames] = _scatter(matches, one)
        except InputError:  # a drift that they absorb, or too few stars
            continue
    before = found.pop(model.frames, np.inf)
    if not found or before < GAIN * min(found.values()):
        return None
    best = next(name for name, size in found.items() if size <= ALIKE * min(found.values()))
    return FrameChoice(best, found[best], before, model.unit, model.frames)


def _scatter(matches: Matches, model: DistortionModel) -> float:
    """Median length of the residuals, corrected for the model's degrees of freedom.

    The first fit weights all matches alike; in the next ones its scatter separates false ones.
    """
    median = 1.0
    for _ in range(FITS):
        sigma = np.full(len(matches), max(median / MEDIAN_LENGTH, np.finfo(float).tiny))
        table = matches.with_errors((sigma, sigma))
        fit = fit_linear(table, model, rejection=Rejection(clip_abs=None))
        median = float(np.median(np.hypot(*residuals(fit, table).T)))
    return median * float(np.sqrt(2 * len(matches) / (2 * len(matches) - model.n_params)))
