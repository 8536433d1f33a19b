from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table

from bayesdist.data import ReferenceCatalog, catalog_from_table
from bayesdist.data.preparing import motion_error_line, select_motions
from bayesdist.errors import InputError


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


def test_what_the_line_needs(rng):
    _, c = catalog_with_bad(rng, 2000)
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
    with pytest.raises(InputError, match="row 2, column 'star': star 7 occurs twice"):
        catalog_from_table(table, unit="pix")
    with pytest.raises(InputError, match="codes of the stars"):
        replace(c, star=np.array([-1, 0, 1]))
