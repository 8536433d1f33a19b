"""Stars of which some are displaced from the others, made with numpy alone."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.diagnose import ScoreTest, score_tests
from bayesdist.infer import OutlierMixture
from bayesdist.model import Chip, DistortionModel
from tests.infer.patterned import mode_of

SIDE = 2048.0
CHIP = Chip(1, "A", (SIDE, SIDE), (SIDE / 2, SIDE / 2))
SIGMA = 0.02  # px
SHAPE = (
    *("skewness by position", "skewness of a patch", "correlation by position", "two cores"),
    *("shape by position", "displaced stars", "displaced group of stars"),
)

Noise = Callable[[np.random.Generator, int], np.ndarray]


def scaled(pixel: np.ndarray) -> np.ndarray:
    """Pixels as -1 to 1 over the detector."""
    return (pixel - SIDE / 2) / (SIDE / 2)


def true_map(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """True positions (n, 2): pixels from the middle, displaced by a cubic polynomial."""
    X, Y = scaled(x), scaled(y)
    du = 9 * X * Y + 5 * X**2 - 4 * X**3 + 3 * X * Y**2
    dv = 7 * Y**2 - 6 * X * Y + 5 * X**2 * Y - 2 * Y**3
    return np.stack([x - SIDE / 2 + du, y - SIDE / 2 + dv], axis=1)


def direction(rng: np.random.Generator) -> np.ndarray:
    angle = rng.uniform(0, 2 * np.pi)
    return np.array([np.cos(angle), np.sin(angle)])


def gaussian(rng: np.random.Generator, n: int) -> np.ndarray:
    return rng.standard_normal((n, 2))


def student(rng: np.random.Generator, n: int, dof: int = 4) -> np.ndarray:
    """One factor for both axes of a star."""
    return gaussian(rng, n) / np.sqrt(rng.chisquare(dof, (n, 1)) / dof)


def student_by_axis(rng: np.random.Generator, n: int) -> np.ndarray:
    return rng.standard_t(5, (n, 2))


def unequal(rng: np.random.Generator, n: int) -> np.ndarray:
    """Errors that differ from star to star by a factor of two either way, quoted alike."""
    return gaussian(rng, n) * np.exp(0.7 * rng.standard_normal((n, 1)))


def in_circle(rng: np.random.Generator, n: int, radius: float) -> np.ndarray:
    """Points (n, 2) that are even within a circle."""
    r, angle = radius * np.sqrt(rng.uniform(size=n)), rng.uniform(0, 2 * np.pi, n)
    return np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1)


def matches_of(x, y, uv, sigma: float = SIGMA, **columns) -> Matches:
    errors = np.full(len(x), sigma)
    return Matches(x, y, *np.asarray(uv).T, sigma_u=errors, sigma_v=errors.copy(), **columns)


def scene(
    rng: np.random.Generator,
    n: int,
    displaced: Callable[[np.random.Generator, np.ndarray, np.ndarray], np.ndarray] | None = None,
    *,
    noise: Noise = gaussian,
    false: float = 0.04,
    radius: float | None = None,
) -> Matches:
    """Stars with displacements (n, 2) by a function of the generator and of x and y.

    A fraction is false: of a scatter of 0.6 px, or even within a radius.
    """
    x, y = rng.uniform(0.5, SIDE + 0.5, (2, n))
    uv = true_map(x, y) + SIGMA * noise(rng, n)
    if displaced is not None:
        uv += displaced(rng, x, y)
    wrong = rng.uniform(size=n) < false
    far = 0.6 * gaussian(rng, n) if radius is None else in_circle(rng, n, radius)
    return matches_of(x, y, uv + wrong[:, None] * far)


def two_visits(apart: float, share: Callable[[np.ndarray], np.ndarray], turned: float = 0.0):
    """The share of the second visit, by X, lies so far from the first, and is turned (px)."""

    def displaced(rng, x, y):
        second = rng.uniform(size=len(x)) < share(scaled(x))
        rotation = turned * np.stack([-scaled(y), scaled(x)], axis=1)
        return second[:, None] * (apart * direction(rng) + rotation)

    return displaced


def third(apart: float, own: float = 0.0):
    """A third of the stars has moved, all by the same distance and each by its own motion (px)."""

    def displaced(rng, x, y):
        hit = rng.uniform(size=len(x)) < 1 / 3
        return hit[:, None] * (apart * direction(rng) + own * gaussian(rng, len(x)))

    return displaced


def tail(scale: float, share: float):
    """Exponential displacements to one side, of more stars towards one edge."""

    def displaced(rng, x, y):
        hit = rng.uniform(size=len(x)) < share * (1 + scaled(x)) / 2
        return (hit * rng.exponential(scale, len(x)))[:, None] * direction(rng)

    return displaced


def halo(share: float, across: float = 600.0, sigmas: float = 3.0):
    """Of the stars in a circle a share is false, all displaced alike."""

    def displaced(rng, x, y):
        middle = rng.uniform(400, SIDE - 400, 2)
        inside = np.hypot(x - middle[0], y - middle[1]) < across / 2
        hit = inside & (rng.uniform(size=len(x)) < share)
        return hit[:, None] * sigmas * SIGMA * direction(rng)

    return displaced


def model_of(order: int = 3) -> DistortionModel:
    return DistortionModel(order, (CHIP,))


def examined(
    matches: Matches,
    order: int = 3,
    mixture: OutlierMixture | None = None,
    match_radius: float | None = None,
) -> dict[str, ScoreTest]:
    """Score tests at the mode of the posterior, by their names."""
    posterior, _ = mode_of(matches, model_of(order), mixture)
    found = score_tests(matches, posterior, match_radius=match_radius)
    return {test.name: test for test in found}


def nominal_within(
    rng: np.random.Generator,
    n: int,
    radius: float,
    *,
    sigma: float = SIGMA,
    off: float = 0.06,
    false: float = 0.1,
) -> tuple[Matches, int]:
    """Matches that were cut at a radius about nominal positions, which are off by a smooth field.

    With the nominal positions, and with the number of true matches that were cut. False ones are
    even within the radius.
    """
    x, y = rng.uniform(0.5, SIDE + 0.5, (2, n))
    true = true_map(x, y)
    X, Y = scaled(x), scaled(y)
    error = off * np.stack([np.sin(2 * X + Y + 1), np.cos(1.5 * Y - X)], axis=1)
    wrong = rng.uniform(size=n) < false
    uv = np.where(
        wrong[:, None],
        true + error + in_circle(rng, n, radius),
        true + sigma * gaussian(rng, n),
    )
    kept = np.hypot(*(uv - true - error).T) < radius
    nominal = (true + error)[kept]
    columns = dict(zip(("u_nominal", "v_nominal"), nominal.T, strict=True))
    return matches_of(x[kept], y[kept], uv[kept], sigma, **columns), int((~kept).sum())


@dataclass(frozen=True)
class Described:
    """Displaced stars as a finding describes them."""

    share: float
    share_sigma: float
    shift: np.ndarray  # (2,)
    shift_sigma: np.ndarray


def described(test: ScoreTest) -> Described:
    """Numbers in the finding of a displaced group of stars."""
    pair = r"(-?[\d.]+) \+- ([\d.]+)"
    varies = r"(?: \(from \d+ to \d+ % over the field\))?"
    text = rf"{pair} % of them{varies} by {pair} pix along u and {pair} pix along v"
    found = re.search(text, test.finding)
    assert found, test.finding
    share, share_sigma, u, sigma_u, v, sigma_v = map(float, found.groups())
    return Described(share / 100, share_sigma / 100, np.array([u, v]), np.array([sigma_u, sigma_v]))
