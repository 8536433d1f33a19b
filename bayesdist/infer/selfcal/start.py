"""Start of a self-calibration: a known distortion, or none, and exposures that lie on the sky.

A start is good enough when detections of a star come to lie within the first linking length.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from bayesdist.data.matching.frames import MutualFrames
from bayesdist.data.matching.linear_map import LinearMap
from bayesdist.model import Chip, DistortionModel, PolynomialBasis
from bayesdist.utils.arrays import Float, Int

Start = Callable[[Float, Float, int], Float]


def undistorted(chips: Sequence[Chip], pixel: float) -> Start:
    """Start of pixels about each chip's reference pixel: x, y and chip number to positions (N, 2).

    `pixel` is the size of a pixel in the unit of u, v.
    """
    reference = {chip.number: chip.reference_pixel for chip in chips}

    def start(x: Float, y: Float, chip: int) -> Float:
        return pixel * (np.stack([x, y], axis=-1) - reference[chip])

    return start


def chips_side_by_side(
    start: Start, chips: Sequence[Chip], frames: MutualFrames, exposure: Int, number: Int
) -> Start:
    """Start in which the relative positions of the chips are those of their stars.

    `start` is that of each chip alone; `frames` are those of lists, each of one chip of one
    exposure, with exposure and chip number (lists,).  On the plane of the first chip; a chip that
    no exposure has together with the first one stays.
    """
    maps = {}
    for chip in chips[1:]:
        found = []
        for one in np.unique(exposure):
            rows = [
                np.flatnonzero((exposure == one) & (number == n))
                for n in (chips[0].number, chip.number)
            ]
            if all(len(r) for r in rows):
                (a,), (b,) = rows
                back = np.linalg.inv(frames.matrices[a])
                matrix = back @ frames.matrices[b]
                found.append(
                    np.column_stack([matrix, back @ (frames.shifts[b] - frames.shifts[a])])
                )
        if found:
            maps[chip.number] = np.median(found, axis=0)

    def moved(x: Float, y: Float, chip: int) -> Float:
        plane = start(x, y, chip)
        if chip not in maps:
            return plane
        return plane @ maps[chip][:, :2].T + maps[chip][:, 2]

    return moved


def fitted_polynomials(
    start: Start, chips: Sequence[Chip], order: int, onto: LinearMap | None = None
) -> Float:
    """Legendre coefficients (chips, 2, K) of a start, by quadrature over each chip.

    `start` maps x, y and the number of a chip to positions (N, 2), `onto` is applied to these.
    """
    out = []
    for chip in chips:
        x, y, weight = chip.quadrature(4 * (order + 1))
        root = np.sqrt(weight)[:, None]
        basis = PolynomialBasis(order, chip.size, chip.reference_pixel).evaluate(x, y)
        plane = start(x, y, chip.number)
        plane = plane if onto is None else onto(plane)
        out.append(np.linalg.lstsq(root * basis, root * plane, rcond=None)[0].T)
    return np.stack(out)


def start_parameters(
    model: DistortionModel, coefficients: Float, frames: MutualFrames, middles: Float
) -> Float:
    """Parameters (D,) for exposures with the given frames onto the plane of the first exposure.

    The frame is exact at `middles` (E, 2), the middle of each exposure's detections on its own
    plane.
    """
    theta = np.zeros(model.n_params)
    for chip, of_chip in zip(model.chips, coefficients, strict=True):
        for axis in (0, 1):
            theta[model.coefficient_slice(chip.number, axis)] = of_chip[axis]
    o = np.asarray(model.origin)
    for e in range(1, len(model.exposures)):
        names = model.free_frame_names(e)
        angle = frames.rotations[e] if "rotation" in names else 0.0
        c, s = np.cos(angle), np.sin(angle)
        place = frames.matrices[e] @ middles[e] + frames.shifts[e]
        shift = place - o - np.array([[c, -s], [s, c]]) @ (middles[e] - o)
        values = {"shift_u": shift[0], "shift_v": shift[1], "rotation": angle}
        theta[model.frame_slice(e)] = [values.get(name, 0.0) for name in names]
    return theta
