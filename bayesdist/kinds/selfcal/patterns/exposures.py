"""Simulated dithered exposures of a dense field, and dither patterns.

A dither pattern consists of the pointings and roll angles of exposures.  The simulations contain
the pointings and the pixel positions of the stars.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import lcm

import numpy as np
from scipy.spatial.distance import pdist

from bayesdist.model import Chip, DistortionModel
from bayesdist.model.grid import mesh
from bayesdist.utils.arrays import Bool, Float, Int

MOST_STEPS = 30  # maximum number of Newton steps
CLOSE = 1e-9  # pixels: Newton steps below this have converged
EDGE = 9  # points along each side of a chip, to find its extent on the sky
OUTSIDE = 0.1  # of the chip's size: margin around the chip in which stars are searched for
GAP = 50.0  # default gap between chips, pixels
ONE_LINE = 0.02  # pointings with a smaller axis ratio count as lying along one line


def dither_pattern(
    n: int,
    size: tuple[float, float],
    rolls_deg: Sequence[float],
    rng: np.random.Generator,
    *,
    least: float = 5.0,
    largest: float = 0.75,
) -> tuple[Float, Float]:
    """Offsets and roll angles of dithered exposures that sample all spatial scales.

    As in calibration programmes of HST, the logarithms of the offset lengths are uniformly
    distributed, the directions are random, and the roll angles are used cyclically.

    Parameters
    ----------
    n : int
        Number of exposures.
    size : tuple of float
        Columns and rows of the detector.
    rolls_deg : sequence of float
        Roll angles in degrees.
    rng : numpy.random.Generator
    least : float
        Smallest offset in pixels.
    largest : float
        Largest offset, as a fraction of the smaller side of the detector.

    Returns
    -------
    offsets : ndarray, shape (n, 2)
        Offsets in pixels; 0 for the first exposure.
    rolls : ndarray, shape (n,)
        Roll angles relative to the first exposure, in radians.
    """
    length = np.exp(rng.uniform(np.log(least), np.log(largest * min(size)), n))
    angle = rng.uniform(0, 2 * np.pi, n)
    offsets = np.stack([length * np.cos(angle), length * np.sin(angle)], axis=1)
    offsets[0] = 0.0
    rolls = np.radians([rolls_deg[k % len(rolls_deg)] - rolls_deg[0] for k in range(n)])
    return offsets, rolls


def dithered_model(
    chips: Sequence[Chip],
    coefficients: Float,
    offsets: Float,
    rolls: Float,
    *,
    frames: str = "shift_rotation",
) -> tuple[DistortionModel, Float]:
    """Model of dithered exposures, and its true parameters (D,).

    `coefficients` (chips, 2, K) are Legendre coefficients in pixels.  `offsets` and `rolls` are
    those of `dither_pattern`, and `frames` is the frame model.
    """
    order = int((np.sqrt(8 * coefficients.shape[2] + 1) - 3) / 2)
    centre = coefficients[:, :, 0].mean(axis=0)
    model = DistortionModel(
        order,
        tuple(chips),
        frames=frames,
        exposures=tuple(f"e{k:03d}" for k in range(len(offsets))),
        origin=(float(centre[0]), float(centre[1])),
    )
    theta = np.zeros(model.n_params)
    theta[: model.n_polynomial] = coefficients.ravel()
    for e in range(1, len(offsets)):
        names = model.free_frame_names(e)
        values = {"shift_u": offsets[e, 0], "shift_v": offsets[e, 1], "rotation": rolls[e]}
        theta[model.frame_slice(e)] = [values.get(name, 0.0) for name in names]
    return model, theta


def sky_seen(model: DistortionModel, theta: Float) -> tuple[Float, Float]:
    """Lower and upper corner (2,) of the rectangle that contains the corners of all exposures.

    Corners are positions (u, v) in the unit of the model.
    """
    corners = []
    for chip in model.chips:
        right, top = (n + 0.5 for n in chip.size)
        x, y = np.array([0.5, right] * 2), np.array([0.5] * 2 + [top] * 2)
        corners += [
            model.predict(theta, x, y, exposure=e, chip=chip.number)
            for e in range(len(model.exposures))
        ]
    points = np.concatenate(corners)
    return points.min(axis=0), points.max(axis=0)


def stars_on_detector(
    model: DistortionModel, theta: Float, sky: Float
) -> tuple[Float, Float, Int, Int, Int]:
    """Detections of the stars at positions (u, v) `sky` (S, 2) in all exposures.

    Returns
    -------
    x, y : ndarray, shape (N,)
        FITS 1-based pixels of the detections.
    exposure, chip : ndarray of int, shape (N,)
        Exposure codes and chip numbers.
    star : ndarray of int, shape (N,)
        Rows of `sky`.
    """
    columns = []
    for e in range(len(model.exposures)):
        for chip in model.chips:
            around = np.flatnonzero(_within(sky, *_outline(model, theta, e, chip)))
            x, y, on_chip = pixels_of(model, theta, sky[around], e, chip)
            k = around[on_chip]
            columns.append(
                (x[on_chip], y[on_chip], np.full(len(k), e), np.full(len(k), chip.number), k)
            )
    x, y, exposure, number, star = (np.concatenate(part) for part in zip(*columns, strict=True))
    return x, y, exposure, number, star


def _outline(
    model: DistortionModel, theta: Float, exposure: int, chip: Chip
) -> tuple[Float, Float]:
    """Lower and upper corner (2,) of a rectangle on the sky that contains a chip with a margin."""
    x, y = mesh(*(np.linspace(0.5, n + 0.5, EDGE) for n in chip.size))
    points = model.predict(theta, x, y, exposure=exposure, chip=chip.number)
    room = OUTSIDE * np.ptp(points, axis=0)
    return points.min(axis=0) - room, points.max(axis=0) + room


def _within(points: Float, low: Float, high: Float) -> Bool:
    """Boolean mask (N,) that is True for points (N, 2) inside a rectangle."""
    return np.all((points > low) & (points < high), axis=1)


def pixels_of(
    model: DistortionModel, theta: Float, sky: Float, exposure: int, chip: Chip
) -> tuple[Float, Float, Bool]:
    """Pixels x, y (S,) of stars on a chip, by Newton's method, and a mask (S,).

    `sky` (S, 2) are positions u, v.  The mask is True for stars that fall on the chip; the pixels
    of all other stars are meaningless.
    """
    basis = model.basis(chip.number)
    groups = model.groups(1, exposure=exposure, chip=chip.number)
    E = model.effective(theta, groups)[0]
    nx, ny = chip.size
    x, y = np.full(len(sky), (nx + 1) / 2), np.full(len(sky), (ny + 1) / 2)
    near = np.ones(len(sky), bool)
    for _ in range(MOST_STEPS):
        values = basis.evaluate(x[near], y[near])
        by_x, by_y = (values @ d @ E.T for d in basis.derivatives)
        miss = sky[near] - values @ E.T
        det = by_x[:, 0] * by_y[:, 1] - by_y[:, 0] * by_x[:, 1]
        dx = (by_y[:, 1] * miss[:, 0] - by_y[:, 0] * miss[:, 1]) / det
        dy = (by_x[:, 0] * miss[:, 1] - by_x[:, 1] * miss[:, 0]) / det
        x[near] += dx
        y[near] += dy
        # a polynomial is meaningless far from the detector
        inside = (np.abs(x[near] - nx / 2) < (0.5 + OUTSIDE) * nx) & (
            np.abs(y[near] - ny / 2) < (0.5 + OUTSIDE) * ny
        )
        near[near] = inside
        if not inside.any() or max(np.abs(dx[inside]).max(), np.abs(dy[inside]).max()) < CLOSE:
            break
    on_chip = near & (x > 0.5) & (x < nx + 0.5) & (y > 0.5) & (y < ny + 0.5)
    return x, y, on_chip


@dataclass(frozen=True, eq=False)
class DitherPattern:
    """Pointings and roll angles of exposures, relative to the first one."""

    name: str
    offsets: Float  # (E, 2), of the detector centre, pixels along the axes of the first exposure
    rolls: Float  # (E,), radians

    def __len__(self) -> int:
        return len(self.offsets)

    @cached_property
    def reach(self) -> float:
        """Largest distance between two pointings, in pixels."""
        return float(pdist(self.offsets).max(initial=0.0))

    @property
    def along_one_line(self) -> bool:
        """True if the pointings differ only along one line."""
        spread = np.linalg.svd(self.offsets - self.offsets.mean(axis=0), compute_uv=False)
        return bool(spread[0] > 0 and spread[1:].max(initial=0.0) < ONE_LINE * spread[0])


def grid_offsets(n: tuple[int, int], step: tuple[float, float]) -> Float:
    """Offsets (n_x n_y, 2) of a regular grid in pixels, row by row, starting at zero.

    `n` has the numbers of columns and rows, and `step` the distances in pixels along both axes.
    """
    return np.stack(
        mesh(np.arange(n[0], dtype=float) * step[0], np.arange(n[1], dtype=float) * step[1]), axis=1
    )


def rolls_in_turn(n: int, n_offsets: int, rolls: Sequence[float]) -> Float:
    """Roll angles (n,) of exposures such that every offset is combined with each of the `rolls`.

    The offsets repeat after `n_offsets` exposures; the roll angles are used cyclically.
    """
    k = np.arange(n)
    # when the combinations would start to repeat, the roll angles are advanced by one
    return np.asarray(rolls, float)[(k + k // lcm(n_offsets, len(rolls))) % len(rolls)]


def flat_coefficients(
    order: int, chips: Sequence[Chip], places: Sequence[tuple[float, float]] | None = None
) -> Float:
    """Legendre coefficients (chips, 2, K) of chips without distortion.

    `places` are the positions (u, v) of the chips' reference pixels, in pixels.  By default the
    chips are stacked upwards, beginning with the first, with gaps of `GAP` pixels.
    """
    model = DistortionModel(order, tuple(chips))
    out, above = np.zeros((len(chips), 2, model.n_terms)), 0.0
    for c, chip in enumerate(chips):
        monomials = np.zeros((2, model.n_terms))
        monomials[0, 1] = monomials[1, 2] = 1.0
        monomials[:, 0] = (0.0, above) if places is None else places[c]
        out[c] = model.basis(chip.number).from_monomials(monomials)
        above += chip.size[1] + GAP
    return out
