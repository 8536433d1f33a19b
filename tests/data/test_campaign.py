from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from bayesdist.data import MagnitudeErrors, Matches, ReferenceCatalog
from bayesdist.data.detections import Detections
from bayesdist.data.exposures import Exposure, ExposureLog
from bayesdist.data.matching.campaign import match_campaign
from bayesdist.data.matching.exposure import search_radius
from bayesdist.data.matching.similarity import mismatch_reason, pattern_index
from bayesdist.data.preparing import neutralise_aberration
from bayesdist.data.starlists import StarCuts, read_star_lists
from bayesdist.errors import InputError
from bayesdist.formats.hst1pass import read_hst1pass, read_matchup
from tests.data.sky import ZERO_POINT, campaign, positions, start
from tests.reduced import case_in_full, only_in_full


def truth_of(table, truth):
    """True rows of the catalogue for the rows of a table, -1 for junk."""
    return np.array([truth[e][r] for e, r in zip(table.exposure, table.row, strict=True)])


@pytest.mark.parametrize(
    "left", [*(case_in_full(left, instead="five pixels are left") for left in (0.0, 1.0)), 5.0]
)
def test_every_star_finds_itself(rng, left):
    catalog, lists, log, truth, rolls = campaign(rng, 6, left=left)
    found = match_campaign(lists, log, catalog, start)
    t = found.table
    true = truth_of(t, truth)
    real = sum(int((rows >= 0).sum()) for rows in truth)
    right = true + 1000 == t.star
    assert right.sum() > 0.999 * real
    # junk and strangers: as few as the reports say
    assert (~right).sum() <= 3 + 3 * sum(r.false_fraction * r.matched for r in found.reports)
    for report, roll in zip(found.reports, rolls, strict=True):
        assert (report.rotation - roll + 180) % 360 - 180 == pytest.approx(0.0, abs=0.15)
        assert report.scale == pytest.approx(1.0, abs=0.003)
        assert report.zero_point == pytest.approx(-ZERO_POINT, abs=0.05)
        # centroid errors of 0.03 on each axis, after a cubic that has taken up what was left
        assert report.rms == pytest.approx(0.03 * np.sqrt(2), rel=0.1)


@pytest.mark.parametrize(("stars", "seen"), [(60, 0.95), (300, 0.5)])
@pytest.mark.parametrize("with_mag", [True, False])
def test_sparse_fields_and_no_magnitudes(rng, stars, seen, with_mag):
    catalog, lists, log, truth, _ = campaign(rng, 3, stars=stars, seen=seen)
    if not with_mag:
        lists = tuple(replace(one, mag=None) for one in lists)
    found = match_campaign(lists, log, catalog, start)
    true = truth_of(found.table, truth)
    real = sum(int((rows >= 0).sum()) for rows in truth)
    assert (true + 1000 == found.table.star).sum() >= 0.97 * real
    assert (true + 1000 != found.table.star).sum() <= 1
    assert (found.table.mag is None) == (found.reports[0].zero_point is None) == (not with_mag)


def test_what_the_table_holds(rng):
    catalog, lists, log, truth, _ = campaign(rng, 3, motion=0.05)
    t = match_campaign(lists, log, catalog, start).table
    true = truth_of(t, truth)
    sure = true >= 0
    assert t.unit == "pix" and t.chip_numbers == (1, 2) and t.exposure_names == ("e0", "e1", "e2")
    assert t.filter_names == ("F814W", "F606W") and t.sources[1] == "e1.parquet"
    for k, one in enumerate(lists):
        here = t.exposure == k
        np.testing.assert_array_equal(t.x[here], one.x[t.row[here]])
        np.testing.assert_array_equal(t.y[here], one.y[t.row[here]])
        np.testing.assert_array_equal(t.mag[here], one.mag[t.row[here]])
        np.testing.assert_array_equal(t.chip_number[here], one.chip[t.row[here]])
        epoch = log[one.name].epoch
        assert np.all(t.epoch[here] == epoch)
        # the catalogue at the epoch, with errors that have grown until then
        then = catalog.at(epoch)
        rows = t.star[here] - 1000
        np.testing.assert_array_equal(t.u[here], then.u[rows])
        np.testing.assert_array_equal(t.v[here], then.v[rows])
        np.testing.assert_allclose(t.sigma_u[here], np.hypot(0.01, 0.003 * (epoch - 2004.5)))
        np.testing.assert_allclose(t.sigma_v[here], np.hypot(0.02, 0.004 * (epoch - 2004.5)))
    assert np.mean(true[sure] + 1000 == t.star[sure]) > 0.999
    assert t.n_rows == sum(len(one) for one in lists) == len(t) + sum(t.rejected.values())


