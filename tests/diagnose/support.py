"""Data that a model describes, with noise of several kinds, and patterns that it does not."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from scipy import stats

from bayesdist.data.matches import Matches
from bayesdist.diagnose import ScoreTest, score_tests
from bayesdist.infer import LinearFit, Posterior, Rejection, fit_linear
from bayesdist.model import Chip, DistortionModel, TimeDependence
from bayesdist.simulate import simulate_matches

from ..infer.patterned import mode_of, moved
from ..infer.support import CHIP, TWO_CHIPS, columns_of, exposures, truth_of

SIGMA = 0.02
TIME = TimeDependence((("u", 1, 0), ("v", 0, 1)), (2005.0,))
MANY_CHIPS = tuple(Chip(k + 1, f"c{k}", (1000.0, 800.0), (500.0, 400.0)) for k in range(6))


def gaussian(rng: np.random.Generator, n: int) -> np.ndarray:
    return rng.standard_normal((n, 2))


def student(rng: np.random.Generator, n: int) -> np.ndarray:
    """Four degrees of freedom, unit variance: one factor for both axes of a star."""
    return gaussian(rng, n) / np.sqrt(rng.chisquare(4, (n, 1)) / 2)


def unequal(rng: np.random.Generator, n: int) -> np.ndarray:
    """Errors that differ from star to star by a factor of two either way, quoted alike."""
    return gaussian(rng, n) * np.exp(0.7 * rng.standard_normal((n, 1)))


@dataclass(frozen=True)
class Scene:
    """A kind of data."""

    n: int
    order: int = 3
    frames: str = "none"
    n_exposures: int = 1
    chips: tuple[Chip, ...] = (CHIP,)
    time: TimeDependence | None = None
    noise: Callable[[np.random.Generator, int], np.ndarray] = gaussian
    fraction: float = 0.0  # of false matches
    mixture: bool = False
    misquoted: float = 0.0  # scatter of the logarithm of quoted errors, whatever the noise is

    def data(self, seed: int) -> tuple[DistortionModel, Matches]:
        rng = np.random.default_rng([seed, self.n, self.order])
        model = DistortionModel(
            self.order,
            self.chips,
            frames=self.frames,
            exposures=exposures(self.n_exposures),
            time=self.time,
            origin=(500.0, 400.0),
        )
        several = self.n_exposures > 1
        epochs = 2002 + 8 * (rng.permutation(self.n_exposures) / self.n_exposures) ** 1.5
        theta = truth_of(model, rng)
        table, _ = simulate_matches(
            model,
            theta,
            self.n,
            rng=rng,
            fraction=0.0,
            sigma=SIGMA,
            mag=rng.uniform(10, 18, self.n),
            epochs=epochs if several else None,
        )
        uv = model.predict(theta, table.x, table.y, **columns_of(table))
        uv += SIGMA * self.noise(rng, self.n)
        false = rng.uniform(size=self.n) < self.fraction
        uv[false] += 0.5 * gaussian(rng, int(false.sum()))
        table = table.with_columns(u=uv[:, 0], v=uv[:, 1], colour=rng.normal(1, 0.3, self.n))
        if self.misquoted:
            factors = np.exp(self.misquoted * rng.standard_normal((2, self.n)))
            table = table.with_errors(tuple(SIGMA * factors))
        return model, table

    def solve(self, model: DistortionModel, table: Matches) -> LinearFit | Posterior:
        if self.mixture:
            return mode_of(table, model)[0]
        return fit_linear(table, model, rejection=Rejection(clip_abs=None))

    def tests(self, seed: int, **options) -> dict[str, ScoreTest]:
        model, table = self.data(seed)
        return by_name(score_tests(table, self.solve(model, table), **options))

    def with_pattern(self, seed: int, pattern: Callable[[Matches], np.ndarray], **options):
        """Tests of data to which a pattern (N, 2) was added."""
        model, table = self.data(seed)
        table = moved(table, pattern(table))
        return by_name(score_tests(table, self.solve(model, table), **options))

    def fitted(self, seed: int) -> tuple[Matches, LinearFit | Posterior]:
        model, table = self.data(seed)
        return table, self.solve(model, table)


def by_name(tests: tuple[ScoreTest, ...]) -> dict[str, ScoreTest]:
    out = {one.name: one for one in tests}
    assert len(out) == len(tests)
    return out


def terms_of(total: int, table: Matches) -> tuple[np.ndarray, np.ndarray]:
    """Products of Legendre polynomials (N, total + 1) of a total order; their mean squares.

    On the detector of `CHIP`.
    """
    X, Y = ((2 * z - n - 1) / n for z, n in zip((table.x, table.y), CHIP.size, strict=True))
    P, Q = legendre.legvander(X, total), legendre.legvander(Y, total)
    phi = np.stack([P[:, total - j] * Q[:, j] for j in range(total + 1)], axis=1)
    area = np.array([1 / ((2 * (total - j) + 1) * (2 * j + 1)) for j in range(total + 1)])
    return phi, area


def polynomial(total: int, rms: float, seed: int) -> Callable[[Matches], np.ndarray]:
    """Random terms of one total order, of this rms over the detector, both axes together."""
    c = np.random.default_rng([3, seed]).standard_normal((total + 1, 2))

    def pattern(table: Matches) -> np.ndarray:
        phi, area = terms_of(total, table)
        return phi @ c * (rms / np.sqrt((c**2).sum(axis=1) @ area))

    return pattern


def scenes_of_null() -> Iterator[tuple[str, Scene]]:
    """Data that the model describes."""
    for order in range(1, 6):
        yield f"order {order}", Scene(500, order)
    yield "student", Scene(500, noise=student)
    yield "unequal", Scene(500, noise=unequal)
    yield "clipped", Scene(600, fraction=0.05)
    yield "mixture", Scene(600, 2, fraction=0.05, mixture=True)
    yield "few", Scene(25, 1)
    yield "frames", Scene(600, 2, "shift_rotation", 5)
    yield "chips", Scene(800, 2, "shift_rotation_scale", 4, TWO_CHIPS)
    yield "time", Scene(600, 2, "shift", 6, time=TIME)
    yield "misquoted", Scene(500, 2, misquoted=1.0)
    yield "nothing left", Scene(60, 1, "shift", 20)
    yield "mostly false", Scene(600, 2, fraction=0.4, mixture=True)
    yield "many chips", Scene(1500, 1, "shift", 3, MANY_CHIPS)


def assert_no_smaller_than_chance(test: str, p: np.ndarray) -> None:
    """Of p-values (n,) no more are below 0.5, 0.1 and 0.01 than chance makes."""
    for level in (0.5, 0.1, 0.01):
        beyond = int((p < level).sum())
        # of some hundred comparisons none, but for a liberal one
        assert stats.binom.sf(beyond - 1, len(p), level) > 1e-5, (test, level, beyond, len(p))


def assert_even(test: str, p: np.ndarray) -> None:
    """The mean of p-values (n,) is one half within its scatter."""
    assert abs(p.mean() - 0.5) < 0.06 + 1.2 / np.sqrt(len(p)), (test, p.mean(), len(p))
