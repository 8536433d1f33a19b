"""Matched stars of known truth, made with numpy: a cubic, and what it leaves out."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bayesdist.data import Matches
from bayesdist.infer import LinearFit, Rejection, build_model, fit_linear

SIZE, SIGMA = 2048.0, 0.02

Map = Callable[[np.ndarray, np.ndarray], np.ndarray]


def scaled(pixel: np.ndarray) -> np.ndarray:
    return (2 * pixel - SIZE - 1) / SIZE


def cubic(rng: np.random.Generator) -> Map:
    """A distortion of some ten pixels in the family of order 3."""
    c = rng.normal(0, 5, (2, 10))

    def true(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        X, Y = scaled(x), scaled(y)
        powers = np.stack([X**i * Y ** (d - i) for d in range(4) for i in range(d, -1, -1)])
        return np.stack([x, y], axis=1) + (c @ powers).T

    return true


def smooth(rng: np.random.Generator, length: float, rms: float) -> Map:
    """A Gaussian random field on each axis, by waves of random directions."""
    k = rng.standard_normal((2, 300, 2)) / length
    a, phase = rng.standard_normal((2, 300)), rng.uniform(0, 2 * np.pi, (2, 300))

    def field(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        at = np.stack([x, y], axis=1)
        waves = [np.cos(at @ k[u].T + phase[u]) @ a[u] for u in (0, 1)]
        return rms * np.sqrt(2 / 300) * np.stack(waves, axis=1)

    return field


def matched(
    n: int, rng: np.random.Generator, *fields: Map, order: int = 3, noise: Map | None = None
) -> tuple[LinearFit, Matches, Map]:
    """A fit, its stars, and the true map."""
    base = cubic(rng)

    def true(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return base(x, y) + sum(field(x, y) for field in fields)

    x, y = rng.uniform(0.5, SIZE + 0.5, (2, n))
    sigma = np.full((n, 2), SIGMA) if noise is None else noise(x, y)
    u, v = (true(x, y) + sigma * rng.standard_normal((n, 2))).T
    quoted = np.full(n, SIGMA)
    table = Matches(x=x, y=y, u=u, v=v, sigma_u=quoted, sigma_v=quoted)
    model = build_model(table, order=order, size=(SIZE, SIZE))
    return fit_linear(table, model, rejection=Rejection(1e9, 1e9)), table, true
