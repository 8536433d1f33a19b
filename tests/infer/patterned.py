"""Stars on a detector with a pattern of blocks that no polynomial describes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.infer import LinearFit, OutlierMixture, Posterior, load
from bayesdist.infer.density.laplace import starting_point
from bayesdist.model import Chip, DistortionModel
from bayesdist.simulate import simulate_matches

from .support import posterior_at, target_of, truth_of

SIDE = 2048.0
CHIP = Chip(1, "A", (SIDE, SIDE), (1024.0, 1024.0))

Field = Callable[[np.ndarray, np.ndarray], np.ndarray]


def blocks(rng: np.random.Generator, side: float, rms: float, size: float = SIDE) -> Field:
    """Independent offsets of square blocks, laid over the detector anyhow."""
    begin = rng.uniform(0, side, 2)
    n = int(size / side) + 2
    offsets = rms * rng.standard_normal((n, n, 2))

    def field(x, y):
        ix, iy = (((z + b) / side).astype(int) for z, b in zip((x, y), begin, strict=True))
        return offsets[iy, ix]

    return field


def moved(matches: Matches, by: np.ndarray) -> Matches:
    return matches.with_columns(u=matches.u + by[:, 0], v=matches.v + by[:, 1])


@dataclass(frozen=True)
class Patterned:
    model: DistortionModel
    theta: np.ndarray
    matches: Matches
    pattern: Field


def patterned(
    seed: int,
    n: int,
    *,
    order: int = 4,
    side: float = 64.0,
    rms: float = 0.1,
    fraction: float = 0.03,
) -> Patterned:
    rng = np.random.default_rng([64, seed])
    model = DistortionModel(order, (CHIP,))
    theta = truth_of(model, rng)
    matches, _ = simulate_matches(model, theta, n, rng=rng, fraction=fraction)
    pattern = blocks(rng, side, rms)
    return Patterned(model, theta, moved(matches, pattern(matches.x, matches.y)), pattern)


def mode_of(
    matches: Matches, model: DistortionModel, mixture: OutlierMixture | None = None
) -> tuple[Posterior, LinearFit]:
    """A posterior that is its mode: all that the robust covariance wants to know of it."""
    target, fit = target_of(model, load(model, matches), mixture or OutlierMixture())
    psi = starting_point(target, fit)
    for _ in range(60):
        value, gradient, matrix = target.expand(psi)
        try:
            step = matrix.factor().solve(gradient)
        except np.linalg.LinAlgError:
            value, gradient, matrix = target.expand(psi, em=True)
            step = matrix.factor().solve(gradient)
        while target.log_density((psi + step)[None])[0] < value - 1e-6:
            step = step / 2
        psi = psi + step
        if gradient @ step < 1e-9:
            return posterior_at(target, psi[None]), fit
    raise AssertionError("no mode was found")
