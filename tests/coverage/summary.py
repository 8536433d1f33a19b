"""What many campaigns say together: shares with their bands, and reliability."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.stats import binom, chisquare

from .places import LEVELS

CONFIDENCE = 0.99
MOST = 20.0
BINS = (0.0, 0.2, 0.5, 0.8, 0.95, 1.0)


def band(share: float, n: float, tests: int = 1) -> tuple[float, float]:
    """Binomial band of a share of n that holds in all of so many tests with 99 % probability."""
    tail = (1 - CONFIDENCE) / 2 / tests
    whole = max(round(n), 1)
    low, high = binom.ppf([tail, 1 - tail], whole, share)
    return float(low / whole), float(high / whole)


@dataclass(frozen=True)
class Covered:
    """Errors of one term within intervals of one probability.

    Parameters
    ----------
    kind, term : str
    level : float
    share : float
        Of the errors that were within.
    n : int
        Errors.
    worth : float
        Independent errors that they are worth: the claimed errors of a campaign's places are
        correlated, and draws of them say by how much the share would scatter.
    pull : float
        Root mean square of errors in units of what is claimed, none counted above `MOST`.
    """

    kind: str
    term: str
    level: float
    share: float
    n: int
    worth: float
    pull: float

    def within(self, tests: int = 1) -> bool:
        low, high = band(self.level, self.worth, tests)
        return low <= self.share <= high


def covered_by_term(kind: str, campaigns: Sequence[dict]) -> list[Covered]:
    """Over the results of `places.covered`."""
    out = []
    for term in sorted({term for one in campaigns for term in one}):
        found = [one[term] for one in campaigns if term in one]
        pull = np.concatenate([one["pull"].ravel() for one in found]).clip(-MOST, MOST)
        for k, level in enumerate(LEVELS):
            expected = np.array([one["expected"][k] for one in found])  # campaigns, draws
            scatter = expected.var(axis=1).sum() / pull.size**2
            mean = expected.mean(axis=1).sum() / pull.size
            out.append(
                Covered(
                    kind,
                    term,
                    level,
                    float(sum(one["inside"][k] for one in found) / pull.size),
                    pull.size,
                    float(mean * (1 - mean) / scatter),
                    float(np.sqrt(np.mean(pull**2))),
                )
            )
    return out


@dataclass(frozen=True)
class Bin:
    """Calibrations that are said to meet their limit with about the same probability.

    Parameters
    ----------
    n : int
    said : float
        Mean probability.
    met : float
        Share that meets it in truth.
    """

    n: int
    said: float
    met: float

    def band(self, tests: int = 1) -> tuple[float, float]:
        return band(self.said, self.n, tests)

    def within(self, tests: int = 1) -> bool:
        low, high = self.band(tests)
        return low <= self.met <= high


def reliability(said: np.ndarray, met: np.ndarray) -> list[Bin]:
    """By said probability, bins that hold some."""
    which = np.clip(np.searchsorted(BINS, said, side="right") - 1, 0, len(BINS) - 2)
    return [
        Bin(int(here.sum()), float(said[here].mean()), float(met[here].mean()))
        for here in (which == k for k in range(len(BINS) - 1))
        if here.any()
    ]


def excess(said: np.ndarray, met: np.ndarray) -> float:
    """How many more meet their limits than is said, in standard deviations of chance."""
    return float((met - said).sum() / np.sqrt((said * (1 - said)).sum()))


WITHIN = (0.02, 0.98)  # ranks over which evenness is looked at


def farthest(ranks: np.ndarray) -> float:
    """Largest distance of the ranks' distribution (..., n) from an even one, in its own errors."""
    n = ranks.shape[-1]
    z = np.linspace(*WITHIN, 97)
    shares = np.mean(ranks[..., None] <= z, axis=-2)
    distance = np.abs(shares - z) / np.sqrt(z * (1 - z) / n)
    return distance.max(axis=-1)


RANK_BINS = 10


def evenness(ranks: np.ndarray) -> float:
    """Chi-square probability that ranks (n,) in ten bins are as uneven as these, or more so."""
    counts, _ = np.histogram(ranks, np.linspace(0, 1, RANK_BINS + 1))
    return float(chisquare(counts).pvalue)


@cache
def simultaneous_band(n: int, probability: float) -> float:
    """What `farthest` of n even ranks stays below with this probability."""
    rng = np.random.default_rng(n)
    return float(np.quantile(farthest(rng.uniform(size=(20_000, n))), probability))
