"""The simulated 47 Tuc campaign against what ACS ISR 2015-06 prints, and against itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from scipy import stats

from bayesdist.data.matching.campaign import match_campaign
from bayesdist.data.starlists import StarCuts
from bayesdist.errors import InputError
from bayesdist.missions.hst.simulate import LINEAR_TERMS, acs_solution, simulate_acs
from bayesdist.missions.hst.simulate.making import cte_shift
from bayesdist.missions.hst.simulate.truth import centroid_error
from bayesdist.model.lookup import corrected
from tests.missions.hst.test_acs_distortion import A_2, B_2, B_3
from tests.reduced import only_in_full

# positions that are where the truth says
EXACT = {"n_stars": 6000, "fine_scale": False, "centroid": 0.0, "blended": 0.0, "false": 0.0}


@pytest.fixture(scope="module")
def small():
    return simulate_acs(n_exposures=8, n_stars=3000, filters=("F606W", "F814W"), n_other=2)


@pytest.fixture(scope="module")
def campaign():
    """All stars, some of the exposures."""
    return simulate_acs(n_exposures=12, seed=3)


def detections(campaign, e):
    """List of an exposure, truth of its detections, and true pixels of its stars (N, 2)."""
    one, truth = campaign.lists[e], campaign.truth
    star = truth.detections[e].star
    u, v = truth.stars.at(truth.log[one.name].epoch)
    out = np.full((len(one), 2), np.nan)
    for chip in (1, 2):
        rows = (star >= 0) & (one.chip == chip)
        out[rows] = np.column_stack(truth.to_pixels(one.name, u[star[rows]], v[star[rows]], chip))
    return one, truth.detections[e], out


def same(a, b):
    return all(
        np.array_equal(getattr(p, key), getattr(q, key))
        for p, q in zip(a.lists, b.lists, strict=True)
        for key in ("x", "y", "chip", "mag", "q")
    )


# -- one seed -------------------------------------------------------------------------------------


def test_a_seed_gives_the_same_campaign(small):
    again = simulate_acs(n_exposures=8, n_stars=3000, filters=("F606W", "F814W"), n_other=2)
    assert same(again, small) and again.log.exposures == small.log.exposures
    np.testing.assert_array_equal(again.catalog.u, small.catalog.u)
    other = simulate_acs(n_exposures=8, n_stars=3000, seed=2)
    assert not np.array_equal(other.catalog.u, small.catalog.u)
    assert other.log.exposures[0].epoch != small.log.exposures[0].epoch


def test_an_option_changes_its_own_part_only(small):
    options = {"n_exposures": 8, "n_stars": 3000}
    alone = simulate_acs(**options)
    np.testing.assert_array_equal(alone.late.v, small.late.v)
    for one, found, truth in zip(
        alone.lists, alone.log.exposures, alone.truth.detections, strict=True
    ):
        k = small.log.names.index(found.name)
        assert small.log.exposures[k] == found
        np.testing.assert_array_equal(small.lists[k].x, one.x)  # another filter moves nothing
        np.testing.assert_array_equal(small.truth.detections[k].star, truth.star)
    trailed = simulate_acs(**options, cte=True)
    for one, other in zip(alone.lists, trailed.lists, strict=True):
        np.testing.assert_array_equal(one.x, other.x)
        np.testing.assert_array_equal(one.mag, other.mag)
        assert not np.array_equal(one.y, other.y)


# -- between pixels and the catalogue -------------------------------------------------------------


def test_pixels_come_back(campaign, rng):
    for name in campaign.log.names[::4]:
        for chip in (1, 2):
            x, y = rng.uniform(0.5, 4096.5, 500), rng.uniform(0.5, 2048.5, 500)
            sky = campaign.truth.to_catalog(name, x, y, chip)
            back = campaign.truth.to_pixels(name, sky[:, 0], sky[:, 1], chip)
            np.testing.assert_allclose(back, [x, y], rtol=0, atol=1e-8)


def test_places_far_off_the_chip_have_no_pixel(campaign):
    name = campaign.log.names[0]
    x, y = campaign.truth.to_pixels(name, [1e5, 5000.0], [5000.0, -1e5], 1)
    assert np.isnan(x).all() and np.isnan(y).all()


def test_the_way_to_the_catalogue_step_by_step(small, rng):
    """Tables, polynomial, deviations, rotation, aberration: one after the other, by `predict`."""
    truth, n = small.truth, 50
    for e, one in enumerate(small.log):
        model, theta = acs_solution(one.filter)
        c, s = np.cos(truth.frames.angle[e]), np.sin(truth.frames.angle[e])
        for chip in (1, 2):
            x, y = rng.uniform(1, 4096, n), rng.uniform(1, 2048, n)
            px, py = corrected(truth.tables, x, y, chip=chip, filter=one.filter)
            w = model.predict(theta, px, py, epoch=one.epoch, chip=chip)
            if chip == 1:
                w = w + np.column_stack([px - 2048, py - 1024]) @ truth.frames.own[e].T
            w = w + w @ truth.frames.shared[e].T
            sky = truth.frames.centre[e] + one.vafactor * w @ np.array([[c, -s], [s, c]]).T
            np.testing.assert_allclose(
                truth.to_catalog(one.name, x, y, chip), sky, rtol=0, atol=1e-8
            )


def measured_linear_terms(campaign, e, stars):
    """Both chips' linear terms from a list: monomials by least squares, turned to the gauge."""
    one, found = campaign.lists[e], campaign.truth.detections[e]
    va = campaign.log[one.name].vafactor
    fits = {}
    for chip in (1, 2):
        rows = (found.star >= 0) & (one.chip == chip)
        X, Y = (one.x[rows] - 2048) / 2048, (one.y[rows] - 1024) / 1024
        powers = [(i, j) for i in range(6) for j in range(6 - i)]
        design = np.stack([X**i * Y**j for i, j in powers], axis=-1)
        places = np.column_stack(stars)[found.star[rows]] / va
        fit, *_ = np.linalg.lstsq(design, places, rcond=None)
        pick = {power: fit[k] for k, power in enumerate(powers)}
        # columns: constant, derivative by x, derivative by y
        fits[chip] = np.stack([pick[0, 0], pick[1, 0] / 2048, pick[0, 1] / 1024], axis=-1)
    up = fits[2][:, 2] / np.hypot(*fits[2][:, 2])  # A_3 = 0: this is the V axis
    turn = np.array([[up[1], -up[0]], [up[0], up[1]]])
    zero = fits[2][:, 0].copy()
    for chip in (1, 2):
        fits[chip][:, 0] -= zero
    return {chip: (turn @ fits[chip]).ravel() for chip in (1, 2)}


