"""The test of ACS ISR 2015-06, section 6: two exposures of the run laid on each other.

Corrected positions of the same stars differ by a shift, a rotation and a scale if the calibration
is right, and by a pattern if it is not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from bayesdist.calibration.calibration import Calibration
from bayesdist.data import Matches
from bayesdist.diagnose.residuals.binned import BinnedResiduals, binned_residuals
from bayesdist.infer.solution.solution import Solution
from bayesdist.infer.solution.transforms import without_frames
from bayesdist.model import LookupTable, corrected
from bayesdist.utils.arrays import Float, Int

MIN_OVERLAP = 0.5  # of the stars of the exposure that has fewer: what "overlap well" means
MIN_SHARED_STARS = 100  # shared stars below which there is no map to be drawn
STARS_PER_CELL = 12  # stars in a cell, on average
MAX_CELLS = 24  # along an axis


@dataclass(frozen=True, eq=False)
class Alignment:
    """The similarity a = shift + scale R(rotation) b between two exposures, and what it leaves."""

    shift: Float  # (2,), pixels
    rotation: float  # radians, from xi to eta
    scale: float
    position: Float  # (N, 2), (xi, eta) of the stars in exposure a, pixels
    residual: Float  # (N, 2), a minus the transformed b, pixels

    @property
    def rms(self) -> Float:
        """Root mean square residual of each axis, shape (2,), pixels."""
        return np.sqrt(np.mean(self.residual**2, axis=0))


def align(position_a: Float, position_b: Float) -> Alignment:
    """Fit of shift, rotation and scale between positions (N, 2) of the same stars, in pixels.

    Every star counts alike and none is clipped: the fit is that of `tweakwcs.fit_rscale`.
    """
    a, b = position_a @ [1, 1j], position_b @ [1, 1j]
    za, zb = a - a.mean(), b - b.mean()
    turn = complex(np.vdot(zb, za) / np.vdot(zb, zb))
    shift = complex(a.mean() - turn * b.mean())
    residual = a - shift - turn * b
    return Alignment(
        shift=np.array([shift.real, shift.imag]),
        rotation=float(np.angle(turn)),
        scale=abs(turn),
        position=position_a,
        residual=np.stack([residual.real, residual.imag], axis=1),
    )


@dataclass(frozen=True, eq=False)
class OverlapTest:
    """Two exposures of the run laid on each other, through the old files and the new ones."""

    names: tuple[str, str]
    epochs: tuple[float, float]
    pa_v3: tuple[float, float]  # NaN where it is not known
    # old, new: of the same stars: through the known distortion of the start, and through the
    # solution
    old: Alignment
    new: Alignment
    # binned_old, binned_new: over the area that both exposures see; axes (xi, eta), pixels
    binned_old: BinnedResiduals
    binned_new: BinnedResiduals
    # (xi, eta) of the area's corner, which the cells count from, pixels
    corner: tuple[float, float]
    pixel_mas: float
    # True where the catalogue's proper motions between the two epochs were taken out
    with_motions: bool

    @property
    def n_stars(self) -> int:
        """Stars that both exposures have."""
        return len(self.new.residual)


def overlap_test(
    pairs: Matches,
    solution: Solution,
    known: Calibration,
    tables: Sequence[LookupTable],
    *,
    unit_arcsec: float,
    pixel: float,
    rolls: Mapping[str, float | None],
) -> OverlapTest | None:
    """Lay the two exposures that are farthest apart in time on each other.

    `pairs` have raw pixels beside positions of the catalogue, `known` is the distortion of the
    start, `tables` go with the solution, `unit_arcsec` is the size of the unit of u and v, `pixel`
    that of a pixel in arcsec, `rolls` the PA_V3 of exposures where it is known. None where no two
    exposures share enough stars.
    """
    chosen = chosen_exposures(pairs)
    if chosen is None:
        return None
    shared = _shared(pairs, *chosen)
    epochs = tuple(float(np.median(pairs.column("epoch")[rows])) for rows in shared)
    planes = [
        (
            _known_plane(known, pairs, rows, epoch),
            _solved_plane(solution, tables, pairs, rows, epoch) * unit_arcsec,
        )
        for rows, epoch in zip(shared, epochs, strict=True)
    ]
    motion = np.column_stack(
        [column[shared[1]] - column[shared[0]] for column in (pairs.u, pairs.v)]
    )
    later = [_at_first_epoch(b, pairs, shared[1], motion) for b in planes[1]]
    old, new = (
        align(_centred(a) / pixel, _centred(b) / pixel)
        for a, b in zip(planes[0], later, strict=True)
    )
    corner, binned_old, binned_new = _binned(old, new)
    names = tuple(pairs.exposure_names[code] for code in chosen)
    pa_v3 = tuple(np.nan if (r := rolls[name]) is None else r for name in names)
    return OverlapTest(
        names=(names[0], names[1]),
        epochs=(epochs[0], epochs[1]),
        pa_v3=(float(pa_v3[0]), float(pa_v3[1])),
        old=old,
        new=new,
        binned_old=binned_old,
        binned_new=binned_new,
        corner=corner,
        pixel_mas=1000 * pixel,
        with_motions=bool(np.abs(motion).max() > 0),
    )


def chosen_exposures(pairs: Matches) -> tuple[int, int] | None:
    """Codes of the two exposures farthest apart in time that share half of their stars.

    `pairs` have codes of the catalogue's stars, and epochs. The earlier exposure comes first; None
    where no two share enough.
    """
    if pairs.star is None or pairs.epoch is None:
        return None
    n = len(pairs.exposure_names)
    ones = np.ones(len(pairs))
    seen = csr_array((ones, (pairs.exposure, pairs.star)), shape=(n, int(pairs.star.max()) + 1))
    common = (seen @ seen.T).toarray()
    own = np.diag(common)
    epoch = np.bincount(pairs.exposure, pairs.epoch, n) / np.maximum(own, 1)
    enough = (common >= MIN_OVERLAP * np.minimum.outer(own, own)) & (common >= MIN_SHARED_STARS)
    apart = np.where(enough, np.abs(np.subtract.outer(epoch, epoch)), -1.0)
    a, b = (int(k) for k in np.unravel_index(int(apart.argmax()), apart.shape))
    if a == b or apart[a, b] <= 0:
        return None
    return (a, b) if epoch[a] < epoch[b] else (b, a)


def _shared(pairs: Matches, a: int, b: int) -> tuple[Int, Int]:
    """Rows of the same stars in two exposures."""
    star = pairs.column("star")
    of_a, of_b = (np.flatnonzero(pairs.exposure == code) for code in (a, b))
    _, first, second = np.intersect1d(star[of_a], star[of_b], return_indices=True)
    return of_a[first], of_b[second]


def _known_plane(known: Calibration, pairs: Matches, rows: Int, epoch: float) -> Float:
    """Positions (N, 2) through the known distortion, its drift included; arcseconds."""
    then = None if known.no_date else epoch
    chips = pairs.chip_number[rows]
    out = np.empty((len(rows), 2))
    for number in np.unique(chips):
        here = chips == number
        x, y = pairs.x[rows[here]], pairs.y[rows[here]]
        out[here] = known.forward(x, y, chip=int(number), epoch=then)
    return out


def _solved_plane(
    solution: Solution, tables: Sequence[LookupTable], pairs: Matches, rows: Int, epoch: float
) -> Float:
    """Positions (N, 2) through tables, polynomial and drift of a solution, in its unit.

    Without what is fitted for the single exposure: no file holds that.
    """
    chips = pairs.chip_number[rows]
    filters = np.asarray(pairs.filter_names)[pairs.filter[rows]]
    x, y = corrected(tables, pairs.x[rows], pairs.y[rows], chip=chips, filter=filters)
    view = without_frames(solution)
    then = None if view.model.time is None else epoch
    return np.asarray(view.model.predict(view.mean, x, y, chip=chips, epoch=then))


def _at_first_epoch(plane: Float, pairs: Matches, rows: Int, motion: Float) -> Float:
    """Positions with the catalogue's motions since the other epoch taken out.

    The catalogue is turned and scaled to the plane: pairs of one exposure say how.
    """
    w = plane @ [1, 1j]
    z = pairs.u[rows] + 1j * pairs.v[rows]
    zc = z - z.mean()
    turn = np.vdot(zc, w - w.mean()) / np.vdot(zc, zc)
    step = turn * (motion @ [1, 1j])
    return plane - np.column_stack([step.real, step.imag])


def _centred(plane: Float) -> Float:
    """Positions (N, 2) about their mean."""
    return plane - plane.mean(axis=0)


def _binned(
    old: Alignment, new: Alignment
) -> tuple[tuple[float, float], BinnedResiduals, BinnedResiduals]:
    """Residuals in square cells over the area that both exposures see."""
    corner = new.position.min(axis=0)
    width, height = np.ptp(new.position, axis=0) + 1e-6
    cell = np.sqrt(width * height * STARS_PER_CELL / len(new.position))
    cell = max(cell, max(width, height) / MAX_CELLS)
    bins = (max(1, round(width / cell)), max(1, round(height / cell)))
    # cells count from 0.5, as pixels do
    x, y = (new.position - corner + 0.5).T
    binned = [
        binned_residuals(x, y, *one.residual.T, bins=bins, size=(float(width), float(height)))
        for one in (old, new)
    ]
    return (float(corner[0]), float(corner[1])), binned[0], binned[1]
