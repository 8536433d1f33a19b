"""Gauge of a self-calibration: all constraints on it, and its directions in words.

Constraints include the commanded offsets and rolls of exposures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from astropy.table import Table

from bayesdist.data.tables.column import SourceColumn, conversion
from bayesdist.data.tables.names import find_columns
from bayesdist.errors import InputError
from bayesdist.files.tables import read_table
from bayesdist.infer.equations.priors import GaussianPriors, Prior
from bayesdist.kinds.selfcal.config import SelfcalConfig
from bayesdist.kinds.selfcal.infer.gauge import FAR, Gauge, NamedDirection, find_gauge, functionals
from bayesdist.kinds.selfcal.infer.mode import SelfCalibrationMode
from bayesdist.kinds.selfcal.infer.prior import frame_prior, pointing_prior, tie
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.checks import GAUGE_CONTRADICTION
from bayesdist.utils.distributions import chi2_sf

COLUMNS = ["name", "state", "sigma_detections", "sigma_fixed", "unit", "edge_pix", "fixed_by"]

CONVENTION, DETECTIONS, REFERENCES = "convention", "detections", "reference stars"
TOGETHER = "all together"

_COLUMNS = {
    "exposure": ("exposure", "name", "rootname"),
    "du": ("du", "postarg1", "dx"),
    "dv": ("dv", "postarg2", "dy"),
    "sigma": ("sigma",),
    "roll": ("roll",),
    "group": ("group", "guide_stars"),
}
# largest plausible numbers: offsets and errors in the unit of u and v, rolls in degrees
_LARGEST = {"du": 1e8, "dv": 1e8, "sigma": 1e8, "roll": 720.0}


def fixed_by(
    gauge: Gauge, solution: SelfCalibrationMode, pieces: GaugeConstraints
) -> dict[str, str]:
    """Source of the constraint on each property and common motion of the sky, by its name."""
    problem, theta = solution.problem, solution.theta
    alone, with_priors = solution.curvatures
    priors = {name: piece(theta) for name, piece in pieces.pieces.items()}
    sigmas: dict[str, dict[str, float]] = {}
    relative: dict[str, tuple[str, ...]] = {}  # common motions that each source leaves free
    none = Prior.none(theta)
    for name, information in priors.items():
        constrained = find_gauge(problem, theta, alone, information)
        sigmas[name] = {d.name: d.sigma_fixed for d in constrained.directions}
        relative[name] = constrained.relative
    if problem.priors.informed.any():
        constrained = find_gauge(problem, theta, alone, none, known=with_priors)
        sigmas[REFERENCES] = {d.name: d.sigma_fixed for d in constrained.directions}
        relative[REFERENCES] = constrained.relative
    motions = {}
    for motion in gauge.motions:
        sources = [source for source, left in relative.items() if motion.name not in left]
        motions[motion.name] = (
            CONVENTION
            if motion.held
            else " and ".join(sources) or TOGETHER
            if motion.determined
            else DETECTIONS
        )
    return {d.name: _fixed_by(d, sigmas) for d in gauge.directions} | motions


def _fixed_by(direction: NamedDirection, sigmas: Mapping[str, Mapping[str, float]]) -> str:
    if not np.isfinite(direction.sigma_fixed):
        return CONVENTION
    limit = FAR * direction.sigma_fixed
    sources = [name for name, of in sigmas.items() if of[direction.name] < limit]
    if direction.by_detections:
        return DETECTIONS
    return " and ".join(sources) or TOGETHER


def gauge_table(gauge: Gauge, fixed: Mapping[str, str], model: DistortionModel) -> Table:
    """One row per property of the solution: free ones first, then nearly free combinations."""
    rows = [
        _row(d, fixed) | {"edge_pix": d.edge_pix}
        for d in sorted(gauge.directions, key=lambda d: (not d.free, not d.weak))
    ]
    blank = {"sigma_fixed": np.nan, "unit": "", "edge_pix": np.nan, "fixed_by": ""}
    for motion in gauge.motions:
        state, sigma = ("free", np.inf) if motion.free else ("nearly free", np.nan)
        row = {"name": motion.name, "state": state, "sigma_detections": sigma}
        rows.append(blank | row | {"fixed_by": fixed[motion.name]})
    for sigma, k in gauge.weakest:
        row = {"name": f"combination led by {model.names[int(k)]}", "state": "nearly free"}
        at_edge = {"sigma_detections": sigma, "unit": "pix at the edge", "edge_pix": 1.0}
        rows.append(blank | row | at_edge)
    for name in gauge.unnamed:
        row = {"name": f"combination with {name}", "state": "free"}
        rows.append(blank | row | {"sigma_detections": np.inf})
    return Table(rows)[COLUMNS]


def _row(d: NamedDirection, fixed: Mapping[str, str]) -> dict[str, object]:
    """Name of a property, its uncertainty, and its constraint."""
    return {
        "name": d.name,
        "state": "free" if d.free else "nearly free" if d.weak else "known",
        "sigma_detections": d.sigma,
        "sigma_fixed": d.sigma_fixed,
        "unit": d.unit,
        "fixed_by": fixed[d.name],
    }


def gauge_summary(
    gauge: Gauge, fixed: Mapping[str, str], model: DistortionModel
) -> dict[str, object]:
    """Entry 'gauge' of the section 'selfcal' of summary.json; infinite sigmas become null."""
    return {
        "n_free": int(gauge.null.shape[1]),
        "n_by_convention": int(gauge.open.shape[1]),
        "held": [model.names[k] for k in gauge.held],
        "directions": [_row(d, fixed) for d in gauge.directions],
        "unnamed": list(gauge.unnamed),
        "sentences": list(gauge.sentences),
    }


def gauge_words(
    gauge: Gauge,
    fixed: Mapping[str, str],
    model: DistortionModel,
    contact: tuple[float, float] | None = None,
) -> str:
    """Text that states the gauge of a product and where its tangent planes touch the sky.

    `contact` is the point (u, v) where the plane of the stars touches the sky; None if the sky is
    taken as flat.
    """
    by: dict[str, list[str]] = {}
    for d in gauge.directions:
        if d.free or d.weak:
            by.setdefault(fixed[d.name], []).append(d.name.replace("_", " "))
    for motion in gauge.motions:
        by.setdefault(fixed[motion.name], []).append(motion.name.replace("_", " "))
    parts = [f"{', '.join(names)} by {source}" for source, names in by.items()]
    held = ", ".join(model.names[k] for k in gauge.held)
    text = "Gauge of a self-calibration: " + ("; ".join(parts) or "all is known from detections")
    text += f"; held: {held}." if held else "."
    return text if contact is None else f"{text} {_contact_words(model, contact)}"


def _contact_words(model: DistortionModel, contact: tuple[float, float]) -> str:
    """Sentence on the points where the planes of exposures and stars touch the sky."""
    chip = model.chips[0]
    x, y = (f"{z:.10g}" for z in chip.reference_pixel)
    u, v = (f"{z:.10g}" for z in contact)
    return (
        f"The tangent plane of each exposure touches the sky at pixel ({x}, {y}) of chip "
        f"{chip.number}, that of the stars at u = {u}, v = {v} {model.unit}."
    )


@dataclass(frozen=True, eq=False)
class Commanded:
    """Commanded pointings of the exposures."""

    # (E, 2), along u and v, NaN if an exposure has none; None if the file has only rolls
    offsets: Float | None
    sigma: Float  # (E,), errors per axis
    roll: Float | None  # (E,), radians, from u to v
    group: Int  # (E,), equal for exposures with the same guide stars


def read_commanded(
    path: Path, names: Sequence[str], unit: str, scale_mas: float | None, sigma: float | None
) -> Commanded:
    """Read commanded offsets and rolls of exposures from a table.

    Its columns are exposure, du and dv along u and v, sigma, roll in degrees from u to v, and
    group.

    Parameters
    ----------
    path : Path
    names : sequence of str
        Names of the exposures.
    unit : str
        Unit of columns that state none.
    scale_mas : float or None
        Pixel size in mas.
    sigma : float or None
        Error of the offsets, if given, in place of a column sigma.

    Raises
    ------
    InputError
        If columns, exposures or errors are missing, an exposure is listed twice, or a number is
        implausibly large.
    """
    table = read_table(path)
    columns = find_columns(table.colnames, None, _COLUMNS, source=str(path))
    if "exposure" not in columns or ("du" in columns) != ("dv" in columns):
        raise InputError(
            f"no columns exposure, du and dv among {', '.join(table.colnames) or 'none'}",
            where=str(path),
            do="name the exposures and their offsets along u and v",
        )

    def column(key: str) -> SourceColumn:
        return SourceColumn(table[columns[key]], str(path), columns[key])

    def numbers(key: str, factor: float = 1.0) -> Float:
        values = column(key).numbers() * factor
        large = ~(np.abs(values) <= _LARGEST[key])
        if large.any():
            raise column(key).fail(int(np.argmax(large)), "is implausibly large")
        return values

    def length(key: str) -> Float:
        column_unit = column(key).unit
        return numbers(
            key, 1.0 if column_unit is None else _factor(column_unit, unit, scale_mas, path)
        )

    codes, labels = column("exposure").labels()
    row_of = {labels[code]: k for k, code in enumerate(codes)}
    if len(row_of) < len(codes):
        duplicate = labels[int(np.argmax(np.bincount(codes)))]
        raise InputError(
            f"exposure {duplicate} occurs twice", where=str(path), do="keep one row of each"
        )
    rows = np.array([row_of.get(name, -1) for name in names])
    if (rows < 0).all():
        raise InputError(
            f"has none of the exposures {', '.join(names[:3])}, ...",
            where=str(path),
            do="name them as the lists do",
        )

    def of_each(values: Float, missing: float = np.nan) -> Float:
        return np.where(rows >= 0, values[rows], missing)

    offsets, error = None, np.full(len(names), np.nan if sigma is None else sigma)
    if "du" in columns:
        offsets = np.stack([of_each(length("du")), of_each(length("dv"))], axis=1)
        if "sigma" in columns and sigma is None:
            error = of_each(length("sigma"), 1.0)
        if not (error > 0).all():
            raise InputError(
                "the offsets have no errors",
                where=str(path),
                do="give a column sigma above zero, or gauge.offset_sigma",
            )
    group = np.zeros(len(names), np.int64)
    if "group" in columns:
        group = np.where(rows >= 0, column("group").labels()[0][rows], -1)
    roll = np.radians(of_each(numbers("roll"))) if "roll" in columns else None
    return Commanded(offsets, error, roll, group)


def _factor(own: str, unit: str, scale_mas: float | None, path: Path) -> float:
    """Conversion factor from the unit `own` to `unit`; either may be the pixel."""
    if own == unit:
        return 1.0
    if "pix" not in (own, unit):
        return conversion(own, unit, where=str(path))
    if scale_mas is None:
        raise InputError(
            f"offsets are in {own}, but u and v are in {unit}",
            where=str(path),
            do="give detector.scale_mas for the conversion",
        )
    if own == "pix":
        return conversion("mas", unit, where=str(path)) * scale_mas
    return conversion(own, "mas", where=str(path)) / scale_mas


Piece = Callable[[Float], Prior]


@dataclass(frozen=True, eq=False)
class GaugeConstraints:
    """Priors that fix the gauge with information other than the detections, by source."""

    pieces: Mapping[str, Piece]  # priors as functions of parameters (D,), by source

    def __call__(self, theta: Float) -> Prior:
        """Combined prior of all constraints, linearised at theta (D,)."""
        out = Prior.none(theta)
        for piece in self.pieces.values():
            out = out + piece(theta)
        return out

    def contradictions(self, theta: Float) -> Iterator[str]:
        """Sentences about constraints that disagree significantly with a solution `theta` (D,).

        The solution itself includes the constraints.
        """
        for name, piece in self.pieces.items():
            prior = piece(theta)
            values, vectors = np.linalg.eigh(prior.precision)
            measured = values > 1e-10 * values[-1]
            right = vectors[:, measured].T @ prior.right
            square, n = float(np.sum(right**2 / values[measured])), int(measured.sum())
            if chi2_sf(square, n) < GAUGE_CONTRADICTION.value:
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
        """Constraints that a configuration gives."""
        block, pieces = config.gauge, dict[str, Piece]()
        if commanded is not None and commanded.offsets is not None:
            offsets, errors, groups = commanded.offsets, commanded.sigma, commanded.group
            pieces["commanded offsets"] = lambda theta: pointing_prior(
                model, theta, offsets, errors, group=groups
            )
        if block.roll_sigma_deg is not None:
            if commanded is None or commanded.roll is None:
                raise InputError(
                    "has no column roll, but gauge.roll_sigma_deg is given",
                    where=str(block.offsets),
                    do="add the commanded rolls in degrees, from u to v, or leave out their error",
                )
            roll, error = commanded.roll, np.radians(block.roll_sigma_deg)
            pieces["commanded rolls"] = lambda theta: _rolls(model, theta, roll, error)
        if block.exposure_scale_sigma is not None:
            scatter = block.exposure_scale_sigma
            zeros = np.zeros(len(model.exposures))  # scales are deviations from 1
            pieces["scatter of the scales"] = lambda theta: frame_prior(
                model, theta, "scale", zeros, scatter
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
    """Prior on commanded rolls, each with its error.

    The error of the first roll is common to all differences.
    """
    rotation = np.zeros(len(model.exposures))
    for e in range(1, len(rotation)):
        names = model.free_frame_names(e)
        if "rotation" in names:
            rotation[e] = theta[model.frame_slice(e).start + names.index("rotation")]
    off = np.exp(1j * (roll - rotation))  # phase factors that have a common unknown zero point
    # the zero point is the mean angle, and no angle is far from it
    zero = np.nanmean(off)
    return frame_prior(model, theta, "rotation", rotation + np.angle(off / zero), sigma)


def _scale(model: DistortionModel, theta: Float, size: float, sigma: float) -> Prior:
    """Prior that ties the pixel scale at the first chip's reference pixel to `size`."""
    row = functionals(model, theta)["scale"]
    return tie(theta, row, float(np.log(size / model.linear_scale(theta))), sigma)
