"""Statistics of all stars that are needed before any fit, as sums over chunks of the data."""

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

# relative distance by which a star at the edge of its circle may seem to lie outside
ROUNDING = 1e-6


@dataclass(frozen=True, eq=False)
class ChipSurvey:
    """Positions of the stars of one chip."""

    n: int
    # vertices (m, 2) of the convex hull, FITS 1-based pixels; all points where they span no area
    corners: Float
    sums: Float  # (5,) of x, y, x^2, xy, y^2 in units of the chip's size
    outside: str  # sentence on the first star that lies on no pixel; empty where there is none

    def __add__(self, other: ChipSurvey) -> ChipSurvey:
        return ChipSurvey(
            self.n + other.n,
            _hull(np.concatenate([self.corners, other.corners])),
            self.sums + other.sums,
            self.outside or other.outside,
        )


@dataclass(frozen=True, eq=False)
class Survey:
    """Counts and extents of some of the data; surveys of pieces add."""

    n: int
    groups: Groups  # without members
    exposures: Int  # number (E,) of stars of each exposure of the model
    chips: tuple[ChipSurvey, ...]  # in the order of the model's
    variance: tuple[Float, ...]  # evenly spread samples of the squared errors of both axes
    sources: tuple[str, ...]
    # largest distance of a star from its nominal position, and its name; less than 0 without
    # nominal positions
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
        """Median quoted error of one axis: the scale of the priors."""
        return float(np.sqrt(np.median(np.concatenate(self.variance))))

    def check_circle(self, radius: float | None) -> None:
        """Raise InputError for a star outside the circle in which stars were matched.

        `radius` is in the unit of u, v; None without such a circle.  The error names the star that
        is farthest from its nominal position.
        """
        distance, where = self.farthest
        if radius is not None and distance > radius * (1 + ROUNDING):
            raise InputError(
                f"lies {distance:.6g} from its nominal position, outside the match circle of "
                f"radius {radius:g}",
                where=where,
                do="set outliers.match_radius to the radius with which the stars were matched, or "
                "correct the row",
            )

    @property
    def where(self) -> str:
        """Names of the files, for errors."""
        return ", ".join(self.sources)


def survey(stars: Stars, matches: Matches, every: int) -> Survey:
    """Survey of one piece; every n-th star gives its errors to the sample."""
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
        # without frames a model need not have the exposures; the length is that of the model
        exposures=np.bincount(matches.exposure, minlength=len(model.exposures))[
            : len(model.exposures)
        ],
        chips=tuple(chips),
        variance=(stars.var_u[::every].copy(), stars.var_v[::every].copy()),
        sources=matches.sources,
        farthest=_farthest(matches),
    )


def _farthest(matches: Matches) -> tuple[float, str]:
    """Largest distance of a star from its nominal position, and the star's file and row."""
    if matches.u_nominal is None or matches.v_nominal is None:
        return -1.0, ""
    distance = np.hypot(matches.u - matches.u_nominal, matches.v - matches.v_nominal)
    k = int(np.argmax(distance))
    return float(distance[k]), f"{matches.sources[matches.source[k]]}, row {matches.row[k] + 1}"


def _hull(points: Float) -> Float:
    """Vertices of the convex hull, or all points where it has no area."""
    if len(points) < 4:
        return points
    try:
        if len(points) > 1000:  # points inside the octagon of the extremes are no vertices
            x, y = points.T
            seen = (x, y, x + y, x - y)
            extreme = points[sorted(set(chain(*((p.argmin(), p.argmax()) for p in seen))))]
            inner = ConvexHull(extreme).equations
            beyond = np.zeros(len(points), bool)
            for a, b, c in inner:
                beyond |= a * x + b * y + c > -1e-9
            points = points[beyond]
        return points[ConvexHull(points).vertices]
    except QhullError:  # nearly collinear: no area
        return points