@pytest.fixture(scope="module")
def exact():
    """Exact positions, no tables, no deviations: only what Tables 1-3 say, at several epochs."""
    return simulate_acs(n_exposures=6, scatter=0.0, **EXACT)


def test_exact_lists_give_back_tables_1_to_3(exact):
    for e, one in enumerate(exact.log):
        date = 2004.5 if one.epoch < 2009.4 else 2012.5
        found = measured_linear_terms(exact, e, exact.truth.stars.at(one.epoch))
        for chip in (1, 2):
            terms = dict(zip(LINEAR_TERMS, found[chip], strict=True))
            for name, table in (("A_2", A_2), ("B_2", B_2), ("B_3", B_3)):
                alpha, beta = table[chip, date]
                expected = alpha + beta * (one.epoch - date)
                assert terms[name] == pytest.approx(expected, abs=1e-10), (one.name, chip, name)
        assert found[1][3] == pytest.approx(2079.58, abs=1e-6)


def test_true_linear_terms_are_what_a_perfect_solution_finds(exact):
    """With the scatter of exposures, too."""
    scattered = simulate_acs(n_exposures=3, scatter=1e-4, **EXACT)
    for campaign in (exact, scattered):
        for e, one in enumerate(campaign.log):
            found = measured_linear_terms(campaign, e, campaign.truth.stars.at(one.epoch))
            for chip in (1, 2):
                terms = campaign.truth.linear_terms(one.name, chip)
                off = np.abs(found[chip] - terms)
                assert np.all(off < np.array([1e-6, 1e-10, 1e-10] * 2)), (one.name, chip, off)


def test_proper_motions_are_in_the_positions(exact):
    """Fitted to the stars as they were in 2004.5, the residuals are 0.01 px/yr times the years."""
    stars = exact.truth.stars
    for e, one in enumerate(exact.log):
        seen, found, _ = detections(exact, e)
        sky = exact.truth.to_catalog(one.name, seen.x, seen.y, seen.chip)
        still = np.column_stack(stars.at(2004.5))[found.star]
        moved = np.column_stack(stars.at(one.epoch))[found.star]
        np.testing.assert_allclose(sky, moved, rtol=0, atol=1e-8)
        years = abs(one.epoch - 2004.5)
        assert (sky - still).std() == pytest.approx(0.01 * years, rel=0.05)


