"""Numbers of a whole detector: scales, angle of the axes, areas, the largest displacement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.missions.acs.handbook.whole_detector import WholeDetector
from bayesdist.model.grid import mesh

__all__ = ["DetectorNumbers", "detector_numbers"]

# Points on each axis of a chip where extremes are looked for: they lie at edges and in corners.
_GRID = 129


@dataclass(frozen=True)
class DetectorNumbers:
    """Numbers of a detector that section 4.1 of the ACS handbook gives."""

    non_linear_max: float  # largest non-linear displacement, output pixels
    non_linear_at: tuple[float, float]  # where, pixels of the detector as one array
    scale_x: float  # size of a pixel along the detector's axes at its centre
    scale_y: float
    mean_scale_x: float  # the same, mean over all pixels
    mean_scale_y: float
    scale_range: float  # largest size of a pixel (root of its area) over the smallest, less 1
    angle: float  # between the detector's axes at its centre, degrees
    # largest over smallest size of a pixel in any direction at the centre, less 1
    elongation: float
    area_min: float  # pixel area over that at the centre
    area_max: float
    # length of the array along its axes, gaps included: mean scales times pixels
    size: tuple[float, float]


def detector_numbers(detector: WholeDetector) -> DetectorNumbers:
    """Numbers of any detector as section 4.1 of the ACS handbook gives them."""
    best, where = -1.0, (0.0, 0.0)
    low, high = np.inf, 0.0
    scales, pixels = np.zeros(2), 0.0
    for n, c in detector.chips.items():
        x, y = (np.linspace(1.0, size, _GRID) for size in c.basis.size)
        field = detector.non_linear(n, x, y)
        iy, ix = np.unravel_index(int(field.length.argmax()), field.length.shape)
        if field.length[iy, ix] > best:
            best, where = float(field.length[iy, ix]), (float(field.x[ix]), float(field.y[iy]))
        area = detector.relative_area(n, x, y)
        low, high = min(low, float(area.min())), max(high, float(area.max()))
        slopes = c.slope(*mesh(x, y))
        weight = c.basis.size[0] * c.basis.size[1]
        scales += weight * np.hypot(slopes[:, 0], slopes[:, 1]).mean(axis=0)
        pixels += weight
    L = detector.central_slope
    axes = L[0] + 1j * L[1]
    stretch = np.linalg.svd(L, compute_uv=False)
    mean = scales / pixels
    extent = detector.bounds[1] - detector.bounds[0]
    return DetectorNumbers(
        non_linear_max=best,
        non_linear_at=where,
        scale_x=float(abs(axes[0])),
        scale_y=float(abs(axes[1])),
        mean_scale_x=float(mean[0]),
        mean_scale_y=float(mean[1]),
        scale_range=float(np.sqrt(high / low) - 1.0),
        angle=float(abs(np.degrees(np.angle(axes[1] / axes[0])))),
        elongation=float(stretch[0] / stretch[1] - 1.0),
        area_min=low,
        area_max=high,
        size=(float(mean[0] * extent[0]), float(mean[1] * extent[1])),
    )
