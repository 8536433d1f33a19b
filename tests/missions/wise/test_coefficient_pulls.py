"""Coefficients of calibrated WISE bands against the truth, with false matches in the data.

Many small sets of all four bands; one of the two families has the partition pattern as well, which
holds no polynomial and so must not move a coefficient, but makes residuals larger than quoted.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binomtest, chi2, kstest, norm

from bayesdist.missions.wise.published import WISE_BANDS
from tests.infer.calibration import over_seeds
from tests.reduced import only_in_full

from .calibrations import with_pattern, without_pattern

pytestmark = pytest.mark.slow

RARE = 1e-4  # probability of failing by chance, in each test


@pytest.fixture(scope="module", params=[without_pattern, with_pattern], ids=["plain", "pattern"])
def runs(request, full: bool):
    if not full and request.param is without_pattern:
        pytest.skip("sets with the pattern are run: set BAYESDIST_FULL=1")
    return over_seeds(request.param, 4 * (40 if full else 2))


def pulls(runs, band: str | None = None) -> np.ndarray:
    return np.array([r["pulls"] for r in runs if band in (None, r["band"])])


@only_in_full("tests/infer/test_high_orders converges")
def test_all_converge(runs):
    assert all(r["converged"] for r in runs)


@pytest.mark.parametrize("band", [None, *WISE_BANDS])
def test_errors_have_the_size_that_is_stated(runs, band, capsys):
    """Joint chi-square of 30 coefficients, summed over the sets: exact where these correlate."""
    some = [r for r in runs if band in (None, r["band"])]
    dof = 30 * len(some)
    total = sum(r["chi2"] for r in some)
    with capsys.disabled():
        found = pulls(runs, band)
        clipped = np.array([r["clipped"] for r in some])
        print(
            f"\n{band or 'all'}: chi2/dof {total / dof:.3f} of {dof}, "
            f"rms of pulls {np.sqrt(np.mean(found**2)):.3f} "
            f"(u {np.sqrt(np.mean(found[:, :15] ** 2)):.3f}, "
            f"v {np.sqrt(np.mean(found[:, 15:] ** 2)):.3f}), "
            f"clipped least squares {np.sqrt(np.mean(clipped**2)):.3f}"
        )
    assert chi2.ppf(RARE / 2, dof) < total < chi2.isf(RARE / 2, dof)


@pytest.mark.parametrize("limit", [1.0, 2.0, 3.0])
def test_tails_are_normal(runs, limit, capsys):
    far = np.abs(pulls(runs)).ravel() > limit
    with capsys.disabled():
        print(f"\nbeyond {limit:g} sigma: {far.mean():.4f}, normal {2 * norm.sf(limit):.4f}")
    assert binomtest(int(far.sum()), far.size, 2 * norm.sf(limit)).pvalue > RARE


def test_pulls_are_normal(runs, capsys):
    found = kstest(pulls(runs).ravel(), "norm")
    with capsys.disabled():
        print(f"\nKolmogorov-Smirnov: D = {found.statistic:.4f}, p = {found.pvalue:.3f}")
    assert found.pvalue > RARE


def test_no_coefficient_is_biased(runs):
    """Mean pull of each of the 4 x 30 coefficients: the largest of them is no wonder."""
    z = np.array([pulls(runs, b).mean(axis=0) * np.sqrt(len(pulls(runs, b))) for b in WISE_BANDS])
    assert np.abs(z).max() < norm.isf(RARE / 2 / z.size)
