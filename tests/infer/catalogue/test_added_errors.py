"""Errors beyond the quoted ones by groups of stars: true sizes, and no groups where there are none.

The data are made here with numpy: a cubic distortion, quoted errors of 0.02, larger scatter.
"""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.data import Matches
from bayesdist.data.magnitude_errors import AddedErrors
from bayesdist.errors import InputError
from bayesdist.infer import build_model, fit_linear
from bayesdist.infer.catalogue.added_errors import DECISIVE, grouped_errors
from bayesdist.model import Chip
from tests.reduced import case_in_full, only_in_full

from ..support import UNCLIPPED

SIZE = (1000.0, 800.0)
QUOTED = 0.02


def stars(seed, n, sigma=(0.05, 0.05), *, false=0.04, labels=1, by="chip", dof=None, quoted=QUOTED):
    """Matches whose scatter is `sigma`: on each axis, or of each label on each axis (G, 2)."""
    rng = np.random.default_rng(seed)
    x, y = (rng.uniform(1, side, n) for side in SIZE)
    X, Y = x / 500 - 1, y / 400 - 1
    label = np.arange(n) % labels
    size = np.broadcast_to(np.asarray(sigma, float), (labels, 2))[label]
    noise = rng.normal(size=(n, 2)) if dof is None else rng.standard_t(dof, size=(n, 2))
    noise *= size
    bad = rng.uniform(size=n) < false
    noise[bad] = rng.normal(0, 0.5, (int(bad.sum()), 2))
    columns = {}
    if labels > 1:
        names = tuple(str(k + 1) for k in range(labels))
        columns = {
            "chip": {"chip": label, "chip_numbers": tuple(range(1, labels + 1))},
            "exposure": {"exposure": label, "exposure_names": names},
            "filter": {"filter": label, "filter_names": names},
        }[by]
    quoted = np.broadcast_to(np.asarray(quoted, float), (n,))
    return Matches(
        x=x,
        y=y,
        u=x + 0.4 * X**2 * Y + noise[:, 0],
        v=y - 0.3 * X * Y + noise[:, 1],
        sigma_u=quoted,
        sigma_v=quoted,
        **columns,
    )


def found_in(table, *, by="", outliers=True, order=3):
    chips = tuple(Chip(number, f"c{number}", SIZE, (500.5, 400.5)) for number in table.chip_numbers)
    several = {"chips": chips} if len(chips) > 1 else {"size": SIZE}
    model = build_model(table, order=order, **several)
    options = {} if outliers else UNCLIPPED
    return grouped_errors(table, fit_linear(table, model, **options), by=by, outliers=outliers)


def test_equal_errors_give_the_unbiased_variance():
    """Of n residuals and p parameters of an axis: their sum of squares over n - p."""
    n, order = 60, 4
    table = stars(1, n, (0.05, 0.15), false=0.0)
    X, Y = table.x / 500 - 1, table.y / 400 - 1
    A = np.stack([X**i * Y**j for i in range(order + 1) for j in range(order + 1 - i)], axis=1)
    data = np.stack([table.u, table.v], axis=1)
    rest = data - A @ np.linalg.lstsq(A, data, rcond=None)[0]
    true = (rest**2).sum(axis=0) / (n - A.shape[1]) - QUOTED**2
    found = found_in(table, outliers=False, order=order)
    assert found.grouping == "axis" and A.shape[1] == 15
    np.testing.assert_allclose(found.variance[0], true, rtol=2e-3)


def test_the_restricted_likelihood_is_unbiased_on_average(full):
    """60 stars, 15 parameters: without what the fit takes up variances would be 25 % too small."""
    n = 40 if full else 15
    ratios = [
        (found_in(stars(100 + k, 60, false=0.0), outliers=False, order=4).variance + QUOTED**2)
        / 0.05**2
        for k in range(n)
    ]
    # of n sets with 45 degrees of freedom on each of two axes
    assert np.mean(ratios) == pytest.approx(1.0, abs=4 * np.sqrt(2 / (n * 90)))


@pytest.mark.parametrize("sizes", [(0.043, 0.060), (0.06, 0.03)])
def test_unequal_axes_have_jitters_of_their_own(sizes):
    found = found_in(stars(2, 3000, sizes))
    true = np.sqrt(np.square(sizes) - QUOTED**2)
    assert found.grouping == "axis" and found.evidence["axis"] > DECISIVE
    np.testing.assert_array_less(np.abs(found.sigma[0] - true), 4 * found.sigma_error[0])
    # a variance of n normal variables is known to sqrt(2 / n) of the whole
    error = np.square(sizes) / true / np.sqrt(2 * 0.96 * 3000)
    np.testing.assert_allclose(found.sigma_error[0], error, rtol=0.1)
    added = found.added
    low, high = np.argsort(sizes)
    assert added.sigma[0, low] == 0
    assert added.sigma[0, high] ** 2 == pytest.approx(np.ptp(found.variance))


