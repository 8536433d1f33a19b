"""Epochs that are wrong show in the residuals of stars that move."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.table import Table
from scipy.spatial import cKDTree

from bayesdist.data import Matches, find_similarity, pattern_index
from bayesdist.diagnose.residuals.misfit import epoch_shift
from bayesdist.infer import build_model, fit_linear
from tests.reduced import case_in_full, only_in_full

SIGMA, PM = 0.02, 0.012  # arcsec, and arcsec per year


def stars(years, seed, n=400, exposures=1):
    """Matches on a plane with a distortion of second order, `years` away from the catalogue."""
    rng = np.random.default_rng(seed)
    xi, eta = rng.uniform(-100, 100, (2, n))
    pm = rng.normal(0, PM, (2, n))
    parts = []
    for k in range(exposures):
        u = np.array([xi, eta]) + years * pm + rng.normal(0, SIGMA, (2, n))
        u[0, : n // 20] += rng.normal(0, 3.0, n // 20)  # false matches
        x = 500 + 4 * u[0] + 1e-4 * u[1] ** 2
        y = 500 + 4 * u[1] - 2e-4 * u[0] * u[1]
        parts.append((x, y, np.full(n, k)))
    x, y, exposure = (np.concatenate(column) for column in zip(*parts, strict=True))
    many = np.tile([xi, eta, *pm], exposures)
    return Matches(x, y, many[0], many[1], np.full(len(x), SIGMA), np.full(len(x), SIGMA),
                      unit="arcsec", pm_u=many[2], pm_v=many[3], exposure=exposure,
                      exposure_names=tuple(map(str, range(exposures))))  # fmt: skip


def found(table):
    model = build_model(table, order=3, size=(1000, 1000))
    return epoch_shift(table, fit_linear(table, model))


@pytest.mark.parametrize("exposures", [case_in_full(1, instead="three are run"), 3])
def test_the_shift_is_found_with_its_error(exposures):
    """Pulls over many fields of stars; the errors of a field's stars differ between exposures."""
    results = [found(stars(-9.9, seed, exposures=exposures)) for seed in range(40)]
    pull = np.array([(one.years + 9.9) / one.sigma for one in results])
    assert abs(pull.mean()) < 3.5 / np.sqrt(40) and 0.7 < pull.std() < 1.4
    assert all(one.significant for one in results)
    one = results[0]
    # sigma from the motions alone: a closed form
    expected = SIGMA / PM / np.sqrt(2 * 0.95 * 400 * exposures)
    assert one.sigma == pytest.approx(expected, rel=0.2)
    assert one.after == pytest.approx(SIGMA, rel=0.15)
    assert one.before == pytest.approx(np.hypot(SIGMA, 9.9 * PM), rel=0.3)
    assert "before the epoch that the reference positions have" in one.sentence


@pytest.mark.slow
@only_in_full("the shift is found with its error")
def test_errors_of_motions_do_not_draw_the_shift_to_zero():
    """A fifth of their scatter; and two stars of five have no motions, which catalogues call 0."""
    pulls = []
    for seed in range(40):
        table, rng = stars(-9.9, seed, n=800), np.random.default_rng(1000 + seed)
        error = 0.18 * PM
        quoted = np.array([table.pm_u, table.pm_v]) + rng.normal(0, error, (2, 800))
        quoted[:, rng.uniform(size=800) < 0.4] = 0.0
        sigma = np.where(quoted == 0, 0.0, error)
        one = found(table.with_columns(pm_u=quoted[0], pm_v=quoted[1], sigma_pm_u=sigma[0],
                                sigma_pm_v=sigma[1]))  # fmt: skip
        assert one.significant
        pulls.append((one.years + 9.9) / one.sigma)
    assert abs(np.mean(pulls)) < 3.5 / np.sqrt(40) and 0.7 < np.std(pulls) < 1.4


@pytest.mark.parametrize(
    ("day", "epoch"), [("2011_10_31", 2011.83), ("2012_09_25", 2012.73), ("2013_10_24", 2013.81)]
)
def test_dates_of_lists_of_hst_follow_from_gaia(data_dir, day, epoch):
    """Positions and motions of Gaia DR2 at 2015.5; the date is that in the name of the list."""
    gaia = Table.read(data_dir / "flystar" / "my_gaia.fits")
    gaia = gaia[~(np.ma.getmaskarray(gaia["vx"]) | np.ma.getmaskarray(gaia["m"]))]
    column = {name: np.asarray(gaia[name], float) for name in gaia.colnames[1:]}
    reference = np.stack([column["x0"], column["y0"]], axis=-1)
    name = f"{day}_F606W_MATCHUP_XYMEEE_final.calib"
    hst = Table.read(data_dir / "flystar" / name, format="ascii")
    xy = np.stack([np.asarray(hst["x"]), np.asarray(hst["y"])], axis=-1)
    similar = find_similarity(xy, pattern_index(reference, column["m"]), mag=hst["m"],
                              scale=(0.03, 0.05))  # fmt: skip
    distance, nearest = cKDTree(similar.map(xy)).query(reference)
    j = np.flatnonzero(distance < 0.1)
    i, sigma = nearest[j], np.full(len(j), 0.006)
    motions = {"pm_u": "vx", "pm_v": "vy", "sigma_pm_u": "vxe", "sigma_pm_v": "vye"}
    table = Matches(*xy[i].T, *reference[j].T, sigma, sigma, unit="arcsec",
                       **{key: column[name][j] for key, name in motions.items()})  # fmt: skip
    model = build_model(table, order=3, size=(2200, 2200))
    one = epoch_shift(table, fit_linear(table, model))
    assert one.significant and one.after < 0.35 * one.before
    # errors of 0.03 to 0.06 years, and what Gaia's motions of crowded stars have beyond theirs
    assert abs(one.years - (epoch - 2015.5)) < 0.25


def test_right_epochs_are_left_alone():
    assert not any(found(stars(0.0, seed)).significant for seed in range(40))


def test_without_motions_there_is_nothing_to_find():
    table = stars(-9.9, 1)
    no = dict.fromkeys(("pm_u", "pm_v"))
    assert found(table.with_columns(**no)) is None
    still = table.with_columns(pm_u=np.zeros(400), pm_v=np.zeros(400))
    assert found(still) is None
