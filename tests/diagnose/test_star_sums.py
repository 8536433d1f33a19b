"""Sums over pieces of the data are those of the whole, and of what one would do with arrays."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from bayesdist.data import Matches
from bayesdist.diagnose.checks import exposure_checks
from bayesdist.diagnose.residuals.binned import binned_residuals, binned_sums
from bayesdist.diagnose.residuals.stars import (
    StarSample,
    flagged_by_exposure,
    star_sample,
    star_sums,
)
from bayesdist.infer import (
    OutlierMixture,
    fit_linear,
    load,
    memberships,
    residuals,
    sample,
)
from bayesdist.model import Chip, DistortionModel
from tests.batched import in_batches

SIZE = (1016.0, 508.0)
BINS = {2: ((5, 4), (12, 1)), 1: ((6, 3), (5, 4))}  # by chip


def test_bins_of_pieces_add(rng):
    n = 150_000  # more than are summed at a time
    x, y = rng.uniform(-5.0, 1020.0, n), rng.uniform(0.5, 508.5, n)
    r = rng.normal(0.3, 0.1, (2, n))
    whole = binned_residuals(x, y, *r, bins=(31, 15), size=SIZE)
    parts = [
        binned_sums(x[rows], y[rows], *r[:, rows], bins=(31, 15), size=SIZE)
        for rows in np.array_split(np.arange(n), (10, 70_000, 70_001))
    ]
    sums = (parts[0] + parts[1]) + (parts[2] + parts[3])
    found = sums.residuals()
    np.testing.assert_array_equal(found.count, whole.count)
    assert found.n_outside == whole.n_outside > 0
    assert sums.n + found.n_outside == n
    for name in ("mean_u", "mean_v", "sem_u", "sem_v"):
        np.testing.assert_allclose(getattr(found, name), getattr(whole, name), rtol=1e-10)


def test_other_bins_do_not_add():
    args = ([1.0], [1.0], [0.0], [0.0])
    one = binned_sums(*args, bins=3, size=SIZE)
    for other in (
        binned_sums(*args, bins=(3, 4), size=SIZE),
        binned_sums(*args, bins=3, size=(9.0, 9.0)),
    ):
        with pytest.raises(ValueError, match="do not add"):
            one + other


def test_edges_decide_to_the_last_bit():
    """A star on the line between two bins, or one bit before it: as numpy's own histogram."""
    for n, size in ((7, 1016.0), (31, 1000.0), (64, 4096.0), (3, 10.0)):
        edges = np.linspace(0.5, size + 0.5, n + 1)
        x = np.concatenate([edges, np.nextafter(edges[1:], 0), np.nextafter(edges[:-1], 1e9)])
        zero = np.zeros_like(x)
        sums = binned_sums(x, zero + 1.0, zero, zero, bins=(n, 1), size=(size, 1.0))
        np.testing.assert_array_equal(sums.count[0], np.histogram(x, edges)[0])


def test_equal_residuals_scatter_by_nothing():
    b = binned_residuals([1.0, 2.0, 3.0], [1.0] * 3, [0.1] * 3, [-7e5] * 3, bins=1, size=(9, 9))
    assert b.mean_v[0, 0] == -7e5
    assert 0 <= b.sem_u[0, 0] < 1e-8 and 0 <= b.sem_v[0, 0] < 0.1


@pytest.fixture(scope="module")
def several():
    """Two chips, three exposures with frames, some false matches; and its fit."""
    rng = np.random.default_rng(7)
    n, names = 3000, ("a", "b", "c")
    chips = tuple(Chip(k, f"chip {k}", SIZE, (508.5, 254.5)) for k in (2, 1))
    model = DistortionModel(2, chips, frames="shift", exposures=names)
    theta = np.zeros(model.n_params)
    for chip in chips:
        for axis, term in enumerate(((1, 0), (0, 1))):
            basis = model.basis(chip.number)
            monomial = np.array([float(t == term) for t in basis.terms])
            theta[model.coefficient_slice(chip.number, axis)] = basis.from_monomials(monomial)
    x, y = rng.uniform(0.5, SIZE[0] + 0.5, n), rng.uniform(0.5, SIZE[1] + 0.5, n)
    exposure, chip = rng.integers(0, 3, n), rng.integers(0, 2, n)
    numbers = np.array([1, 2])[chip]
    uv = model.predict(theta, x, y, exposure=exposure, chip=numbers)
    spread = np.where(rng.random(n) < 0.05, 0.6, 0.05)
    u, v = (uv + rng.normal(size=(n, 2)) * spread[:, None]).T
    table = Matches(
        x, y, u, v, sigma_u=np.full(n, 0.05), sigma_v=np.full(n, 0.06), exposure=exposure,
        exposure_names=names, chip=chip, chip_numbers=(1, 2),
    )  # fmt: skip
    return table, fit_linear(table, model)