def test_unequal_axes_are_found_beside_stars_whose_motion_is_assumed():
    """60 % have errors of 2 px, beside which the difference of the axes is small."""
    n, rng = 1500, np.random.default_rng(7)
    table = stars(7, n, (0.05, 0.15))
    assumed = rng.random(n) < 0.6
    more = np.where(assumed, 2.0, 0.0)
    u, v = (a + more * rng.normal(size=n) for a in (table.u, table.v))
    sigma = np.hypot(QUOTED, more)
    table = table.with_columns(u=u, v=v, assumed_motion=assumed.astype(int))
    found = found_in(table.with_errors((sigma, sigma)))
    assert found.grouping == "axis"
    expected = np.array([0.05, 0.15]) ** 2 - QUOTED**2
    # 600 stars on an axis, with some false ones: the scatter of a variance is 6 %
    np.testing.assert_allclose(found.variance[0] + QUOTED**2, expected + QUOTED**2, rtol=0.25)


@pytest.mark.slow
@only_in_full("estimates are unbiased")
def test_stated_errors_are_those_by_which_estimates_scatter():
    """Pulls of the added variances over 30 sets, quoted errors over a factor of four."""
    pulls = []
    for seed in range(30):
        quoted = np.random.default_rng(seed).uniform(0.02, 0.08, 600)
        base = stars(seed, 600, (0.0, 0.0), false=0.03, quoted=quoted)
        rng = np.random.default_rng(1000 + seed)
        extra = rng.normal(size=(2, 600)) * np.hypot(quoted, [[0.03], [0.07]])
        table = base.with_columns(u=base.u + extra[0], v=base.v + extra[1])
        found = found_in(table)
        assert found.grouping == "axis"
        pulls.append((found.variance[0] - [0.03**2, 0.07**2]) / found.error[0])
    pulls = np.array(pulls)
    assert abs(pulls.mean()) < 4 / np.sqrt(pulls.size)
    assert (pulls**2).mean() == pytest.approx(1.0, abs=4 * np.sqrt(2 / pulls.size))


def test_correlated_errors_neither_split_the_axes_nor_bias_what_is_added():
    """Variances alone are used: what is lost is in the dispersion, and so in the stated error."""
    pulls, dispersions = [], []
    for seed in range(25):
        rng = np.random.default_rng([46, seed])
        base = stars(seed, 400, (0.0, 0.0), false=0.0)
        sigma = rng.uniform(0.02, 0.06, 400)
        C = sigma[:, None, None] ** 2 * np.array([[1.0, 0.95], [0.95, 1.0]])
        noise = np.einsum("nij,nj->ni", np.linalg.cholesky(C), rng.standard_normal((400, 2)))
        noise += 0.03 * rng.standard_normal((400, 2))
        table = base.with_columns(u=base.u + noise[:, 0], v=base.v + noise[:, 1])
        found = found_in(table.with_covariances(C))
        assert found.grouping == "one"
        pulls.append((found.variance[0, 0] - 0.03**2) / found.error[0, 0])
        dispersions.append(found.dispersion)
    assert np.mean(dispersions) > 1.1
    assert abs(np.mean(pulls)) < 4 / np.sqrt(25)
    assert np.mean(np.square(pulls)) == pytest.approx(1.0, abs=4 * np.sqrt(2 / 25))


@pytest.mark.parametrize(
    ("dof", "n"),
    [
        (None, 300),
        case_in_full(None, 2000, instead="longer tails are run"),
        (4, 300),
        case_in_full(4, 2000, instead="fewer stars are run"),
    ],
)
def test_equal_axes_are_not_split(dof, n):
    """At odds of 20 to 1; long tails, of a t distribution, are none either."""
    seeds = range(20)
    split = [found_in(stars(200 + k, n, dof=dof)).added is not None for k in seeds]
    assert sum(split) <= 1


def test_right_quoted_errors_are_not_split():
    found = found_in(stars(3, 2000, (QUOTED, QUOTED)))
    assert found.grouping == "one" and found.added is None
    assert found.sigma.max() < 4 * found.sigma_error.max()


