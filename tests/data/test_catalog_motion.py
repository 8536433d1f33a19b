from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table

from bayesdist.data import ReferenceCatalog, catalog_from_table
from bayesdist.data.motions import derive_motions, motion_error_line, select_motions
from bayesdist.errors import InputError


def two_epochs(rng, n=4000):
    """True positions and motions, and what is measured before and after a gap."""
    true = rng.uniform(0, 5000, (2, n))
    pm = rng.normal(0, 0.01, (2, n))
    mag = rng.uniform(-14, -8, n)
    s = 0.003 * 10 ** (0.15 * (mag + 14))
    out = []
    for name, mean, scale in (("early", 2004.5, 1.0), ("late", 2012.0, 0.6)):
        epoch = mean + rng.uniform(-0.5, 0.5, n)
        sigma = scale * s
        seen = true + pm * (epoch - 2004.5) + rng.normal(0, 1, (2, n)) * sigma
        out.append(
            ReferenceCatalog(u=seen[0], v=seen[1], sigma_u=sigma, sigma_v=sigma, mag=mag,
                             epoch=epoch, source=name, star=100 + np.arange(n))
        )  # fmt: skip
    return true, pm, *out


def test_motions_and_their_errors_are_those_of_the_truth(rng):
    true, pm, early, late = two_epochs(rng)
    c = derive_motions(early, late)
    n = len(c)
    pulls = np.stack([(c.pm_u - pm[0]) / c.sigma_pm_u, (c.pm_v - pm[1]) / c.sigma_pm_v])
    # mean of squares of 2 n normal numbers: 1 +- sqrt(2 / 2n)
    assert np.mean(pulls**2) == pytest.approx(1.0, abs=4 * np.sqrt(1 / n))
    # the same for positions, at epochs before, between and after
    for epoch in (2000.0, 2009.4, 2016.0):
        then = c.at(epoch)
        here = true + pm * (epoch - 2004.5)
        z = np.stack([(then.u - here[0]) / then.sigma_u, (then.v - here[1]) / then.sigma_v])
        assert np.mean(z**2) == pytest.approx(1.0, abs=4 * np.sqrt(1 / n))
    # at the mean epoch the two are uncorrelated
    at_mean = true[0] + pm[0] * (c.epoch - 2004.5)
    z = (c.u - at_mean) / c.sigma_u
    assert abs(np.mean(z * pulls[0])) < 4 / np.sqrt(n)


def test_the_closed_form_of_two_positions(rng):
    early = ReferenceCatalog(u=[1.0], v=[2.0], sigma_u=[0.3], sigma_v=[0.3], epoch=2000.0)
    late = ReferenceCatalog(u=[2.0], v=[0.0], sigma_u=[0.4], sigma_v=[0.4], epoch=2010.0)
    c = derive_motions(early, late)
    assert (c.pm_u[0], c.pm_v[0]) == pytest.approx((0.1, -0.2))
    assert c.sigma_pm_u[0] == pytest.approx(0.05)  # 0.3, 0.4, 0.5 over ten years
    # weights 1/0.09 and 1/0.16: 16/25 and 9/25
    assert c.epoch[0] == pytest.approx(2003.6)
    assert c.sigma_u[0] == pytest.approx(0.24)
    # what was measured comes out again at both epochs, with its own error
    for one in (early, late):
        then = c.at(float(one.epoch))
        assert (then.u[0], then.v[0]) == pytest.approx((one.u[0], one.v[0]))
        assert then.sigma_u[0] == pytest.approx(one.sigma_u[0])


def test_stars_are_paired_by_their_codes(rng):
    _, _, early, late = two_epochs(rng, 300)
    keep = np.flatnonzero(rng.random(300) < 0.7)
    shuffled = late.select(rng.permutation(keep))
    c = derive_motions(early, shuffled)
    assert c.star.tolist() == (100 + keep).tolist()  # in the order of the first
    straight = derive_motions(early, late).select(keep)
    np.testing.assert_array_equal(c.pm_u, straight.pm_u)
    np.testing.assert_array_equal(c.mag, early.mag[keep])