def test_aberration_is_in_the_positions(exact):
    """Without the division by VAFACTOR the scale of an exposure is off by just that factor."""
    seen = []
    for e, one in enumerate(exact.log):
        right = measured_linear_terms(exact, e, exact.truth.stars.at(one.epoch))[2]
        neglected = replace(
            exact,
            log=replace(exact.log, exposures=tuple(replace(x, vafactor=1.0) for x in exact.log)),
        )
        wrong = measured_linear_terms(neglected, e, exact.truth.stars.at(one.epoch))[2]
        assert wrong[1] / right[1] - 1 == pytest.approx(one.vafactor - 1, abs=1e-10)
        seen.append(one.vafactor - 1)
    assert max(np.abs(seen)) > 2e-5  # a shift of 0.04 px at 2048 pixels


# -- as the report saw it -------------------------------------------------------------------------


def test_exposures_cover_years_rolls_and_catalogue():
    log = simulate_acs(n_exposures=110, n_stars=200).log
    epochs, rolls = log.values("epoch"), log.values("pa_v3")
    assert len(log) == 110 and 2002.3 <= epochs.min() < 2002.5 and epochs.max() > 2014.0
    assert not np.any((epochs > 2007.1) & (epochs < 2009.4))
    assert 40 < np.sum(epochs < 2009) < 70  # both segments of Tables 1-3
    largest_gap = np.diff(np.sort(np.append(rolls, rolls.min() + 360.0))).max()
    assert largest_gap < 40.0
    # Figures 14 and 16: a wave with its maximum around 0 and its minimum around 180 degrees; the
    # speed of the Earth, 29.78 km/s, times the cosine of the target's ecliptic latitude
    factor = log.values("vafactor") - 1
    wave = np.column_stack([np.ones(110), np.cos(np.radians(rolls)), np.sin(np.radians(rolls))])
    (_, along, across), left, *_ = np.linalg.lstsq(wave, factor, rcond=None)
    latitude = SkyCoord(5.646, -72.067, unit="deg").barycentrictrueecliptic.lat.rad
    assert np.hypot(along, across) == pytest.approx(29.78 / 299792 * np.cos(latitude), rel=0.15)
    assert abs(across) < along
    assert left[0] < 0.4 * ((factor - factor.mean()) ** 2).sum()  # the rest is the orbit of HST
    assert 5e-5 < np.ptp(factor) < 2.6e-4


def test_every_frame_lies_inside_the_catalogue(campaign):
    corners = np.array([[1.0, 1.0], [4096.0, 1.0], [1.0, 2048.0], [4096.0, 2048.0]])
    low, high = campaign.catalog.u.min(), campaign.catalog.u.max()
    for name in campaign.log.names:
        for chip in (1, 2):
            sky = campaign.truth.to_catalog(name, corners[:, 0], corners[:, 1], chip)
            assert sky.min() > low - 50 and sky.max() < high + 50
    sizes = [len(one) for one in campaign.lists]
    assert min(sizes) > 5000 and 8000 < np.mean(sizes) < 12_000


def test_stars_crowd_to_the_east(campaign):
    """Figure 2.  East is at small u: the cluster's centre is 6.7' = 8040 px from the middle."""
    u, v = campaign.truth.stars.u, campaign.truth.stars.v
    assert np.sum(u < 5000) > 1.5 * np.sum(u > 5000)
    assert abs(np.sum(v < 5000) / len(v) - 0.5) < 0.01
    counts, _ = np.histogram(u, bins=9)
    assert np.all(np.diff(counts) < 0)
    distance = np.hypot(u - (5000 - 8040), v - 5000)
    assert 3000 < distance.min() < 4000