@pytest.mark.parametrize("mirrored", [False, True])
def test_matches_have_the_covariances_of_catalogue_and_centroids(rng, mirrored):
    """Of the catalogue at the epoch, and of the pixels turned by the roll of the exposure."""
    catalog, lists, log, _, rolls = campaign(rng, 3, motion=0.05)
    n = len(catalog)
    root = rng.standard_normal((n, 5, 5))
    C = root @ np.swapaxes(root, 1, 2)
    size = 1 / np.sqrt(np.einsum("nii->ni", C))
    catalog = replace(catalog, correlations=C * size[:, :, None] * size[:, None])
    sigma = np.array([0.01, 0.02, 0.0, 0.003, 0.004])  # as in `campaign`
    C = catalog.correlations * np.outer(sigma, sigma)
    lists = [
        replace(
            one,
            sigma_x=rng.uniform(0.01, 0.1, len(one)),
            sigma_y=rng.uniform(0.01, 0.1, len(one)),
            rho_xy=rng.uniform(-0.9, 0.9, len(one)),
        )
        for one in lists
    ]
    if mirrored:
        catalog = catalog.mirrored()
    table = match_campaign(lists, log, catalog, start, mirrored=(mirrored,)).table
    for k, one in enumerate(lists):
        here = table.exposure == k
        dt = log[one.name].epoch - 2004.5
        A = np.array([[1, 0, 0, dt, 0], [0, 1, 0, 0, dt]])
        angle = np.radians(rolls[k])
        R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        pixels = one.covariances[table.row[here]]
        expected = A @ C[table.star[here] - 1000] @ A.T + R @ pixels @ R.T
        found = table.select(here).covariances()
        np.testing.assert_allclose(found, expected, atol=3e-3 * np.abs(expected).max())
    # some lists alone have errors: those of the centroids are left out
    some = match_campaign(
        [replace(lists[0], sigma_x=None, sigma_y=None, rho_xy=None), *lists[1:]],
        log,
        catalog,
        start,
        mirrored=(mirrored,),
    ).table
    first = some.select(some.exposure == 1)
    dt = log["e1"].epoch - 2004.5
    A = np.array([[1, 0, 0, dt, 0], [0, 1, 0, 0, dt]])
    np.testing.assert_allclose(first.covariances(), A @ C[first.star - 1000] @ A.T, rtol=1e-9)


def test_motions_are_needed_where_stars_move(rng):
    catalog, lists, log, _, _ = campaign(rng, 2, motion=0.3, left=0.0)
    moving = match_campaign(lists, log, catalog, start)
    still = match_campaign(lists, log, replace(catalog, pm_u=None, pm_v=None), start)
    # 2 and 9 years away from the epoch, 0.3 px a year on each axis
    assert moving.reports[1].rms < 0.05 < 1.5 < still.reports[1].rms


