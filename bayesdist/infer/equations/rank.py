"""Detection of parameters that the data do not determine, by name and with the reason.

The checks run before the equations are solved, because solving a degenerate least-squares problem
returns numbers without any warning.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from bayesdist.errors import DegenerateError
from bayesdist.infer.equations.arrow import Arrow
from bayesdist.infer.stars.shards import Survey
from bayesdist.model import DistortionModel, Groups
from bayesdist.model.frames import DEVIATIONS, FRAME_KINDS, frame_names

# Eigenvalues of the unit-diagonal normal matrix below this count as zero. Rounding alone gives
# ~1e-15, and a fit that loses 11 of 16 digits is meaningless.
RANK_TOLERANCE = 1e-11

# Smallest fraction of the chip area within the convex hull of its stars; below it, the polynomial
# would be an extrapolation over most of the chip.
LEAST_COVERAGE = 0.25


@dataclass(frozen=True)
class NullSpace:
    """Null space of a normal matrix: directions that the data do not determine."""

    rank: int
    n_params: int
    # condition number of the normal matrix scaled to unit diagonal; infinite if it is singular
    condition: float
    # names of the parameters with large components in each null direction, largest first
    directions: tuple[tuple[str, ...], ...]


def null_space(matrix: Arrow, names: tuple[str, ...]) -> NullSpace:
    """Rank, condition number and null directions of a normal matrix; `names` are its rows."""
    scale = np.sqrt(matrix.diagonal())
    dead = scale == 0
    scale[dead] = 1.0
    unit = matrix.dense() / np.outer(scale, scale)
    values = np.linalg.eigvalsh(unit)
    free = values < RANK_TOLERANCE * max(values[-1], 1.0)
    directions = []
    # eigenvectors take twice as long as eigenvalues and are rarely needed
    for vector in np.linalg.eigh(unit).eigenvectors[:, free].T if free.any() else ():
        size = np.abs(vector)
        parts = np.argsort(-size)[:6]
        directions.append(tuple(names[k] for k in parts if size[k] > 0.1 * size.max()))
    return NullSpace(
        rank=int((~free).sum()),
        n_params=len(names),
        condition=float("inf") if free.any() else float(values[-1] / values[0]),
        directions=tuple(directions),
    )


def require_full_rank(matrix: Arrow, model: DistortionModel, groups: Groups) -> NullSpace:
    """Require that a normal matrix has full rank, and return its `NullSpace`.

    Raises DegenerateError with the parameters of the first null direction and the likely reason.
    """
    space = null_space(matrix, model.names)
    if space.rank == space.n_params:
        return space
    first = space.directions[0]
    listed = ", ".join(first[:-1]) + f" and {first[-1]}" if len(first) > 1 else first[0]
    verb = "are degenerate" if len(first) > 1 else "is not determined by the data"
    reason, do = _reason(first, model, groups, _simpler_frames(matrix, model))
    raise DegenerateError(
        f"{listed} {verb} (rank {space.rank} of {space.n_params}){reason}", where="model", do=do
    )


def _simpler_frames(matrix: Arrow, model: DistortionModel) -> str:
    """Advice to use the most general kind of frames that is not degenerate; empty if none is."""
    dense = matrix.dense()
    for kind in reversed(FRAME_KINDS[: FRAME_KINDS.index(model.frames)]):
        names = frame_names(kind)
        remaining = [
            k
            for k, p in enumerate(model.parameters)
            if p.kind != "frame" or p.name.rpartition(".")[2] in names
        ]
        part = dense[np.ix_(remaining, remaining)]
        scale = np.sqrt(part.diagonal())
        if (scale == 0).any():
            continue
        values = np.linalg.eigvalsh(part / np.outer(scale, scale))
        if values[0] >= RANK_TOLERANCE * max(values[-1], 1.0):
            return f", or set model.frames = '{kind}'"
    return ""


def _reason(
    direction: tuple[str, ...], model: DistortionModel, groups: Groups, simpler: str
) -> tuple[str, str]:
    kinds = {p.name: p for p in model.parameters}
    parts = [kinds[name] for name in direction]
    deviations = any(p.kind == "frame" and p.name.endswith(DEVIATIONS) for p in parts)
    if model.gauge == "held" and deviations:
        return (
            ": the scale or shear that all exposures have in common is also in the polynomials",
            "give scale and shear of every exposure Gaussian priors, or choose gauge 'first'",
        )
    if any(p.kind == "tdd" for p in parts):
        if len(np.unique(groups.epoch)) == 1:
            return (
                ": all exposures share one epoch",
                "drop model.tdd or add exposures at other epochs",
            )
        if any(p.kind == "frame" for p in parts):
            return (
                f": the frame '{model.frames}' of each exposure absorbs the drift",
                f"drop the time-dependent term (model.tdd){simpler}",
            )
        return (
            ": the epochs of a segment do not fix its terms",
            "drop the term or the break, or add exposures in that segment",
        )
    if any(p.kind == "frame" for p in parts):
        return (
            ": too little joins the exposures",
            f"give more stars that exposures have on the same chips{simpler}",
        )
    return (
        f": the stars do not fill the detector well enough for order {model.order}",
        "lower model.order or add stars",
    )


def check_coverage(
    model: DistortionModel, survey: Survey, n_priors: int = 0, *, known: bool = False
) -> None:
    """Raise DegenerateError if the data, summarised by `survey`, cannot determine the model.

    This is the case if there are fewer measurements (including `n_priors` informative priors) than
    parameters, too few stars in an exposure, no stars on a chip, stars outside a chip or on a line,
    or stars that cover too small a part of a chip.  The last two are not checked if the polynomials
    are `known` from an earlier calibration.
    """
    n = survey.n
    if 2 * n + n_priors < model.n_params:
        raise DegenerateError(
            f"{n} {'star gives' if n == 1 else 'stars give'} {2 * n} numbers, fewer than the "
            f"{model.n_params} parameters",
            where=survey.where,
            do="lower model.order or give more stars",
        )
    q = len(frame_names(model.frames))
    if q:
        for name, count in zip(model.exposures, survey.exposures, strict=True):
            if 2 * count < q:
                kinds = [kind for kind in FRAME_KINDS if 2 * count >= len(frame_names(kind))]
                stars = "1 star" if count == 1 else f"{count} stars"
                raise DegenerateError(
                    f"exposure {name!r} has {stars}, too few for frame '{model.frames}'",
                    where=survey.where,
                    do=f"leave the exposure out, or set model.frames = '{kinds[-1]}'",
                )
    for chip, chip_survey in zip(model.chips, survey.chips, strict=True):
        location = f"chip {chip.name}" if len(model.chips) > 1 else survey.where
        if not chip_survey.n:
            raise DegenerateError("no star lies on this chip", where=location, do="drop the chip")
        if chip_survey.outside:
            raise DegenerateError(
                chip_survey.outside,
                where=location,
                do="correct detector.size, the columns or data.pixel_origin, or leave the row out",
            )
        if known:
            continue
        a, b, aa, ab, bb = chip_survey.sums / chip_survey.n
        spread = np.linalg.eigvalsh([[aa - a * a, ab - a * b], [ab - a * b, bb - b * b]])
        # differences of squares: half of the digits are lost
        if chip_survey.n < 3 or spread[0] < 1e-12 * spread[1]:
            raise DegenerateError(
                "all stars lie on a line", where=location, do="check columns x and y"
            )
        try:
            covered = ConvexHull(chip_survey.corners / chip.size).volume
        except QhullError:  # nearly collinear: no area
            covered = 0.0
        if covered < LEAST_COVERAGE:
            x, y = chip_survey.corners.T
            raise DegenerateError(
                f"the stars lie within x {x.min():.0f} to {x.max():.0f}, y {y.min():.0f} to "
                f"{y.max():.0f} and span {100 * covered:.0f} % of the detector, so that the rest "
                "would be extrapolated",
                where=location,
                do="add stars, or describe only the part that is measured as the detector",
            )
