"""Terms of second order, smooth fields and slow deviations of single exposures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.model import ErrorModel
from bayesdist.assess.terms.correlated import FieldsOfExposures
from bayesdist.assess.terms.parameters import SolutionErrors
from bayesdist.data.matches import Matches
from bayesdist.diagnose import score_tests
from bayesdist.diagnose.correlated import Discrepancy, estimate_discrepancy
from bayesdist.diagnose.correlated.exposure_time import correlation_p
from bayesdist.diagnose.correlated.neighbours import (
    SEPARATION_EDGES,
    ExposureScores,
    exposure_products,
)
from bayesdist.infer import Rejection, fit_linear
from bayesdist.model import TimeDependence

from ..infer.patterned import moved
from .support import Scene, by_name

pytestmark = pytest.mark.usefixtures("one_thread")

SCENE = Scene(2400, 3, "shift_rotation", 8)
SECOND, FIELDS, TIME = "second order of exposures", "fields of exposures", "exposures in time"
Pattern = Callable[[Matches], np.ndarray]


def second_order(rms: float, seed: int, exposures: int = 8) -> tuple[Pattern, np.ndarray]:
    """Terms of second order new in each exposure, and their coefficients (E, 2, 3)."""
    c = rms / np.sqrt(6) * np.random.default_rng([31, seed]).standard_normal((exposures, 2, 3))

    def pattern(table: Matches) -> np.ndarray:
        X, Y = (table.x - 500.5) / 500, (table.y - 400.5) / 400
        # of unit mean square
        terms = np.stack([(3 * X**2 - 1) / 2, X * Y, (3 * Y**2 - 1) / 2], 1)
        return np.einsum("nak,nk->na", c[table.exposure], terms * [5**0.5, 3.0, 5**0.5])

    return pattern, c


def field(rms: float, length: float, seed: int, exposures: int = 8) -> Pattern:
    """A random field of waves, new in each exposure; `rms` is that of both axes together."""
    rng = np.random.default_rng([37, seed])
    wave = rng.standard_normal((exposures, 100, 2)) / length
    phase = rng.uniform(0, 2 * np.pi, (exposures, 100))
    size = rms / 10 * rng.standard_normal((exposures, 100, 2))

    def pattern(table: Matches) -> np.ndarray:
        at, e = np.stack([table.x, table.y], 1), table.exposure
        return np.einsum("nk,nka->na", np.cos(np.einsum("na,nka->nk", at, wave[e]) + phase[e]),
                         size[e])  # fmt: skip

    return pattern


def found(pattern: Pattern, seed: int = 1, scene: Scene = SCENE):
    """Tests and correlated errors of data with a pattern, and the solution."""
    model, table = scene.data(seed)
    table = moved(table, pattern(table))
    fit = fit_linear(table, model, rejection=Rejection(1e9, 1e9))
    discrepancy = estimate_discrepancy(
        table, fit, rng=np.random.default_rng(seed), stars=table, sample=table,
        structure=False, n_draws=400,
    )  # fmt: skip
    return by_name(score_tests(table, fit)), discrepancy, fit


def nothing(table: Matches) -> np.ndarray:
    return np.zeros((len(table), 2))


def test_terms_of_second_order_are_found_and_their_size_held():
    rms = 0.008
    pattern, c = second_order(rms, 1)
    tests, discrepancy, _ = found(pattern)
    assert tests[SECOND].p_value < 1e-12
    true = np.sqrt((c - c.mean(axis=0)).var(axis=0, ddof=1).sum())
    assert tests[SECOND].size == pytest.approx(true, rel=0.25)
    fields = discrepancy.facts["exposure_fields"]
    assert fields["second_order"] == pytest.approx(true, rel=0.35)
    assert fields["field"] < 0.4 * fields["second_order"]
    assert not tests[FIELDS].significant


@pytest.mark.parametrize("length", [60.0, 150.0])
def test_a_field_that_is_new_in_each_exposure_is_found_and_its_size_held(length):
    rms = 0.012
    tests, discrepancy, _ = found(field(rms, length, 2))
    assert tests[FIELDS].p_value < 1e-6
    whole = discrepancy.facts["exposure_fields"]
    # all but the linear terms
    assert np.hypot(whole["second_order"], whole["field"]) == pytest.approx(rms, rel=0.35)


def test_a_pattern_of_the_detector_is_no_field_of_exposures():
    """The same in all exposures: products within them are as large as those across."""
    wave = field(0.02, 80.0, 3, exposures=1)

    def static(table: Matches) -> np.ndarray:
        return wave(table.with_columns(exposure=np.zeros(len(table), int)))

    tests, discrepancy, _ = found(static)
    assert tests[FIELDS].p_value > 1e-3 and tests[SECOND].p_value > 1e-3
    assert discrepancy.facts["exposure_fields"]["field"] < 0.004


def test_inside_the_model_neither_is_found_nor_makes_errors():
    tests, discrepancy, fit = found(nothing)
    assert not tests[SECOND].significant and not tests[FIELDS].significant
    theta = discrepancy.fields.theta
    D = fit.model.n_distortion
    more = np.diag(theta.T @ theta / len(theta))[:D] / np.diag(fit.cov)[:D]
    assert more.mean() < 0.1


def test_products_are_those_of_all_pairs():
    """Sums over cells against a loop over pairs, without deviations that were taken out."""
    rng = np.random.default_rng(5)
    n = 400
    exposure = np.arange(n) % 3
    # in the middles of cells, so that pairs are in the bins of their cells
    X = (2 * rng.integers(32, size=n) + 1) / 32 - 1
    Y = (2 * rng.integers(26, size=n) + 1) / 26 - 1
    scores = ExposureScores(
        X, Y, rng.standard_normal((n, 2)), np.ones((n, 2)), np.zeros(n, int), exposure,
        np.arange(n),
    )  # fmt: skip
    one = exposure_products(scores, [(1024.0, 832.0)])[0]
    powers = np.stack([np.ones(n), X, Y, X**2, X * Y, Y**2], 1)
    g = scores.gradient.copy()
    H = np.zeros((n, n))
    for e in range(3):
        rows = exposure == e
        hat = powers[rows] @ np.linalg.pinv(powers[rows])
        g[rows] -= hat @ g[rows]
        H[np.ix_(rows, rows)] = hat
    # of cells that lie 1/16 apart
    d = np.sqrt((X[:, None] - X) ** 2 + (26 / 32 * (Y[:, None] - Y)) ** 2 + 1 / 16**2 / 3)
    i, j = np.triu_indices(n, 1)
    same = exposure[i] == exposure[j]
    ratio = (g**2).sum(axis=0) / (n - 18)
    products = ((g[i] * g[j]) + H[i, j][:, None] * ratio).sum(axis=1) / 2
    low, high = SEPARATION_EDGES[one.bins], SEPARATION_EDGES[one.bins + 1]
    direct = np.array([
        products[same & (d[i, j] >= a) & (d[i, j] < b)].mean()
        - products[~same & (d[i, j] >= a) & (d[i, j] < b)].mean()
        for a, b in zip(low, high, strict=True)
    ])  # fmt: skip
    np.testing.assert_allclose(one.covariance, direct, atol=1e-9)


def variance_over_detector(discrepancy: Discrepancy, fit, *, single: bool) -> float:
    """Mean square over a grid of the fields of exposures, along one axis."""
    term = FieldsOfExposures(discrepancy, single)
    drawn = ErrorModel(SolutionErrors(fit), (term,)).drawn(400, 3)
    domain = EvaluationDomain.of_chips(fit.model, (31, 25))
    return float(np.mean(drawn.at(domain)[1].total()))


@pytest.mark.parametrize("kind", ["second order", "field"])
def test_errors_in_the_mean_and_in_one_exposure_are_those_of_the_truth(kind):
    """The mean of E exposures has 1 / E of the variance of the deviations that the fit follows."""
    squares = {True: [], False: []}
    for seed in range(2):
        make = {
            "second order": lambda k: second_order(0.01, k)[0],
            "field": lambda k: field(0.01, 150.0, k),
        }[kind]
        pattern = make(seed)
        _, discrepancy, fit = found(pattern, seed)
        for single, values in squares.items():
            values.append(variance_over_detector(discrepancy, fit, single=single))
    mean, alone = np.mean(squares[False]), np.mean(squares[True])
    assert alone == pytest.approx(0.01**2 / 2 * (1 + 1 / 8), rel=0.45)
    if kind == "second order":
        assert alone / mean == pytest.approx(1 + 8, rel=0.3)
    else:  # polynomials follow a part of such a field
        assert 9 < alone / mean < 40


@pytest.mark.parametrize("seed", [1, 2])
def test_a_field_too_faint_to_be_significant_still_has_an_error(seed):
    """Its rms is a third of a star's error, and no test needs to find it."""
    rms = 0.006
    _, discrepancy, fit = found(field(rms, 100.0, seed), seed)
    stated = np.sqrt(2 * variance_over_detector(discrepancy, fit, single=True))
    assert 0.4 * rms < stated < 1.6 * rms


