"""Residual tables: exact over all pairs, honest in their errors, and what the report printed."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from bayesdist.diagnose.periods import pattern_changes
from bayesdist.diagnose.residuals.binned import BinValues, band_bins
from bayesdist.diagnose.residuals.tables import (
    STATISTICS,
    bin_row,
    pair_row,
    pair_statistics,
    period_table,
    residual_statistics,
)
from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer import build_model, fit_linear, residuals
from bayesdist.infer.stars.likelihood import Clip
from bayesdist.infer.stars.shards import LocalShards
from bayesdist.missions.wise.assess.account import (
    contradictions_across,
    contradictions_within,
)
from bayesdist.missions.wise.assess.distortion_field import band_sums
from bayesdist.missions.wise.assess.residual_tables import (
    TABLE_5_1,
    TABLE_5_2,
    TABLE_5_3,
    noise_of_bins,
    printed_rows,
    residual_tables,
)
from bayesdist.missions.wise.published import SAMPLE_SIZES, WISE_ARCSEC
from bayesdist.missions.wise.simulate import simulate_wise
from tests.reduced import only_in_full

SIZE = (60.0, 60.0)
TABLE_C_1 = """
25-Day/X 0.00016 0.03644 -0.08390 0.09606 -0.00066 -0.06650 0.08068
JD212.5/X 0.00245 0.03778 -0.09498 0.10607 0.00102 -0.07175 0.08426
JD412.5/X -0.00256 0.03630 -0.09234 0.09361 -0.00368 -0.07417 0.07788
25-Day/Y 0.00060 0.01559 -0.05461 0.08401 0.00003 -0.03432 0.04386
JD212.5/Y -0.00393 0.01653 -0.05701 0.09080 -0.00429 -0.03883 0.04397
JD412.5/Y 0.00544 0.01675 -0.04477 0.07794 0.00426 -0.03108 0.04950
"""


def _brute(values):
    return residual_statistics(values[:, None] - values[None, :])


def _same(ours, brute, scale):
    for name in STATISTICS:
        assert ours[name] == pytest.approx(brute[name], abs=1e-14 * scale), name


@pytest.mark.parametrize("n", [1, 2, 3, 8, 40, 101])
@pytest.mark.parametrize("kind", ["normal", "ties", "skew"])
def test_all_pairs_by_counting_are_all_pairs_by_listing(n, kind):
    rng = np.random.default_rng(n)
    make = {
        "normal": lambda m: rng.normal(0.3, 0.02, m),
        "ties": lambda m: rng.integers(-2, 3, m).astype(float),
        "skew": lambda m: rng.gamma(0.3, 1.0, m) ** 3,
    }[kind]
    values = make(n)
    _same(pair_statistics(values), _brute(values), max(np.abs(values).max(), 1.0))


def test_all_pairs_of_45_x_45_bins_are_never_stored():
    """Four million differences are 33 MB."""
    a = np.random.default_rng(1).normal(size=45 * 45)
    tracemalloc.start()
    pair_statistics(a)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 0.5e6


def _bins(mean, sem, dof=1e6):
    mean = np.asarray(mean, float)
    return BinValues(mean, np.broadcast_to(sem, mean.shape), np.full(mean.shape, float(dof)))


def test_values_are_those_of_the_bins_as_they_are():
    rng = np.random.default_rng(2)
    mean = rng.normal(0.01, 0.02, (9, 9))
    mean[3, 4] = np.nan
    one = bin_row("W1/X", _bins(mean, 0.01), absorbed=1, rng=rng)
    expected = residual_statistics(mean)
    assert dict(one.value) == pytest.approx({name: expected[name] for name in STATISTICS})
    assert (one.n_bins, one.n_left_out) == (80, 1)
    assert one.sigma_noise**2 + one.variance == pytest.approx(one.value["sigma"] ** 2)
    pair = pair_row("W1/X", _bins(mean, 0.01), absorbed=1, rng=rng)
    good = mean[np.isfinite(mean)]
    _same(pair.value, _brute(good), 1.0)
    assert pair.variance == pytest.approx(2 * one.variance)


def test_bins_without_noise_have_no_errors():
    rng = np.random.default_rng(3)
    mean = rng.gamma(2.0, 0.01, (8, 8))
    for row in (
        bin_row("a", _bins(mean, 0.0), absorbed=1, rng=rng),
        pair_row("b", _bins(mean, 0.0), absorbed=1, rng=rng),
    ):
        for name in STATISTICS:
            # percentiles of drawn pairs are found to a thousandth of sigma
            assert row.error[name] <= 1e-3 * row.value["sigma"]
            assert row.noise_free[name] == pytest.approx(
                row.value[name], abs=2e-3 * row.value["sigma"]
            )


def test_what_noise_hides_stays_in_order(full):
    """Of noise alone extremes meet in the middle; they do not pass each other."""
    rng = np.random.default_rng(5)
    for _ in range(20 if full else 8):
        noise = _bins(0.02 * rng.standard_normal((12, 12)), 0.02)
        for row in (
            bin_row("a", noise, absorbed=1, rng=rng),
            pair_row("b", noise, absorbed=1, rng=rng),
        ):
            free = [row.noise_free[name] for name in ("min", "p01", "median", "p99", "max")]
            assert free == sorted(free)
            assert free[-1] - free[0] <= row.value["max"] - row.value["min"]


WIDENED = ("sigma", "min", "max", "p01", "p99")


@pytest.fixture(scope="module")
def observed():
    """The same 15 x 15 bins observed 150 times, the noise larger to one side."""
    rng = np.random.default_rng(4)
    truth = rng.normal(0.005, 0.02, (15, 15))
    sem = np.linspace(0.008, 0.02, 15)
    return truth, sem, truth + sem * rng.standard_normal((150, 15, 15))


@pytest.fixture(scope="module")
def rows(observed):
    _, sem, noisy = observed
    rng = np.random.default_rng(17)
    return [bin_row("W1/X", _bins(m, sem), absorbed=1, rng=rng) for m in noisy]


@pytest.fixture(scope="module")
def pairs(observed):
    """Of the first forty."""
    _, sem, noisy = observed
    rng = np.random.default_rng(18)
    return [pair_row("W1/X", _bins(m, sem), absorbed=1, rng=rng) for m in noisy[:40]]


def _quoted(some, name):
    return np.sqrt(np.mean([r.error[name] ** 2 for r in some]))


@pytest.mark.parametrize("name", STATISTICS)
def test_the_quoted_error_is_the_scatter_over_repetitions(rows, name):
    """To 20 per cent; a standard deviation of 150 values is known to 6."""
    scatter = np.std([r.value[name] for r in rows], ddof=1)
    assert _quoted(rows, name) == pytest.approx(scatter, rel=0.2)


@pytest.mark.parametrize("name", STATISTICS)
def test_noise_free_values_are_those_of_the_truth_within_their_errors(observed, rows, name):
    """And of what noise widens more than half is taken back."""
    true = residual_statistics(observed[0])[name]
    free = np.array([r.noise_free[name] for r in rows])
    assert np.sqrt(np.mean((free - true) ** 2)) < 1.5 * _quoted(rows, name)
    if name in WIDENED:
        added = np.mean([r.value[name] for r in rows]) - true
        assert abs(free.mean() - true) < 0.5 * abs(added)


def test_the_noise_free_sigma_and_its_error_cover_the_truth(observed, rows):
    """Pulls of the variance: mean 0, variance 1."""
    pulls = np.array([(r.variance - observed[0].var()) / r.variance_error for r in rows])
    n = pulls.size
    assert abs(pulls.mean()) < 4 / np.sqrt(n)
    low, high = chi2.ppf([1e-4, 1 - 1e-4], n) / n
    assert low < np.mean(pulls**2) < high


@pytest.mark.slow
@only_in_full("errors of single maps are compared")
@pytest.mark.parametrize("name", ["sigma", "max", "p99"])
def test_errors_over_all_pairs_are_the_scatter_over_repetitions(observed, pairs, name):
    values = [pair_statistics(m.ravel())[name] for m in observed[2]]
    assert _quoted(pairs, name) == pytest.approx(np.std(values, ddof=1), rel=0.2)


def test_stars_in_bins_of_pure_noise_leave_no_variance():
    """Eight stars in a bin: standard errors known to 27 per cent each, variance zero within error.

    Every other data set lost a plane, three degrees of freedom out of 36, to a fit.
    """
    rng = np.random.default_rng(5)
    x, y = (
        np.repeat(g.ravel(), 8) for g in np.meshgrid(np.arange(5, 60, 10), np.arange(5, 60, 10))
    )
    design = np.stack([np.ones(x.size), x, y], axis=1)
    for absorbed in (1, 3):
        pulls = []
        for _ in range(200):
            r = rng.normal(0, 0.1, x.size)
            if absorbed == 3:
                r -= design @ np.linalg.lstsq(design, r)[0]
            bins = band_bins(x, y, r, r, bins=6, size=SIZE).values("X")
            row = bin_row("a", bins, absorbed=absorbed, rng=rng)
            pulls.append(row.variance / row.variance_error)
        assert abs(np.mean(pulls)) < 4 / np.sqrt(200)
        assert 0.75 < np.std(pulls) < 1.25


def _band(rng, *, n=4000, sigma=0.1, shape=0.0, size=SIZE, bins=6):
    x, y = 0.5 + rng.random(n) * size[0], 0.5 + rng.random(n) * size[1]
    wave = shape * np.sin(7 * x / size[0])
    ru, rv = rng.normal(0, sigma, (2, n)) + np.stack([wave, -wave])
    return band_bins(x, y, ru, rv, bins=bins, size=size)


def _tables(bands, rng):
    return residual_tables(bands, rng=rng, arcsec=WISE_ARCSEC, absorbed=dict.fromkeys(bands, 1))


def test_radial_is_the_mean_length_of_single_residuals():
    """sqrt(pi / 2) sigma for normal residuals, not the length of the mean residual."""
    rng = np.random.default_rng(6)
    row = _tables({"W1": _band(rng, n=20000)}, rng)["5-1"]["W1/radial"]
    expected = 0.1 * np.sqrt(np.pi / 2)
    assert abs(row.value["mean"] - expected) < 4 * row.error["mean"]
    assert row.error["mean"] == pytest.approx(0.1 * np.sqrt((2 - np.pi / 2) / 20000), rel=0.2)


def test_pieces_of_the_data_add():
    rng = np.random.default_rng(7)
    x, y = 0.5 + rng.random((2, 900)) * 60
    r = rng.normal(size=(2, 900))
    whole = band_bins(x, y, *r, bins=4, size=SIZE)
    parts = [
        band_bins(x[s], y[s], *r[:, s], bins=4, size=SIZE) for s in (slice(300), slice(300, 900))
    ]
    for axis in ("X", "Y", "radial"):
        a, b = whole.values(axis), (parts[0] + parts[1]).values(axis)
        np.testing.assert_allclose(a.mean, b.mean, rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(a.sem, b.sem, rtol=1e-10)
    with pytest.raises(InputError, match="unknown axis"):
        whole.values("Z")


def test_bins_of_a_fit_are_those_of_its_residuals():
    rng = np.random.default_rng(8)
    matches, _ = simulate_wise(3000, rng=rng)
    model = build_model(matches, order=4, size=(1016.0, 1016.0), reference_pixel=(508.5, 508.5))
    fit = fit_linear(matches, model)
    used = fit.uses(matches)
    r = residuals(fit, matches)[used]
    theirs = band_bins(matches.x[used], matches.y[used], *r.T, bins=9, size=(1016.0, 1016.0))
    shards = LocalShards(model, matches, 100.0)
    ours = shards.sum(band_sums, fit.mean, fit.clip, np.eye(2), {}, 1.0, 9).bins
    assert isinstance(fit.clip, Clip)
    for axis in ("X", "Y", "radial"):
        np.testing.assert_allclose(ours.values(axis).mean, theirs.values(axis).mean, atol=1e-11)


def test_tables_have_the_rows_and_columns_of_the_report():
    """Labels in the printed order; W4's pixels count 5.5 arcsec, and differences of two bands."""
    rng = np.random.default_rng(9)
    bands = {name: _band(rng, shape=0.05) for name in ("W1", "W2", "W3")}
    bands["W4"] = _band(rng, shape=0.02, size=(30.0, 30.0))
    heads = ["Mean", "Sigma", "Min", "Max", "Median", "1%-tile", "99%-tile"]
    tables = _tables(bands, rng)
    cases = (
        (tables["5-1"], TABLE_5_1, "Band/Axis", "pix"),
        (tables["5-2"], TABLE_5_2, "Bands/Axis", "arcsec"),
        (tables["5-3"], TABLE_5_3, "Band/Axis", "arcsec"),
    )
    for ours, printed, first, unit in cases:
        table = ours.to_table()
        assert table.colnames == [first, *heads]
        assert list(table[first]) == list(printed_rows(printed))
        assert {str(table[h].unit) for h in heads} == {unit}
    wide = cases[0][0].to_table(errors=True)
    assert {"Sigma error", "Sigma noise-free", "Sigma noise", "Bins"} <= set(wide.colnames)
    one, pairs = cases[0][0], cases[2][0]
    assert pairs["W4/Y"].value["sigma"] == pytest.approx(
        5.5 * np.sqrt(2) * one["W4/Y"].value["sigma"]
    )
    x = {name: bands[name].values("X").mean for name in ("W1", "W4")}
    difference = residual_statistics(5.5 * x["W4"] - 2.75 * x["W1"])
    assert cases[1][0]["W4-W1/X"].value["p99"] == pytest.approx(difference["p99"])


