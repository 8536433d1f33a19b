"""Calibrations that cannot be of a detector, whatever file they were read from."""

from __future__ import annotations

import numpy as np

from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.chip_map import ChipMap
from bayesdist.errors import FormatError, InputError
from bayesdist.utils.arrays import Float

MOST_PIXELS = 1e6  # columns or rows of a chip
FAR = 1e7  # pixels from the chip to its reference pixel
BEND = 10.0  # sizes of the chip by which positions may be off the linear terms
ROUNDING = 1e-3  # of covariances in text
OFF = 1e3  # factor between a stated scale and the size of a pixel


def refuse_senseless(found: Calibration) -> None:
    """Refuse sizes, scales and coefficients that no detector can have."""
    do = "correct the file, or fetch it again"
    for cause in _faults(found):
        raise FormatError(cause, where=found.name, do=do)


def _faults(found: Calibration) -> list[str]:
    for chip in found.model.chips:
        if not all(1 < n <= MOST_PIXELS for n in chip.size):
            return [f"chip {chip.number} has {chip.size[0]:g} x {chip.size[1]:g} pixels"]
        if not np.abs(chip.reference_pixel).max() <= FAR:
            x, y = chip.reference_pixel
            return [f"chip {chip.number} has its reference pixel at ({x:g}, {y:g})"]
    if not np.isfinite(found.solution.mean).all():
        return ["some coefficients are not finite"]
    if not np.isfinite(found.solution.cov).all():
        return ["some errors of coefficients are not finite"]
    if not _is_covariance(found.solution.cov):
        return ["the covariance of its coefficients is none: a correlation lies beyond 1"]
    if any(not np.isfinite(table.values).all() for table in (*found.before, *found.after)):
        return ["some values of its look-up tables are not finite"]
    point = found.plane.point
    if point is not None and not (abs(point[0]) <= 360 and abs(point[1]) <= 90):
        return [f"the plane touches the sky at ({point[0]:g}, {point[1]:g}) degrees: on no sphere"]
    try:
        maps = found.at(origin="stated")
    except InputError:  # it has no date of its own
        return []
    faults = [fault for number, one in maps.items() for fault in _faults_of_map(number, one)]
    if faults or found.scale is None:
        return faults
    pixel = float(np.sqrt(abs(np.linalg.det(next(iter(maps.values())).linear))))
    if not 1 / OFF < found.scale / pixel < OFF:
        return [f"the stated scale is {found.scale:g}, and the linear terms give {pixel:.3g}"]
    return []


def _is_covariance(cov: Float) -> bool:
    """Whether variances are positive or zero, and correlations lie between -1 and 1."""
    variance = np.diag(cov)
    if variance.min(initial=0.0) < 0:
        return False
    sigma = np.sqrt(variance)
    return bool((np.abs(cov) <= (1 + ROUNDING) * np.outer(sigma, sigma)).all())


def _faults_of_map(number: int, one: ChipMap) -> list[str]:
    """What is wrong with the polynomial of a chip."""
    area = abs(float(np.linalg.det(one.linear)))
    (nx, ny), (x0, y0) = one.basis.size, one.basis.reference_pixel
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(1, nx, 5), np.linspace(1, ny, 5)))
    if not area > 0 or not np.isfinite(area):
        return [f"the linear terms of chip {number} make a pixel without an area"]
    zero = one.basis.evaluate(np.array([x0]), np.array([y0])) @ one.coefficients.T
    there = one.basis.evaluate(x, y) @ one.coefficients.T - zero
    bend = np.hypot(*(there - np.stack([x - x0, y - y0], axis=1) @ one.linear.T).T)
    reach = max(nx, ny, float(np.hypot(x - x0, y - y0).max())) * np.sqrt(area)
    if not bend.max() < BEND * reach:
        return [
            f"the polynomial of chip {number} leads {bend.max() / np.sqrt(area):.3g} px away from "
            f"its linear terms, on a chip of {nx:g} x {ny:g} pixels"
        ]
    return []
