"""The field's posterior: exact where a dense solve can say so, calibrated over truths."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binomtest

from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.nodes import (
    Matern,
    TablePosterior,
    binned_table,
    field_table,
    fit_mixture,
)
from tests.infer.nodes.support import (
    CHIP,
    ORDER,
    PATTERN,
    SIZE,
    STEP,
    bilinear,
    joint_solution,
    node_pixels,
    pattern,
    places,
)
from tests.infer.support import legendre_design
from tests.reduced import only_in_full

NOISE = 0.03


def measured(rng, x, y, d, *, jitter: float = 0.0, polynomial: float = 0.0):
    """Shifts (N, 2) and quoted variances (N, 2) of stars: errors differ from star to star."""
    variance = NOISE**2 * rng.uniform(0.3, 3.0, (len(x), 2))
    r = bilinear(x, y) @ d
    c = polynomial * rng.standard_normal((10, 2))
    r += legendre_design(ORDER, x, y, size=SIZE) @ c
    r += np.sqrt(variance + jitter**2) * rng.standard_normal((len(x), 2))
    return r, variance


def table_of(x, y, r, variance, **options) -> TablePosterior:
    options = {"smoothness": (1.5,)} | options
    return field_table(x, y, r, variance, chip=CHIP, order=ORDER, step=STEP, **options)


def flat(planes) -> np.ndarray:
    return planes.reshape(2, -1).T


@pytest.fixture
def small(rng):
    """A few thousand stars, three times denser on one side, and a polynomial of its own."""
    x, y = places(rng, 4000, gradient=True)
    d = pattern(rng)
    r, variance = measured(rng, x, y, d, jitter=0.02, polynomial=0.3)
    return x, y, r, variance, table_of(x, y, r, variance)


def test_it_is_the_exact_joint_solution(small, rng):
    """Nodes, covariance, and positions of polynomial and table together, to rounding."""
    x, y, r, variance, got = small
    joint = joint_solution(x, y, r, variance + got.jitter**2, got.priors)
    mean, cov = joint.nodes
    np.testing.assert_allclose(flat(got.table.values), mean, atol=2e-7)
    np.testing.assert_allclose(got.cov, cov, atol=1e-6 * np.abs(cov).max())
    np.testing.assert_allclose(
        got.table.sigma.reshape(2, -1) ** 2, cov.diagonal(0, 1, 2), rtol=1e-5
    )

    px, py = places(rng, 200)
    W = bilinear(px, py)
    alone = np.sqrt(np.einsum("ni,aij,nj->na", W, cov, W))
    np.testing.assert_allclose(got.position_sigma(px, py), alone, rtol=1e-5)

    # the polynomial fitted with the table held has its formal error, and follows the table's
    phi = legendre_design(ORDER, px, py, size=SIZE)
    formal = np.stack([((phi @ a.sums.polynomial_root) ** 2).sum(axis=1) for a in got.axes], axis=1)
    total = np.sqrt(formal + got.position_sigma(px, py, refitted=True) ** 2)
    where, sigma = joint.at(px, py)
    np.testing.assert_allclose(total, sigma, rtol=1e-5)
    polynomial = phi @ np.stack([a.sums.polynomial_of(a.mean) for a in got.axes], axis=1)
    np.testing.assert_allclose(got.table.evaluate(px, py) + polynomial, where, atol=1e-6)


def test_polynomial_and_table_are_nearly_independent(small, rng):
    """Their variances simply added come within a few per cent, even with uneven stars."""
    _, _, _, _, got = small
    px, py = places(rng, 300)
    ratio = got.position_sigma(px, py, refitted=True) / got.position_sigma(px, py)
    assert abs(np.median(ratio) - 1) < 0.01
    assert np.abs(ratio - 1).max() < 0.25


def test_what_it_takes_up_of_an_error_beneath(small, rng):
    """A table beneath that is wrong by e changes this one's mean by minus S A e: measured."""
    x, y, r, variance, got = small
    wrong = 0.05 * pattern(rng)
    moved = table_of(x, y, r - bilinear(x, y) @ wrong, variance, earlier=got, search="none")
    px, py = places(rng, 50)
    for a, axis in enumerate(got.axes):
        rows = got.rows(px, py, a)
        change = rows @ (moved.axes[a].mean - axis.mean)
        np.testing.assert_allclose(-axis.gain(rows) @ wrong[:, a], change, atol=2e-5)


