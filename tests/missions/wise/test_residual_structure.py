"""Structure left in residuals: found where it is, named for what it is, and only there."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial import legendre
from scipy.stats import chi2, kstest

from bayesdist.diagnose.residuals.binned import BinnedResiduals
from bayesdist.errors import DegenerateError, InputError
from bayesdist.missions.wise.assess.residual_field import residual_correlation, residual_partition
from bayesdist.model.basis import polynomial_terms
from tests.reduced import case_in_full

SIDE = 1016.0


def _bins(mean, sem, *, count=500, size=(SIDE, SIDE)):
    """Binned residuals of given means (2, ny, nx); 500 stars in a bin make errors normal."""
    ny, nx = mean.shape[1:]
    sem = np.broadcast_to(sem, mean.shape)
    x, y = ((np.arange(n) + 0.5) * s / n + 0.5 for n, s in ((nx, size[0]), (ny, size[1])))
    count = np.broadcast_to(count, (ny, nx)).astype(np.int64)
    return BinnedResiduals(x, y, mean[0], mean[1], count, sem[0], sem[1])


def _blocks(n, k, rng, amplitude, *, tilts=True):
    """Offsets and tilts of k x k blocks in n x n bins, averaged where an edge cuts a bin."""
    fine = 2 * n * k  # cells on a side, a whole number in each bin and block
    place = (np.arange(fine) + 0.5) * k / fine
    block, within = place.astype(int), 2 * (place % 1) - 1
    c, tx, ty = (
        rng.normal(0, amplitude, (3, 2, k, k)) * np.array([1, tilts, tilts])[:, None, None, None]
    )
    at = np.ix_([0, 1], block, block)
    values = c[at] + tx[at] * within + ty[at] * within[:, None]
    return values.reshape(2, n, 2 * k, n, 2 * k).mean(axis=(2, 4))


def _polynomial(n, order):
    side = np.linspace(-1, 1, n)
    v = legendre.legvander(side, order)
    return np.stack(
        [np.outer(v[:, j], v[:, i]).ravel() for i, j in polynomial_terms(order)], axis=1
    )


def test_the_correlation_is_that_over_all_pairs_of_bins():
    """Oblong bins, noise that differs, bins left out; the fields of zero residual is the origin."""
    rng = np.random.default_rng(1)
    shape = (2, 8, 12)
    sem = 0.01 * (1 + rng.random(shape))
    count = np.where(rng.random(shape[1:]) < 0.15, 2, 500)
    mean = rng.normal(0, 0.05, shape)
    size = (900.0, 800.0)
    results = [
        residual_correlation(
            _bins(m, sem, count=count, size=size), order=0, rng=np.random.default_rng(2)
        )
        for m in (mean, 0 * mean)
    ]
    used = count > 5
    centred = []
    for m, s in zip(mean, sem, strict=True):
        w = 1 / s[used] ** 2
        centred.append(m[used] - np.sum(w * m[used]) / w.sum())
    u, v = centred
    yy, xx = np.nonzero(used)
    distance = np.hypot(75.0 * np.subtract.outer(xx, xx), 100.0 * np.subtract.outer(yy, yy))
    ring = np.rint(distance / 100).astype(int)
    for r in range(1, 5):
        at = (ring == r) & (distance > 0)
        assert results[0].separation[r - 1] == pytest.approx(distance[at].mean())
        assert results[0].n_pairs[r - 1] * 2 == at.sum()
        for name, a, b in (("uu", u, u), ("vv", v, v), ("uv", u, v)):
            ours = getattr(results[0], name)[r - 1] - getattr(results[1], name)[r - 1]
            assert ours == pytest.approx(np.outer(a, b)[at].mean(), abs=1e-15)


def test_sigma_is_that_of_independent_products():
    """sem^2 / sqrt(pairs) for one axis; each pair counts twice in u-v, with other stars."""
    n, sem = 16, 0.02
    c = residual_correlation(_bins(np.zeros((2, n, n)), sem), rng=np.random.default_rng(3))
    inflate = 499 / 497
    one = sem**2 * inflate / np.sqrt(c.n_pairs)
    np.testing.assert_allclose(c.sigma_uu, one, rtol=0.15)  # 500 draws: 3 per cent
    np.testing.assert_allclose(c.sigma_vv, one, rtol=0.15)
    np.testing.assert_allclose(c.sigma_uv, one / np.sqrt(2), rtol=0.15)


def test_noise_has_no_correlation(full):
    """P-values of noise that lost a cubic are uniform when the cubic is accounted for."""
    rng = np.random.default_rng(4)
    n = 10
    design = _polynomial(n, 3)
    p = []
    for _ in range(60 if full else 20):
        e = rng.standard_normal((n * n, 2))
        e -= design @ np.linalg.lstsq(design, e)[0]
        p.append(residual_correlation(_bins(0.01 * e.T.reshape(2, n, n), 0.01), order=3, rng=rng))
    assert kstest([c.p_value for c in p], "uniform").pvalue > 1e-3
    assert np.median([c.reach for c in p]) == 0


def test_a_wave_is_seen_as_far_as_it_keeps_its_phase():
    """cos of wavelength L: products fall as the Bessel function J0(2 pi d / L), zero at 0.38 L."""
    rng = np.random.default_rng(5)
    n, length = 31, 500.0
    x = np.linspace(0, SIDE, n)
    wave = 0.02 * np.cos(2 * np.pi * x / length)[None, :] * np.ones((n, 1))
    mean = np.stack([wave, np.zeros((n, n))]) + rng.normal(0, 0.01, (2, n, n))
    c = residual_correlation(_bins(mean, 0.01), rng=rng)
    assert c.p_value == pytest.approx(1 / 501)
    assert c.uu[0] == pytest.approx(0.02**2 / 2, rel=0.15)
    assert np.abs(c.vv / c.sigma_vv).max() < 5
    assert 0.28 * length < c.reach < 0.42 * length


# reduced, each number of blocks once, with tilts or without
@pytest.mark.parametrize(
    ("n", "k", "tilts"),
    [
        (n, k, tilts)
        if tilts == bool(number % 2) and (n, k) != (45, 5)
        else case_in_full(n, k, tilts, instead="other numbers of blocks are run like this")
        for number, (n, k) in enumerate([(31, 5), (45, 5), (45, 9), (31, 2), (24, 3)])
        for tilts in (False, True)
    ],
)
def test_a_planted_partition_is_found_with_its_number_and_size(n, k, tilts):
    """WISE: 5 x 5 and 9 x 9 in 31 and 45 bins, twice a bin's noise, a fit of order 4."""
    rng = np.random.default_rng(6)
    noise = 0.012
    pattern = _blocks(n, k, rng, 2 * noise if k > 3 else 4 * noise, tilts=tilts)
    design = _polynomial(n, 4)
    bins = _bins(pattern + rng.normal(0, noise, (2, n, n)), noise)
    found = residual_partition(bins, order=4, rng=rng)
    assert found.k == k and found.significant and found.edges_seen
    assert f"{k} x {k} blocks" in found.sentence
    for axis in range(2):
        flat = pattern[axis].ravel()
        left = flat - design @ np.linalg.lstsq(design, flat)[0]
        assert found.rms[axis] == pytest.approx(left.std(), rel=0.2)
        # planes over the whole field belong to the fit and to the blocks: 3 directions less
        off = np.sum((found.pattern[axis].ravel() - left) ** 2) / noise**2
        low, high = chi2.ppf([1e-4, 1 - 1e-4], 3 * (k * k - 1))
        assert low < off < high


