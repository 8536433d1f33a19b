"""Parts of a chip over which an error is judged."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from bayesdist.errors import InputError

__all__ = ["QUADRANTS", "WHOLE", "Region", "check_region", "in_region", "region_words"]

Float = NDArray[np.float64]
Region: TypeAlias = "str | tuple[tuple[float, float], ...]"

WHOLE = "whole"
QUADRANTS = ("lower left", "lower right", "upper left", "upper right")

_INNER = re.compile(r"inner\s+(\d+(?:\.\d*)?)\s*%")


def check_region(region: Region | Sequence[Sequence[float]], where: str) -> Region:
    """A region as it is kept: in a form that can be compared.

    `region`: 'whole'; 'inner 80 %', the rectangle of so much of both sides around the middle of the
    chip; a quadrant: 'lower left', 'lower right', 'upper left', 'upper right'; or the corners of a
    polygon in FITS 1-based pixels. `where`: for the message. InputError for anything else.
    """
    if isinstance(region, str):
        text = " ".join(region.lower().split())
        inner = _INNER.fullmatch(text)
        if text in (WHOLE, *QUADRANTS) or (inner and 0 < float(inner[1]) <= 100):
            return text
        raise InputError(
            f"there is no region {region!r}",
            where=where,
            do=f"name 'whole', 'inner 80 %', {', '.join(map(repr, QUADRANTS))}, or give the "
            "corners of a polygon, [[x, y], ...]",
        )
    corners = tuple(tuple(float(value) for value in corner) for corner in region)
    if len(corners) < 3 or any(len(c) != 2 or not np.isfinite(c).all() for c in corners):
        raise InputError(
            f"a polygon of {len(corners)} corners is no region"
            if len(corners) < 3
            else "a corner of the polygon is not two numbers",
            where=where,
            do="give three or more corners, [[x, y], ...] in pixels",
        )
    return tuple((x, y) for x, y in corners)


def in_region(region: Region, size: tuple[float, float], x: Float, y: Float) -> NDArray[np.bool_]:
    """Boolean mask of the pixels in a region; its edge belongs to rectangles.

    `region`: as `check_region` gives it. `size`: columns and rows of the chip. `x`, `y`: (N,), FITS
    1-based pixels. Returns (N,).
    """
    if not isinstance(region, str):
        return _in_polygon(np.array(region), x, y)
    # from -1 to 1 between the centres of the outermost pixels
    X, Y = (2.0 * (a - 1.0) / (n - 1.0) - 1.0 for a, n in zip((x, y), size, strict=True))
    if region in QUADRANTS:
        upper, right = region.startswith("upper"), region.endswith("right")
        return np.asarray(((Y >= 0) if upper else (Y <= 0)) & ((X >= 0) if right else (X <= 0)))
    inner = _INNER.fullmatch(region)
    half = float(inner[1]) / 100 if inner else 1.0
    return np.asarray(np.maximum(np.abs(X), np.abs(Y)) <= half + 1e-12)


def _in_polygon(corners: Float, x: Float, y: Float) -> NDArray[np.bool_]:
    """Pixels from which a ray to the right crosses an odd number of sides."""
    inside = np.zeros(np.shape(x), bool)
    for (x1, y1), (x2, y2) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if y1 == y2:
            continue
        crossing = x1 + (y - y1) / (y2 - y1) * (x2 - x1)
        inside ^= ((y1 > y) != (y2 > y)) & (x < crossing)
    return inside


def region_words(region: Region) -> str:
    """' over the inner 80 %' and the like; empty for the whole chip."""
    if region == WHOLE:
        return ""
    if isinstance(region, str):
        return f" over the {region}" + (" quadrant" if region in QUADRANTS else "")
    return f" over a polygon of {len(region)} corners"