def test_one_exposure_that_is_turned_is_set_aside_and_named():
    scene = replace(SCENE, frames="none")

    def turned(table: Matches) -> np.ndarray:
        about = np.stack([400.5 - table.y, table.x - 500.5], 1)
        return 3.5e-4 * about * (table.exposure == 5)[:, None]

    _, good, _ = found(nothing, scene=scene)
    _, wrong, _ = found(turned, scene=scene)
    assert wrong.facts["exposures_outlying"] == ["e6"]
    assert "exposures_outlying" not in good.facts
    for name in ("rotation", "shape"):
        before, after = (np.median(one.linear.scatter[name]) for one in (good, wrong))
        assert after < 4 * before + 1e-6


def autoregressive(phi: float, n: int, k: int, rng: np.random.Generator) -> np.ndarray:
    out = rng.standard_normal((n, k))
    for i in range(1, n):
        out[i] = phi * out[i - 1] + np.sqrt(1 - phi**2) * out[i]
    return out


def test_probabilities_of_correlation_in_time_are_even():
    rng = np.random.default_rng(8)
    epoch = np.sort(rng.uniform(2000, 2010, 14))
    p = np.array([
        correlation_p(rng.standard_normal((14, 3)) + 5 * (epoch - 2005)[:, None], epoch)[0]
        for _ in range(60)
    ])  # fmt: skip
    assert stats.kstest(p, "uniform").pvalue > 1e-3
    assert correlation_p(rng.standard_normal((5, 3)), epoch[:5]) == (1.0, 0.0)
    wander = [correlation_p(autoregressive(0.95, 30, 3, rng), np.arange(30.0))[0] for _ in range(5)]
    assert np.median(wander) < 1e-5