def test_exact_means_do_not_split_blocks_further():
    """Ten and fifteen blocks hold the five, but their freedom is not needed."""
    rng = np.random.default_rng(16)
    pattern = _blocks(45, 5, rng, 0.02)
    bins = _bins(pattern + rng.normal(0, 0.0004, (2, 45, 45)), 0.0004)
    found = residual_partition(bins, order=4, tried=(3, 4, 5, 6, 10, 15), rng=rng)
    assert found.k == 5 and found.edges_seen
    assert found.gain[10] > found.gain[6]


def test_gains_are_those_of_two_least_squares_fits():
    """Commensurable blocks: Q is by how much chi-square falls when planes are fitted too."""
    rng = np.random.default_rng(7)
    n, k = 12, 4
    sem = 0.01 * (1 + rng.random((2, n, n)))
    mean = rng.normal(0, 0.02, (2, n, n)) + _blocks(n, k, rng, 0.02)
    found = residual_partition(_bins(mean, sem), order=2, tried=[k], rng=rng)
    cells = np.kron(np.arange(k * k).reshape(k, k), np.ones((3, 3))).ravel()
    blocks = (cells[:, None] == np.arange(k * k)).astype(float)
    y, x = np.divmod(np.arange(n * n), n)
    planes = np.hstack([blocks, blocks * x[:, None], blocks * y[:, None]])
    poly = _polynomial(n, 2)
    q = d = rest = free = 0
    for m, s in zip(mean, sem, strict=True):
        squares, rank = [], []
        for design in (poly, np.hstack([poly, planes])):
            a, b = design / s.ravel()[:, None], m.ravel() / s.ravel()
            solution, _, r, _ = np.linalg.lstsq(a, b)
            squares.append(np.sum((b - a @ solution) ** 2))
            rank.append(r)
        q, d = q + squares[0] - squares[1], d + rank[1] - rank[0]
        rest, free = rest + squares[1], free + n * n - rank[1]

    def likelihood(variance, total, number):
        return -(number * np.log(variance) + total / variance) / 2

    together = (q + rest) / (d + free)
    gain = likelihood(q / d, q, d) + likelihood(rest / free, rest, free)
    gain -= likelihood(together, q + rest, d + free)
    assert q / d > rest / free
    assert found.gain[k] == pytest.approx(gain, rel=1e-9)


