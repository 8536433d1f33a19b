"""Simulated tables that are written as they come are the tables that would have been returned."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from scipy import stats

from bayesdist.data import Matches, open_matches, read_matches
from bayesdist.errors import InputError
from bayesdist.missions.wise.simulate import simulate_wise, simulate_wise_partitioned, wise_solution
from bayesdist.simulate import simulate_partitioned

NAMES = ("x", "y", "u", "v", "sigma_u", "sigma_v", "mag")


def test_reading_back_gives_the_same_numbers(tmp_path):
    truth = simulate_wise_partitioned(tmp_path, 5000, rng=np.random.default_rng(3), jitter=0.05)
    matches, expected = simulate_wise(5000, rng=np.random.default_rng(3), jitter=0.05)
    back = read_matches(tmp_path)
    for name in NAMES:
        assert getattr(back, name).tobytes() == getattr(matches, name).tobytes()
    assert (truth.false == expected.false).all() and truth.jitter == 0.05
    assert back.unit == matches.unit and back.exposure_names == matches.exposure_names


def test_chunks_follow_one_generator(tmp_path):
    simulate = partial(simulate_wise, rng=np.random.default_rng(3))
    truth = simulate_partitioned(tmp_path, 2500, simulate, chunk=1000)
    assert len(list(tmp_path.iterdir())) == 3
    rng = np.random.default_rng(3)
    chunks, truths = zip(*(simulate_wise(n, rng=rng) for n in (833, 833, 834)), strict=True)
    expected = Matches.concatenate(chunks)
    opened = open_matches(tmp_path)
    (piece,) = opened.readers()
    back = piece.load()
    for name in NAMES:
        assert getattr(back, name).tobytes() == getattr(expected, name).tobytes()
    assert (truth.false == np.concatenate([t.false for t in truths])).all()


def test_pairs_scatter_about_the_published_solution_across_chunks(tmp_path):
    simulate = partial(simulate_wise, rng=np.random.default_rng(8), fraction=0.1)
    truth = simulate_partitioned(tmp_path, 40_000, simulate, chunk=7000)
    model, theta = wise_solution()
    m = read_matches(tmp_path)
    r = np.column_stack([m.u, m.v]) - model.predict(theta, m.x, m.y)
    wide = np.hypot(np.column_stack([m.sigma_u, m.sigma_v]), truth.jitter)
    assert stats.kstest((r / wide)[~truth.false].ravel(), "norm").pvalue > 1e-3
    assert stats.kstest(r[truth.false].ravel(), "norm").pvalue > 1e-3
    assert stats.binomtest(int(truth.false.sum()), 40_000, 0.1).pvalue > 1e-3


def test_large_tables_follow_the_model_in_all_steps():
    """Beyond 65 536 rows positions are computed in steps: an error there would be one of pixels."""
    n = 70_001
    matches, truth = simulate_wise(n, rng=np.random.default_rng(5), fraction=0.0, jitter=0.0)
    model, theta = wise_solution()
    r = np.column_stack([matches.u, matches.v]) - model.predict(theta, matches.x, matches.y)
    z = r / np.column_stack([matches.sigma_u, matches.sigma_v])
    assert not truth.false.any()
    for rows in np.array_split(np.arange(n), 20):
        assert np.abs(z[rows]).max() < 6.0


def test_errors(tmp_path):
    rng = np.random.default_rng(1)
    with pytest.raises(InputError, match="no band 'W9'"):
        simulate_wise_partitioned(tmp_path, 100, band="W9", rng=rng)
    assert not list(tmp_path.iterdir())
    simulate_wise_partitioned(tmp_path, 100, rng=rng)
    with pytest.raises(InputError, match="holds Parquet files already"):
        simulate_wise_partitioned(tmp_path, 100, rng=rng)
    with pytest.raises(InputError, match="no tables to write"):
        simulate_wise_partitioned(tmp_path / "none", 0, rng=rng)
