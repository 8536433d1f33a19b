"""Numbers of section 4.1 of the ACS handbook for a whole detector, with the published values.

Only numbers in the text of the section are included, not its Table 4.1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypedDict

import numpy as np

from bayesdist.errors import InputError
from bayesdist.missions.hst.handbook.whole_detector import WholeDetector
from bayesdist.model.grid import mesh

# points per axis of the grid on which extremes are searched for; they occur at edges and corners
_GRID = 129


@dataclass(frozen=True)
class DetectorNumbers:
    """Quantities of a detector that are given in section 4.1 of the ACS handbook."""

    non_linear_max: float  # largest non-linear displacement, output pixels
    non_linear_at: tuple[float, float]  # its position, pixels of the detector as one array
    scale_x: float  # pixel scale along the detector's x axis at its centre
    scale_y: float  # pixel scale along the y axis
    mean_scale_x: float  # mean over all pixels of the scale along x
    mean_scale_y: float  # mean over all pixels of the scale along y
    scale_range: float  # ratio of the largest to the smallest scale (root of the area), minus 1
    angle: float  # between the detector's axes at its centre, degrees
    elongation: float  # ratio of the largest to the smallest scale at the centre, minus 1
    area_min: float  # smallest pixel area relative to that at the centre
    area_max: float  # largest pixel area relative to that at the centre
    size: tuple[float, float]  # length of the array along x and y: mean scale times pixels


def detector_numbers(detector: WholeDetector) -> DetectorNumbers:
    """Compute the quantities of section 4.1 of the ACS handbook for any detector."""
    best, position = -1.0, (0.0, 0.0)
    low, high = np.inf, 0.0
    scales, pixels = np.zeros(2), 0.0
    for n, c in detector.chips.items():
        x, y = (np.linspace(1.0, size, _GRID) for size in c.basis.size)
        field = detector.non_linear(n, x, y)
        iy, ix = np.unravel_index(int(field.length.argmax()), field.length.shape)
        if field.length[iy, ix] > best:
            best, position = float(field.length[iy, ix]), (float(field.x[ix]), float(field.y[iy]))
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
        non_linear_at=position,
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


# published values by detector and quantity, as printed
_PUBLISHED: dict[str, dict[str, str]] = {
    "WFC": {
        "non-linear": "82",
        "non-linear arcsec": "about 4",
        "angle": "about 85",
        "elongation": "8",
        "area min": "0.89",
        "area max": "1.08",
        "output scale": "0.05",
    },
    "HRC": {
        "non-linear": "4.9",
        "non-linear arcsec": "about 0.1",
        "angle": "about 85",
        "axes": "about 14",
        "scale range": "about 1",
        "area deviation": "just over 2",
        "size x": "29",
        "size y": "25",
        "output scale": "0.025",
    },
    "SBC": {
        "angle": "about 85",
        "size x": "35",
        "size y": "30",
        "output scale": "0.025",
    },
}

# quantities that are published in arcseconds
_ANGLES = ("non-linear arcsec", "size x", "size y", "output scale")


def acs_detector(name: str) -> str:
    """Name of an ACS detector in capitals; raises InputError for any other name."""
    key = name.strip().upper()
    if key not in _PUBLISHED:
        raise InputError(
            f"ACS has no detector {name!r}",
            where="detector",
            do=f"choose one of {', '.join(_PUBLISHED)}",
        )
    return key


class HandbookRow(TypedDict):
    """Row of the table that compares a detector with the published values."""

    quantity: str
    unit: str
    published: str  # text as printed, or empty
    value: float


def handbook_rows(
    numbers: DetectorNumbers, *, scale: float, unit: str, detector: str = ""
) -> list[HandbookRow]:
    """Rows of the table that compares a detector with the published values.

    Parameters
    ----------
    numbers : DetectorNumbers
    scale : float
        Size of an output pixel in `unit`.
    unit : str
        Unit of the undistorted plane.
    detector : str
        WFC, HRC or SBC of ACS; for other detectors there are no published values.

    Returns
    -------
    list of HandbookRow
        Rows in the order of the handbook.
    """
    n = numbers
    angle = unit if unit != "pix" else "pix of u, v"
    scales = f"{angle}/pix"
    deviation = 100 * max(1 - n.area_min, n.area_max - 1)
    axes = 100 * (max(n.scale_x, n.scale_y) / min(n.scale_x, n.scale_y) - 1)
    listed = [
        ("non-linear", "largest non-linear displacement", "output pix", n.non_linear_max),
        (f"non-linear {unit}", f"the same in {angle}", angle, n.non_linear_max * scale),
        ("", "where: x", "pix", n.non_linear_at[0]),
        ("", "where: y", "pix", n.non_linear_at[1]),
        ("angle", "angle between the axes at the centre", "deg", n.angle),
        ("elongation", "elongation at the centre", "%", 100 * n.elongation),
        ("", "scale along x at the centre", scales, n.scale_x),
        ("", "scale along y at the centre", scales, n.scale_y),
        ("axes", "difference of these scales", "%", axes),
        ("", "mean scale along x", scales, n.mean_scale_x),
        ("", "mean scale along y", scales, n.mean_scale_y),
        ("scale range", "range of the scale, root of area", "%", 100 * n.scale_range),
        ("area min", "smallest pixel area, centre 1", "", n.area_min),
        ("area max", "largest pixel area, centre 1", "", n.area_max),
        ("area deviation", "largest deviation of the area", "%", deviation),
        ("size x", "length along x", angle, n.size[0]),
        ("size y", "length along y", angle, n.size[1]),
        ("output scale", "size of an output pixel", angle, scale),
    ]
    published = _PUBLISHED.get(detector.strip().upper(), {})
    if unit != "arcsec":
        published = {key: text for key, text in published.items() if key not in _ANGLES}
    return [
        {
            "quantity": quantity,
            "unit": row_unit,
            "published": published.get(key, ""),
            "value": float(value),
        }
        for key, quantity, row_unit, value in listed
    ]