def test_no_polynomial_is_left_in_it(small):
    got = small[-1]
    phi = legendre_design(ORDER, *node_pixels(), size=SIZE)
    assert np.abs(phi.T @ flat(got.table.values)).max() < 1e-9
    assert np.abs(phi.T @ got.cov).max() < 1e-12


def test_a_polynomial_in_the_residuals_changes_nothing(small):
    """A table is the same whatever earlier polynomial its residuals come from."""
    x, y, r, variance, got = small
    bent = r + legendre_design(ORDER, x, y, size=SIZE) @ np.full((10, 2), 0.7)
    other = table_of(x, y, bent, variance)
    np.testing.assert_allclose(other.table.values, got.table.values, atol=1e-6)


def test_hyperparameters_and_jitter_come_back(rng):
    x, y = places(rng, 20_000)
    r, variance = measured(rng, x, y, pattern(rng), jitter=0.02)
    got = table_of(x, y, r, variance)
    assert abs(got.jitter - 0.02) < 4 * got.jitter_sigma < 0.002
    for axis in got.axes:
        off = np.log([axis.field.prior.amplitude, axis.field.prior.length])
        off = np.abs(off - np.log([PATTERN.amplitude, PATTERN.length]))
        assert (off < 3.5 * np.sqrt(np.diag(np.linalg.inv(axis.field.curvature)))).all()
    exact, variance = measured(rng, x, y, pattern(rng))
    assert table_of(x, y, exact, variance).jitter < 0.006


def test_effective_parameters_run_from_the_polynomial_to_all_nodes(rng):
    d = pattern(rng)
    few, many = places(rng, 250), places(rng, 60_000)
    got = [table_of(*p, *measured(rng, *p, d)).axes[0].n_effective for p in (few, many)]
    assert 10 < got[0] < 200
    assert 300 < got[1] <= 320


def test_no_pattern_no_table(rng):
    """Quoted errors right and nothing else there: the table is far below the noise of its bins."""
    x, y = places(rng, 20_000)
    r, variance = measured(rng, x, y, np.zeros((320, 2)))
    got = table_of(x, y, r, variance)
    per_bin = NOISE / np.sqrt(20_000 / 320)
    assert got.table.values.std() < 0.3 * per_bin
    pull = got.table.values / got.table.sigma
    assert (pull**2).mean() < 2.0


def test_a_table_by_tiles_is_nearly_that_of_the_whole_chip(rng):
    d = pattern(rng, Matern(0.05, 120.0, 1.5))
    x, y = places(rng, 20_000)
    r, variance = measured(rng, x, y, d)
    whole, tiles = (table_of(x, y, r, variance, search=k) for k in ("chip", "tiles"))
    off = (tiles.table.values - whole.table.values) / whole.table.sigma
    assert 0 < np.abs(off).max() < 0.5 and off.std() < 0.1


def test_where_there_are_no_stars_the_prior_speaks(rng):
    """In a hole of three correlation lengths sigma rises to the amplitude, and tells the truth."""
    x, y = places(rng, 20_000)
    prior = Matern(0.08, 30.0, 1.5)
    keep = (x < 380) | (x > 580) | (y < 160) | (y > 360)
    nx, ny = node_pixels()
    deep = (nx > 440) & (nx < 520) & (ny > 220) & (ny < 300)
    seen = (nx < 350) | (ny < 130) | (ny > 390)
    squares = []
    for _ in range(4):
        d = pattern(rng, prior)
        got = table_of(x[keep], y[keep], *measured(rng, x[keep], y[keep], d))
        sigma = flat(got.table.sigma)
        amplitude = np.array([p.amplitude for p in got.priors])
        assert (np.abs(sigma[deep] / amplitude - 1) < 0.2).all()
        assert (sigma[seen] < 0.2 * amplitude).all()
        squares.append((((flat(got.table.values) - d) / sigma)[deep] ** 2).mean())
    assert 0.3 < np.mean(squares) < 2.2


@pytest.mark.parametrize("fraction", [0.03, 0.10])
def test_false_matches_do_not_pull(rng, fraction):
    """With weights from the mixture; the same stars with all weights one go far astray."""
    x, y = places(rng, 30_000)
    d = pattern(rng, Matern(0.02, 70.0, 1.5))
    r, variance = measured(rng, x, y, d)
    false = rng.random(len(x)) < fraction
    r[false] = rng.normal([0.5, -0.5], 0.8, (false.sum(), 2))
    mixture = fit_mixture(r, variance)
    assert abs(mixture.fraction - fraction) < 0.15 * fraction
    got = table_of(x, y, r, variance, weight=mixture.probability)
    pull = (flat(got.table.values) - d) / flat(got.table.sigma)
    assert abs(pull.mean()) < 0.2 and (pull**2).mean() < 1.4
    naive = table_of(x, y, r, variance)
    error = [np.sqrt(((flat(t.table.values) - d) ** 2).mean()) for t in (got, naive)]
    assert error[1] > 2 * error[0]