def by_fit(fit):
    clipped = fit.likelihood
    return clipped, clipped


def test_a_piece_without_a_chip_adds_nothing(several):
    table, fit = several
    both = load(fit.model, table).sum(star_sums, *by_fit(fit), BINS)
    parts = [
        load(fit.model, table.select(table.chip == code)).sum(star_sums, *by_fit(fit), BINS)
        for code in (0, 1)
    ]
    assert parts[0].binned[2, (5, 4)].n == 0
    for key, sums in (parts[0] + parts[1]).binned.items():
        np.testing.assert_array_equal(sums.count, both.binned[key].count)
        np.testing.assert_allclose(sums.first, both.binned[key].first, atol=1e-9)


def test_one_pass_gives_what_arrays_give(several):
    table, fit = several
    residual, used = residuals(fit, table), fit.uses(table)
    assert used.sum() == fit.n_used < len(table)
    numbers = table.chip_number
    for piece in (10_000, 700):
        sums = load(fit.model, in_batches(table, piece)).sum(star_sums, *by_fit(fit), BINS)
        assert set(sums.binned) == {
            (chip, bins) for chip, several in BINS.items() for bins in several
        }
        for chip, bins in sums.binned:
            here = used & (numbers == chip)
            expected = binned_residuals(
                table.x[here], table.y[here], *residual[here].T, bins=bins, size=SIZE
            )
            found = sums.binned[chip, bins].residuals()
            np.testing.assert_array_equal(found.count, expected.count)
            for name in ("mean_u", "mean_v", "sem_u", "sem_v"):
                np.testing.assert_allclose(
                    getattr(found, name), getattr(expected, name), rtol=1e-8, atol=1e-13
                )
        for k in range(3):
            here = table.exposure == k
            assert sums.exposures.n[k] == here.sum()
            assert sums.exposures.n_used[k] == (used & here).sum()
            rms = np.sqrt((residual[used & here] ** 2).mean(axis=0))
            np.testing.assert_allclose([r[k] for r in sums.exposures.rms], rms, rtol=1e-10)


def test_the_sums_over_exposures_are_those_of_the_fit(several):
    table, fit = several
    e = load(fit.model, table).sum(star_sums, *by_fit(fit), BINS).exposures
    assert (e.n.sum(), e.n_used.sum()) == (fit.n_rows, fit.n_used)
    rms = np.sqrt([e.uu.sum() / e.n_used.sum(), e.vv.sum() / e.n_used.sum()])
    np.testing.assert_allclose(rms, [fit.rms_u, fit.rms_v], rtol=1e-9)


def test_the_task_and_what_it_returns_travel(several):
    """To workers and back."""
    table, fit = several
    task, clipped = pickle.loads(pickle.dumps((star_sums, by_fit(fit))))
    one = load(fit.model, table).sum(star_sums, *by_fit(fit), BINS)
    other = pickle.loads(pickle.dumps(load(fit.model, table).sum(task, *clipped, BINS)))
    np.testing.assert_array_equal(one.exposures.uu, other.exposures.uu)
    np.testing.assert_array_equal(one.binned[2, (5, 4)].second, other.binned[2, (5, 4)].second)


def test_stars_flagged_are_those_that_are_flagged_one_by_one(several):
    table, fit = several
    posterior = sample(fit, table, outliers=OutlierMixture(), target_ess=50, target_rhat=1.1)
    flagged = memberships(posterior, table).outlier_probability > 0.5
    expected = [(flagged & (table.exposure == k)).sum() for k in range(3)]
    found = flagged_by_exposure(load(fit.model, in_batches(table, 700)), posterior)
    np.testing.assert_array_equal(found, expected)
    assert found.sum() == posterior.n_flagged > 50
    some = star_sample(table.sample(1000), len(table), fit, posterior)
    assert some.partial and len(some) == 1000
    np.testing.assert_array_equal(some.table.row, np.arange(0, 3000, 3))
    np.testing.assert_array_equal(some.outlier_probability > 0.5, flagged[::3])
    np.testing.assert_array_equal(some.used, fit.uses(table)[::3])
    np.testing.assert_allclose(some.residual, residuals(posterior, table)[::3], atol=1e-12)


