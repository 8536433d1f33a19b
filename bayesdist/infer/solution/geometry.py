"""Geometry of a chip in a solution: scales, orientation, parity, skew and distortion.

The model of gnDSTR (WSDC D-T033, section 1) has a polynomial for each axis "plus a skew factor
applied to Y", constrained to zero. Since both polynomials have all linear terms here, the skew is
not an additional parameter: applying a skew to a polynomial with perpendicular axes gives another
polynomial of the same order. The skew is therefore a function of the four linear coefficients.

If one pixel along x and along y at the reference pixel maps to the vectors e_x and e_y, then::

    sin(skew) = - e_x . e_y / (|e_x| |e_y|)         the angle from e_x to e_y is 90 degrees + skew
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bayesdist.errors import InputError
from bayesdist.infer.solution.solution import Solution
from bayesdist.model import DistortionModel
from bayesdist.model.grid import mesh
from bayesdist.utils.arrays import Float
from bayesdist.utils.text import number

MAS = {"deg": 3.6e6, "arcsec": 1000.0, "mas": 1.0}  # milliarcseconds per unit of u, v
GRID = 21  # positions per axis at which the distortion is evaluated
LARGEST_ANISOTROPY = 0.05  # ratio of the scales of the axes minus 1, for square pixels on the sky
LARGEST_SKEW = 0.1  # rad; the most tilted focal plane in use has 0.09
LARGEST_DISTORTION = 0.05  # fraction of half the diagonal of the chip
LARGEST_SCALE_ERROR = 0.02  # relative deviation from the stated pixel scale
RADIANS = 0.01  # relative tolerance on the stretch caused by radians that are read as degrees
# Stretch caused by right ascensions in hours that are read as degrees: a factor of about 15.
HOURS = (12.0, 18.0)


@dataclass(frozen=True)
class Geometry:
    """Linear part of the mapping of one chip, and its largest distortion.

    Drift and exposure frames are not included.
    """

    chip: int
    unit: str  # unit of u, v
    scale_x: float  # scale along x at the reference pixel, in the unit of u, v per pixel
    scale_y: float  # scale along y
    position_angle: float  # degrees: direction of +y, measured from +v towards +u
    parity: int  # -1 if u, v is a mirror image of x, y, otherwise 1
    skew: float  # radians: the angle from the x axis to the y axis in u, v, minus 90 degrees
    stretch: float  # ratio of the largest to the smallest scale over all directions
    mean_scale: float  # square root of the pixel area in the best linear map of the chip
    distortion: float  # pixels: largest deviation from the best linear map
    half_diagonal: float  # pixels

    @property
    def anisotropy(self) -> float:
        """Ratio of the larger to the smaller of the scales along x and y, minus 1."""
        low, high = sorted((self.scale_x, self.scale_y))
        return high / low - 1.0

    @property
    def scales(self) -> tuple[str, str, str]:
        """Scales along x and y, formatted, and their unit."""
        factor, unit = 1.0, f"{self.unit}/px"
        if self.unit in MAS:
            factor, unit = MAS[self.unit], "mas/px"
        return number(factor * self.scale_x, 6), number(factor * self.scale_y, 6), unit

    @property
    def sentence(self) -> str:
        """Scales, orientation, parity and largest distortion as one line of text."""
        x, y, unit = self.scales
        return (
            f"scale {x} x {y} {unit}, +y at {self.position_angle:.2f} degrees from +v towards +u, "
            f"parity {self.parity:+d}, largest distortion {number(self.distortion, 3)} px"
        )

    @property
    def mirrored(self) -> str:
        """Warning that the chip shows a mirror image of the sky; empty if it does not.

        It is valid only if u, v are on a tangent plane with u increasing to the east.
        """
        if self.parity < 0:
            return ""
        return (
            f"chip {self.chip} shows the sky mirrored (east is to the right where north is up): "
            "right if the optics mirror it, otherwise x and y are swapped or one of them is "
            "counted from the wrong side"
        )

    @property
    def warnings(self) -> list[str]:
        """Warnings about an anisotropy, skew or distortion that is unusual for a detector."""
        x, y, unit = self.scales
        out = []
        if self.anisotropy > LARGEST_ANISOTROPY:
            out.append(
                f"the pixel is {x} x {y} {unit} (chip {self.chip}): check the unit of both "
                "positions, and that the columns are raw pixels"
            )
        if abs(self.skew) > LARGEST_SKEW:
            out.append(
                f"the axes of chip {self.chip} are {90 + np.degrees(self.skew):.1f} degrees apart: "
                "check the columns of positions"
            )
        if self.distortion > LARGEST_DISTORTION * self.half_diagonal:
            out.append(
                f"the distortion of chip {self.chip} reaches {number(self.distortion, 3)} px, "
                f"{100 * self.distortion / self.half_diagonal:.0f} % of half its diagonal: check "
                "the tangent point and the columns of positions"
            )
        return out


def geometry_of(solution: Solution, chip: int | None = None) -> Geometry:
    """Compute the geometry of a chip.

    Parameters
    ----------
    solution : Solution
        Fit or posterior; its mean is used.
    chip : int, optional
        Chip number; the first chip by default.

    Returns
    -------
    Geometry

    Raises
    ------
    InputError
        If there is no such chip.
    """
    model = solution.model
    number_of_chip = model.chips[0].number if chip is None else chip
    basis = model.basis(number_of_chip)
    theta = np.asarray(solution.mean, float)
    coefficients = np.stack(
        [theta[model.coefficient_slice(number_of_chip, axis)] for axis in (0, 1)]
    )
    rows = basis.monomial_matrix[[basis.terms.index((1, 0)), basis.terms.index((0, 1))]]
    linear = coefficients @ rows.T
    size = basis.size
    x, y = mesh(*(np.linspace(0.5, n + 0.5, GRID) for n in size))
    plane = coefficients @ basis.evaluate(x, y).T
    design = np.column_stack([np.ones_like(x), x - x.mean(), y - y.mean()])
    best = np.linalg.lstsq(design, plane.T, rcond=None)[0]
    mean_scale = float(np.sqrt(abs(np.linalg.det(best[1:]))))
    deviation = np.hypot(*(plane - (design @ best).T)) / mean_scale
    largest, smallest = np.linalg.svd(linear, compute_uv=False)
    return Geometry(
        chip=number_of_chip,
        unit=model.unit,
        scale_x=float(np.hypot(*linear[:, 0])),
        scale_y=float(np.hypot(*linear[:, 1])),
        position_angle=float(np.degrees(np.arctan2(linear[0, 1], linear[1, 1]))),
        parity=-1 if np.linalg.det(linear) < 0 else 1,
        skew=skew_of(solution, chip=number_of_chip).value,
        stretch=float(largest / smallest),
        mean_scale=mean_scale,
        distortion=float(deviation.max()),
        half_diagonal=float(np.hypot(*size) / 2),
    )


def geometries(solution: Solution) -> list[Geometry]:
    """Geometry of every chip."""
    return [geometry_of(solution, chip.number) for chip in solution.model.chips]


def _in_radians(stretch: float, ra: float, dec: float) -> bool:
    """True if the stretch of the pixels suggests that RA and Dec are in radians, not degrees.

    `ra` and `dec` are the field's position as read.  Radians read as degrees put the field near
    the equator, so that the factor cos(dec) in the east-west direction is missing.
    """
    possible = 0 <= ra <= 2 * np.pi and abs(dec) < np.pi / 2
    missing = np.cos(np.radians(dec)) / np.cos(dec) if possible else 1.0
    return bool(missing > 1 + LARGEST_ANISOTROPY and abs(stretch / missing - 1.0) < RADIANS)


def refuse_geometry(
    chips: Sequence[Geometry],
    *,
    scale_mas: float | None,
    tangent_point: tuple[float, float] | None,
    where: str,
) -> None:
    """Raise InputError if the fitted geometry shows that the input has wrong units or scale.

    Detects right ascensions in hours, coordinates in radians, and a pixel scale `scale_mas` that
    differs from the fitted one.  `tangent_point` is RA and Dec in degrees, or None if u, v are not
    on a tangent plane.
    """
    first = chips[0]
    if first.unit not in MAS:
        return
    x, y, unit = first.scales
    if tangent_point is not None and _in_radians(first.stretch, *tangent_point):
        raise InputError(
            f"the pixel is {x} x {y} {unit}, but the field is at ra {tangent_point[0]:.4g}, dec "
            f"{tangent_point[1]:.4g}: square pixels have this shape if both are in radians and "
            "are read as degrees",
            where=where,
            do="convert ra and dec to degrees, or give the columns the unit rad",
        )
    if tangent_point is not None and HOURS[0] < first.stretch < HOURS[1]:
        raise InputError(
            f"the pixel is {x} x {y} {unit}: one direction of the sky is {first.stretch:.3g} times "
            "the other, as where right ascensions in hours are read as degrees",
            where=where,
            do="multiply ra by 15, or give the column the unit hourangle",
        )
    if scale_mas is None:
        return
    factor = MAS[first.unit]
    fitted = [
        factor * value
        for chip in chips
        for value in (chip.mean_scale, np.sqrt(chip.scale_x * chip.scale_y * np.cos(chip.skew)))
    ]
    nearest = min(fitted, key=lambda value: abs(value / scale_mas - 1.0))
    if abs(nearest / scale_mas - 1.0) > LARGEST_SCALE_ERROR:
        raise InputError(
            f"the pixel scale is given as {scale_mas:g} mas, but that of the fit is "
            f"{number(fitted[0], 5)} mas",
            where="detector.scale_mas",
            do="correct it or leave it out, as u and v are angles; or correct data.unit",
        )


# -- skew of a solution: the angle between the detector's axes on the sky, minus 90 degrees --------


@dataclass(frozen=True)
class Skew:
    """Deviation of the angle between the axes from 90 degrees.

    Parameters
    ----------
    value, sigma : float
        Skew and its standard error in radians.
    """

    value: float
    sigma: float

    @property
    def significance(self) -> float:
        """Skew divided by its error; infinite if the error is zero."""
        return self.value / self.sigma if self.sigma > 0 else float("inf")


def skew_of(solution: Solution, *, chip: int | None = None) -> Skew:
    """Skew of a chip at its reference pixel, with its error.

    Parameters
    ----------
    solution : Solution
        Fit or posterior. The error is propagated from its covariance.
    chip : int, optional
        Chip number; the first chip by default.

    Returns
    -------
    Skew
        Skew of the polynomials, without drift and exposure frames.
    """
    value, gradient = _skew(solution.model, solution.mean, chip)
    # if the skew is constrained by a prior, rounding may make its variance slightly negative
    return Skew(value, float(np.sqrt(max(float(gradient @ solution.cov @ gradient), 0.0))))


def _skew(model: DistortionModel, theta: Float, chip: int | None) -> tuple[float, Float]:
    """Skew in radians, and its derivative (D,) with respect to theta."""
    basis = model.basis(chip)
    slices = [model.coefficient_slice(chip, axis) for axis in (0, 1)]
    rows = basis.monomial_matrix[[basis.terms.index((1, 0)), basis.terms.index((0, 1))]]
    # the columns of J are e_x and e_y
    J = np.stack([rows @ theta[part] for part in slices])
    (a, b), (c, d) = J
    n_x, n_y = np.hypot(a, c), np.hypot(b, d)
    cosine = (a * b + c * d) / (n_x * n_y)
    by_x = (J[:, 1] / n_y - cosine * J[:, 0] / n_x) / n_x
    by_y = (J[:, 0] / n_x - cosine * J[:, 1] / n_y) / n_y
    gradient = np.zeros_like(theta)
    for axis, part in enumerate(slices):
        gradient[part] = -(by_x[axis] * rows[0] + by_y[axis] * rows[1])
    return float(-np.arcsin(cosine)), gradient / np.sqrt(1 - cosine**2)