@pytest.mark.slow
@only_in_full("tests/app/campaign counts them")
def test_completeness_and_false_matches_are_what_happens(rng):
    catalog, lists, log, truth, _ = campaign(rng, 4, stars=40_000, junk=0.5, seen=0.7)
    found = match_campaign(lists, log, catalog, start, radius=4.0)
    false, predicted = 0, 0.0
    for k, report in enumerate(found.reports):
        assert report.completeness == pytest.approx(0.7, abs=0.02 + report.false_fraction)
        here = found.table.exposure == k
        rows = truth_of(found.table.select(here), truth)
        false += int((rows < 0).sum())
        unreal = int((truth[k] < 0).sum())
        predicted += report.false_rate * unreal
        # a third of the detections are junk, spread evenly over a field with a gradient
        hits = int((rows < 0).sum())
        assert report.false_fraction * len(rows) == pytest.approx(hits, abs=4 * np.sqrt(hits))
    assert false > 300
    # competition for one star: as in test_matching, some per cent beside the Poisson error
    assert predicted == pytest.approx(false, rel=0.08, abs=3 * np.sqrt(false))


def test_cuts_are_counted_and_kept_out(rng):
    catalog, lists, log, _, _ = campaign(rng, 2)
    bright = StarCuts(mag=(-np.inf, -8.0 + ZERO_POINT))
    found = match_campaign(lists, log, catalog, start, cuts=bright)
    for one, report in zip(lists, found.reports, strict=True):
        assert report.detected == len(one)
        assert report.rejected == {"too faint": int((one.mag > -8.0 + ZERO_POINT).sum())}
        # 85 % are seen, and of those near the limit some scatter over it
        assert 0.7 < report.completeness < 0.85
    t = found.table
    assert t.mag.max() <= -8.0 + ZERO_POINT
    assert t.rejected["too faint"] == sum(r.rejected["too faint"] for r in found.reports)
    assert len(t) + sum(t.rejected.values()) == t.n_rows
    with pytest.raises(InputError, match=r"exposure e0: the cuts leave none of \d+ .* saturated"):
        match_campaign(lists, log, catalog, start, cuts=StarCuts(saturation=90.0))


def test_the_search_radius_of_known_distances(rng):
    # circular normal errors beside chance pairs: 98 % of the first lie within 2.797 sigma
    n, sigma, largest = 40_000, 0.1, 4.0
    true = sigma * rng.rayleigh(size=n)
    false = largest * np.sqrt(rng.uniform(size=int(0.1 * 10_000)))
    distance = np.concatenate([true, false])
    rho = rng.uniform(0, 2000, len(distance))
    unpaired = rng.uniform(0, 2000, 9_000)
    radius = search_radius(rho, distance, unpaired, largest=largest, chance=0.1)
    np.testing.assert_allclose(radius.radius, 2 * 2.797 * sigma, rtol=0.05)
    # where a distortion is known less well, towards the corners, pairs are allowed further apart
    worse = search_radius(rho, distance * (1 + (rho > 1500)), unpaired, largest=8.0, chance=0.1)
    assert worse(1900.0) == pytest.approx(2 * worse(100.0), rel=0.1)


def test_a_chip_without_detections_is_said(rng):
    catalog, lists, log, _, _ = campaign(rng, 3)
    halved = (lists[0], lists[1].select(lists[1].chip == 2), lists[2])
    found = match_campaign(halved, log, catalog, start)
    assert [r.missing_chips for r in found.reports] == [(), (1,), ()]
    assert found.reports[1].per_chip[1] == 0 < found.reports[1].per_chip[2]
    # the footprint is that of the chip that is there
    assert found.reports[1].completeness == pytest.approx(0.85, abs=0.03)


def test_a_wrong_field_is_named_with_the_best_count(rng):
    _, lists, log, _, _ = campaign(rng, 2, stars=2500)
    uv, mag = positions(rng, 2500, 6000.0)
    other = ReferenceCatalog(u=uv[:, 0], v=uv[:, 1], mag=mag, source="elsewhere.ecsv")
    message = (
        r"e0\.parquet, exposure e0: does not match elsewhere\.ecsv: .* \d+ stars, while chance"
    )
    with pytest.raises(InputError, match=message):
        match_campaign(lists, log, other, start)


