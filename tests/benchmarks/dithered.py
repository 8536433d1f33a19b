"""One dithered field for self-calibration: what an observer has of it, and the truth beside.

Both programs begin with the same: pixels and their errors, commanded pointings and rolls, and
reference stars.  Nobody is told the distortion.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from astropy.wcs import WCS
from numpy.typing import NDArray

from bayesdist.kinds.selfcal.patterns.exposures import dither_pattern
from bayesdist.model import Chip, DistortionModel
from tests.kinds.selfcal.dithered_fields import DitheredField, simulate_dithers, smooth_distortion

__all__ = [
    "BRIGHT",
    "PIXEL",
    "REACH",
    "REFERENCE_SIGMA",
    "ROLLS",
    "DitheredSky",
    "Sizes",
    "dithered_sky",
    "relative",
]

Float = NDArray[np.float64]

PIXEL = 0.05 / 3600  # degrees
TANGENT = (6.0, -30.0)  # degrees
ROLLS = (0.0, 60.0, 130.0)
SIGMA = 0.02  # pixels, of a centroid on each axis
POINTING = 4.0  # pixels: 0.2 arcsec, from the guide stars
REFERENCES = 0.2  # of the stars, the brightest ones
REFERENCE_SIGMA = 0.01  # pixels: 0.5 mas, a Gaia star some years from its epoch
GRID = (33, 17)
BRIGHT = 0.15  # of the detections: those by which a solution is found first
REACH = 80.0  # pixels: within which detections of a star are looked for at first


@dataclass(frozen=True)
class Sizes:
    """What is run."""

    size: tuple[float, float]
    order: int
    distortion: float  # pixels: the largest non-linear part
    exposures: int
    stars: int
    seeds: tuple[int, ...]
    false: tuple[float, ...]
    roll_error: float = 0.01  # degrees


@dataclass(frozen=True, eq=False)
class DitheredSky:
    """A field, how it was commanded, and its reference stars.

    Parameters
    ----------
    field : DitheredField
    commanded : ndarray, shape (E, 2)
        Where the reference pixel was sent, pixels of the sky.
    rolls : ndarray, shape (E,)
        As commanded, radians.
    references : ndarray, shape (R, 2)
        Places of the reference stars, with errors of `REFERENCE_SIGMA`.
    reference_mags : ndarray, shape (R,)
    """

    field: DitheredField
    commanded: Float
    rolls: Float
    references: Float
    reference_mags: Float

    @property
    def chip(self) -> Chip:
        """The detector."""
        return self.field.model.chips[0]

    @cached_property
    def plane(self) -> WCS:
        """The sky of the simulation: a tangent plane whose pixels are u, v, with north up."""
        out = WCS(naxis=2)
        out.wcs.crpix = self.field.model.origin
        out.wcs.cdelt = -PIXEL, PIXEL
        out.wcs.crval = TANGENT
        out.wcs.ctype = "RA---TAN", "DEC--TAN"
        return out

    @cached_property
    def grid(self) -> tuple[Float, Float]:
        """Places on the detector at which solutions are judged."""
        return _grid(self.chip)

    def places(self, model: DistortionModel, theta: Float) -> Float:
        """The grid on the sky in every exposure (E, N, 2), by parameters of a model."""
        x, y = self.grid
        exposures = range(len(model.exposures))
        return np.stack([model.predict(theta, x, y, exposure=e) for e in exposures])

    @cached_property
    def truth(self) -> Float:
        """Where the grid truly lies (E, N, 2)."""
        return self.places(self.field.model, self.field.theta)


def dithered_sky(sizes: Sizes, seed: int, false: float) -> DitheredSky:
    """Simulate a field.

    Parameters
    ----------
    sizes : Sizes
    seed : int
    false : float
        Share of false detections: half of them within a pixel of their star, half anywhere.
    """
    rng = np.random.default_rng(seed)
    nx, ny = sizes.size
    chip = Chip(1, "chip", sizes.size, ((nx + 1) / 2, (ny + 1) / 2))
    offsets, rolls = dither_pattern(sizes.exposures, sizes.size, ROLLS, rng)
    field = simulate_dithers(
        (chip,),
        _distortion(chip, sizes.order, sizes.distortion, rng),
        offsets,
        rolls,
        n_stars=sizes.stars,
        rng=rng,
        sigma=SIGMA,
        disturbed=false / 2,
        spurious=false / 2,
    )
    E, d = sizes.exposures, field.detections
    x, y = (np.full(E, c) for c in chip.reference_pixel)
    true = field.model.predict(field.theta, x, y, exposure=np.arange(E))
    star, first = np.unique(d.star[d.star >= 0], return_index=True)
    mag = d.mag[d.star >= 0][first]  # type: ignore[index]
    bright = np.argsort(mag)[: round(REFERENCES * len(star))]
    places = field.sky[star[bright]]
    return DitheredSky(
        field,
        true + POINTING * rng.standard_normal((E, 2)),
        rolls + np.radians(sizes.roll_error) * rng.standard_normal(E),
        places + REFERENCE_SIGMA * rng.standard_normal(places.shape),
        mag[bright],
    )


def _distortion(chip: Chip, order: int, largest: float, rng: np.random.Generator) -> Float:
    """Coefficients whose part beyond the tangent at the centre is so large at most, pixels."""
    model = DistortionModel(order, (chip,))
    basis = model.basis()
    monomials = smooth_distortion(order, (chip,), 1.0, rng)[0] @ basis.monomial_matrix.T
    monomials[:, :3] = 0.0
    bent = basis.evaluate(*_grid(chip)) @ basis.from_monomials(monomials).T
    monomials *= largest / np.hypot(*bent.T).max()
    monomials[0, 1] = monomials[1, 2] = 1.0
    return basis.from_monomials(monomials)[None]


def _grid(chip: Chip) -> tuple[Float, Float]:
    x, y = np.meshgrid(*(np.linspace(1, n, k) for n, k in zip(chip.size, GRID, strict=True)))
    return x.ravel(), y.ravel()


def relative(places: Float, design: Float) -> Float:
    """Places, or errors of places, (..., N, 2) without their part that is linear in the sky.

    What a linear map of the sky does is not the detector's: programs hold it differently.

    Parameters
    ----------
    places : ndarray, shape (..., N, 2)
    design : ndarray, shape (N, 2)
        Where they lie on the sky.
    """
    q = np.linalg.qr(np.column_stack([np.ones(len(design)), design]))[0]
    return np.asarray(places - q @ (q.T @ places))
