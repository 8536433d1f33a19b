"""Sampling of unknown break dates, with the parameters of the trend integrated out.

The prior of a date is uniform over the span of the series, with a minimum number of exposures in
each segment.  A break may be anywhere between two consecutive exposures, so that a candidate is a
random date in one of these gaps.  A new date is selected from the current date and several
candidates from a fixed density, with weights of likelihood times prior divided by that density.
Exchanging the current date with a candidate leaves the joint density unchanged, so that the
posterior is invariant (as in Tjelmeland 2004).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bayesdist.infer.series.design import Design
from bayesdist.infer.series.trend import MIN_EXPOSURES_FOUND
from bayesdist.utils.arrays import Bool, Float, Int

# log marginal likelihood (C, M) of dates (C, M, B), up to a constant for each chain
Likelihood = Callable[[Float], Float]

CANDIDATES = 8  # number of candidates per move
FROM_PRIOR = 0.25  # fraction of the prior in the density of the candidates


class BreakMoves:
    """Moves of the break dates of a trend with unknown breaks."""

    def __init__(self, design: Design) -> None:
        self.count = design.trend.find
        self.dates = np.unique(design.series.epoch)
        self.epoch = np.sort(design.series.epoch)
        self.width = np.diff(self.dates)
        self.prior = self.width / self.width.sum()
        self.density = np.tile(self.prior, (self.count, 1))
        self._seen = np.zeros_like(self.density)

    def possible(self, breaks: Float) -> Bool:
        """Boolean mask (...): dates (..., B) that ascend, with enough exposures in each segment."""
        place = np.searchsorted(self.epoch, breaks)
        shape = (*breaks.shape[:-1], 1)
        edges = np.concatenate([np.zeros(shape, int), place, np.full(shape, len(self.epoch))], -1)
        return np.all(np.diff(edges, axis=-1) >= MIN_EXPOSURES_FOUND, axis=-1)

    def _at(self, gap: Int, rng: np.random.Generator) -> Float:
        return self.dates[gap] + self.width[gap] * rng.random(gap.shape)

    def start(self, n_chains: int, likelihood: Likelihood, rng: np.random.Generator) -> Float:
        """Starting dates (C, B), found by adding one break after the other."""
        breaks = np.zeros((n_chains, 0))
        for _ in range(self.count):
            gap = np.broadcast_to(np.arange(len(self.width)), (n_chains, len(self.width)))
            new = self._at(gap, rng)[..., None]
            old = np.broadcast_to(breaks[:, None], (*gap.shape, breaks.shape[1]))
            trial = np.sort(np.concatenate([old, new], axis=-1), axis=-1)
            weight = np.where(self.possible(trial), likelihood(trial), -np.inf)
            weight += np.log(self.prior)
            if not np.isfinite(weight).any(axis=1).all():
                # no room for another break: distribute all breaks evenly over the exposures
                places = np.linspace(0, len(self.dates) - 1, self.count + 2)[1:-1].astype(int)
                return np.tile(self._at(places, rng), (n_chains, 1))
            breaks = _pick(trial, weight, rng)
        return breaks

    def scan(self, breaks: Float, likelihood: Likelihood, rng: np.random.Generator) -> Float:
        """New dates (C, B), drawn from all gaps, break by break; stores the probabilities."""
        for b in range(self.count):
            gap = np.broadcast_to(np.arange(len(self.width)), (len(breaks), len(self.width)))
            trial = self._trial(breaks, b, self._at(gap, rng))
            weight = np.where(self.possible(trial), likelihood(trial), -np.inf)
            weight = weight + np.log(self.prior)
            weight -= weight.max(axis=1, keepdims=True)
            probability = np.exp(weight) / np.exp(weight).sum(axis=1, keepdims=True)
            self._seen[b] += probability.mean(axis=0)
            breaks = _pick(trial, weight, rng)
        return breaks

    def learn(self) -> None:
        """Set the density of the candidates from the stored scans; it is fixed afterwards."""
        total = self._seen.sum(axis=1, keepdims=True)
        self.density = (1 - FROM_PRIOR) * self._seen / total + FROM_PRIOR * self.prior

    def move(self, breaks: Float, likelihood: Likelihood, rng: np.random.Generator) -> Float:
        """New dates (C, B), selected from the current dates and candidates, break by break."""
        n = len(breaks)
        for b in range(self.count):
            gap = rng.choice(len(self.width), size=(n, CANDIDATES), p=self.density[b])
            dates = np.concatenate([breaks[:, b : b + 1], self._at(gap, rng)], axis=1)
            trial = self._trial(breaks, b, dates)
            gap_index = np.searchsorted(self.dates, dates, side="right") - 1
            gap_index = np.clip(gap_index, 0, len(self.width) - 1)
            weight = np.where(self.possible(trial), likelihood(trial), -np.inf)
            weight = weight + np.log(self.prior[gap_index] / self.density[b][gap_index])
            breaks = _pick(trial, weight, rng)
        return breaks

    @staticmethod
    def _trial(breaks: Float, b: int, dates: Float) -> Float:
        trial = np.repeat(breaks[:, None], dates.shape[1], axis=1)
        trial[..., b] = dates
        return trial


def _pick(trial: Float, log_weight: Float, rng: np.random.Generator) -> Float:
    """Draw one of the M candidates (C, M, B) of each chain, with log weights (C, M)."""
    noise = rng.gumbel(size=log_weight.shape)
    best = np.argmax(log_weight + noise, axis=1)
    return trial[np.arange(len(trial)), best]