@pytest.mark.parametrize(
    ("factor", "mirror"),
    [
        (0.05, 1),
        case_in_full(1000.0, 1, instead="another unit is named"),
        case_in_full(1.0, -1, instead="tests/app has a mirrored catalogue"),
    ],
)
def test_what_would_match_is_named(rng, factor, mirror):
    """The catalogue in arcsec or thousandths, or seen from behind."""
    catalog, lists, log, _, _ = campaign(rng, 1, stars=4000)
    other = replace(catalog, u=factor * catalog.u, v=mirror * factor * catalog.v)
    with pytest.raises(InputError) as error:
        match_campaign(lists, log, other, start)
    said = str(error.value)
    assert "e0.parquet" in said and "bring together" in said
    if mirror < 0:
        assert "its mirror image does match: " in said
    else:
        scale = float(said.split("does match at ")[1].split()[0])
        assert scale == pytest.approx(factor, rel=0.01)


@pytest.mark.slow
@only_in_full("a wrong field is named without one")
def test_no_reason_is_made_up(rng):
    """Where a list matches as it is, or where nothing matches, there is nothing to be named."""
    catalog, lists, _, _, _ = campaign(rng, 1, stars=2500)
    plane = start(lists[0].x, lists[0].y, lists[0].chip, 2005.0)
    uv = np.column_stack([catalog.u, catalog.v])
    for places in (uv, rng.permuted(uv, axis=0)):
        index = pattern_index(places, catalog.mag)
        assert mismatch_reason(plane, lists[0].mag, index) == ""


def strewn(rng, one):
    """The same list with positions of no sky."""
    return replace(one, x=rng.uniform(1, 4096, len(one)), y=rng.uniform(1, 2048, len(one)))


def test_an_exposure_of_no_sky_is_left_out_and_counted(rng):
    catalog, lists, log, _, _ = campaign(rng, 6, stars=2500)
    bad = (*lists[:2], strewn(rng, lists[2]), *lists[3:])
    found = match_campaign(bad, log, catalog, start)
    assert list(found.left_out) == ["e2"] and "bring together" in found.left_out["e2"]
    assert found.table.exposure_names == ("e0", "e1", "e3", "e4", "e5")
    assert found.table.rejected["exposure left out"] == len(lists[2])
    t = found.table
    assert len(t) + sum(t.rejected.values()) == t.n_rows == sum(len(one) for one in bad)
    # the others match as if it had never been
    rest = match_campaign([*lists[:2], *lists[3:]], log, catalog, start).table
    np.testing.assert_array_equal(t.u, rest.u)
    np.testing.assert_array_equal(t.exposure, rest.exposure)


@pytest.mark.parametrize(
    "numbers",
    [
        case_in_full((0, 1), instead="others are strewn", id="the first two"),
        pytest.param((2, 4), id="more than a fifth"),
    ],
)
def test_too_many_of_them_are_an_error(rng, numbers):
    catalog, lists, log, _, _ = campaign(rng, 6, stars=2500)
    bad = [strewn(rng, one) if k in numbers else one for k, one in enumerate(lists)]
    with pytest.raises(InputError, match=rf"exposure e{numbers[0]}: .* 1 more of 6 exposures"):
        match_campaign(bad, log, catalog, start)


def turned(one):
    """Chip 1 read out from the other side."""
    return replace(one, x=np.where(one.chip == 1, 4097.0 - one.x, one.x))


def test_a_chip_that_lies_elsewhere_is_said(rng):
    catalog, lists, log, _, _ = campaign(rng, 5)
    found = match_campaign((turned(lists[0]), *lists[1:]), log, catalog, start)
    assert [one.astray for one in found.reports] == [(1,), (), (), (), ()]
    said = found.warnings(log)
    assert any("chip 1 hardly match in exposure e0" in text for text in said)
    with pytest.raises(InputError, match="in 5 of 5 exposures the detections of chip 1 do not"):
        match_campaign([turned(one) for one in lists], log, catalog, start)


