"""A dense field seen in dithered exposures, for self-calibration: detections of known truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.detections import NO_STAR, Detections
from bayesdist.errors import InputError
from bayesdist.model import Chip, DistortionModel

__all__ = ["DitheredField", "dither_pattern", "pixels_of", "simulate_dithers", "smooth_distortion"]

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

MOST_STEPS = 30
CLOSE = 1e-9  # pixels
OUTSIDE = 0.1  # of the detector's size, beyond which no star is looked for


@dataclass(frozen=True, eq=False)
class DitheredField:
    """Detections and what is true of them.

    Parameters
    ----------
    model : DistortionModel
    theta : ndarray, shape (D,)
        True parameters.
    detections : Detections
        `star` holds the true star of each, `NO_STAR` for those that are of none.
    sky : ndarray, shape (S, 2)
        True positions on the sky of the first exposure.
    false : ndarray of bool, shape (N,)
        Detections that are of no star, or displaced by more than their errors.
    """

    model: DistortionModel
    theta: Float
    detections: Detections
    sky: Float
    false: Bool

    @property
    def unlabelled(self) -> Detections:
        """The detections as an observer has them."""
        return replace(self.detections, star=np.full(len(self.detections), NO_STAR))


def smooth_distortion(
    order: int, chips: Sequence[Chip], size_pix: float, rng: np.random.Generator
) -> Float:
    """Coefficients (chips, 2, K) of a distortion, falling with the order.

    Parameters
    ----------
    order : int
    chips : sequence of Chip
        Side by side along y, a gap of fifty pixels between them.
    size_pix : float
        Of the quadratic terms at the edge.
    rng : numpy.random.Generator
    """
    model = DistortionModel(order, tuple(chips))
    out = np.zeros((len(chips), 2, model.n_terms))
    above = 0.0
    for c, chip in enumerate(chips):
        basis = model.basis(chip.number)
        monomials = np.zeros((2, model.n_terms))
        monomials[0, 1] = monomials[1, 2] = 1.0
        out[c] = basis.from_monomials(monomials)
        out[c, 1, 0] += above
        above += chip.size[1] + 50.0
        degree = np.array([i + j for i, j in basis.terms])
        high = degree > 1
        out[c][:, high] += (
            size_pix * rng.standard_normal((2, high.sum())) / 4.0 ** (degree[high] - 2)
        )
    return out


def dither_pattern(
    n: int,
    size: tuple[float, float],
    rolls_deg: Sequence[float],
    rng: np.random.Generator,
    *,
    least: float = 5.0,
    largest: float = 0.75,
) -> tuple[Float, Float]:
    """Offsets that sample all scales from a few pixels to a part of the detector.

    As the program that calibrated ACS (ACS handbook, 4.1.1): the lengths are spread evenly in
    their logarithm, the directions at random.

    Parameters
    ----------
    n : int
        Exposures; the first one has no offset.
    size : tuple of float
        Of the detector, pixels.
    rolls_deg : sequence of float
        Roll angles, taken in turn.
    rng : numpy.random.Generator
    least : float
        Pixels.
    largest : float
        Part of the detector's smaller side.

    Returns
    -------
    offsets : ndarray, shape (n, 2)
        Pixels.
    rolls : ndarray, shape (n,)
        Radians, relative to the first one.
    """
    length = np.exp(rng.uniform(np.log(least), np.log(largest * min(size)), n))
    angle = rng.uniform(0, 2 * np.pi, n)
    offsets = np.stack([length * np.cos(angle), length * np.sin(angle)], axis=1)
    offsets[0] = 0.0
    rolls = np.radians([rolls_deg[k % len(rolls_deg)] - rolls_deg[0] for k in range(n)])
    return offsets, rolls


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
    """Detections of stars spread evenly over all that the exposures see.

    Parameters
    ----------
    chips : sequence of Chip
    coefficients : ndarray, shape (chips, 2, K)
        Legendre coefficients, in pixels.
    offsets, rolls
        Of the exposures, as `dither_pattern` gives them.
    n_stars : int
    rng : numpy.random.Generator
    frames : str
    sigma : float or tuple of float
        Error on one axis, pixels: one for all, or the smallest and largest, spread evenly in
        their logarithm over the stars; the magnitudes go with them.
    disturbed : float
        Share of detections that lie anywhere within `reach` of their star.
    spurious : float
        Share of detections that are of no star, anywhere on the detector.
    reach : float
        Pixels.
    epochs : sequence of float, optional
        Decimal years of the exposures.

    Raises
    ------
    InputError
        When no star falls on the detector.
    """
    E, order = len(offsets), int((np.sqrt(8 * coefficients.shape[2] + 1) - 3) / 2)
    centre = coefficients[:, :, 0].mean(axis=0)
    model = DistortionModel(
        order,
        tuple(chips),
        frames=frames,
        exposures=tuple(f"e{k:03d}" for k in range(E)),
        origin=(float(centre[0]), float(centre[1])),
    )
    theta = np.zeros(model.n_params)
    theta[: model.n_polynomial] = coefficients.ravel()
    for e in range(1, E):
        block = model.frame_slice(e)
        names = model.free_frame_names(e)
        values = {"shift_u": offsets[e, 0], "shift_v": offsets[e, 1], "rotation": rolls[e]}
        theta[block] = [values.get(name, 0.0) for name in names]
    sky = _field(model, theta, n_stars, rng)
    low, high = (sigma, sigma) if isinstance(sigma, float) else sigma
    share = rng.uniform(size=n_stars)
    error = low * (high / low) ** share
    columns: list[tuple[Float, ...]] = []
    for e in range(E):
        for chip in model.chips:
            x, y, seen = pixels_of(model, theta, sky, e, chip)
            k = np.flatnonzero(seen)
            columns.append((x[k], y[k], np.full(len(k), e), np.full(len(k), chip.number), k))
    x, y, exposure, number, star = (np.concatenate(parts) for parts in zip(*columns, strict=True))
    n = len(x)
    if n == 0:
        raise InputError("no star falls on the detector", where="simulation", do="give more stars")
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


def _field(model: DistortionModel, theta: Float, n_stars: int, rng: np.random.Generator) -> Float:
    """Positions over the rectangle that holds all exposures' corners."""
    corners = []
    for chip in model.chips:
        x, y = (
            np.array(v) for v in ([0.5, chip.size[0] + 0.5] * 2, [0.5] * 2 + [chip.size[1]] * 2)
        )
        for e in range(len(model.exposures)):
            corners.append(model.predict(theta, x, y, exposure=e, chip=chip.number))
    points = np.concatenate(corners)
    low, high = points.min(axis=0), points.max(axis=0)
    return low + rng.uniform(size=(n_stars, 2)) * (high - low)