def test_the_table_of_periods():
    rng = np.random.default_rng(10)
    periods = {name: _band(rng, shape=0.05) for name in ("25-Day", "JD212.5", "JD412.5")}
    table = period_table(periods, rng=rng, arcsec_per_pixel=2.75)
    assert [r.label for r in table.rows] == list(printed_rows(TABLE_C_1))
    expected = residual_statistics(2.75 * periods["JD212.5"].values("Y").mean)
    assert table["JD212.5/Y"].value["max"] == pytest.approx(expected["max"])
    with pytest.raises(KeyError):
        table["JD1/Y"]


def test_periods_without_change_have_uniform_p_values():
    """Structure that stays is no change: seven stars in a bin, three periods."""
    rng = np.random.default_rng(11)
    p = []
    for _ in range(60):
        periods = {str(k): _band(rng, n=n, shape=0.2) for k, n in enumerate((300, 500, 900))}
        found = pattern_changes(periods)
        p += [c.p_value for c in found[:2]]  # two axes of one period: independent
        assert all(c.correlation > 0.5 for c in found)
    assert kstest(p, "uniform").pvalue > 1e-3


def test_a_period_that_changed_is_named_with_its_size():
    rng = np.random.default_rng(12)
    periods = {"a": _band(rng, shape=0.2), "b": _band(rng, shape=0.2), "c": _band(rng, shape=0.3)}
    found = {(c.period, c.axis): c for c in pattern_changes(periods)}
    worst = min(found.values(), key=lambda c: c.p_value)
    assert worst.period == "c" and worst.p_value < 1e-6
    wave = 0.1 * np.sin(7 * np.linspace(0, 1, 601))
    means = wave[:-1].reshape(6, 100).mean(axis=1)
    assert found["c", "X"].rms == pytest.approx(np.sqrt(np.mean(means**2)), rel=0.2)


