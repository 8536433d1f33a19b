"""Starting parameters of a self-calibration: an approximate distortion, and exposure frames.

They are accurate enough if the detections of a star are within the first linking length of each
other on the sky.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from bayesdist.data.matching.field import MutualFrames
from bayesdist.data.matching.pairs import LinearMap
from bayesdist.model import Chip, DistortionModel, PolynomialBasis
from bayesdist.utils.arrays import Float, Int

Start = Callable[[Float, Float, int], Float]


def undistorted(chips: Sequence[Chip], pixel: float) -> Start:
    """Start without distortion: positions are pixel offsets from the chip's reference pixel.

    Returns a function of x, y (N,) and a chip number that returns positions (N, 2).  `pixel` is the
    size of a pixel in the unit of u, v.
    """
    reference = {chip.number: chip.reference_pixel for chip in chips}

    def start(x: Float, y: Float, chip: int) -> Float:
        return pixel * (np.stack([x, y], axis=-1) - reference[chip])

    return start


def chips_side_by_side(
    start: Start, chips: Sequence[Chip], frames: MutualFrames, exposure: Int, number: Int
) -> Start:
    """Start with relative positions of the chips that were derived from their stars.

    `start` is the start of each chip by itself.  `frames` are the frames of lists of detections,
    each of one chip in one exposure; `exposure` and `number` (lists,) are the exposure and the chip
    number of each list.  Positions are on the plane of the first chip.  A chip that is never
    observed together with the first chip is unchanged.
    """
    maps = {}
    for chip in chips[1:]:
        relative = []
        for code in np.unique(exposure):
            rows = [
                np.flatnonzero((exposure == code) & (number == n))
                for n in (chips[0].number, chip.number)
            ]
            if all(len(r) for r in rows):
                (a,), (b,) = rows
                back = np.linalg.inv(frames.matrices[a])
                matrix = back @ frames.matrices[b]
                relative.append(
                    np.column_stack([matrix, back @ (frames.shifts[b] - frames.shifts[a])])
                )
        if relative:
            maps[chip.number] = np.median(relative, axis=0)

    def moved(x: Float, y: Float, chip: int) -> Float:
        plane = start(x, y, chip)
        if chip not in maps:
            return plane
        return plane @ maps[chip][:, :2].T + maps[chip][:, 2]

    return moved


def fitted_polynomials(
    start: Start, chips: Sequence[Chip], order: int, onto: LinearMap | None = None
) -> Float:
    """Legendre coefficients (chips, 2, K) that approximate a start, by quadrature over each chip.

    `start` is a function of x, y and a chip number that returns positions (N, 2).  If the map
    `onto` is given, it is applied to these positions.
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
    """Parameters (D,) from polynomials and the frames of the exposures relative to the first one.

    Frames of the model may be simpler than the given ones; they agree at `middles` (E, 2), the
    centre of the detections of each exposure on the plane of that exposure.
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