def pixels_of(
    model: DistortionModel, theta: Float, sky: Float, exposure: int, chip: Chip
) -> tuple[Float, Float, Bool]:
    """Where stars lie on a chip, by Newton's method, and which of them it sees.

    Parameters
    ----------
    model : DistortionModel
    theta : ndarray, shape (D,)
    sky : ndarray, shape (S, 2)
    exposure : int
        Code.
    chip : Chip

    Returns
    -------
    x, y : ndarray, shape (S,)
        FITS 1-based pixels; meaningless where the star is not seen.
    seen : ndarray of bool, shape (S,)
    """
    basis = model.basis(chip.number)
    groups = model.groups(1, exposure=exposure, chip=chip.number)
    E = model.effective(theta, groups)[0]
    nx, ny = chip.size
    x, y = np.full(len(sky), (nx + 1) / 2), np.full(len(sky), (ny + 1) / 2)
    near = np.ones(len(sky), bool)
    for _ in range(MOST_STEPS):
        values = basis.evaluate(x[near], y[near])
        by_x, by_y = (values @ d @ E.T for d in basis.derivatives)
        miss = sky[near] - values @ E.T
        det = by_x[:, 0] * by_y[:, 1] - by_y[:, 0] * by_x[:, 1]
        dx = (by_y[:, 1] * miss[:, 0] - by_y[:, 0] * miss[:, 1]) / det
        dy = (by_x[:, 0] * miss[:, 1] - by_x[:, 1] * miss[:, 0]) / det
        x[near] += dx
        y[near] += dy
        # a polynomial says nothing far from the detector
        inside = (np.abs(x[near] - nx / 2) < (0.5 + OUTSIDE) * nx) & (
            np.abs(y[near] - ny / 2) < (0.5 + OUTSIDE) * ny
        )
        near[near] = inside
        if not inside.any() or max(np.abs(dx[inside]).max(), np.abs(dy[inside]).max()) < CLOSE:
            break
    seen = near & (x > 0.5) & (x < nx + 0.5) & (y > 0.5) & (y < ny + 0.5)
    return x, y, seen
