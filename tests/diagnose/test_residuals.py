import numpy as np
import pytest
from scipy.stats import binned_statistic_2d

from bayesdist.diagnose.residuals.binned import binned_residuals
from bayesdist.diagnose.residuals.tables import pair_statistics, residual_statistics
from bayesdist.errors import InputError

SIZE = (1016.0, 508.0)


@pytest.fixture
def stars():
    rng = np.random.default_rng(8)
    n = 5000
    x, y = 0.5 + rng.random(n) * SIZE[0], 0.5 + rng.random(n) * SIZE[1]
    return x, y, rng.normal(0.01, 0.03, n), rng.normal(-0.02, 0.05, n)


def test_bins_are_those_of_scipy(stars):
    x, y, ru, rv = stars
    b = binned_residuals(x, y, ru, rv, bins=(31, 15), size=SIZE)
    edges = [[0.5, SIZE[1] + 0.5], [0.5, SIZE[0] + 0.5]]
    for statistic, ours in (("mean", b.mean_u), ("count", b.count)):
        theirs = binned_statistic_2d(y, x, ru, statistic, bins=(15, 31), range=edges).statistic
        np.testing.assert_allclose(ours, theirs, rtol=1e-12)
    theirs = binned_statistic_2d(
        y, x, rv, lambda r: np.std(r, ddof=1) / np.sqrt(r.size), bins=(15, 31), range=edges
    ).statistic
    np.testing.assert_allclose(b.sem_v, theirs, rtol=1e-11)
    np.testing.assert_allclose(np.diff(b.x), SIZE[0] / 31, rtol=1e-12)
    assert b.x[0] == pytest.approx(0.5 + SIZE[0] / 62) and b.y.size == 15
    assert b.n_outside == 0


def test_edges_empty_bins_and_strays():
    x = [0.5, 10.5, 10.6, 2.0]
    y = [0.5, 10.5, 5.0, np.nextafter(0.5, 0)]
    b = binned_residuals(x, y, [1.0, 2.0, 3.0, 4.0], [0.0] * 4, bins=2, size=(10, 10))
    np.testing.assert_array_equal(b.count, [[1, 0], [0, 1]])
    assert b.mean_u[0, 0] == 1 and b.mean_u[1, 1] == 2
    assert np.isnan(b.mean_u[0, 1]) and np.isnan(b.sem_u).all()
    assert b.n_outside == 2


def test_standard_errors_cover_the_truth():
    """400 bins of 50 stars: 95 % within the interval of Student's t with 49 degrees of freedom."""
    rng = np.random.default_rng(9)
    n = 400 * 50
    g = np.repeat(np.arange(20), 50 * 20) + 1.0, np.tile(np.repeat(np.arange(20), 50), 20) + 1.0
    b = binned_residuals(
        *g, rng.normal(0.3, 0.1, n), rng.normal(-1, 2, n), bins=20, size=(20.0, 20.0)
    )
    assert (b.count == 50).all()
    for mean, sem, truth in ((b.mean_u, b.sem_u, 0.3), (b.mean_v, b.sem_v, -1.0)):
        covered = np.mean(np.abs(mean - truth) < 2.0096 * sem)
        assert abs(covered - 0.95) < 4 * np.sqrt(0.95 * 0.05 / 400)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(ru=[np.nan, 0.0]), "not finite"),
        (dict(rv=[0.0]), "differ in length"),
        (dict(bins=0), "number of bins is 0"),
        (dict(bins=(3, 2.5)), "number of bins"),
    ],
)
def test_what_cannot_be_binned_is_refused(change, message):
    given = dict(ru=[0.0, 0.0], rv=[0.0, 0.0], bins=2) | change
    with pytest.raises(InputError, match=message):
        binned_residuals(
            [1.0, 2.0], [1.0, 2.0], given.pop("ru"), given.pop("rv"), size=SIZE, **given
        )


def test_statistics_of_whole_numbers():
    s = residual_statistics(np.arange(101.0)[::-1])
    assert (s["min"], s["p01"], s["median"], s["p99"], s["max"]) == (0, 1, 50, 99, 100)
    assert s["mean"] == 50 and s["n"] == 101
    assert s["sigma"] == pytest.approx(np.sqrt((101**2 - 1) / 12))


def test_differences_of_all_pairs_of_bins():
    """WSDC D-T033, Tables 5-1 and 5-3: of sigmas of bins follow those of pairs, in arcsec."""
    r = np.random.default_rng(3).gamma(2.0, 0.01, 31 * 31)
    published = {
        "W2/X": (0.01679, 0.06531),
        "W2/Y": (0.008914, 0.03467),
        "W3/Y": (0.008846, 0.0344),
    }
    for single, paired in published.values():
        bins = r * single / residual_statistics(r)["sigma"]
        assert 2.75 * pair_statistics(bins)["sigma"] == pytest.approx(paired, rel=1e-3)


def test_empty_bins_are_left_out_and_nothing_is_refused():
    assert residual_statistics([[1.0, np.nan], [3.0, np.nan]])["mean"] == 2
    assert residual_statistics([[1.0, np.nan], [3.0, np.nan]])["n"] == 2
    for bad in ([], [np.nan], [np.inf, 1.0]):
        with pytest.raises(InputError):
            residual_statistics(bad)
