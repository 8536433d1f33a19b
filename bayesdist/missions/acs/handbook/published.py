"""Numbers of section 4.1 of the ACS handbook for each detector, beside those of a calibration.

Its Table 4.1 is not here: only what its text says.
"""

from __future__ import annotations

from typing import Any

from bayesdist.errors import InputError
from bayesdist.missions.acs.handbook.numbers import DetectorNumbers

__all__ = ["acs_detector", "handbook_rows"]

# detector: quantity: as printed
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

# what is printed in arcseconds
_ANGLES = ("non-linear arcsec", "size x", "size y", "output scale")


def acs_detector(name: str) -> str:
    """Name of a detector of ACS in capitals; any other is refused."""
    found = name.strip().upper()
    if found not in _PUBLISHED:
        raise InputError(
            f"ACS has no detector {name!r}",
            where="detector",
            do=f"choose one of {', '.join(_PUBLISHED)}",
        )
    return found


def handbook_rows(
    numbers: DetectorNumbers, *, scale: float, unit: str, detector: str = ""
) -> list[dict[str, Any]]:
    """Rows of the table: quantity, unit, published, ours.

    `scale`: size of an output pixel, in `unit`. `unit`: of the undistorted plane. `detector`: WFC,
    HRC or SBC of ACS; of others nothing is printed. Returns keys quantity, unit, published (text,
    empty where the handbook has nothing), value.
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
    known = _PUBLISHED.get(detector.strip().upper(), {})
    if unit != "arcsec":
        known = {key: text for key, text in known.items() if key not in _ANGLES}
    return [
        {"quantity": what, "unit": of, "published": known.get(key, ""), "value": float(value)}
        for key, what, of, value in listed
    ]