def test_exposures_that_wander_widen_the_error_of_the_drift():
    drift = TimeDependence((("u", 1, 0), ("v", 1, 0), ("v", 0, 1)), (2005.0,))
    scene = Scene(3000, 2, "shift_rotation", 24, time=drift)
    rng = np.random.default_rng(7)
    sizes = 4e-5 * autoregressive(0.95, 24, 3, rng)
    matrices = np.array([[[1, 0], [0, 1]], [[1, 0], [0, -1]], [[0, 1], [1, 0]]])

    def deviating(table: Matches, order: np.ndarray) -> np.ndarray:
        dates, number = np.unique(table.epoch, return_inverse=True)
        assert len(dates) == 24
        about = np.stack([table.x - 500.5, table.y - 400.5], 1)
        return np.einsum("nk,kab,nb->na", sizes[order][number], matrices, about)

    tests, discrepancy, fit = found(lambda table: deviating(table, np.arange(24)), scene=scene)
    assert tests[TIME].significant and discrepancy.linear.correlation_time > 0
    mixed = rng.permutation(24)

    others, independent, _ = found(lambda table: deviating(table, mixed), scene=scene)
    assert not others[TIME].significant and independent.linear.correlation_time == 0
    rate = [k for k, name in enumerate(fit.model.names) if "rate" in name or "tdd" in name]
    assert rate
    wide, narrow = (one.linear.theta[:, rate].std(axis=0) for one in (discrepancy, independent))
    assert np.median(wide / narrow) > 1.5
