"""Constraints beside the detections of a self-calibration, which fix its gauge."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from bayesdist.app.config import SelfcalConfig
from bayesdist.app.kinds.selfcal.commanded import Commanded
from bayesdist.errors import InputError
from bayesdist.infer.equations.priors import GaussianPriors, Prior
from bayesdist.infer.selfcal.prior import frame_prior, pointing_prior, tie
from bayesdist.infer.selfcal.sky_moves import functionals
from bayesdist.limits import GAUGE_CONTRADICTION
from bayesdist.model import DistortionModel

__all__ = ["GaugeConstraints"]

Float = NDArray[np.float64]
Piece = Callable[[Float], Prior]


@dataclass(frozen=True, eq=False)
class GaugeConstraints:
    """Constraints on the gauge beside the detections, each from one source.

    Parameters
    ----------
    pieces : mapping of str to callable
        Prior linearised at parameters (D,), by what it is from.
    """

    pieces: Mapping[str, Piece]

    def __call__(self, theta: Float) -> Prior:
        """Prior of all pieces together, linearised at theta (D,)."""
        out = Prior.none(theta)
        for piece in self.pieces.values():
            out = out + piece(theta)
        return out

    def contradictions(self, theta: Float) -> Iterator[str]:
        """Pieces that a solution (D,), which has them in it, is too far from, as sentences."""
        for name, piece in self.pieces.items():
            known = piece(theta)
            values, vectors = np.linalg.eigh(known.precision)
            measured = values > 1e-10 * values[-1]
            right = vectors[:, measured].T @ known.right
            square, n = float(np.sum(right**2 / values[measured])), int(measured.sum())
            if chi2.sf(square, n) < GAUGE_CONTRADICTION.value:
                yield (
                    f"the {name} contradict the detections: chi-square {square:.4g} of {n}; an "
                    "error is too small, or a value is wrong"
                )

    @classmethod
    def of(
        cls,
        config: SelfcalConfig,
        model: DistortionModel,
        commanded: Commanded | None,
        unit_arcsec: float | None,
    ) -> GaugeConstraints:
        """Constraints that a configuration gives.

        Raises
        ------
        InputError
            For a prior on a parameter that the model does not have, and errors of rolls without
            rolls.
        """
        block, pieces = config.gauge, dict[str, Piece]()
        if commanded is not None and commanded.offsets is not None:
            offsets, errors, groups = commanded.offsets, commanded.sigma, commanded.group
            pieces["commanded offsets"] = lambda theta: pointing_prior(
                model, theta, offsets, errors, group=groups
            )
        if block.roll_sigma_deg is not None:
            if commanded is None or commanded.roll is None:
                raise InputError(
                    "has no column roll, and gauge.roll_sigma_deg is given",
                    where=str(block.offsets),
                    do="add the commanded rolls in degrees, from u to v, or leave their error out",
                )
            roll, error = commanded.roll, np.radians(block.roll_sigma_deg)
            pieces["commanded rolls"] = lambda theta: _rolls(model, theta, roll, error)
        if block.exposure_scale_sigma is not None:
            scatter = block.exposure_scale_sigma
            same = np.zeros(len(model.exposures))  # scales are deviations from one
            pieces["scatter of the scales"] = lambda theta: frame_prior(
                model, theta, "scale", same, scatter
            )
        if block.scale is not None and unit_arcsec is not None:
            size, sigma = block.scale.mas / 1000 / unit_arcsec, block.scale.sigma
            name = f"scale of {block.scale.detector}" if block.scale.detector else "given scale"
            pieces[name] = lambda theta: _scale(model, theta, size, sigma)
        if config.prior:
            named = {p.parameter: (p.mean, p.sigma) for p in config.prior}
            priors = GaussianPriors.of(model, named)
            pieces["priors"] = priors.about
        return cls(pieces)


def _rolls(model: DistortionModel, theta: Float, roll: Float, sigma: float) -> Prior:
    """Commanded rolls, each with its error; the first one's is shared by all the differences."""
    now = np.zeros(len(model.exposures))
    for e in range(1, len(now)):
        names = model.free_frame_names(e)
        if "rotation" in names:
            now[e] = theta[model.frame_slice(e).start + names.index("rotation")]
    off = np.exp(1j * (roll - now))  # of each, all by one unknown zero point
    # that is where the angles lie on average, and no angle is far from it
    zero = np.nanmean(off)
    return frame_prior(model, theta, "rotation", now + np.angle(off / zero), sigma)


def _scale(model: DistortionModel, theta: Float, size: float, sigma: float) -> Prior:
    """A tie of the pixel at the first chip's reference pixel to a size."""
    row = functionals(model, theta)["scale"]
    return tie(theta, row, float(np.log(size / model.linear_scale(theta))), sigma)
