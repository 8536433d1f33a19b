"""Sets of WISE pairs in memory, and their calibrations."""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from bayesdist.data import Matches
from bayesdist.infer import Rejection, fit_linear, sample
from bayesdist.missions.wise.published import WISE_BANDS
from bayesdist.missions.wise.simulate import PairChunk, WiseSet, wise_set

CLIP_ABS = 3.0  # pixels: the match circle in the corners

FEW = 4000  # pairs of a set whose pulls are looked at


def pairs_of(one: WiseSet) -> PairChunk:
    """All pairs of a set."""
    chunks = [one.chunk(k) for k in range(len(one.edges) - 1)]
    names = [f.name for f in fields(PairChunk)]
    return PairChunk(*(np.concatenate([getattr(c, name) for c in chunks]) for name in names))


def matches_of(pairs: PairChunk) -> Matches:
    """What a calibration is given."""
    return Matches(pairs.x, pairs.y, pairs.u, pairs.v, pairs.sigma, pairs.sigma)


def calibration_of(task: int, partition: bool) -> dict[str, object]:
    """A small set of one band, calibrated: seeds run slowest, bands fastest."""
    band, seed = WISE_BANDS[task % 4], 100 + task // 4
    one = wise_set(band, pairs=FEW, seed=seed, partition=partition)
    matches = matches_of(pairs_of(one))
    fit = fit_linear(matches, one.model, rejection=Rejection(clip_abs=CLIP_ABS))
    posterior = sample(fit, matches, seed=seed)
    d = posterior.mean - one.theta
    return {
        "band": band,
        "pulls": d / posterior.sigma,
        "chi2": float(d @ np.linalg.solve(posterior.cov, d)),
        "clipped": (fit.mean - one.theta) / fit.sigma,
        "converged": posterior.convergence.converged,
    }


def with_pattern(task: int) -> dict[str, object]:
    return calibration_of(task, True)


def without_pattern(task: int) -> dict[str, object]:
    return calibration_of(task, False)
