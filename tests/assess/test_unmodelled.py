"""What a polynomial leaves out at a place: by pairs of stars, against patterns that are known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from bayesdist.assess.star_pairs import pair_sums
from bayesdist.assess.unmodelled import total_errors, unmodelled
from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer import fit_linear
from bayesdist.infer.robust import robust_covariance
from bayesdist.infer.robust.cells import Cells, recommended_cells
from bayesdist.infer.robust.scores import scores_of
from bayesdist.model import TimeDependence
from tests.infer.patterned import mode_of, moved, patterned
from tests.infer.support import TWO_CHIPS, UNCLIPPED, residual_of, simulated, stars_of
from tests.infer.test_robust import LEVELS, PLACES, band


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    import numba

    before = numba.get_num_threads()
    numba.set_num_threads(1)
    yield
    numba.set_num_threads(before)


def test_pairs_are_those_of_different_stars_of_one_exposure():
    """Star by star, two chips, three exposures; residuals and weights by numpy."""
    model, matches, _ = simulated(1, 500, frames="shift", n_exposures=3, chips=TWO_CHIPS)
    matches = matches.with_sigma(*np.random.default_rng(1).uniform(0.05, 0.2, (2, 500)))
    fit = fit_linear(matches, model, **UNCLIPPED)
    side, blocks = 100.0, Cells(((4, 4), (4, 4)))
    found = pair_sums(stars_of(model, matches), scores_of(fit), side, blocks)
    w = np.column_stack([matches.sigma_u, matches.sigma_v]) ** -2.0
    g = w * residual_of(model, fit.mean, matches)
    for chip in (0, 1):
        size = np.array(model.chips[chip].size)
        for k, wide in enumerate((side, 2 * side, 4 * side)):
            n_cells = np.round(size / wide)
            place = np.column_stack([matches.x, matches.y]) - 0.5
            cell = (place / size * n_cells).astype(int)
            together = (
                (cell[:, None] == cell).all(axis=2)
                & (matches.exposure[:, None] == matches.exposure)
                & (matches.chip == chip)
                & (matches.chip[:, None] == chip)
                & ~np.eye(500, dtype=bool)
            )
            if k == 0:
                assert found.n_pairs[chip] == together.sum() // 2 > 50
            for p, (a, b) in enumerate(((0, 0), (1, 1), (0, 1))):
                assert found.products[chip, k, :, p].sum() == pytest.approx(
                    g[:, a] @ together @ g[:, b], rel=1e-6
                )
                assert found.weights[chip, k, :, p].sum() == pytest.approx(
                    w[:, a] @ together @ w[:, b], rel=1e-9
                )


def test_stars_without_a_pattern_leave_nothing():
    """40 detectors: the mean is zero within its error, alarms are rare, and errors are right."""
    pulls, found = [], 0
    cells = Cells(((16, 16),))
    for seed in range(40):
        p = patterned(seed, 1500, order=2, rms=0.0, fraction=0.0)
        fit = fit_linear(p.matches, p.model, **UNCLIPPED)
        robust = robust_covariance(p.matches, fit, cells)
        (one,) = unmodelled(p.matches, fit, cells, robust=robust)
        pulls.append([*(one.variance / one.error), one.covariance / one.covariance_error])
        found += int(one.found.sum())
    pulls = np.array(pulls)
    assert abs(pulls.mean()) < 3.3 / np.sqrt(pulls.size)
    low, high = stats.chi2.ppf([0.001, 0.999], pulls.size) / pulls.size
    # errors by a jackknife of 64 blocks are known to a tenth each: a t of some 60 degrees
    assert low < np.mean(pulls**2) < high * 60 / 58
    assert found <= stats.binom.ppf(0.999, 80, stats.norm.sf(3))


def test_what_only_some_exposures_know_is_no_structure():
    """Frames that take the drift upon themselves: the polynomials' own errors are large then."""
    cells, pulls = Cells(((16, 16), (16, 16))), []
    time = TimeDependence((("u", 1, 0), ("v", 0, 1)), (2004.0,), ())
    for seed in range(12):
        model, matches, _ = simulated(
            seed,
            9000,
            frames="affine",
            n_exposures=6,
            chips=TWO_CHIPS,
            time=time,
            epochs=np.linspace(2002, 2008, 6),
        )
        fit = fit_linear(matches, model, **UNCLIPPED)
        robust = robust_covariance(matches, fit, cells)
        for one in unmodelled(matches, fit, cells, robust=robust):
            pulls.extend(one.variance / one.error)
    assert abs(np.mean(pulls)) < 3.3 / np.sqrt(len(pulls))