def test_centroids_are_as_good_as_published(campaign):
    """0.01 to 0.02 px for -14 <= mag <= -10, worse for saturated and for faint stars."""
    off, mag, q = [], [], []
    for e in range(len(campaign.lists)):
        one, found, true = detections(campaign, e)
        clean = (found.star >= 0) & ~found.blended
        off.append(np.column_stack([one.x, one.y])[clean] - true[clean])
        mag.append(campaign.truth.stars.mag[found.star[clean]])
        q.append(one.q[clean])
    off, mag, q = np.concatenate(off), np.concatenate(mag), np.concatenate(q)

    def rms(bright, faint):
        return np.sqrt((off[(mag > bright) & (mag < faint)] ** 2).mean())

    well = [rms(m, m + 0.5) for m in np.arange(-14.0, -10.0, 0.5)]
    assert well[0] > 0.0095 and well[-1] < 0.0205
    assert np.all(np.diff(well) > -0.0005)
    assert rms(-8.0, -7.5) > 0.05
    assert rms(-15.0, -14.5) > 0.04
    # Figure 5: below -14 the fit is of the size of the error, above it is bad
    good = (mag > -14) & (mag < -10)
    assert np.quantile(q[good], 0.9) < 0.025 and np.quantile(q[mag < -14], 0.1) > 0.1


def test_false_detections_and_blends_are_as_many_as_asked(campaign):
    star = np.concatenate([one.star for one in campaign.truth.detections])
    blended = np.concatenate([one.blended for one in campaign.truth.detections])
    n = len(star)
    assert abs((star < 0).mean() - 0.05) < 5 * np.sqrt(0.05 / n)
    real = star >= 0
    assert abs(blended[real].mean() - 0.01) < 5 * np.sqrt(0.01 / real.sum())
    assert not blended[~real].any()
    for one in campaign.truth.detections:
        kept = one.star[one.star >= 0]
        assert len(np.unique(kept)) == len(kept)


def test_blends_draw_positions_by_the_share_of_the_light():
    """Neighbours evenly within 2 px with 0.01 to 0.5 of the light, evenly in its logarithm."""
    campaign = simulate_acs(
        n_exposures=4, n_stars=20_000, centroid=0.0, blended=0.3, false=0.0, fine_scale=False
    )
    pulls = []
    for e in range(4):
        one, found, true = detections(campaign, e)
        shift = np.hypot(*(np.column_stack([one.x, one.y]) - true).T)
        np.testing.assert_allclose(shift[~found.blended], 0.0, atol=1e-9)
        pulls.append(shift[found.blended])
    pulls = np.concatenate(pulls)
    low, high = 0.01, 10**-0.3
    mean = 4 / 3 * np.log((1 + high) / (1 + low)) / np.log(high / low)
    assert abs(pulls.mean() - mean) < 4 * pulls.std() / np.sqrt(len(pulls))
    assert pulls.max() < 2 * high / (1 + high)


def test_errors_of_the_catalogue_are_those_quoted(campaign):
    truth, catalog = campaign.truth.stars, campaign.catalog
    for own, other, sigma in (
        ("u", "u", "sigma_u"),
        ("v", "v", "sigma_v"),
        ("pm_u", "pm_u", "sigma_pm_u"),
        ("pm_v", "pm_v", "sigma_pm_v"),
    ):
        pull = (getattr(catalog, own) - getattr(truth, other)) / getattr(catalog, sigma)
        assert stats.kstest(pull, "norm").pvalue > 1e-3
    assert truth.pm_u.std() == pytest.approx(0.01, rel=0.02)
    assert truth.pm_v.std() == pytest.approx(0.01, rel=0.02)
    well = (catalog.mag > -14) & (catalog.mag < -10)
    assert np.mean(catalog.sigma_u[well] < 0.02) > 0.999  # Figure 3


def test_pairs_scatter_as_their_errors_say(campaign):
    """The package's matcher finds the pairs; sigma^2 = centroid^2 + catalogue(t)^2 holds for them.

    Of blends only those come through that are hardly moved, and beyond 4 sigma nothing is counted.
    """
    model, theta = acs_solution()

    def start(x, y, chip, epoch):
        return model.predict(theta, x, y, epoch=2004.5, chip=chip)

    cuts = StarCuts(mag=(-14.0, -9.0))
    some = campaign.lists[::5]
    pairs = match_campaign(some, campaign.log, campaign.catalog, start, cuts=cuts).table
    wrong, pulls, expected = 0, [], 0
    for one in some:
        rows = pairs.exposure == pairs.exposure_names.index(one.name)
        found = campaign.truth.detections[campaign.log.names.index(one.name)]
        index = {x: k for k, x in enumerate(one.x)}
        k = np.array([index[x] for x in pairs.x[rows]])
        wrong += np.sum(found.star[k] != pairs.star[rows])
        expected += np.sum((found.star >= 0) & cuts.passed(one)[0])
        chip = one.chip[k]
        sky = campaign.truth.to_catalog(one.name, pairs.x[rows], pairs.y[rows], chip)
        centroid = centroid_error(campaign.truth.stars.mag[pairs.star[rows]])
        off = np.column_stack([pairs.u[rows], pairs.v[rows]]) - sky
        sigma = np.hypot(
            np.column_stack([pairs.sigma_u[rows], pairs.sigma_v[rows]]), centroid[:, None]
        )
        pulls.append((off / sigma)[~found.blended[k]])
    assert wrong <= 2 and len(pairs) > 0.95 * expected
    pulls = np.concatenate(pulls).ravel()
    inside = pulls[np.abs(pulls) < 4]
    assert len(inside) > 0.999 * len(pulls)
    # centroid errors are in pixels of the detector, some per cent off those of the catalogue
    assert inside.std() == pytest.approx(1.0, abs=0.03)


