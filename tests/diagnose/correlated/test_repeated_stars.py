"""Stars that are measured several times: their errors, and what is not to be seen in them."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.data import Matches
from bayesdist.diagnose.correlated import estimate_discrepancy
from bayesdist.diagnose.diagnostics import diagnose_fit
from bayesdist.diagnose.score.tests import score_tests
from bayesdist.infer import build_model, fit_linear
from bayesdist.infer.stars.loading import opened

SIZE, STARS, CATALOGUE, CENTROID = 2048.0, 600, 0.02, 0.005


def measured(kind: str, seed: int) -> tuple[Matches, np.ndarray]:
    """Stars whose reference errors are common to several rows, and the code of these errors."""
    rng = np.random.default_rng([11, seed])
    times = rng.integers(1, 6, STARS) if kind == "unequal" else np.full(STARS, 3)
    times = np.full(STARS // 4, 4) if kind == "groups" else times
    code = np.repeat(np.arange(len(times)), times)
    x, y = rng.uniform(10, SIZE - 10, (2, len(times)))[:, code]
    if kind == "groups":  # four pinholes about each fiducial, which is on a grid
        side = np.arange(len(times))
        x = 60.0 + 150.37 * (side % 13)[code] + np.tile([0.0, 4.0, 0.0, 4.0], len(times))
        y = 60.0 + 150.73 * (side // 13)[code] + np.tile([0.0, 0.0, 4.0, 4.0], len(times))
    error = CATALOGUE * rng.standard_normal((2, len(times)))[:, code]
    position = np.stack([x, y]) + CENTROID * rng.standard_normal((2, len(code)))
    sigma = np.full(len(code), np.hypot(CATALOGUE, CENTROID))
    stars = Matches(*position, x + error[0], y + error[1], sigma_u=sigma, sigma_v=sigma)
    return stars.with_star_codes(), code


def rms_in_common(table: Matches, code: np.ndarray) -> float:
    """Rms of the errors that rows have in common in this sample."""
    means = [
        np.bincount(code, z) / np.bincount(code) for z in (table.u - table.x, table.v - table.y)
    ]
    return float(np.sqrt(np.mean(np.square(means)) - CENTROID**2 / (len(code) / len(means[0]))))


def true_covariance(fit, table: Matches, code: np.ndarray) -> np.ndarray:
    """Covariance of the coefficients of u by ordinary least squares with errors in common."""
    basis = fit.model.basis().evaluate(table.x, table.y)
    solve = np.linalg.pinv(basis)
    by_star = np.stack([np.bincount(code, row) for row in solve])
    return CATALOGUE**2 * by_star @ by_star.T + CENTROID**2 * solve @ solve.T


@pytest.mark.parametrize("kind", ["three", "unequal", "groups"])
def test_errors_of_the_fit_are_those_of_stars(kind, full):
    """Against the closed form; what a star has in common is no structure."""
    ratio = []
    for seed in range(8 if full else 1):
        table, code = measured(kind, seed)
        fit = fit_linear(table, build_model(table, order=3, size=(SIZE, SIZE)))
        found = estimate_discrepancy(
            table, fit, rng=np.random.default_rng(1), sample=table, stars=table, n_draws=300
        )
        block = fit.model.coefficient_slice(1, 0)
        expected = true_covariance(fit, table, code)
        got = np.linalg.solve(expected, found.noise[block, block])
        ratio.append(np.trace(got) / len(expected))
        # 300 numbers and more tell it to 4 %, and the fit takes some of them
        assert found.facts["star_rms"] == pytest.approx(rms_in_common(table, code), rel=0.12)
        assert max(row["rms"] for row in found.facts["structure"]) < 0.2 * CATALOGUE
    # a variance of 150 stars and more on two axes is known to a tenth, that of one sample
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.15 if full else 0.4)


def examined(table: Matches):
    """Significant score tests by name, and the p-value of structure in the residuals."""
    fit = fit_linear(table, build_model(table, order=3, size=(SIZE, SIZE)))
    with opened(fit.model, table) as shards:
        diagnostics = diagnose_fit(
            fit,
            None,
            table,
            shards,
            table,
            eliminated=None,
            centroid=None,
            known=False,
            match_radius=None,
            in_circle=False,
            matched_before=True,
        )
    found = {t.name for t in score_tests(table, fit) if t.significant}
    return found, diagnostics.misfits[0].p_value, diagnostics


def test_tests_of_residuals_count_stars():
    """Rows that count each by itself show waves and structure that are not there."""
    table, _ = measured("three", 3)
    found, p, diagnostics = examined(table)
    assert not found and p > 1e-3
    names = {check.name for check in diagnostics.input_checks}
    assert "Stars with several detections in one exposure" in names
    apart = table.with_columns(star=np.arange(len(table)))
    found, p, _ = examined(apart)
    assert "repeating pattern" in found and p < 1e-6
    table, _ = measured("groups", 3)
    found, p, diagnostics = examined(table)
    assert not found and p > 1e-3
    assert "Tight groups of stars" in {check.name for check in diagnostics.input_checks}