def test_odd_exposures_are_named_and_others_are_not(rng):
    catalog, lists, log, _, _ = campaign(rng, 8, stars=8000)
    # the lists of this sky know no aberration
    still = ExposureLog(tuple(replace(one, vafactor=1.0) for one in log))
    assert match_campaign(lists, still, catalog, start).warnings(still) == []
    thin = lists[5].select(rng.random(len(lists[5])) < 0.5)
    found = match_campaign((*lists[:5], thin, *lists[6:]), still, catalog, start)
    (said,) = found.warnings(still)
    assert "completeness" in said and "e5 (0.4" in said
    wrong = ExposureLog(
        tuple(replace(one, vafactor=1.00019 if one.name == "e3" else 1.0) for one in log)
    )
    found = match_campaign(lists, wrong, catalog, start)
    (said,) = found.warnings(wrong)
    assert "scale" in said and "e3 (-1.9e-04)" in said


def test_wrong_arguments_are_named(rng):
    catalog, lists, log, _, _ = campaign(rng, 2, stars=3000)
    with pytest.raises(InputError, match=r"e1\.parquet: exposure e1 is not in exposure log"):
        match_campaign(lists, log.select(names=["e0"]), catalog, start)
    with pytest.raises(InputError, match="exposure e0 also has a list in"):
        match_campaign((lists[0], lists[0]), log, catalog, start)
    with pytest.raises(InputError, match="no star lists"):
        match_campaign((), log, catalog, start)
    with pytest.raises(InputError, match=r"known distortion gives shape \(1,\)"):
        match_campaign(lists, log, catalog, lambda x, y, chip, epoch: np.zeros(1))
    sigma = np.full(len(catalog), 0.01)
    sigma[6] = 0.0
    with pytest.raises(InputError, match="standard, star 1006, column 'sigma_u': an error of 0"):
        match_campaign(lists, log, replace(catalog, sigma_u=sigma), start)


def test_a_summary_has_a_row_for_each_exposure(rng):
    catalog, lists, log, _, _ = campaign(rng, 2)
    found = match_campaign(lists, log, catalog, start, cuts=StarCuts(mag=(-20.0 + 25, 18.0)))
    summary = found.summary()
    assert summary["exposure"].tolist() == ["e0", "e1"]
    assert summary["too faint"].tolist() == [r.rejected["too faint"] for r in found.reports]
    assert np.all(summary["chip 1"] + summary["chip 2"] == summary["matched"])


@pytest.mark.slow
@only_in_full("test_matching has a million")
def test_many_detections_match_in_seconds(rng):
    catalog, lists, log, _, _ = campaign(rng, 12, stars=40_000, side=8000.0)
    n = sum(len(one) for one in lists)
    begin = time.process_time()
    match_campaign(lists, log, catalog, start)
    # a million in some 15 s of processor time, which others on the machine do not add to
    assert (time.process_time() - begin) / n < 45e-6


def test_errors_of_centroids_add_in_quadrature():
    errors = MagnitudeErrors(
        mag=np.array([-12.0]), sigma_u=np.array([0.03]), sigma_v=np.array([0.05]),
        n=np.array([100]), scatter_u=np.array([0.03]), scatter_v=np.array([0.05]),
    )  # fmt: skip
    k = np.arange(3.0)
    table = Matches(x=k, y=k, u=k, v=k, mag=k, sigma_u=[0.04] * 3, sigma_v=[0.12] * 3)
    both = table.with_errors(errors, in_quadrature=True)
    np.testing.assert_allclose(both.sigma_u, 0.05)
    np.testing.assert_allclose(both.sigma_v, 0.13)
    bare = Matches(x=k, y=k, u=k, v=k, mag=k)
    alone = bare.with_errors(errors, in_quadrature=True)
    np.testing.assert_allclose(alone.sigma_u, 0.03)
    with pytest.raises(InputError, match="no magnitudes"):
        Matches(x=k, y=k, u=k, v=k).with_errors(errors, in_quadrature=True)