def test_what_the_printed_tables_contradict():
    """Table 5-1 and 5-3 agree for W2 and W3, 5-2 for W3-W2; W1 and W4 came from other models.

    Within Table 5-2 the mean 0.01859 of W4-W1/Y is open to both other bands, which give 0.01894,
    and its median 0.1710 is further from the mean than sigma.
    """
    t51, t52, t53, tc1 = (printed_rows(t) for t in (TABLE_5_1, TABLE_5_2, TABLE_5_3, TABLE_C_1))
    within = [
        s for t in (t51, t52, t53, tc1) for row in t.values() for s in contradictions_within(row)
    ]
    assert len(within) == 1 and within[0].startswith("W4-W1/Y: mean 0.01859 and median 0.171")
    across = contradictions_across(t51, t52, t53)
    named = {s.partition(":")[0] for s in across}
    assert all("W1" in label or "W4" in label for label in named)
    assert {"W1/X", "W1/Y", "W4/X", "W4/Y"} <= named
    assert any(s.startswith("W1/X: sigma 0.2073 is published, 0.0758 ") for s in across)
    triangles = [s for s in across if "by way of" in s]
    assert len(triangles) == 1 and "0.01894 follows by way of W2, W3" in triangles[0]


def test_noise_explains_table_5_1_in_w4_only():
    """From the radial rows and the sample sizes: W1 and W2 bins hold next to no noise, W4 little
    else; and no printed sigma is below the noise it must hold.
    """
    t51 = printed_rows(TABLE_5_1)
    share = {}
    for band, n in SAMPLE_SIZES.items():
        noise = noise_of_bins(t51[f"{band}/radial"].value["mean"], n)
        for axis in "XY":
            share[band, axis] = (noise / t51[f"{band}/{axis}"].value["sigma"]) ** 2
    assert max(share.values()) < 1
    assert max(share[b, a] for b in ("W1", "W2") for a in "XY") < 0.01
    assert max(share["W3", a] for a in "XY") < 0.2
    assert min(share["W4", a] for a in "XY") > 0.8