def test_codes_of_other_stars_are_seen(rng):
    _, _, early, late = two_epochs(rng, 300)
    wrong = replace(late, star=rng.permutation(late.star))
    with pytest.raises(InputError, match=r"early and late: stars of one code lie .* apart"):
        derive_motions(early, wrong)
    with pytest.raises(InputError, match="no star in common"):
        derive_motions(early, replace(late, star=late.star + 1000))
    with pytest.raises(InputError, match="earlier catalogue first"):
        derive_motions(late, early)
    with pytest.raises(InputError, match="has no errors"):
        derive_motions(replace(early, sigma_u=None, sigma_v=None), late)
    with pytest.raises(InputError, match="has no epoch"):
        derive_motions(early, replace(late, epoch=None))
    with pytest.raises(InputError, match="different units"):
        derive_motions(early, replace(late, unit="mas"))


def catalog_with_bad(rng, n=20_000, bad=0.08):
    """Errors that grow with magnitude, and some stars far above their like (blends)."""
    mag = rng.uniform(-14, -6, n)
    usual = 1e-3 * 10 ** (0.2 * np.maximum(mag + 10, 0)) * np.exp(rng.normal(0, 0.15, n))
    is_bad = rng.random(n) < bad
    sigma = np.where(is_bad, usual * rng.uniform(3, 10, n), usual)
    zero = np.zeros(n)
    return is_bad, ReferenceCatalog(
        u=rng.uniform(0, 1e4, n), v=rng.uniform(0, 1e4, n), mag=mag, epoch=2004.5,
        pm_u=zero, pm_v=zero, sigma_pm_u=usual, sigma_pm_v=sigma,
    )  # fmt: skip


def test_the_line_follows_magnitude_and_leaves_out_the_bad_ones(rng):
    is_bad, c = catalog_with_bad(rng)
    kept = select_motions(c)
    good = np.isin(c.star, kept.star)
    assert good[is_bad].mean() < 0.01
    # 2.5 scatters, widened a little by the bad ones: fewer than 1.5 % of the others go
    assert good[~is_bad].mean() > 0.985
    # faint stars are not punished for being faint
    faint = c.mag > -7
    assert good[~is_bad & faint].mean() > 0.97
    line = motion_error_line(c)
    assert line(-6.5) / line(-12.0) == pytest.approx(10 ** (0.2 * 3.5), rel=0.2)


def test_other_lines(rng):
    _, c = catalog_with_bad(rng, 2000)
    worse = np.maximum(c.sigma_pm_u, c.sigma_pm_v)
    assert len(select_motions(c, 0.002)) == (worse <= 0.002).sum()
    by_mag = select_motions(c, lambda mag: np.where(mag < -10, 0.002, 0.0))
    assert by_mag.mag.max() < -10
    with pytest.raises(InputError, match="measured so well"):
        select_motions(c, 0.0)
    with pytest.raises(InputError, match="no magnitudes"):
        select_motions(replace(c, mag=None))
    with pytest.raises(InputError, match="no errors of the proper motions"):
        select_motions(replace(c, sigma_pm_u=None, sigma_pm_v=None))


def test_a_star_keeps_its_code(rng):
    c = ReferenceCatalog(u=[1.0, 2.0, 3.0], v=[0.0, 0.0, 0.0], pm_u=np.zeros(3), pm_v=np.zeros(3),
                         epoch=2000.0)  # fmt: skip
    assert c.star.tolist() == [0, 1, 2]
    assert c.select(np.array([2, 0])).at(2010.0).star.tolist() == [2, 0]
    big = 6_123_456_789_012_345_679  # beyond the whole numbers of float64
    table = Table({"u": [1.0, 2.0], "v": [1.0, 2.0], "star": [big, big + 1]})
    assert catalog_from_table(table, unit="pix").star.tolist() == [big, big + 1]
    table["star"] = [7, 7]
    with pytest.raises(InputError, match="row 2, column 'star': star 7 stands twice"):
        catalog_from_table(table, unit="pix")
    with pytest.raises(InputError, match="codes of the stars"):
        replace(c, star=np.array([-1, 0, 1]))