def test_what_belongs_to_the_detector_is_seen_in_turned_exposures(rng):
    """Columns that are shifted along x, at four rolls: along the axes of the sky they cancel."""
    model = DistortionModel(
        1,
        (Chip(2, "A", SIZE, (508.0, 254.0)),),
        frames="shift_rotation",
        exposures=("a", "b", "c", "d"),
    )
    theta = np.zeros(model.n_params)
    for axis, place in ((0, 1), (1, 2)):
        theta[model.coefficient_slice(2, axis)][place] = SIZE[axis] / 2
    rolls = np.array([0.0, 1.0, 2.0, 3.0]) * np.pi / 2
    for code in (1, 2, 3):
        theta[model.frame_slice(code)] = 30.0 * code, -20.0, rolls[code]
    n = 40_000
    x, y = rng.uniform(1, SIZE[0], n), rng.uniform(1, SIZE[1], n)
    exposure = np.arange(n) % 4
    pattern = np.where(x // 127 % 2 == 0, 0.05, -0.05)
    u, v = model.predict(theta, x, y, exposure=exposure).T
    table = Matches(
        x, y,
        u + pattern * np.cos(rolls[exposure]) + 0.01 * rng.standard_normal(n),
        v + pattern * np.sin(rolls[exposure]) + 0.01 * rng.standard_normal(n),
        sigma_u=np.full(n, 0.01), sigma_v=np.full(n, 0.01), exposure=exposure,
        exposure_names=model.exposures, chip=np.zeros(n, int), chip_numbers=(2,),
    )  # fmt: skip
    fit = fit_linear(table, model)
    shards = load(model, table)
    sums = shards.sum(star_sums, *by_fit(fit), {2: ((8, 1),)})
    shards.close()
    found = sums.binned[2, (8, 1)].residuals()
    left = pattern - np.polyval(np.polyfit(x, pattern, 1), x)  # what the polynomial leaves of it
    expected = [left[x // 127 == k].mean() for k in range(8)]
    np.testing.assert_allclose(found.mean_u[0], expected, atol=0.002)
    np.testing.assert_allclose(found.mean_v[0], 0.0, atol=0.002)


def test_an_exposure_with_other_errors_is_named(rng):
    """Twelve exposures of Gaussian residuals, and one of them with twice the errors."""
    n, names = 6000, tuple(f"e{k:02d}" for k in range(12))
    codes, sigma = np.arange(n) % 12, np.full((n, 2), 0.05)
    x = np.arange(1.0, n + 1)
    table = Matches(x, x, x, x, exposure=codes, exposure_names=names)
    for factor in (1.0, 2.0):
        residual = 0.05 * rng.standard_normal((n, 2)) * np.where(codes == 4, factor, 1.0)[:, None]
        found = StarSample(table, residual, np.ones(n, bool), n, sigma**2).by_exposure
        (check,) = exposure_checks(found)
        assert found.of_all == pytest.approx((residual**2).sum() / 0.05**2 / (2 * n))
        assert found.relative[4] == pytest.approx(factor**2 / found.of_all, rel=0.2)
        assert list(np.flatnonzero(found.deviating)) == ([4] if factor > 1 else [])
        assert check.level == ("warn" if factor > 1 else "pass")
        assert ("(e04)" in check.sentence) == (factor > 1)
    assert not list(exposure_checks(None))


def test_many_exposures_of_few_stars_do_not_deviate_by_chance(rng):
    """Of 400 exposures of 20 stars some are always three standard deviations away."""
    n_named, codes = 0, np.repeat(np.arange(400), 20)
    x, used = np.arange(1.0, codes.size + 1), np.ones(codes.size, bool)
    table = Matches(x, x, x, x, exposure=codes, exposure_names=tuple(map(str, range(400))))
    for _ in range(50):
        residual = rng.standard_normal((codes.size, 2))
        found = StarSample(table, residual, used, x.size, np.ones((x.size, 2))).by_exposure
        n_named += found.deviating.any()
        residual[codes == 7] *= 3.0
        found = StarSample(table, residual, used, x.size, np.ones((x.size, 2))).by_exposure
        assert found.deviating[7]
    assert n_named <= 2