def test_the_rms_of_a_pattern_is_found():
    """With false matches in, by the mixture: 20 patterns, unequal on both axes."""
    values, errors = [], []
    cells = Cells(((32, 32),))
    for seed in range(20):
        p = patterned(100 + seed, 8000, order=2, rms=0.1)
        shrink = np.array([0.0, -0.5])  # v has half the pattern
        matches = moved(p.matches, shrink * p.pattern(p.matches.x, p.matches.y))
        posterior, _ = mode_of(matches, p.model)
        robust = robust_covariance(matches, posterior, cells)
        (one,) = unmodelled(matches, posterior, cells, robust=robust)
        assert one.found.all()
        values.append([*one.variance, one.covariance])
        errors.append([*one.error, one.covariance_error])
        np.testing.assert_allclose(one.rms, np.sqrt(one.variance))
        np.testing.assert_allclose(one.rms_error, one.error / (2 * one.rms))
        assert (one.limit(0.95) > one.rms).all()
    values, errors = np.array(values), np.array(errors)
    expected = np.array([0.01, 0.0025, 0.0])
    of_mean = np.sqrt((errors**2).mean(axis=0) / 20)
    # pairs in cells of s pixels see (1 - s / 192)^2 of blocks of 64 pixels, a parabola in s
    assert (np.abs(values.mean(axis=0) - expected) < 3.5 * of_mean).all()
    scatter = values.var(axis=0, ddof=1) / (errors**2).mean(axis=0)
    low, high = stats.chi2.ppf([0.001, 0.999], 19) / 19
    assert (scatter > low).all() and (scatter < high).all()


def test_what_cannot_be_is_refused():
    p = patterned(1, 60, order=1, fraction=0.0)
    fit = fit_linear(p.matches, p.model)
    with pytest.raises(InputError, match="the side is 0"):
        unmodelled(p.matches, fit, Cells(((8, 8),)), side=0.0)
    with pytest.raises(DegenerateError, match="pairs of stars are less than"):
        unmodelled(p.matches, fit, Cells(((32, 32),)))


@pytest.mark.slow
def test_total_errors_cover_the_true_place_of_a_pixel(full, capsys):
    """Polynomial and pattern together; the formal error and that of the coefficients do not."""
    n = 200 if full else 40
    x, y = PLACES.T.astype(float)
    inside: dict[str, list] = {"total": [], "coefficients": [], "formal": []}
    for seed in range(n):
        p = patterned(500 + seed, 8000)
        posterior, _ = mode_of(p.matches, p.model)
        cells = recommended_cells(p.model, 64.0)
        robust = robust_covariance(p.matches, posterior, cells)
        left = unmodelled(p.matches, posterior, cells, robust=robust)
        truth = p.model.predict(p.theta, x, y) + p.pattern(x, y)
        miss = np.abs(p.model.predict(posterior.mean, x, y) - truth)
        coefficients = robust.at(x, y)
        total = total_errors(robust, left, x, y)
        inside["total"].append([miss < total.half_width(q) for q in LEVELS])
        inside["coefficients"].append([miss < coefficients.half_width(q) for q in LEVELS])
        inside["formal"].append([miss < total.formal * stats.norm.ppf(0.5 + q / 2) for q in LEVELS])
    for k, level in enumerate(LEVELS):
        each = {name: np.array(v)[:, k].mean(axis=0).ravel() for name, v in inside.items()}
        with capsys.disabled():
            print(f"\n{level:.1%}: " + ", ".join(f"{q} {v.mean():.3f}" for q, v in each.items()))
        low, high = band(level, n, each["total"].size)
        assert (each["total"] >= low).all() and (each["total"] <= high).all()
        for name in ("coefficients", "formal"):
            assert each[name].mean() < band(level, n)[0]
