"""Dense fields seen in dithered exposures, for self-calibration: detections of known truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.detections import NO_STAR, Detections
from bayesdist.kinds.selfcal.patterns.exposures import (
    dithered_model,
    flat_coefficients,
    sky_seen,
    stars_on_detector,
)
from bayesdist.model import Chip, DistortionModel

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class DitheredField:
    """Detections and their truth."""

    model: DistortionModel
    theta: Float  # (D,)
    detections: Detections  # with the true star, or `NO_STAR`
    sky: Float  # (S, 2), on the sky of the first exposure
    false: Bool  # (N,), of no star, or displaced by more than the errors

    @property
    def unlabelled(self) -> Detections:
        """Detections as an observer has them."""
        return replace(self.detections, star=np.full(len(self.detections), NO_STAR))


def smooth_distortion(
    order: int, chips: Sequence[Chip], size_pix: float, rng: np.random.Generator
) -> Float:
    """Coefficients (chips, 2, K) of a distortion, falling with the order.

    The chips are side by side along y, with a gap of fifty pixels; `size_pix` is the size of the
    quadratic terms at the edge.
    """
    model = DistortionModel(order, tuple(chips))
    out = flat_coefficients(order, chips)
    for c, chip in enumerate(chips):
        degree = np.array([i + j for i, j in model.basis(chip.number).terms])
        high = degree > 1
        out[c][:, high] += (
            size_pix * rng.standard_normal((2, high.sum())) / 4.0 ** (degree[high] - 2)
        )
    return out


def simulate_dithers(
    chips: Sequence[Chip],
    coefficients: Float,
    offsets: Float,
    rolls: Float,
    *,
    n_stars: int,
    rng: np.random.Generator,
    frames: str = "shift_rotation",
    sigma: float | tuple[float, float] = 0.02,
    disturbed: float = 0.0,
    spurious: float = 0.0,
    reach: float = 1.0,
    epochs: Sequence[float] | None = None,
) -> DitheredField:
    """Detections of stars spread evenly over the area of all exposures.

    `coefficients` (chips, 2, K) are Legendre's, in pixels, `offsets` and `rolls` as from
    `dither_pattern`.  `sigma` is the error on one axis in pixels: one for all, or the smallest and
    largest, spread evenly in their logarithm over the stars; the magnitudes go with them.
    `disturbed` is the fraction of detections anywhere within `reach` pixels of their star,
    `spurious` that of detections of no star, anywhere on the detector.
    """
    model, theta = dithered_model(chips, coefficients, offsets, rolls, frames=frames)
    low_corner, high_corner = sky_seen(model, theta)
    sky = low_corner + rng.uniform(size=(n_stars, 2)) * (high_corner - low_corner)
    low, high = (sigma, sigma) if isinstance(sigma, float) else sigma
    share = rng.uniform(size=n_stars)
    error = low * (high / low) ** share
    x, y, exposure, number, star = stars_on_detector(model, theta, sky)
    n = len(x)
    assert n, "no star falls on the detector"
    s = error[star]
    false = rng.uniform(size=n) < disturbed
    r, angle = reach * np.sqrt(rng.uniform(size=n)), rng.uniform(0, 2 * np.pi, n)
    dx = np.where(false, r * np.cos(angle), s * rng.standard_normal(n))
    dy = np.where(false, r * np.sin(angle), s * rng.standard_normal(n))
    x, y = x + dx, y + dy
    extra = rng.binomial(n, spurious / (1.0 - spurious)) if spurious else 0
    which = rng.integers(n, size=extra)
    sizes = {c.number: c.size for c in model.chips}
    width = np.array([sizes[int(c)] for c in number[which]]).reshape(-1, 2)
    place = 0.5 + rng.uniform(size=(extra, 2)) * width
    detections = Detections(
        np.concatenate([x, place[:, 0]]),
        np.concatenate([y, place[:, 1]]),
        np.concatenate([exposure, exposure[which]]),
        model.exposures,
        np.concatenate([number, number[which]]),
        None if epochs is None else np.asarray(epochs, float),
        np.concatenate([s, s[which]]),
        np.concatenate([share[star], share[star[which]]]) * 5.0 - 12.0,
        np.concatenate([star, np.full(extra, NO_STAR)]),
    )
    return DitheredField(
        model, theta, detections, sky, np.concatenate([false, np.ones(extra, bool)])
    )
