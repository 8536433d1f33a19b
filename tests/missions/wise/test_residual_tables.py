"""Tables 5-1, 5-2, 5-3 and C-1 from calibrations of simulated pairs: noise and pattern in theory.

Source of the tables: WSDC D-T033, section 5 and Appendix C.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2

from bayesdist.diagnose.periods import pattern_changes
from bayesdist.diagnose.residuals.binned import band_bins
from bayesdist.diagnose.residuals.tables import period_table
from bayesdist.infer import Rejection, fit_linear, load
from bayesdist.missions.wise.assess.distortion_field import band_sums
from bayesdist.missions.wise.assess.residual_tables import residual_tables
from bayesdist.missions.wise.published import RESIDUAL_SIGMAS, WISE_ARCSEC, WISE_BANDS
from bayesdist.missions.wise.simulate import wise_set

from .calibrations import matches_of, pairs_of

# the pattern of W3 is small beside its noise
PAIRS = {"W1": 150_000, "W2": 150_000, "W3": 600_000, "W4": 150_000}
RARE = 1e-5
AXES = ("X", "Y")
PATTERNED = ("W1", "W2", "W3")
TERMS = 15


def calibrated(band: str, partition: bool, bins: int = 31, pairs: int | None = None):
    """Set, pairs, fit and bins; without false matches, whose share of the noise no theory gives."""
    one = wise_set(
        band, pairs=pairs or PAIRS[band], seed=8, false_fraction=0.0, partition=partition
    )
    drawn = pairs_of(one)
    matches = matches_of(drawn)
    fit = fit_linear(matches, one.model, rejection=Rejection(1e9, None))
    with_shards = load(one.model, matches)
    found = with_shards.sum(band_sums, fit.mean, fit.clip, np.eye(2), {}, 1.0, bins).bins
    with_shards.close()
    return one, drawn, fit, found


@pytest.fixture(scope="module")
def plain():
    return {band: calibrated(band, False) for band in WISE_BANDS}


@pytest.fixture(scope="module")
def patterned():
    return {band: calibrated(band, True) for band in PATTERNED}


@pytest.fixture(scope="module")
def plain_tables(plain):
    return tables_of(plain)


@pytest.fixture(scope="module")
def patterned_tables(patterned):
    return tables_of(patterned)


def tables_of(bands) -> dict:
    """Rows by label, of each table."""
    absorbed = dict.fromkeys(bands, TERMS)
    found = {band: bins for band, (*_, bins) in bands.items()}
    tables = residual_tables(found, rng=rng(), arcsec=WISE_ARCSEC, absorbed=absorbed)
    return {name: rows(table) for name, table in tables.items()}


def rows(table) -> dict:
    return {row.label: row for row in table.rows}


def rng():
    return np.random.default_rng(1)


def noise2(one, pairs, bins: int = 31) -> float:
    """Mean over the bins of the variance of a mean: sigma^2 / n, from the errors as drawn."""
    edges = np.linspace(0.5, one.array.size[0] + 0.5, bins + 1)
    n, *_ = np.histogram2d(pairs.y, pairs.x, [edges, edges])
    total, *_ = np.histogram2d(pairs.y, pairs.x, [edges, edges], weights=pairs.sigma**2)
    return float(np.mean(total / n**2))


@cache
def bin_means(one, bins: int = 31) -> np.ndarray:
    """Means of the pattern in bins, (2, bins, bins), as the residuals have them."""
    fine = 16
    g = 0.5 + one.array.size[0] * (np.arange(bins * fine) + 0.5) / (bins * fine)
    x, y = (w.ravel() for w in np.meshgrid(g, g))
    cells = one.pattern.offsets(x, y).T.reshape(2, bins, fine, bins, fine)
    return -cells.mean(axis=(2, 4))


# -- noise ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("band", WISE_BANDS)
def test_noise_of_table_5_1_is_sigma_over_root_n(plain, plain_tables, band, axis):
    """Less the 15 coefficients of the axis, which the fit has taken out."""
    one, pairs, *_ = plain[band]
    row = plain_tables["5-1"][f"{band}/{axis}"]
    dof = row.n_bins - TERMS
    expected = noise2(one, pairs) * dof / row.n_bins
    low, high = chi2.ppf([RARE, 1 - RARE], dof) / dof
    assert low < row.value["sigma"] ** 2 / expected < high
    # the part that is called noise is that, and nothing remains
    assert row.sigma_noise**2 == pytest.approx(expected, rel=0.02)
    assert abs(row.variance) < 4.5 * row.variance_error


def test_noise_of_two_bands_adds_in_table_5_2(plain, plain_tables):
    for label, row in plain_tables["5-2"].items():
        later, earlier = label.partition("/")[0].split("-")
        dof = row.n_bins - TERMS
        expected = sum(WISE_ARCSEC[b] ** 2 * noise2(*plain[b][:2]) for b in (later, earlier))
        low, high = chi2.ppf([RARE, 1 - RARE], dof) / dof
        assert low < row.value["sigma"] ** 2 / (expected * dof / row.n_bins) < high, label


# -- partition pattern ----------------------------------------------------------------------------


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("band", PATTERNED)
def test_what_remains_in_table_5_1_is_the_pattern(patterned, patterned_tables, band, axis):
    one, *_ = patterned[band]
    row = patterned_tables["5-1"][f"{band}/{axis}"]
    true = bin_means(one)[AXES.index(axis)].var()
    assert abs(row.variance - true) < 4.5 * row.variance_error
    # none at all would be seen, and bins smooth it a little
    assert 4.5 * row.variance_error < true
    published = RESIDUAL_SIGMAS[band][AXES.index(axis)]
    assert 0.85 * published < np.sqrt(true) < published


@pytest.mark.parametrize("axis", AXES)
def test_what_remains_in_table_5_2_is_the_difference_of_the_patterns(
    patterned, patterned_tables, axis
):
    k = AXES.index(axis)
    means = {b: WISE_ARCSEC[b] * bin_means(patterned[b][0])[k] for b in PATTERNED}
    for later, earlier in (("W2", "W1"), ("W3", "W1"), ("W3", "W2")):
        row = patterned_tables["5-2"][f"{later}-{earlier}/{axis}"]
        true = (means[later] - means[earlier]).var()
        assert abs(row.variance - true) < 4.5 * row.variance_error


def test_table_5_3_follows_from_table_5_1(patterned_tables):
    """All pairs of bins: sqrt(2) times the sigma, the range as maximum, zero in the middle."""
    for label, row in patterned_tables["5-3"].items():
        scale, one = WISE_ARCSEC[label[:2]], patterned_tables["5-1"][label].value
        assert row.value["sigma"] == pytest.approx(np.sqrt(2) * scale * one["sigma"], rel=1e-12)
        assert row.value["max"] == pytest.approx(scale * (one["max"] - one["min"]), rel=1e-12)
        assert row.value["mean"] == pytest.approx(0.0, abs=1e-12)
        assert row.value["p01"] == pytest.approx(-row.value["p99"], rel=1e-9)


@pytest.mark.parametrize("band", PATTERNED)
def test_the_pattern_moves_no_coefficient(plain, patterned, band):
    """Same pairs with and without it: what differs is noise of the places, not a polynomial.

    Its offsets act like errors of its own rms, beside those that are quoted.
    """
    one, _, fit, _ = patterned[band]
    without = plain[band][2]
    d = fit.mean - without.mean
    sigma2 = np.repeat(np.square(RESIDUAL_SIGMAS[band]), TERMS)
    # of a weighted mean of N values, whose weights are those of the pairs
    w = patterned[band][1].sigma ** -2
    variance = sigma2 * (w**2).sum() / w.sum() ** 2
    (i, j) = np.array(one.model.basis().terms).T
    norm = np.tile((2 * i + 1) * (2 * j + 1), 2)
    total = (d**2 / (variance * norm)).sum()
    # squares of the pattern are uneven over the array, so that this is no exact chi-square
    assert total < 2 * chi2.isf(RARE, 2 * TERMS)


# -- periods --------------------------------------------------------------------------------------


def test_periods_of_table_c_1_differ_by_noise_alone():
    """45 x 45 bins, five periods; the structure is the same in each of them and in all together."""
    one, pairs, fit, _ = calibrated("W1", True, bins=45, pairs=400_000)
    left = np.column_stack([pairs.u, pairs.v]) - one.model.predict(fit.mean, pairs.x, pairs.y)
    number = pairs.frame * 5 // len(one.survey.names)
    periods = {
        str(k): band_bins(
            pairs.x[number == k], pairs.y[number == k], *left[number == k].T,
            bins=45, size=one.array.size,
        )
        for k in range(5)
    }  # fmt: skip
    every = band_bins(pairs.x, pairs.y, *left.T, bins=45, size=one.array.size)
    shown = {"all": every, "first": periods["0"], "last": periods["4"]}
    table = period_table(shown, rng=rng(), arcsec_per_pixel=2.75)
    for label, row in rows(table).items():
        true = (2.75 * bin_means(one, 45)[AXES.index(label[-1])]).var()
        assert abs(row.variance - true) < 4.5 * row.variance_error, label
    found = rows(table)
    # a fifth of the pairs: five times the noise, so that sigma alone would seem to have grown
    for axis in AXES:
        ratio = found[f"first/{axis}"].sigma_noise ** 2 / found[f"all/{axis}"].sigma_noise ** 2
        share = (number == 0).mean()
        assert ratio == pytest.approx(1 / share, rel=0.1)
    changes = pattern_changes(periods)
    assert min(c.p_value for c in changes) > RARE
