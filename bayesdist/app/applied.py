"""A calibration as `apply`, `pam` and `handbook` take it: its chips in one plane, and its scale."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bayesdist.app.rundir import RunDirectory
from bayesdist.app.solutions import solution_at
from bayesdist.assess.area import pixel_areas
from bayesdist.assess.calibration import Calibration
from bayesdist.errors import FormatError, InputError
from bayesdist.products import IdcTab
from bayesdist.products.calibration_file import read_calibrations
from bayesdist.products.chips_in_frame import (
    chips_of_idctab,
    chips_of_solution,
    scale_of_idctab,
)
from bayesdist.products.formats.common.content import read_hdus
from bayesdist.products.sip_build import ARCSEC
from bayesdist.products.subarray import Subarray, subarray_at_corner, subarrays_of_image

__all__ = ["Applied", "applied", "images_of"]


@dataclass(frozen=True, eq=False)
class Applied:
    """A calibration that is to be applied.

    Parameters
    ----------
    name : str
        Of the file or run.
    chips : mapping of int to Calibration
        The reference chip first.
    scale : float
        Size of a corrected pixel, in the unit of the calibration.
    scale_from : str
        Where that is from.
    tab : IdcTab or None
    """

    name: str
    chips: Mapping[int, Calibration]
    scale: float
    scale_from: str
    tab: IdcTab | None = None

    @property
    def unit(self) -> str:
        """Of the undistorted plane."""
        return next(iter(self.chips.values())).unit

    @property
    def instrument(self) -> str:
        """INSTRUME of an IDCTAB, else empty."""
        return "" if self.tab is None else self.tab.instrument

    @property
    def detector(self) -> str:
        """DETECTOR of an IDCTAB, else empty."""
        return "" if self.tab is None else self.tab.detector

    @property
    def notes(self) -> tuple[str, ...]:
        """What a reader has to know."""
        first = next(iter(self.chips.values()))
        known = () if first.cov is not None else ("it holds no errors",)
        partly = () if first.correlated else ("its errors come without correlations",)
        return (*first.notes, *known, *partly)


def applied(
    path: str | Path,
    *,
    filter: str | None = None,
    epoch: float | None = None,
    scale: float | None = None,
) -> Applied:
    """The calibration of a file or a run.

    Parameters
    ----------
    path : path
        IDCTAB, run directory, posterior.nc, fit.nc, SIP header or WISE meta-data.
    filter : str, optional
        Of an IDCTAB; names of both wheels may be joined by a comma.  The band of WISE meta-data.
    epoch : float, optional
        Decimal years, for what depends on time.
    scale : float, optional
        Size of a corrected pixel, in the unit of the calibration.

    Returns
    -------
    Applied

    Raises
    ------
    InputError
        For a file of none of these kinds, a filter or date that is missing or not there, or a scale
        that is not positive.
    """
    path = Path(path)
    if not path.exists():
        raise InputError("there is no such file", where=str(path), do="check the name")
    tab = None
    solution = solution_at(path)
    if solution is not None:
        chips = chips_of_solution(solution, str(path), epoch=epoch)
        own, source = _scale_of_run(path, next(iter(chips.values())))
    else:
        tab = _idctab(path)
        if tab is not None:
            chips = chips_of_idctab(tab, filter=filter, epoch=epoch)
            own, source = scale_of_idctab(tab, filter), "SCALE"
        else:
            found = read_calibrations(path, filter=filter, epoch=epoch)
            chips = {n or 1: replace(c, chip=n or 1) for n, c in found.items()}
            own, source = _scale_of_pixel(next(iter(chips.values())))
    if scale is not None:
        if not (np.isfinite(scale) and scale > 0):
            raise InputError(f"the scale is {scale}", where="--scale", do="give a positive number")
        own, source = float(scale), "--scale"
    return Applied(str(path), chips, own, source, tab)


def _idctab(path: Path) -> IdcTab | None:
    """The IDCTAB that a file is; None for others."""
    try:
        hdus = read_hdus(path)
    except FormatError:
        return None
    if len(hdus) < 2 or "XREF" not in hdus[1].header.values():
        return None
    return IdcTab(hdus, str(path))


def _scale_of_run(path: Path, first: Calibration) -> tuple[float, str]:
    """Size of a corrected pixel: one of u, v, as configured, or that of the zero point's pixel."""
    if first.unit == "pix":
        return 1.0, "pixels of u, v"
    home = path if path.is_dir() else path.parent
    if (home / "run.json").exists():
        mas = RunDirectory(home).config.detector.scale_mas
        if mas is not None:
            return 1e-3 * mas / ARCSEC[first.unit], "detector.scale_mas"
    return _scale_of_pixel(first)


def _scale_of_pixel(first: Calibration) -> tuple[float, str]:
    x, y = first.basis.reference_pixel
    area = float(pixel_areas(first, [x], [y])[0][0, 0])
    if not area > 0:
        raise InputError(
            "the pixel at the zero point has no area", where=first.name, do="give --scale"
        )
    return float(np.sqrt(area)), "the pixel at the zero point"


def images_of(
    found: Applied,
    *,
    image: str | Path | None = None,
    ltv: tuple[float, float] | None = None,
    corner: tuple[float, float] | None = None,
) -> dict[int, Subarray]:
    """Where pixels lie on their chips, as one of three options says; empty for whole chips.

    Parameters
    ----------
    found : Applied
    image : path, optional
        A calibrated image.
    ltv : tuple of float, optional
        LTV1, LTV2.
    corner : tuple of float, optional
        The pixel of the chip that is the subarray's first.

    Raises
    ------
    InputError
        For more than one of them, or as `subarrays_of_image`.
    """
    given = [("--image", image), ("--ltv", ltv), ("--corner", corner)]
    named = [name for name, value in given if value is not None]
    if len(named) > 1:
        raise InputError(
            f"{' and '.join(named)} say the same", where="options", do="keep one of them"
        )
    if image is not None:
        return subarrays_of_image(image, {n: c.basis.size for n, c in found.chips.items()})
    if ltv is not None:
        return dict.fromkeys(found.chips, Subarray((ltv[0], ltv[1])))
    if corner is not None:
        return dict.fromkeys(found.chips, subarray_at_corner(*corner))
    return {}
