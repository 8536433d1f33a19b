"""Statistics of the stars that are needed before a fit, as sums over chunks of the data."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.infer.stars.stars import Stars
from bayesdist.model import Groups, merge_groups
from bayesdist.utils.arrays import Float, Int

# relative tolerance for stars at the edge of their match circle
ROUNDING = 1e-6


@dataclass(frozen=True, eq=False)
class ChipSurvey:
    """Number and extent of the stars on one chip."""

    n: int  # number of stars
    # vertices (m, 2) of the convex hull, FITS 1-based pixels; all points if they span no area
    corners: Float
    sums: Float  # sums (5,) of x, y, x^2, xy, y^2 in units of the chip's size
    outside: str  # message about the first star outside the chip; empty if there is none

    def __add__(self, other: ChipSurvey) -> ChipSurvey:
        return ChipSurvey(
            self.n + other.n,
            _hull(np.concatenate([self.corners, other.corners])),
            self.sums + other.sums,
            self.outside or other.outside,
        )


@dataclass(frozen=True, eq=False)
class Survey:
    """Statistics of stars; the surveys of different chunks of the data can be added."""

    n: int  # number of stars
    groups: Groups  # without members
    exposures: Int  # number (E,) of stars in each exposure of the model
    chips: tuple[ChipSurvey, ...]  # in the order of the model's chips
    variance: tuple[Float, ...]  # evenly spaced samples of the squared errors of both axes
    sources: tuple[str, ...]  # names of the files
    # largest distance of a star from its nominal position, and the name of the star; the distance
    # is negative if nominal positions are unknown
    farthest: tuple[float, str] = (-1.0, "")

    def __add__(self, other: Survey) -> Survey:
        return Survey(
            self.n + other.n,
            merge_groups(self.groups, other.groups)[0],
            self.exposures + other.exposures,
            tuple(a + b for a, b in zip(self.chips, other.chips, strict=True)),
            self.variance + other.variance,
            self.sources,
            max(self.farthest, other.farthest, key=lambda one: one[0]),
        )

    @property
    def reference_sigma(self) -> float:
        """Median quoted error per axis, which is the scale of the priors."""
        return float(np.sqrt(np.median(np.concatenate(self.variance))))

    def check_circle(self, radius: float | None) -> None:
        """Raise InputError if a star is outside its match circle.

        `radius` is in the unit of u, v; None if there is no match circle.  The message names the
        star that is farthest from its nominal position.
        """
        distance, star_name = self.farthest
        if radius is not None and distance > radius * (1 + ROUNDING):
            raise InputError(
                f"is {distance:.6g} from its nominal position, outside the match circle of "
                f"radius {radius:g}",
                where=star_name,
                do="set outliers.match_radius to the radius with which the stars were matched, or "
                "correct the row",
            )

    @property
    def where(self) -> str:
        """Names of the files, for error messages."""
        return ", ".join(self.sources)


def survey(stars: Stars, matches: Matches, every: int) -> Survey:
    """Survey of a chunk of the data; the errors of every `every`-th star are sampled."""
    model = stars.model
    numbers = matches.chip_number
    chips = []
    for chip in model.chips:
        rows = np.flatnonzero(numbers == chip.number) if len(model.chips) > 1 else slice(None)
        x, y = matches.x[rows], matches.y[rows]
        out = (x < 0.5) | (x > chip.size[0] + 0.5) | (y < 0.5) | (y > chip.size[1] + 0.5)
        sentence = ""
        if out.any():
            k = int(np.arange(len(matches))[rows][np.argmax(out)])
            file = f" of {matches.sources[matches.source[k]]}" if len(matches.sources) > 1 else ""
            sentence = (
                f"row {matches.row[k] + 1}{file} lies at pixel ({matches.x[k]:.2f}, "
                f"{matches.y[k]:.2f}), outside the {chip.size[0]:g} x {chip.size[1]:g} detector"
            )
            if bool(((x <= chip.size[1] + 0.5) & (y <= chip.size[0] + 0.5)).all()):
                sentence += " (all rows would lie inside if x and y, or the size, are swapped)"
        a, b = x / chip.size[0], y / chip.size[1]
        sums = np.array([a.sum(), b.sum(), a @ a, a @ b, b @ b])
        chips.append(ChipSurvey(len(x), _hull(np.column_stack([x, y])), sums, sentence))
    return Survey(
        n=len(stars),
        groups=stars.groups,
        # truncated to the exposures of the model, which may be fewer if it has no frames
        exposures=np.bincount(matches.exposure, minlength=len(model.exposures))[
            : len(model.exposures)
        ],
        chips=tuple(chips),
        variance=(stars.var_u[::every].copy(), stars.var_v[::every].copy()),
        sources=matches.sources,
        farthest=_farthest(matches),
    )


def _farthest(matches: Matches) -> tuple[float, str]:
    """Largest distance of a star from its nominal position, and the file and row of the star."""
    if matches.u_nominal is None or matches.v_nominal is None:
        return -1.0, ""
    distance = np.hypot(matches.u - matches.u_nominal, matches.v - matches.v_nominal)
    k = int(np.argmax(distance))
    return float(distance[k]), f"{matches.sources[matches.source[k]]}, row {matches.row[k] + 1}"


def _hull(points: Float) -> Float:
    """Vertices of the convex hull, or all points if it has no area."""
    if len(points) < 4:
        return points
    try:
        if len(points) > 1000:  # drop points inside the octagon of the extremes, for speed
            x, y = points.T
            projections = (x, y, x + y, x - y)
            extreme = points[sorted(set(chain(*((p.argmin(), p.argmax()) for p in projections))))]
            inner = ConvexHull(extreme).equations
            beyond = np.zeros(len(points), bool)
            for a, b, c in inner:
                beyond |= a * x + b * y + c > -1e-9
            points = points[beyond]
        return points[ConvexHull(points).vertices]
    except QhullError:  # nearly collinear: no area
        return points