@pytest.mark.slow
@only_in_full("tests/campaign compares with it")
def test_scatter_of_the_exposures_gives_the_published_sigma():
    """sigma(alpha) of A_2 and B_2 before SM4 is 8.7e-7 to 9.2e-7 in Tables 1 and 3; 6 seeds."""
    sigma, corr = {"A_2": [], "B_2": []}, []
    for seed in range(6):
        truth = simulate_acs(n_exposures=110, n_stars=200, seed=seed).truth
        epoch = truth.log.values("epoch")
        early = epoch < 2009.0
        terms = {
            chip: np.array([truth.linear_terms(name, chip) for name in truth.frames.names])
            for chip in (1, 2)
        }
        left = {}
        for name, k in (("A_2", 1), ("B_2", 4)):
            for chip in (1, 2):
                t, y = epoch[early] - 2004.5, terms[chip][early, k]
                line = np.polyfit(t, y, 1)
                left[chip] = y - np.polyval(line, t)
                scatter = np.sqrt((left[chip] ** 2).sum() / (early.sum() - 2))
                sigma[name].append(
                    scatter
                    * np.sqrt(
                        np.linalg.inv([[early.sum(), t.sum()], [t.sum(), (t**2).sum()]])[0, 0]
                    )
                )
            corr.append(np.corrcoef(left[1], left[2])[0, 1])
    for name, values in sigma.items():
        assert np.mean(values) == pytest.approx(9.1e-7, rel=0.12), name
    assert np.mean(corr) > 0.9  # mostly common to both chips


def test_outlying_exposures_deviate_more():
    frames = simulate_acs(n_exposures=110, n_stars=200, outlying=0.2).truth.frames
    size = np.abs(frames.shared[:, 0, 0])
    assert 10 <= frames.outlying.sum() <= 35
    assert size[frames.outlying].mean() > 5 * size[~frames.outlying].mean()


def test_trailed_charge_moves_stars_away_from_the_readout():
    """~0.1 px: more with time, with transfers, and for faint stars."""
    y, mag = np.array([1.0, 1024.0, 2048.0]), np.full(3, -9.0)
    upper, lower = cte_shift(1, y, mag, 2014.2), cte_shift(2, y, mag, 2014.2)
    np.testing.assert_allclose(upper, [-0.1, -0.05, 0.0], atol=1e-4)
    np.testing.assert_allclose(lower, [0.0, 0.05, 0.1], atol=1e-4)
    assert np.all(np.abs(cte_shift(2, y, mag, 2004.2)) < np.abs(lower) + 1e-12)
    assert np.all(np.abs(cte_shift(2, y[1:], mag[1:] - 3, 2014.2)) < 0.5 * lower[1:])


def test_one_roll_for_all():
    log = simulate_acs(n_exposures=5, n_stars=200, pa_v3=-30.0).log
    assert set(log.values("pa_v3")) == {330.0}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"filters": ("F606W", "F606W")}, "filters"),
        ({"filters": ()}, "filters"),
        ({"filters": ("F1",)}, "F1"),
        ({"n_exposures": 0}, "n_exposures"),
        ({"n_stars": 99}, "n_stars"),
        ({"false": 1.0}, "false"),
        ({"outlying": -0.1}, "outlying"),
        ({"scatter": -1e-6}, "scatter"),
        ({"centroid": np.nan}, "centroid"),
    ],
)
def test_options_that_make_no_campaign_are_refused(options, words):
    with pytest.raises(InputError, match=words):
        simulate_acs(**{"n_exposures": 2, "n_stars": 200} | options)
