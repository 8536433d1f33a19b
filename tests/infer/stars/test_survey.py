"""What is known of all stars before anything is fitted: pieces add to the whole."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from bayesdist.infer import load
from bayesdist.infer.stars.shards import survey, total
from bayesdist.infer.stars.stars import prepare
from tests.batched import in_batches

from ..support import CHIP, TWO_CHIPS, pieces, simulated, table


def survey_of(model, matches, every=1):
    return survey(prepare(model, matches)[0], matches, every)


@pytest.fixture(scope="module", params=[1, 2], ids=["one chip", "two chips"])
def campaign(request):
    chips = (CHIP, *TWO_CHIPS[1:])[: request.param]
    rng = np.random.default_rng(3)
    return simulated(
        121,
        5000,
        frames="shift",
        n_exposures=3,
        chips=chips,
        sigma=tuple(rng.uniform(0.02, 0.1, (2, 5000))),
    )[:2]


CUTS = [[], [1], [3, 4, 5], [1500, 1501, 4000], list(range(100, 5000, 100))]


@pytest.mark.parametrize("cuts", CUTS, ids=str)
def test_surveys_of_pieces_add_to_that_of_the_whole(campaign, cuts):
    model, matches = campaign
    shuffled = matches.select(np.random.default_rng(4).permutation(5000))
    added = total(survey_of(model, shuffled.select(rows)) for rows in pieces(5000, cuts))
    assert added.n == 5000
    np.testing.assert_array_equal(added.exposures, np.bincount(matches.exposure, minlength=3))
    assert added.groups.same(survey_of(model, matches).groups)
    assert added.sources == matches.sources
    both = np.concatenate([matches.sigma_u, matches.sigma_v])
    assert added.reference_sigma == pytest.approx(np.median(both), rel=1e-3)
    for code, (chip, found) in enumerate(zip(model.chips, added.chips, strict=True)):
        here = matches.chip == code
        x, y = matches.x[here], matches.y[here]
        assert found.n == here.sum() and found.outside == ""
        hull = ConvexHull(np.column_stack([x, y]))  # of all stars at once
        assert ConvexHull(found.corners).volume == pytest.approx(hull.volume, rel=1e-12)
        assert {tuple(c) for c in found.corners} == {tuple(p) for p in hull.points[hull.vertices]}
        a, b = x / chip.size[0], y / chip.size[1]
        np.testing.assert_allclose(
            found.sums, [a.sum(), b.sum(), (a * a).sum(), (a * b).sum(), (b * b).sum()], rtol=1e-12
        )


def test_the_median_error_is_that_of_a_spread_sample():
    model, matches, _ = simulated(
        122, 9000, sigma=tuple(np.linspace(0.02, 0.1, 18_000).reshape(2, -1))
    )
    exact = np.median(np.concatenate([matches.sigma_u, matches.sigma_v]))
    for every in (1, 7, 100):
        found = survey_of(model, matches, every)
        assert [len(v) for v in found.variance] == [-(-9000 // every)] * 2
        assert found.reference_sigma == pytest.approx(exact, rel=2e-2 if every > 1 else 1e-6)


def planted(rows: dict[int, float], n: int = 40):
    """A table with stars beyond the right edge of the detector, 1000 columns wide."""
    rng = np.random.default_rng(5)
    x, y = rng.uniform(1, 1000, n), rng.uniform(1, 800, n)
    for row, where in rows.items():
        x[row] = where
    return table(x, y, x, y)


def test_the_first_star_outside_is_named_whatever_the_pieces():
    model, *_ = simulated(123, 10)
    matches = planted({17: 1000.6, 9: 2000.25, 30: -3.0})
    for cuts in ([], [10], [9], [5, 18], [1, 2, 3, 31]):
        added = total(survey_of(model, matches.select(rows)) for rows in pieces(40, cuts))
        (found,) = added.chips
        assert found.outside.startswith("row 10 lies at pixel (2000.25, ")
        assert "outside the 1000 x 800 detector" in found.outside


@pytest.mark.parametrize("x", [0.5, 1000.5])
def test_the_edge_of_the_last_pixel_is_inside(x):
    model, *_ = simulated(123, 10)
    assert survey_of(model, planted({17: x})).chips[0].outside == ""
    beyond = np.nextafter(x, 1e9 if x > 1 else -1)
    assert survey_of(model, planted({17: beyond})).chips[0].outside.startswith("row 18 lies")


@pytest.mark.parametrize("n", [1, 3, 4, 50, 3000])
@pytest.mark.parametrize("cut", [0.0, 0.3])
def test_stars_on_a_line_or_in_one_place_have_no_hull(n, cut):
    """No error where there is no area: the points stay, and the sums tell."""
    model, *_ = simulated(123, 10)
    t = np.linspace(0.1, 0.9, n)
    u = 1.0 * np.arange(n)  # distinct rows
    for x, y in (
        (1000 * t, 800 * t),
        (np.full(n, 500.0), 800 * t),
        (np.full(n, 7.0), np.full(n, 7.0)),
    ):
        matches = table(x, y, u, u)
        k = max(1, int(cut * n))
        parts = (
            [matches]
            if not cut or n == 1
            else [matches.select(np.arange(k)), matches.select(np.arange(k, n))]
        )
        (found,) = total(survey_of(model, part) for part in parts).chips
        a, b, aa, ab, bb = found.sums / found.n
        assert (aa - a * a) * (bb - b * b) == pytest.approx((ab - a * b) ** 2, abs=1e-12)
        assert found.corners[:, 0].min() == x.min() and found.corners[:, 0].max() == x.max()


def test_a_chip_without_stars_has_none():
    model, matches, _ = simulated(124, 100, chips=TWO_CHIPS)
    one = survey_of(model, matches.select(matches.chip == 0))
    two = survey_of(model, matches.select(matches.chip == 1))
    assert (one.chips[1].n, two.chips[0].n) == (0, 0) and one.chips[1].outside == ""
    both, whole = one + two, survey_of(model, matches)
    for a, b in zip(both.chips, whole.chips, strict=True):
        assert a.n == b.n
        assert {tuple(c) for c in a.corners} == {tuple(c) for c in b.corners}


def test_the_hull_of_many_stars_is_that_of_all():
    """More than a thousand stars are sifted before the hull is made; none of its corners may go."""
    model, *_ = simulated(123, 10)
    rng = np.random.default_rng(6)
    for shape in ("square", "disc", "diamond", "strip", "blob"):
        x, y = rng.uniform(-1, 1, (2, 20_000))
        if shape == "disc":
            keep = x**2 + y**2 < 1
        elif shape == "diamond":
            keep = np.abs(x) + np.abs(y) < 1
        elif shape == "strip":
            keep = np.abs(x - y) < 0.01
        else:
            keep = np.ones(len(x), bool)
        if shape == "blob":
            x, y = rng.normal(0, 0.15, (2, 20_000)).clip(-0.99, 0.99)
        x, y = 500 + 499 * x[keep], 400 + 399 * y[keep]
        (found,) = survey_of(model, table(x, y, x, y)).chips
        hull = ConvexHull(np.column_stack([x, y]))
        assert {tuple(c) for c in found.corners} == {tuple(p) for p in hull.points[hull.vertices]}


def test_shards_survey_their_pieces(campaign):
    model, matches = campaign
    whole = load(model, matches).survey
    cut = load(model, in_batches(matches, 700)).survey
    assert cut.n == whole.n and cut.where == whole.where
    assert cut.reference_sigma == whole.reference_sigma  # the same stars, all of them
    np.testing.assert_array_equal(cut.exposures, whole.exposures)
