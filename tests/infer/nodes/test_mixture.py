"""Which matches are false: what is not wide is not false, however the errors were quoted."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.infer.nodes import fit_mixture

N = 20_000


def residuals(rng, *, false: float, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Stars of two kinds, 0.015 and 0.03 px, and some false matches."""
    sigma = np.where(rng.random(N) < 0.6, 0.015, 0.03)
    wrong = rng.random(N) < false
    return rng.standard_normal((N, 2)) * np.where(wrong, width, sigma)[:, None], wrong


@pytest.mark.parametrize("quoted", [0.01, 0.02, 0.035, 0.06])
def test_true_matches_are_not_false_whatever_errors_are_quoted(quoted):
    r, _ = residuals(np.random.default_rng(1), false=0.0, width=1.0)
    found = fit_mixture(r, np.full_like(r, quoted**2))
    # of the wider kind, two fifths, those beyond twice their sigma may be doubted: a seventh
    assert found.fraction < 0.4 / 7 + 0.01
    assert np.mean(found.probability > 0.5) > 0.95


@pytest.mark.parametrize("quoted", [0.02, 0.035])
def test_false_matches_are_found_where_the_errors_are_too_large_or_too_small(quoted):
    r, wrong = residuals(np.random.default_rng(2), false=0.05, width=0.6)
    found = fit_mixture(r, np.full_like(r, quoted**2))
    assert found.fraction == pytest.approx(0.05, abs=0.012)
    assert found.outlier_scale == pytest.approx(0.6, rel=0.15)
    assert np.mean(found.probability[~wrong] > 0.5) > 0.98
    # those that lie among the stars by chance cannot be told
    assert np.mean(found.probability[wrong] < 0.5) > 0.9
