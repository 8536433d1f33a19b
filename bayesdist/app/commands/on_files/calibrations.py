"""Calibrations of files or runs with the options of commands."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from bayesdist.app.calibrations import calibration_at, refuse_unused_date
from bayesdist.calibration.apply import Subarray, subarray_at_corner, subarrays_of_image
from bayesdist.calibration.calibration import Calibration
from bayesdist.errors import InputError
from bayesdist.products.common.content import read_hdus


def calibration_of_scale(
    path: str | Path,
    *,
    filter: str | None = None,
    scale: float | None = None,
    size: tuple[float, float] | None = None,
    epoch: float | None = None,
) -> Calibration:
    """Calibration of a file or a run with a given pixel scale.

    Parameters
    ----------
    path : path
    filter, size
        See `calibration_at`.
    scale : float, optional
        Size of a corrected pixel in the unit of u and v; that of the file by default.
    epoch : float, optional
        Date in decimal years, which is only checked.

    Raises
    ------
    InputError
        If the scale is not positive, or an epoch is given and the calibration does not depend on
        time.
    """
    calibration = calibration_at(path, filter=filter, size=size)
    refuse_unused_date(epoch, calibration)
    if scale is None:
        return calibration
    if not (np.isfinite(scale) and scale > 0):
        raise InputError(f"the scale is {scale}", where="--scale", do="give a positive number")
    return replace(calibration, scale=float(scale), scale_from="--scale")


def notes_of(found: Calibration, epoch: float | None) -> tuple[str, ...]:
    """Notes for readers of results that were obtained with a calibration."""
    first = found.chip(epoch=epoch)
    errors = {
        "none": ("it holds no errors",),
        "sigma": ("its errors come without correlations",),
        "covariance": (),
    }
    return (*first.notes, *errors[first.errors])


def images_of(
    found: Calibration,
    *,
    image: str | Path | None = None,
    ltv: tuple[float, float] | None = None,
    corner: tuple[float, float] | None = None,
) -> dict[int, Subarray]:
    """Positions of subarrays on their chips, by chip number; empty for full chips.

    Parameters
    ----------
    found : Calibration
    image : path, optional
        Calibrated image with the keywords of its subarray.
    ltv : tuple of float, optional
        LTV1 and LTV2.
    corner : tuple of float, optional
        Pixel of the chip that is the first pixel of the subarray.

    Raises
    ------
    InputError
        If more than one of the options is given.
    """
    options = [("--image", image), ("--ltv", ltv), ("--corner", corner)]
    named = [name for name, value in options if value is not None]
    if len(named) > 1:
        raise InputError(
            f"{' and '.join(named)} have the same meaning", where="options", do="keep one of them"
        )
    if image is not None:
        sizes = {chip.number: chip.size for chip in found.model.chips}
        headers = (hdu.header for hdu in read_hdus(image))
        return subarrays_of_image(headers, sizes, str(image))
    if ltv is not None:
        return dict.fromkeys(found.numbers, Subarray((ltv[0], ltv[1])))
    if corner is not None:
        return dict.fromkeys(found.numbers, subarray_at_corner(*corner))
    return {}
