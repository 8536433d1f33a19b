"""Plausibility checks of calibrations that were read from files."""

from __future__ import annotations

import numpy as np

from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.chip_map import ChipMap
from bayesdist.errors import FormatError, InputError
from bayesdist.utils.arrays import Float

MOST_PIXELS = 1e6  # columns or rows of a chip
FAR = 1e7  # largest coordinate of a reference pixel, pixels
BEND = 10.0  # largest nonlinear displacement, in units of the chip's size
ROUNDING = 1e-3  # relative tolerance for rounded covariances in text files
OFF = 1e3  # largest ratio between a stated scale and the pixel scale of the linear terms


def refuse_senseless(found: Calibration) -> None:
    """Raise FormatError if sizes, scales, errors or coefficients are implausible for a detector."""
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
        return ["the covariance of its coefficients is invalid: a correlation exceeds 1"]
    if any(not np.isfinite(table.values).all() for table in (*found.before, *found.after)):
        return ["some values of its look-up tables are not finite"]
    point = found.plane.point
    if point is not None and not (abs(point[0]) <= 360 and abs(point[1]) <= 90):
        return [f"the plane touches the sky at ({point[0]:g}, {point[1]:g}) degrees: on no sphere"]
    try:
        maps = found.at(origin="stated")
    except InputError:  # it cannot be evaluated without a date
        return []
    faults = [
        fault for number, chip_map in maps.items() for fault in _faults_of_map(number, chip_map)
    ]
    if faults or found.scale is None:
        return faults
    pixel = float(np.sqrt(abs(np.linalg.det(next(iter(maps.values())).linear))))
    if not 1 / OFF < found.scale / pixel < OFF:
        return [f"the stated scale is {found.scale:g}, but the linear terms give {pixel:.3g}"]
    return []


def _is_covariance(cov: Float) -> bool:
    """True if no variance is negative and all correlations are between -1 and 1."""
    variance = np.diag(cov)
    if variance.min(initial=0.0) < 0:
        return False
    sigma = np.sqrt(variance)
    return bool((np.abs(cov) <= (1 + ROUNDING) * np.outer(sigma, sigma)).all())


def _faults_of_map(number: int, one: ChipMap) -> list[str]:
    """Faults of the polynomial of a chip, as clauses."""
    area = abs(float(np.linalg.det(one.linear)))
    (nx, ny), (x0, y0) = one.basis.size, one.basis.reference_pixel
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(1, nx, 5), np.linspace(1, ny, 5)))
    if not area > 0 or not np.isfinite(area):
        return [f"the linear terms of chip {number} give a pixel without area"]
    zero = one.basis.evaluate(np.array([x0]), np.array([y0])) @ one.coefficients.T
    offsets = one.basis.evaluate(x, y) @ one.coefficients.T - zero
    bend = np.hypot(*(offsets - np.stack([x - x0, y - y0], axis=1) @ one.linear.T).T)
    reach = max(nx, ny, float(np.hypot(x - x0, y - y0).max())) * np.sqrt(area)
    if not bend.max() < BEND * reach:
        return [
            f"the polynomial of chip {number} deviates by {bend.max() / np.sqrt(area):.3g} px from "
            f"its linear terms, on a chip of {nx:g} x {ny:g} pixels"
        ]
    return []