def test_the_field_beats_the_bins(rng):
    x, y = places(rng, 30_000)
    d = pattern(rng)
    r, variance = measured(rng, x, y, d)
    field = table_of(x, y, r, variance).table
    for smooth in (True, False):
        bins = binned_table(x, y, r, chip=CHIP, order=ORDER, step=STEP, smooth=smooth)
        error = [(flat(t.values) - d).std() for t in (field, bins)]
        assert error[0] < 0.7 * error[1]


@pytest.mark.slow
@only_in_full("tests/campaign has pulls of the nodes")
def test_it_is_calibrated_over_truths(capsys):
    """Pulls of nodes N(0, 1) within 10 %, and 68 % of the positions within one sigma.

    Truth and field are drawn anew each time, hyperparameters fitted each time.
    """
    rng = np.random.default_rng(606)
    squares, inside, count = [], 0, 0
    truths = 60
    for _ in range(truths):
        prior = Matern(rng.uniform(0.03, 0.2), rng.uniform(40, 140), 1.5)
        x, y = places(rng, 6000, gradient=True)
        d = pattern(rng, prior)
        r, variance = measured(rng, x, y, d, jitter=0.02, polynomial=0.3)
        got = table_of(x, y, r, variance)
        squares.append((((flat(got.table.values) - d) / flat(got.table.sigma)) ** 2).mean())
        px, py = places(rng, 40)
        error = np.abs(got.table.evaluate(px, py) - bilinear(px, py) @ d)
        inside += int((error < got.position_sigma(px, py)).sum())
        count += error.size
    with capsys.disabled():
        print(f"\nnodes: mean square pull {np.mean(squares):.3f}; positions: {inside / count:.3f}")
    assert abs(np.mean(squares) - 1) < 0.1
    assert binomtest(inside, count, 0.6827).pvalue > 0.003


def test_an_earlier_table_leads_to_the_same_end(small, rng):
    """From other stars of the same chip it leads to the same end; held, it does not move."""
    x, y, r, variance, got = small
    half = slice(0, len(x) // 2)
    other = table_of(x[half], y[half], r[half], variance[half])
    again = table_of(x, y, r, variance, earlier=other)
    for a, b, c in zip(again.axes, got.axes, other.axes, strict=True):
        now, before = (np.log([p.field.prior.amplitude, p.field.prior.length]) for p in (a, b))
        assert (
            np.abs(now - before) < 0.3 * np.sqrt(np.diag(np.linalg.inv(b.field.curvature)))
        ).all()
        assert a.field.prior != c.field.prior
    held = table_of(x, y, r, variance, earlier=other, search="none")
    assert held.priors == other.priors
    assert abs(held.jitter - got.jitter) < got.jitter_sigma


def test_wrong_input_is_named(rng):
    x, y = places(rng, 500)
    r, variance = measured(rng, x, y, pattern(rng))
    with pytest.raises(InputError, match=r"no field of smoothness \[1.0\]"):
        table_of(x, y, r, variance, smoothness=(1.0,))
    with pytest.raises(InputError, match="no hyperparameters to hold"):
        table_of(x, y, r, variance, search="none")
    with pytest.raises(InputError, match="no smoothness"):
        table_of(x, y, r, variance, smoothness=())
    with pytest.raises(InputError, match=r"'variance' has shape \(500,\)"):
        table_of(x, y, r, variance[:, 0])
    with pytest.raises(InputError, match="star 1: 'variance' is 0"):
        table_of(x, y, r, variance * 0)
    with pytest.raises(InputError, match="'weight' is 2"):
        table_of(x, y, r, variance, weight=np.full(500, 2.0))
    with pytest.raises(InputError, match="cannot describe more than a polynomial"):
        field_table(x, y, r, variance, chip=CHIP, order=ORDER, step=(320.0, 256.0))
    with pytest.raises(DegenerateError, match="8 stars do not determine a polynomial of order 3"):
        table_of(x[:8], y[:8], r[:8], variance[:8])
    line = np.full(500, 100.0)
    with pytest.raises(DegenerateError, match="of order 3"):
        table_of(line, y, r, variance)
