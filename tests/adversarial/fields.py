"""Displacements over the detector, made with numpy alone: functions of pixels, in pixels."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.polynomial.legendre import legval2d

SIDE = 2048  # pixels
MIDDLE = (SIDE + 1) / 2

Field = Callable[[np.ndarray, np.ndarray], np.ndarray]  # x, y (N,) -> displacement (N, 2)

WAVES = 400  # of a random field


def scaled(pixel: np.ndarray) -> np.ndarray:
    """Pixels as -1 to 1 over the detector."""
    return (np.asarray(pixel, float) - MIDDLE) / (SIDE / 2)


def even_pixels(n: int = 61) -> tuple[np.ndarray, np.ndarray]:
    """x and y (n * n,) of an even grid of pixels over the detector."""
    line = (np.arange(n) + 0.5) * SIDE / n + 0.5
    x, y = np.meshgrid(line, line)
    return x.ravel(), y.ravel()


def of_rms(field: Field, rms: float) -> Field:
    """The field multiplied so that it has this rms on each axis over the detector."""
    factor = rms / np.sqrt(np.mean(field(*even_pixels()) ** 2))
    return lambda x, y: factor * field(x, y)


def total(*fields: Field) -> Field:
    """The sum of fields."""
    return lambda x, y: np.sum([np.zeros((*np.shape(x), 2)), *(f(x, y) for f in fields)], axis=0)


def polynomial(coefficients: np.ndarray) -> Field:
    """A field of Legendre products, from coefficients (2, i, j) of both axes."""

    def field(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        X, Y = scaled(x), scaled(y)
        return np.stack([legval2d(X, Y, c) for c in coefficients], axis=-1)

    return field


def random_polynomial(rng: np.random.Generator, rms_of_order: dict[int, float]) -> Field:
    """A random polynomial whose terms of each total order have, together, about the given rms."""
    most = max(rms_of_order)
    c = np.zeros((2, most + 1, most + 1))
    for order, rms in rms_of_order.items():
        for i in range(order + 1):
            j = order - i
            # the rms of a Legendre product is 1 / sqrt((2 i + 1) (2 j + 1))
            size = rms * np.sqrt((2 * i + 1) * (2 * j + 1) / (order + 1))
            c[:, i, j] = size * rng.standard_normal(2)
    return polynomial(c)


def distortion(rng: np.random.Generator, order: int = 3) -> Field:
    """A realistic distortion: 20 to 60 pixels in the corners, less at each higher order."""
    return random_polynomial(rng, {k: 12.0 / 2.5 ** (k - 1) for k in range(1, order + 1)})


def smooth(
    rng: np.random.Generator,
    scale: float,
    rms: float,
    roughness: float | None = None,
    *,
    expected: bool = False,
) -> Field:
    """A homogeneous Gaussian random field, by random Fourier features.

    Parameters
    ----------
    rng : numpy.random.Generator
    scale : float
        Correlation length in pixels.
    rms : float
        On each axis over the detector.
    roughness : float, optional
        nu of a Matern covariance; by default it is the squared exponential.
    expected : bool
        Whether the rms is that of many fields: each by itself has another one.
    """
    waves = rng.standard_normal((2, 2, WAVES)) / scale  # axis, (x, y), wave
    if roughness is not None:
        waves /= np.sqrt(rng.chisquare(2 * roughness, (2, 1, WAVES)) / (2 * roughness))
    phase = rng.uniform(0, 2 * np.pi, (2, WAVES))

    def field(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        at = np.stack([x, y], axis=-1)
        return np.stack(
            [np.cos(at @ w + p).sum(axis=-1) for w, p in zip(waves, phase, strict=True)], axis=-1
        )

    if expected:  # the mean square of a wave is one half
        factor = rms / np.sqrt(WAVES / 2)
        return lambda x, y: factor * field(x, y)
    return of_rms(field, rms)


def ridges(rng: np.random.Generator, period: float, size: float) -> Field:
    """Sinusoidal columns and rows of one period, as lithography leaves them; size is amplitude."""
    phase = rng.uniform(0, 2 * np.pi, 2)

    def field(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        angle = 2 * np.pi / period * np.stack([x, y], axis=-1) + phase
        return size * np.sin(angle)

    return field


def sawtooth(rng: np.random.Generator, period: float, size: float) -> Field:
    """Columns displaced along x by ramps that fall off at sharp edges; size is half the step."""
    phase = rng.uniform(0, period)

    def field(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        ramp = size * (2 * (((np.asarray(x, float) + phase) / period) % 1.0) - 1)
        return np.stack([ramp, np.zeros_like(ramp)], axis=-1)

    return field


def tree_rings(rng: np.random.Generator, rms: float) -> Field:
    """Radial displacements about a point beyond a corner, closer and closer outwards."""
    centre = np.array([-200.0, -300.0]) + rng.uniform(-50, 50, 2)
    phase = rng.uniform(0, 2 * np.pi)

    def field(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        away = np.stack([x, y], axis=-1) - centre
        r = np.linalg.norm(away, axis=-1, keepdims=True)
        return np.sin(np.pi * (r / 400.0) ** 2 + phase) * away / r  # at r the period is 400^2 / r

    return of_rms(field, rms)


def quadrant(size: tuple[float, float]) -> Field:
    """A displacement of the upper right quadrant, as of an amplifier of its own."""

    def field(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        inside = (np.asarray(x) > MIDDLE) & (np.asarray(y) > MIDDLE)
        return inside[..., None] * np.array(size)

    return field


def stitching(step: float, turn: float) -> Field:
    """A step along y, and a rotation by an angle, of the upper half of the detector."""

    def field(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        upper = np.asarray(y) > MIDDLE
        return upper[..., None] * np.stack([turn * (MIDDLE - y), step + turn * (x - MIDDLE)], -1)

    return field


def edges(size: float, reach: float) -> Field:
    """Displacements outwards that fall off exponentially from all four edges."""

    def along(pixel: np.ndarray) -> np.ndarray:
        pixel = np.asarray(pixel, float)
        return size * (np.exp(-(SIDE + 0.5 - pixel) / reach) - np.exp(-(pixel - 0.5) / reach))

    return lambda x, y: np.stack([along(x), along(y)], axis=-1)


def radius(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Vectors (N, 2) from the middle, of length 1 at half a side."""
    return np.stack([scaled(x), scaled(y)], axis=-1)
