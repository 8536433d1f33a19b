"""The test of Kozhurina-Platais et al. (2015), section 6: alignment of two exposures of the run.

Corrected positions of the same stars differ by a shift, a rotation and a scale if the calibration
is correct, and by a pattern if it is not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.plane import ARCSEC
from bayesdist.data import Matches
from bayesdist.diagnose.residuals.binned import BinnedResiduals, binned_residuals
from bayesdist.infer.solution.solution import Solution
from bayesdist.infer.solution.transforms import without_frames
from bayesdist.model import LookupTable, corrected
from bayesdist.utils.arrays import Float, Int

MIN_OVERLAP = 0.5  # smallest fraction of the stars of the exposure with fewer stars that both share
MIN_SHARED_STARS = 100  # smallest number of shared stars for a map
STARS_PER_CELL = 12  # average number per cell
MAX_CELLS = 24  # along each axis


@dataclass(frozen=True, eq=False)
class ExposureAlignment:
    """Similarity transformation between two exposures, and its residuals.

    The transformation is a = shift + scale R(rotation) b.
    """

    shift: Float  # (2,) pixels
    rotation: float  # radians, from xi to eta
    scale: float
    position: Float  # (N, 2) positions (xi, eta) of the stars in exposure a, pixels
    residual: Float  # (N, 2) a minus the transformed b, pixels

    @property
    def rms(self) -> Float:
        """Root mean square residual per axis, shape (2,), pixels."""
        return np.sqrt(np.mean(self.residual**2, axis=0))


def align(position_a: Float, position_b: Float) -> ExposureAlignment:
    """Fit shift, rotation and scale between positions (N, 2) of the same stars, in pixels.

    All stars have equal weight and none is clipped, as in `tweakwcs.fit_rscale`.
    """
    a, b = position_a @ [1, 1j], position_b @ [1, 1j]
    za, zb = a - a.mean(), b - b.mean()
    turn = complex(np.vdot(zb, za) / np.vdot(zb, zb))
    shift = complex(a.mean() - turn * b.mean())
    residual = a - shift - turn * b
    return ExposureAlignment(
        shift=np.array([shift.real, shift.imag]),
        rotation=float(np.angle(turn)),
        scale=abs(turn),
        position=position_a,
        residual=np.stack([residual.real, residual.imag], axis=1),
    )


@dataclass(frozen=True, eq=False)
class OverlapTest:
    """Alignment of two exposures of the run, with the old files and with the new ones."""

    names: tuple[str, str]
    epochs: tuple[float, float]
    pa_v3: tuple[float, float]  # roll angles in degrees; NaN if unknown
    # old, new: alignment of the same stars with the distortion that the run started from, and with
    # the solution
    old: ExposureAlignment
    new: ExposureAlignment
    # binned_old, binned_new: over the common area of both exposures; axes (xi, eta), pixels
    binned_old: BinnedResiduals
    binned_new: BinnedResiduals
    # (xi, eta) of the corner of the area, from which the cells are counted, pixels
    corner: tuple[float, float]
    pixel_mas: float
    # True if the catalogue's proper motions between the two epochs were subtracted
    with_motions: bool

    @property
    def n_stars(self) -> int:
        """Number of stars in both exposures."""
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
    """Align the two exposures that are farthest apart in time.

    Parameters
    ----------
    pairs : Matches
        Raw pixels and positions of the catalogue.
    solution : Solution
        The solution to test.
    known : Calibration
        Distortion that the run started from.
    tables : sequence of LookupTable
        Look-up tables that belong to the solution.
    unit_arcsec : float
        Size of the unit of u and v in arcsec.
    pixel : float
        Size of a pixel in arcsec.
    rolls : mapping
        PA_V3 by the name of the exposure; None if it is unknown.

    Returns
    -------
    OverlapTest or None
        None if no two exposures share enough stars.
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

    `pairs` must have star codes and epochs.  The earlier exposure comes first.  Returns None if no
    two exposures share enough stars.
    """
    if pairs.star is None or pairs.epoch is None:
        return None
    n = len(pairs.exposure_names)
    ones = np.ones(len(pairs))
    incidence = csr_array(
        (ones, (pairs.exposure, pairs.star)), shape=(n, int(pairs.star.max()) + 1)
    )
    common = (incidence @ incidence.T).toarray()
    n_stars = np.diag(common)
    epoch = np.bincount(pairs.exposure, pairs.epoch, n) / np.maximum(n_stars, 1)
    enough = (common >= MIN_OVERLAP * np.minimum.outer(n_stars, n_stars)) & (
        common >= MIN_SHARED_STARS
    )
    apart = np.where(enough, np.abs(np.subtract.outer(epoch, epoch)), -1.0)
    a, b = (int(k) for k in np.unravel_index(int(apart.argmax()), apart.shape))
    if a == b or apart[a, b] <= 0:
        return None
    return (a, b) if epoch[a] < epoch[b] else (b, a)


def _shared(pairs: Matches, a: int, b: int) -> tuple[Int, Int]:
    """Indices of the rows of the same stars in two exposures."""
    star = pairs.column("star")
    of_a, of_b = (np.flatnonzero(pairs.exposure == code) for code in (a, b))
    _, first, second = np.intersect1d(star[of_a], star[of_b], return_indices=True)
    return of_a[first], of_b[second]


def _known_plane(known: Calibration, pairs: Matches, rows: Int, epoch: float) -> Float:
    """Positions (N, 2) according to the known distortion, including its drift; arcseconds."""
    then = None if known.no_date else epoch
    chips = pairs.chip_number[rows]
    out = np.empty((len(rows), 2))
    for number in np.unique(chips):
        on_chip = chips == number
        x, y = pairs.x[rows[on_chip]], pairs.y[rows[on_chip]]
        out[on_chip] = known.forward(x, y, chip=int(number), epoch=then)
    return out * ARCSEC[known.unit]


def _solved_plane(
    solution: Solution, tables: Sequence[LookupTable], pairs: Matches, rows: Int, epoch: float
) -> Float:
    """Positions (N, 2) according to tables, polynomial and drift of a solution, in its unit.

    Fitted terms of the single exposure are not included, because no file contains them.
    """
    chips = pairs.chip_number[rows]
    filters = np.asarray(pairs.filter_names)[pairs.filter[rows]]
    x, y = corrected(tables, pairs.x[rows], pairs.y[rows], chip=chips, filter=filters)
    view = without_frames(solution)
    then = None if view.model.time is None else epoch
    return np.asarray(view.model.predict(view.mean, x, y, chip=chips, epoch=then))


def _at_first_epoch(plane: Float, pairs: Matches, rows: Int, motion: Float) -> Float:
    """Positions with the catalogue's motions since the other epoch subtracted.

    The motions are rotated and scaled to the plane by aligning the catalogue with the exposure.
    """
    w = plane @ [1, 1j]
    z = pairs.u[rows] + 1j * pairs.v[rows]
    zc = z - z.mean()
    turn = np.vdot(zc, w - w.mean()) / np.vdot(zc, zc)
    step = turn * (motion @ [1, 1j])
    return plane - np.column_stack([step.real, step.imag])


def _centred(plane: Float) -> Float:
    """Positions (N, 2) minus their mean."""
    return plane - plane.mean(axis=0)


def _binned(
    old: ExposureAlignment, new: ExposureAlignment
) -> tuple[tuple[float, float], BinnedResiduals, BinnedResiduals]:
    """Residuals in square cells over the common area of both exposures."""
    corner = new.position.min(axis=0)
    width, height = np.ptp(new.position, axis=0) + 1e-6
    cell = np.sqrt(width * height * STARS_PER_CELL / len(new.position))
    cell = max(cell, max(width, height) / MAX_CELLS)
    bins = (max(1, round(width / cell)), max(1, round(height / cell)))
    # cells are counted from 0.5, like pixels
    x, y = (new.position - corner + 0.5).T
    binned = [
        binned_residuals(x, y, *alignment.residual.T, bins=bins, size=(float(width), float(height)))
        for alignment in (old, new)
    ]
    return (float(corner[0]), float(corner[1])), binned[0], binned[1]
