"""Figures and numbers of section 4.1 of the ACS handbook, from real coefficients."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.quiver import Quiver
from numpy.testing import assert_allclose

from bayesdist.diagnose.residuals.binned import binned_sums
from bayesdist.formats.idctab.format import idctab_calibration
from bayesdist.formats.idctab.table import read_idctab
from bayesdist.missions.hst.geometry import (
    area_figure,
    detector_numbers,
    handbook_rows,
    non_linear_figure,
    residual_figure,
)
from bayesdist.missions.hst.whole_detector import WholeDetector
from tests.formats.siaf_acs import SCALE, siaf_calibration


@pytest.fixture(scope="module")
def wfc(data_dir) -> WholeDetector:
    tab = read_idctab(data_dir / "hst_reference" / "0461802ej_idc.fits")
    return WholeDetector(idctab_calibration(tab, "F475W,CLEAR2L").in_frame(), 0.05)


@pytest.fixture(scope="module")
def hrc() -> WholeDetector:
    return WholeDetector({1: siaf_calibration("HRC")}, SCALE)


@pytest.mark.parametrize("name", ["0461802ej", "qbu1641sj", "postsm4"])
def test_delivered_tables_of_the_wfc_give_the_printed_numbers(data_dir, name):
    """82 pixels or about 4 arcsec, 85 degrees, 8 %, areas from 0.89 to 1.08: to their digits."""
    tab = read_idctab(data_dir / "hst_reference" / f"{name}_idc.fits")
    n = detector_numbers(WholeDetector(idctab_calibration(tab, "F475W,CLEAR2L").in_frame(), 0.05))
    assert round(n.non_linear_max) == 82
    assert round(0.05 * n.non_linear_max) == 4
    assert round(n.angle) == 85
    assert round(100 * n.elongation) == 8
    assert (round(n.area_min, 2), round(n.area_max, 2)) == (0.89, 1.08)
    # top left, where pipelines have WFC2 in the lower half
    x, y = n.non_linear_at
    assert x < 100 and y > 4000


def test_hrc_and_sbc_of_the_aperture_file(hrc):
    """The same telescope by other polynomials; the printed 4.9 pixels are 4.46 by these."""
    n = detector_numbers(hrc)
    assert round(n.angle) in (84, 85)
    assert round(100 * (n.scale_x / n.scale_y - 1)) == 14
    assert 0.02 < max(1 - n.area_min, n.area_max - 1) < 0.025  # just over 2 %
    assert [round(v) for v in n.size] == [29, 25]
    assert n.non_linear_max == pytest.approx(4.9, rel=0.1)
    assert round(SCALE * n.non_linear_max, 1) == 0.1
    x, y = n.non_linear_at
    assert x < 100 and y > 900  # top left
    sbc = detector_numbers(WholeDetector({1: siaf_calibration("SBC")}, SCALE))
    assert_allclose(sbc.size, (35, 30), atol=1.0)
    assert round(sbc.angle) in (84, 85)


def test_published_numbers_stand_beside_ours(wfc, hrc):
    for whole, scale, name, printed in ((wfc, 0.05, "WFC", "82"), (hrc, SCALE, "hrc", "4.9")):
        rows = handbook_rows(detector_numbers(whole), scale=scale, unit="arcsec", detector=name)
        assert rows[0]["published"] == printed
        assert rows[0]["value"] == detector_numbers(whole).non_linear_max
        assert rows[-1]["published"] == str(scale)
    plain = handbook_rows(detector_numbers(wfc), scale=1.0, unit="pix")
    assert not any(row["published"] for row in plain)


def test_arrows_are_the_non_linear_part_to_the_stated_scale(wfc):
    figure = non_linear_figure(wfc, "made up", magnification=5.0)
    (ax,) = figure.axes
    arrows = [c for c in ax.collections if isinstance(c, Quiver)]
    assert len(arrows) == 2 and all(a.scale == pytest.approx(0.2) for a in arrows)
    for a, (n, c) in zip(arrows, wfc.chips.items(), strict=True):
        tails = a.XY - np.array(wfc.places[n])
        field = wfc.non_linear(n, np.unique(tails[:, 0]), np.unique(tails[:, 1]))
        assert_allclose(a.U, field.along_x.ravel(), atol=1e-9)
        assert_allclose(a.V, field.along_y.ravel(), atol=1e-9)
        assert tails.min() == pytest.approx(1.0) and tails[:, 0].max() == c.basis.size[0]
    assert "largest 82" in ax.get_title(loc="left")
    assert any("drawn ×5" in t.get_text() for t in ax.texts)
    assert {"chip 1", "chip 2"} <= {t.get_text() for t in ax.texts}
    plain = non_linear_figure(wfc)
    assert "×" in " ".join(t.get_text() for t in plain.axes[0].texts)


def test_contours_are_of_the_area_over_that_at_the_centre(hrc):
    figure = area_figure(hrc, "made up")
    ax, bar = figure.axes
    assert bar.get_ylabel() == "pixel area / area at the centre"
    n = detector_numbers(hrc)
    assert f"{n.area_min:.3f} to {n.area_max:.3f}" in ax.get_title(loc="left")
    (filled, _) = (c for c in ax.collections if hasattr(c, "levels"))
    assert min(filled.levels) <= n.area_min and max(filled.levels) >= n.area_max


def test_residuals_are_drawn_where_their_cells_lie(wfc):
    rng = np.random.default_rng(1)
    x, y = rng.uniform(1, 4096, 4000), rng.uniform(1, 2048, 4000)
    binned = {}
    for n in (2, 1):
        u = rng.normal(0.2 if n == 1 else 0.0, 0.01, 4000)
        sums = binned_sums(x, y, u, rng.normal(0, 0.01, 4000), bins=(8, 4), size=(4096, 2048))
        binned[n] = sums.residuals()
    figure = residual_figure(wfc, binned, "pix", "made up")
    (ax,) = figure.axes
    arrows = [c for c in ax.collections if isinstance(c, Quiver)]
    light, dark = arrows[2:]  # chip 1, displaced: all cells are significant
    assert light.N == 0 and dark.N == 32
    assert_allclose(dark.U, binned[1].mean_u.ravel())
    assert dark.XY[:, 1].min() > 2048
