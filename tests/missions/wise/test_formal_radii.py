"""Formal uncertainty by integrals: against fits of simulated pairs, and against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.assess import uncertainty_map
from bayesdist.data import Matches
from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer import Rejection, fit_linear
from bayesdist.missions.wise.assess.formal_radii import (
    corner_weight,
    effective_sigma,
    formal_radii,
    implied_sigma,
)
from bayesdist.missions.wise.simulate import (
    FORMAL_RADII,
    RADIAL_RESIDUALS,
    SAMPLE_SIZES,
    WISE_ARRAYS,
)
from bayesdist.model import Chip, DistortionModel

SIZE = (1016.0, 1016.0)


@pytest.mark.parametrize("order", [1, 2, 4])
def test_corner_of_an_even_coverage(order):
    """Legendre products are orthogonal there: the variance is the sum of (2i + 1)(2j + 1) / N."""
    terms = [(i, j) for i in range(order + 1) for j in range(order + 1 - i)]
    corner = sum((2 * i + 1) * (2 * j + 1) for i, j in terms)
    f = formal_radii(1000, (0.3, 0.4), order=order)
    assert f.radius_max == pytest.approx(0.5 * np.sqrt(corner / 1000), rel=1e-12)
    assert set(f.position_of_max) <= {0.5, 1016.5}
    # averaged over the array, a polynomial costs its number of terms
    fine = formal_radii(1000, (0.3, 0.4), order=order, grid=(401, 401))
    w = np.ones(401)
    w[[0, -1]] = 0.5
    mean = (np.outer(w, w) * fine.radius**2).sum() / w.sum() ** 2
    assert mean == pytest.approx(0.25 * len(terms) / 1000, rel=2e-3)


def test_a_corner_of_order_4_is_155():
    assert formal_radii(155, 1.0).radius_max == pytest.approx(np.sqrt(2.0), rel=1e-12)


@pytest.fixture(scope="module")
def pairs():
    """Pairs that are rarer towards the corners, in the same density as `thinning`."""
    rng = np.random.default_rng(2)
    X, Y = rng.uniform(-1, 1, (2, 60_000))
    keep = rng.uniform(size=X.size) < thinning(X, Y)
    X, Y = X[keep], Y[keep]
    x, y = 508.5 + 508 * X, 508.5 + 508 * Y
    n = x.size
    u, v = x + 0.1 * rng.standard_normal(n), y + 0.2 * rng.standard_normal(n)
    return Matches(x, y, u, v, np.full(n, 0.1), np.full(n, 0.2))


def thinning(X, Y):
    return np.exp(-(X**2 + Y**2))


@pytest.mark.parametrize("factor", [1.0, 10.0])
def test_fits_of_pairs_have_it(pairs, factor):
    """`fit_linear` with its covariance, and its sandwich where corners count for more."""
    model = DistortionModel(4, (Chip(1, "A", SIZE, (508.5, 508.5)),))
    fit = fit_linear(pairs, model, rejection=Rejection(1e9, 1e9, factor))
    found = uncertainty_map(fit, grid=(9, 9))
    weight = corner_weight(factor)
    f = formal_radii(len(pairs), (0.1, 0.2), density=thinning, weight=weight, grid=(1017, 1017))
    at = np.round(found.x - 0.5).astype(int)
    expected = np.hypot(f.sigma_u, f.sigma_v)[np.ix_(at, at)]
    # 22 000 pairs: their places scatter, most where they are few
    np.testing.assert_allclose(found.radius, expected, rtol=0.06)
    assert np.abs(np.median(found.radius / expected) - 1) < 0.01


def test_the_four_vectors():
    f = formal_radii(100, (0.3, 0.4))
    vectors = f.vectors(1.0, 1016.0)
    np.testing.assert_allclose(np.hypot(*vectors.T), f.radius_max, rtol=1e-12)
    np.testing.assert_allclose(np.abs(vectors[:, 1] / vectors[:, 0]), 4 / 3, rtol=1e-12)
    assert len({tuple(np.sign(one)) for one in vectors}) == 4


def test_weights_taken_for_information_promise_more_than_they_give():
    """An inverse normal matrix with scaled inverse variances is no covariance."""
    plain = formal_radii(1000, 1.0).radius_max
    believed = formal_radii(1000, 1.0, weight=corner_weight(10), weight_informs=True).radius_max
    true = formal_radii(1000, 1.0, weight=corner_weight(10)).radius_max
    assert believed < 0.45 * plain < plain < true
    # a constant factor is information if it is taken for that, and nothing otherwise
    four = formal_radii(1000, 1.0, weight=lambda X, Y: 0 * X + 4, weight_informs=True)
    assert four.radius_max == pytest.approx(plain / 2, rel=1e-12)
    same = formal_radii(1000, 1.0, weight=lambda X, Y: 0 * X + 4)
    assert same.radius_max == pytest.approx(plain, rel=1e-12)


def test_sigmas_of_coefficients_alone_overstate():
    """By direct algebra on monomials over [-1, 1]: in a corner each of them is 1."""
    terms = [(i, j) for i in range(5) for j in range(5 - i)]
    moment = lambda k: 0.0 if k % 2 else 1.0 / (k + 1)  # noqa: E731
    matrix = np.array([[moment(a + c) * moment(b + d) for c, d in terms] for a, b in terms])
    trace = np.trace(np.linalg.inv(matrix))
    f = formal_radii(1000, 1.0, correlated=False)
    assert f.radius_max == pytest.approx(np.sqrt(2 * trace / 1000), rel=1e-9)


def test_effective_sigma_is_what_a_weighted_mean_has():
    sigma = np.array([0.1, 0.2, 0.4])
    assert effective_sigma(sigma) / np.sqrt(3) == pytest.approx(np.sum(sigma**-2) ** -0.5)
    assert effective_sigma([0.3, 0.3]) == pytest.approx(0.3)


def test_implied_sigma_is_the_inverse():
    options = {"order": 3, "size": (508.0, 508.0), "density": thinning}
    radius = formal_radii(777, 0.123, **options).radius_max
    assert implied_sigma(radius, 777, **options) == pytest.approx(0.123, rel=1e-12)


def test_the_published_radii_are_not_those_of_independent_pairs():
    """What the validation says: the error for each pair that the published radii imply."""
    implied = {
        band: implied_sigma(FORMAL_RADII[band], n, size=WISE_ARRAYS[band].size)
        for band, n in SAMPLE_SIZES.items()
    }
    by_hand = {band: FORMAL_RADII[band] / np.sqrt(2 * 155 / n) for band, n in SAMPLE_SIZES.items()}
    assert implied == pytest.approx(by_hand, rel=1e-9)
    scatter = {band: r / np.sqrt(np.pi / 2) for band, r in RADIAL_RESIDUALS.items()}
    ratio = [implied[band] / scatter[band] for band in ("W1", "W2", "W3", "W4")]
    # 20, 17, 1.3 and 0.2: no factor that all bands share
    assert ratio == sorted(ratio, reverse=True)
    assert ratio[0] > 20 and ratio[3] < 0.25


def test_what_cannot_be_is_refused():
    with pytest.raises(InputError, match="0 pairs"):
        formal_radii(0, 1.0)
    with pytest.raises(InputError, match="errors"):
        formal_radii(10, (1.0, 0.0))
    with pytest.raises(InputError, match=r"density: is negative"):
        formal_radii(10, 1.0, density=lambda X, Y: X)
    with pytest.raises(InputError, match="positive"):
        effective_sigma([1.0, 0.0])
    with pytest.raises(DegenerateError, match="do not determine a polynomial of order 9"):
        formal_radii(10, 1.0, order=9, density=lambda X, Y: (np.hypot(X, Y) < 0.05).astype(float))