def test_few_stars_are_not_split_for_less_than_they_can_tell():
    """30 stars know the size of their scatter to 13 %."""
    assert found_in(stars(4, 30, (0.05, 0.06), false=0.0), order=1).grouping == "one"
    assert found_in(stars(4, 30, (0.03, 0.15), false=0.0), order=1).grouping == "axis"


def test_a_wild_match_makes_no_axis_where_there_are_no_false_ones():
    """Without a mixture its square is all there is along u, and says nothing of the others."""
    table = stars(5, 500, false=0.0)
    u = table.u.copy()
    u[7] += 3.0
    assert found_in(table.with_columns(u=u), outliers=False).grouping == "one"


@pytest.mark.parametrize(
    ("sigma", "grouping"),
    [
        ([(0.05, 0.05), (0.05, 0.05)], "one"),
        ([(0.05, 0.08), (0.05, 0.08)], "axis"),
        ([(0.04, 0.04), (0.07, 0.07)], "chip"),
        ([(0.04, 0.06), (0.07, 0.05)], "chip and axis"),
    ],
)
def test_chips_are_compared_where_that_is_asked(sigma, grouping):
    found = found_in(stars(6, 3000, sigma, labels=2), by="chip")
    assert found.grouping == grouping
    true = np.sqrt(np.square(sigma) - QUOTED**2)
    rows = true if len(found.labels) == 2 else true[:1]
    np.testing.assert_array_less(np.abs(found.sigma - rows), 4 * found.sigma_error)
    if grouping == "chip and axis":  # the axes together are equal, and so are the chips
        assert found.labels == ("1", "2") and found.by == "chip" and found.by_axis
        assert found.added.sigma.min() == 0


@pytest.mark.parametrize("by", ["exposure", "filter"])
def test_exposures_and_filters_are_compared_as_well(by):
    sizes = [(0.03, 0.03), (0.05, 0.05), (0.09, 0.09)]
    found = found_in(stars(7, 3000, sizes, labels=3, by=by), by=by)
    assert found.grouping == by and found.labels == ("1", "2", "3")
    true = np.sqrt(np.square(sizes) - QUOTED**2)
    np.testing.assert_array_less(np.abs(found.sigma - true), 4 * found.sigma_error)


def test_small_groups_are_drawn_to_the_common_error():
    """40 exposures of 20 stars: scatters are nearer to the truth than each by itself."""
    drawn, alone = [], []
    for seed in range(4):
        sizes = 0.05 * np.exp(np.random.default_rng(seed).normal(0, 0.3, 40))
        both = np.stack([sizes, sizes], axis=1)
        table = stars(seed, 800, both, labels=40, by="exposure", false=0.0)
        found = found_in(table, by="exposure", outliers=False)
        assert found.grouping == "exposure"
        drawn.append(np.log((found.variance[:, 0] + QUOTED**2) / sizes**2))
        X, Y = table.x / 500 - 1, table.y / 400 - 1
        A = np.stack([X**i * Y**j for i in range(4) for j in range(4 - i)], axis=1)
        data = np.stack([table.u, table.v], axis=1)
        square = ((data - A @ np.linalg.lstsq(A, data, rcond=None)[0]) ** 2).mean(axis=1)
        own = np.bincount(table.exposure, square) / np.bincount(table.exposure)
        alone.append(np.log(own / sizes**2))
    assert np.mean(np.square(drawn)) < 0.95 * np.mean(np.square(alone))
    assert np.var(drawn, axis=1).mean() < np.var(alone, axis=1).mean()


def test_equal_exposures_are_not_split():
    for seed in range(5):
        assert found_in(stars(seed, 1000, labels=20, by="exposure"), by="exposure").added is None


def test_one_label_is_refused():
    with pytest.raises(InputError, match="all matches have the same filter"):
        found_in(stars(9, 300), by="filter")


def test_errors_are_added_in_quadrature_by_the_name_of_the_group():
    table = stars(10, 6, labels=3, by="exposure")
    added = AddedErrors("exposure", ("3", "1"), np.array([[0.0, 0.1], [0.2, 0.0]]), np.ones(2))
    both = table.with_errors(added, in_quadrature=True)
    np.testing.assert_allclose(both.sigma_u, np.hypot(QUOTED, np.array([0.2, 1.0, 0.0] * 2)))
    np.testing.assert_allclose(both.sigma_v, np.hypot(QUOTED, np.array([0.0, 1.0, 0.1] * 2)))
    np.testing.assert_array_equal(both.u, table.u)