def test_noise_of_bins_is_what_simulated_bins_show():
    rng = np.random.default_rng(15)
    band = _band(rng, n=50000, bins=20)
    row = _tables({"W1": band}, rng)["5-1"]
    implied = noise_of_bins(row["W1/radial"].value["mean"], 50000, 400)
    assert row["W1/X"].value["sigma"] == pytest.approx(implied, rel=0.15)
    assert row["W1/Y"].sigma_noise == pytest.approx(implied, rel=0.02)


def test_tables_of_real_numbers_contradict_nothing():
    """Whatever the bins are, their own tables pass, rounded to four digits."""
    rng = np.random.default_rng(13)

    def printed(label, values):
        statistics = residual_statistics(values)
        return f"{label} " + " ".join(f"{statistics[n]:.4g}" for n in STATISTICS)

    for _ in range(30):
        bins = {b: rng.gamma(0.4, 0.02, 40) * rng.choice([-1, 1]) for b in ("W1", "W2", "W3", "W4")}
        scale = {"W1": 2.75, "W2": 2.75, "W3": 2.75, "W4": 5.5}
        names = list(bins)
        t51 = printed_rows("\n".join(printed(f"{b}/X", v) for b, v in bins.items()))
        t53 = printed_rows(
            "\n".join(
                printed(f"{b}/X", scale[b] * (v[:, None] - v[None, :])) for b, v in bins.items()
            )
        )
        t52 = printed_rows(
            "\n".join(
                printed(f"{b}-{a}/X", scale[b] * bins[b] - scale[a] * bins[a])
                for k, a in enumerate(names)
                for b in names[k + 1 :]
            )
        )
        for row in (*t51.values(), *t52.values(), *t53.values()):
            assert contradictions_within(row) == []
        assert contradictions_across(t51, t52, t53) == []


def test_what_makes_no_table_is_refused():
    rng = np.random.default_rng(14)
    with pytest.raises(DegenerateError, match="W1/X: only 0 bins hold two stars"):
        _tables({"W1": _band(rng, n=1)}, rng)
    for bad in ("W1/X 1 2 3", "W1/X 1 2 3 4 5 6 seven", "W1/X 1 2 3 4 5 6 nan"):
        with pytest.raises(InputError, match="row 1"):
            printed_rows(bad)
