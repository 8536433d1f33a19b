"""What fixes the gauge of a self-calibration, and its directions in words."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray
from scipy.stats import chi2

from bayesdist.app.config import Config
from bayesdist.app.selfcal.inputs import Commanded
from bayesdist.errors import InputError
from bayesdist.infer.equations.priors import GaussianPriors, Prior
from bayesdist.infer.selfcal.gauge import FAR, Gauge, NamedDirection, find_gauge
from bayesdist.infer.selfcal.mode import SelfCalibrationMode, curvatures
from bayesdist.infer.selfcal.prior import (
    frame_prior,
    pointing_prior,
    tie,
)
from bayesdist.infer.selfcal.sky_moves import functionals
from bayesdist.limits import GAUGE_CONTRADICTION
from bayesdist.model import DistortionModel

__all__ = ["CONVENTION", "Known", "fixed_by", "gauge_summary", "gauge_table", "gauge_words"]

Float = NDArray[np.float64]
Piece = Callable[[Float], Prior]

CONVENTION, DETECTIONS, REFERENCES = "convention", "detections", "reference stars"


@dataclass(frozen=True, eq=False)
class Known:
    """What is known beside the detections, piece by piece.

    Parameters
    ----------
    pieces : mapping of str to callable
        Prior linearised at parameters (D,), by what it is from.
    """

    pieces: Mapping[str, Piece]

    def __call__(self, theta: Float) -> Prior:
        """All of it, linearised at theta (D,)."""
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
        config: Config,
        model: DistortionModel,
        commanded: Commanded | None,
        unit_arcsec: float | None,
    ) -> Known:
        """What the configuration says is known.

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


# -- in words -------------------------------------------------------------------------------------


def fixed_by(gauge: Gauge, solution: SelfCalibrationMode, pieces: Known) -> dict[str, str]:
    """What fixes each property of the solution, by its name.

    Parameters
    ----------
    gauge : Gauge
    solution : SelfCalibrationMode
    pieces : Known
    """
    problem, theta = solution.problem, solution.theta
    alone, known = curvatures(problem, theta, solution.mixture, solution.stars)
    found = {name: piece(theta) for name, piece in pieces.pieces.items()}
    sigmas: dict[str, dict[str, float]] = {}
    none = Prior.none(theta)
    for name, information in found.items():
        one = find_gauge(problem, theta, alone, information)
        sigmas[name] = {d.name: d.sigma_fixed for d in one.directions}
    if problem.priors.informed.any():
        one = find_gauge(problem, theta, alone, none, known=known)
        sigmas[REFERENCES] = {d.name: d.sigma_fixed for d in one.directions}
    return {d.name: _fixed_by(d, sigmas) for d in gauge.directions}


def _fixed_by(direction: NamedDirection, sigmas: Mapping[str, Mapping[str, float]]) -> str:
    if not np.isfinite(direction.sigma_fixed):
        return CONVENTION
    limit = FAR * direction.sigma_fixed
    found = [name for name, of in sigmas.items() if of[direction.name] < limit]
    if direction.by_detections:
        return DETECTIONS
    return " and ".join(found) or "all together"


def gauge_table(gauge: Gauge, fixed: Mapping[str, str], model: DistortionModel) -> Table:
    """One row for each property of the solution, free ones first, then nearly free combinations."""
    rows = [
        {
            "name": d.name,
            "state": _state(d),
            "sigma_detections": d.sigma,
            "sigma_fixed": d.sigma_fixed,
            "unit": d.unit,
            "edge_pix": d.edge_pix,
            "fixed_by": fixed[d.name],
        }
        for d in sorted(gauge.directions, key=lambda d: (not d.free, not d.weak))
    ]
    rows += [
        {
            "name": f"combination led by {model.names[int(k)]}",
            "state": "nearly free",
            "sigma_detections": sigma,
            "sigma_fixed": np.nan,
            "unit": "pix at the edge",
            "edge_pix": 1.0,
            "fixed_by": "",
        }
        for sigma, k in gauge.weakest
    ]
    rows += [
        {
            "name": f"combination with {name}",
            "state": "free",
            "sigma_detections": np.inf,
            "sigma_fixed": np.nan,
            "unit": "",
            "edge_pix": np.nan,
            "fixed_by": "",
        }
        for name in gauge.unnamed
    ]
    return Table(rows)


def _state(d: NamedDirection) -> str:
    return "free" if d.free else "nearly free" if d.weak else "known"


def gauge_summary(
    gauge: Gauge, fixed: Mapping[str, str], model: DistortionModel
) -> dict[str, object]:
    """Part 'gauge' of the section 'selfcal' of summary.json; infinite sigmas are null there."""
    return {
        "n_free": int(gauge.null.shape[1]),
        "n_by_convention": int(gauge.open.shape[1]),
        "held": [model.names[k] for k in gauge.held],
        "directions": [
            {
                "name": d.name,
                "state": _state(d),
                "sigma_detections": d.sigma,
                "sigma_fixed": d.sigma_fixed,
                "unit": d.unit,
                "fixed_by": fixed[d.name],
            }
            for d in gauge.directions
        ],
        "unnamed": list(gauge.unnamed),
        "sentences": list(gauge.sentences),
    }


def gauge_words(gauge: Gauge, fixed: Mapping[str, str], model: DistortionModel) -> str:
    """In which gauge a product stands, in one sentence."""
    by: dict[str, list[str]] = {}
    for d in gauge.directions:
        if d.free or d.weak:
            by.setdefault(fixed[d.name], []).append(d.name.replace("_", " "))
    parts = [f"{', '.join(names)} by {what}" for what, names in by.items()]
    held = ", ".join(model.names[k] for k in gauge.held)
    text = "Gauge of a self-calibration: " + ("; ".join(parts) or "all is known from detections")
    return text + (f"; held: {held}." if held else ".")