def test_noise_holds_no_partition(full):
    """P-values over all k tried are uniform, with bins that differ and a fitted polynomial."""
    rng = np.random.default_rng(8)
    n = 18
    sem = np.linspace(0.005, 0.02, n)
    w = np.repeat(1 / sem[None, :], n, axis=0).ravel()[:, None]
    a = _polynomial(n, 3) * w
    p = []
    for _ in range(100 if full else 15):
        z = rng.standard_normal((n * n, 2))
        z -= a @ np.linalg.lstsq(a, z)[0]
        found = residual_partition(
            _bins((z / w).T.reshape(2, n, n), sem), order=3, tried=range(2, 7), rng=rng
        )
        p.append(found.p_value)
        assert not found.edges_seen and "No partition" in found.sentence
    assert kstest(p, "uniform").pvalue > 1e-3


def test_smooth_structure_is_no_partition():
    rng = np.random.default_rng(9)
    n = 31
    x = np.linspace(0, 1, n)
    for phase, noise in ((0.0, 0.01), (0.7, 0.01), (1.9, 0.01), (0.4, 0.0003)):
        wave = 0.03 * np.outer(np.sin(9 * x + phase), np.cos(7 * x))
        bins = _bins(np.stack([wave, -wave]) + rng.normal(0, noise, (2, n, n)), noise)
        found = residual_partition(bins, order=2, rng=rng)
        assert found.significant
        assert not found.edges_seen and "a polynomial describes it" in found.sentence


def test_what_shows_no_structure_is_refused():
    rng = np.random.default_rng(10)
    good = _bins(np.zeros((2, 9, 9)), 0.01)
    with pytest.raises(InputError, match="3 x 3 bins"):
        residual_correlation(_bins(np.zeros((2, 3, 3)), 0.01), rng=rng)
    with pytest.raises(DegenerateError, match="only 0 bins have at least 5 stars"):
        residual_correlation(_bins(np.zeros((2, 9, 9)), 0.01, count=4), rng=rng)
    with pytest.raises(InputError, match="the order is -1"):
        residual_correlation(good, order=-1, rng=rng)
    with pytest.raises(InputError, match="integers of at least 2"):
        residual_partition(good, tried=[1], rng=rng)
    with pytest.raises(InputError, match="too few for"):
        residual_partition(good, tried=[5], rng=rng)
