"""Stars of a catalogue in exposures of many dates, on two chips that may move, by themselves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.diagnose import ScoreTest, score_tests
from bayesdist.diagnose.score.motions import gap_test, motion_test
from bayesdist.diagnose.score.projection import projection_of
from bayesdist.diagnose.score.questions import functions_for
from bayesdist.diagnose.score.result import Outcome
from bayesdist.diagnose.score.sample import scored_sample
from bayesdist.infer import GaussianPriors, LinearFit, Rejection, fit_linear
from bayesdist.model import DistortionModel, TimeDependence

from ..infer.support import TWO_CHIPS, columns_of, exposures, table, truth_of
from .support import SIGMA, by_name, gaussian

YEARS = 10.0
DRIFT = TimeDependence((("u", 1, 0), ("v", 0, 1)), (2007.0,))


@dataclass(frozen=True)
class Dated:
    """A kind of data.

    Parameters
    ----------
    exposures, stars : int
    frames : str
    time : TimeDependence or None
    noise : callable
        Random generator and number to errors (n, 2) of unit variance.
    position, motion : float
        Errors of the catalogue, pixels and pixels a year.
    stated : bool
        Whether the table has those of the motions.
    gap, turn : float
        Pixels a year: of the second chip's shift along y, and of its rotation at half a side.
    restless : float
        Pixels: scatter of the second chip, along both axes, from exposure to exposure.
    moving, speed : float
        Fraction of the stars that move, and the scatter of their motions, pixels a year.
    wander : float
        Of the dates at which a star is on the same chip: 0 for always.
    """

    exposures: int = 14
    stars: int = 160
    frames: str = "shift_rotation"
    time: TimeDependence | None = None
    noise: Callable[[np.random.Generator, int], np.ndarray] = gaussian
    position: float = 0.01
    motion: float = 0.0
    stated: bool = True
    gap: float = 0.0
    turn: float = 0.0
    restless: float = 0.0
    moving: float = 0.0
    speed: float = 0.0
    wander: float = 1.0

    def data(self, seed: int) -> tuple[DistortionModel, Matches]:
        rng = np.random.default_rng([seed, self.exposures, self.stars])
        model = DistortionModel(
            2, TWO_CHIPS, frames=self.frames, exposures=exposures(self.exposures), time=self.time
        )
        E, S = self.exposures, self.stars
        exposure, star = np.repeat(np.arange(E), S), np.tile(np.arange(S), E)
        epoch = (2002 + YEARS * np.append([0, 1], rng.uniform(size=E - 2)))[exposure]
        chip = rng.integers(2, size=S)[star]
        chip = np.where(rng.uniform(size=E * S) < self.wander, rng.integers(2, size=E * S), chip)
        size = np.array([one.size for one in TWO_CHIPS])[chip]
        at = rng.uniform(0.05, 0.95, (S, 2))[star] + rng.uniform(-0.05, 0.05, (E * S, 2))
        x, y = (at * size).T + 0.5
        theta = truth_of(model, rng)
        first = {"u": np.zeros(E * S), "v": np.zeros(E * S), "sigma": SIGMA, "unit": "pix"}
        matches = table(
            x,
            y,
            **first,
            exposure=exposure,
            exposure_names=exposures(E),
            chip=chip,
            chip_numbers=(1, 2),
            epoch=epoch,
            star=star,
        )
        uv = model.predict(theta, x, y, **columns_of(matches))
        years = (epoch - 2007.0)[:, None]
        uv = uv + self._second(rng, theta, model, matches, uv, years[:, 0])
        catalogue = self.position * rng.standard_normal((S, 2))
        moves = self.motion * rng.standard_normal((S, 2))
        moves += (rng.uniform(size=(S, 1)) < self.moving) * self.speed * rng.standard_normal((S, 2))
        uv += catalogue[star] + years * moves[star] + SIGMA * self.noise(rng, E * S)
        quoted = np.sqrt(SIGMA**2 + self.position**2 + (self.motion * years[:, 0]) ** 2)
        added = {"u": uv[:, 0], "v": uv[:, 1]}
        if self.stated:
            zero = np.zeros(E * S)
            added |= {"pm_u": zero, "pm_v": zero}
            added |= {f"sigma_pm_{a}": np.full(E * S, self.motion) for a in "uv"}
        return model, matches.with_errors((quoted, quoted)).with_columns(**added)

    def _second(self, rng, theta, model, matches, uv, years) -> np.ndarray:
        """What the second chip's own motion does to positions (N, 2)."""
        own = self.restless * rng.standard_normal((self.exposures, 2))[matches.exposure]
        own[:, 1] += self.gap * years
        half = max(TWO_CHIPS[1].size) / 2
        away = np.stack([matches.x, matches.y], 1) - TWO_CHIPS[1].reference_pixel
        own += (self.turn / half * years)[:, None] * away @ [[0, 1], [-1, 0]]
        turn = np.array([model.frame(theta, e)[0] for e in range(self.exposures)])
        moved = np.einsum("nab,nb->na", turn[matches.exposure], own)
        return np.where(matches.chip[:, None] == 1, moved, 0.0)

    def solve(self, model: DistortionModel, matches: Matches) -> LinearFit:
        return fit_linear(matches, model, rejection=Rejection(clip_abs=None))

    def of_time(self, seed: int) -> dict[str, Outcome]:
        """The two tests alone, in a fraction of the time."""
        model, matches = self.data(seed)
        fit = self.solve(model, matches)
        projection = projection_of(
            functions_for(scored_sample(matches, fit)), fit.mean, GaussianPriors.none(model)
        )
        found = gap_test(projection), motion_test(projection.scored)
        return {one.name: one for one in found if one is not None}

    def tests(self, seed: int) -> dict[str, ScoreTest]:
        model, matches = self.data(seed)
        return by_name(score_tests(matches, self.solve(model, matches)))
