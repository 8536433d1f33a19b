"""Held-out stars that share the errors of a look-up table, from a catalogue that quotes none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.stats import binom, kstest

from bayesdist.data import Matches
from bayesdist.diagnose.holdout.predictive import Predictive
from bayesdist.diagnose.holdout.validation import holdout_validation
from bayesdist.model import Chip, DistortionModel, LookupTable

SIZE, CELL = (1000.0, 800.0), (25.0, 25.0)
OWN, LOCAL = 0.02, 0.006
MODEL = DistortionModel(1, (Chip(1, "A", SIZE, (500.5, 400.5)),))
THETA = np.zeros(MODEL.n_params)
RUNS = 12


def held(seed: int, n: int = 20_000) -> Matches:
    """Stars with errors of their own, and one on each axis for all stars of a cell."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(1, SIZE[0], n), rng.uniform(1, SIZE[1], n)
    cell = LOCAL * rng.standard_normal((33, 41, 2))
    data = MODEL.predict(THETA, x, y) + OWN * rng.standard_normal((n, 2))
    data += cell[(y // CELL[1]).astype(int), (x // CELL[0]).astype(int)]
    sigma = np.full(n, OWN)
    return Matches(x=x, y=y, u=data[:, 0], v=data[:, 1], sigma_u=sigma, sigma_v=sigma, unit="pix")


def predictive() -> Predictive:
    values = np.full((2, 33, 41), LOCAL)
    table = LookupTable(1, values, first=(1.0, 1.0), step=CELL)
    cov = np.zeros((MODEL.n_params,) * 2)
    return Predictive(MODEL, THETA, cov, local=(table,), cell=CELL)


def test_right_predictions_raise_no_alarm() -> None:
    """Offsets in 64 regions have uniform probabilities, and all tests together are calm."""
    judged = [holdout_validation(predictive(), held(seed)) for seed in range(RUNS)]
    p = [t.p_value for one in judged for t in one.tests if t.name == "offset" and t.index >= 0]
    assert len(p) > 60 * RUNS and kstest(p, "uniform").pvalue > 1e-3
    assert sum(one.p_value < 0.05 for one in judged) <= binom.ppf(0.999, RUNS, 0.05)


def test_stars_that_are_taken_for_independent_would_be_alarms() -> None:
    """The same errors at the same places, of which it is not known that stars share them."""
    alone = replace(predictive(), cell=None)
    for seed in range(3):
        assert holdout_validation(alone, held(seed)).p_value < 1e-6


def test_few_large_cells_raise_no_alarm_about_distributions() -> None:
    """63 cells, fewer than three for each bin of probabilities: what a run of 900 stars has."""
    side, local = (120.0, 120.0), 0.002

    def one(seed: int) -> list[float]:
        rng = np.random.default_rng(seed)
        n = 900
        x, y = rng.uniform(1, SIZE[0], n), rng.uniform(1, SIZE[1], n)
        cell = local * rng.standard_normal((7, 9, 2))
        data = MODEL.predict(THETA, x, y) + OWN * rng.standard_normal((n, 2))
        data += cell[(y // side[1]).astype(int), (x // side[0]).astype(int)]
        sigma = np.full(n, OWN)
        stars = Matches(
            x=x, y=y, u=data[:, 0], v=data[:, 1], sigma_u=sigma, sigma_v=sigma, unit="pix"
        )
        table = LookupTable(1, np.full((2, 7, 9), local), first=(1.0, 1.0), step=side)
        cov = np.zeros((MODEL.n_params,) * 2)
        found = holdout_validation(Predictive(MODEL, THETA, cov, local=(table,), cell=side), stars)
        return [t.p_value for t in found.tests if t.name == "distribution"]

    p = np.array([one(seed) for seed in range(60)])
    assert kstest(p.ravel(), "uniform").pvalue > 1e-3
    assert p.min() > 1e-5