def test_without_aberration_a_detector_has_one_scale(rng):
    # the sky as detectors of one true scale see it: closer together where the telescope moves
    # towards it
    factors = {"a": 1.00009, "b": 0.99993}
    log = ExposureLog(tuple(Exposure(n, 2005.0, vafactor=f) for n, f in factors.items()))
    xy = rng.uniform(1, 4096, (2, 100))
    origin = (5000.0, 4000.0)
    tables = []
    for name, factor in factors.items():
        u, v = (o + factor * (p - 2048.0) for o, p in zip(origin, xy, strict=True))
        tables.append(Matches(*xy, u, v, exposure_names=(name,), sigma_u=np.ones(100),
                                 sigma_v=np.ones(100)))  # fmt: skip
    t = neutralise_aberration(Matches.concatenate(tables), log)
    for part, factor in ((slice(100), factors["a"]), (slice(100, None), factors["b"])):
        np.testing.assert_allclose(t.u[part] - origin[0] / factor, t.x[part] - 2048.0, atol=1e-9)
    np.testing.assert_allclose(t.sigma_u[:100], 1 / 1.00009)
    bare = ExposureLog((log["a"], Exposure("b", 2005.0)))
    with pytest.raises(InputError, match="exposure b has no vafactor"):
        neutralise_aberration(Matches.concatenate(tables), bare)
    with pytest.raises(InputError, match="has no exposure 'b'"):
        neutralise_aberration(tables[1], log.select(names=["a"]))


def real_lists(data_dir):
    folder = data_dir / "hst1pass_uvis"
    master = read_matchup(folder / "MATCHUP_XYMEEE_final")
    lists = read_star_lists(folder / "*.uvwXYMpq")
    log = ExposureLog(tuple(Exposure(one.name, 2020.2, "F814W") for one in lists))
    published = np.genfromtxt(folder / "hst1pass_uvis_matched.csv", delimiter=",", names=True)
    return lists, log, replace(master, sigma_u=None, sigma_v=None), published


def agreement(found, published):
    """Pairs that the published table has, too, and those that contradict it."""
    theirs = {
        (int(p["frame"]) - 1, round(p["x_raw"], 4), round(p["y_raw"], 4)): int(p["star"])
        for p in published
    }
    t = found.table
    ours = [
        theirs.get((int(e), round(x, 4), round(y, 4)), -1) == star
        for e, x, y, star in zip(t.exposure, t.x, t.y, t.star, strict=True)
    ]
    return sum(ours), len(ours) - sum(ours)


@pytest.mark.plugins
def test_real_exposures_match_as_published(data_dir):
    lists, log, master, published = real_lists(data_dir)
    # the published pairs were found by corrected positions and a radius of 2 pixels
    corrected = {
        (one.name, x, y): (u, v)
        for one in lists
        for x, y, u, v in zip(one.x, one.y, *corrected_positions(data_dir, one), strict=True)
    }

    def known(x, y, chip, epoch):
        exposure = next(one.name for one in lists if len(one) == len(x) and one.x[0] == x[0])
        return np.array([corrected[exposure, *p] for p in zip(x, y, strict=True)])

    same, other = agreement(match_campaign(lists, log, master, known, radius=2.0), published)
    assert len(published) == 6815
    assert same >= 6815 - 8 and other <= 8
    # left to itself the radius shrinks to where no chance is left
    found = match_campaign(lists, log, master, known)
    same, other = agreement(found, published)
    assert same >= 0.99 * 6815 and other <= 4
    assert all(r.completeness > 0.93 and r.radius[1] < 1.0 for r in found.reports)


def corrected_positions(data_dir, one: Detections):
    columns = read_hst1pass(one.source).columns
    return columns["u"], columns["v"]


@pytest.mark.plugins
def test_real_raw_pixels_need_no_distortion_at_all(data_dir):
    # UVIS bends a field of 1024 pixels by some 30: the cubic takes it up
    lists, log, master, published = real_lists(data_dir)
    found = match_campaign(lists, log, master, lambda x, y, chip, epoch: np.column_stack([x, y]))
    same, other = agreement(found, published)
    assert same >= 0.99 * 6815 and other <= 8
