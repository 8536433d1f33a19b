from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table

from bayesdist.data import read_matches
from bayesdist.data.detections import Detections, detections_of
from bayesdist.data.starlists import StarCuts, read_star_lists
from bayesdist.errors import InputError


def one(**changes):
    columns = {
        "x": [1.0, 2.0, 3.0, 4.0, 5.0],
        "y": [5.0, 4.0, 3.0, 2.0, 1.0],
        "mag": [-15.0, -14.5, -13.0, -11.0, -9.0],
        "q": [0.9, 0.1, 0.01, 0.3, 0.02],
    }
    return Detections(exposure_names=("j1",), **{**columns, **changes})


def test_reasons_are_counted_once_each():
    good, rejected = StarCuts(mag=(-14.0, -10.0), saturation=-14.8, q_max=0.2).passed(one())
    assert good.tolist() == [False, False, True, False, False]
    assert rejected == {"saturated": 1, "too bright": 1, "too faint": 1, "poor fit": 1}
    assert sum(rejected.values()) + good.sum() == 5
    good, rejected = StarCuts().passed(one())
    assert good.all() and rejected == {}


def test_cuts_need_their_columns():
    with pytest.raises(InputError, match="exposure j1: has no column 'q'"):
        StarCuts(q_max=0.1).passed(one(q=None))
    with pytest.raises(InputError, match="has no column 'mag'"):
        StarCuts(saturation=-14.0).passed(one(mag=None))
    with pytest.raises(InputError, match="brightest and then the faintest"):
        StarCuts(mag=(-10.0, -14.0))


def test_wrong_lists_are_named():
    with pytest.raises(InputError, match="row 2, column 'mag': value is nan"):
        one(mag=[1.0, np.nan, 1.0, 1.0, 1.0])
    with pytest.raises(InputError, match="'y' has shape"):
        one(y=[1.0])
    with pytest.raises(InputError, match="exposure j1: holds no detections"):
        Detections([], [], exposure_names=("j1",))


def test_one_table_of_several_exposures(tmp_path):
    t = Table({"X": [1.0, 2.0, 3.0], "Y": [4.0, 5.0, 6.0], "exposure": ["b", "a", "b"]})
    t["chip"], t["m"], t["q"] = [2, 1, 1], [-9.0, -8.0, -7.0], [0.1, 0.2, 0.3]
    t.write(tmp_path / "all.ecsv")
    b, a = read_star_lists(tmp_path / "all.ecsv")
    assert (b.name, a.name) == ("b", "a")
    assert b.x.tolist() == [1.0, 3.0] and b.chip.tolist() == [2, 1] and b.row.tolist() == [0, 2]
    assert a.mag.tolist() == [-8.0] and a.q.tolist() == [0.2] and b.chips == (1, 2)


@pytest.mark.plugins
def test_one_file_for_each_exposure(tmp_path):
    for name in ("j2", "j1"):
        Table({"x": [1.0], "y": [2.0]}).write(tmp_path / f"{name}.csv")
    lists = read_star_lists(tmp_path / "*.csv")
    assert [s.name for s in lists] == ["j1", "j2"] and lists[0].chip.tolist() == [1]
    assert lists[0].mag is None and lists[0].source.endswith("j1.csv")
    Table({"x": [1.0], "y": [2.0], "exposure": ["j1"]}).write(tmp_path / "again.ecsv")
    with pytest.raises(InputError, match=r"exposure j1 stands in .*j1\.csv, too"):
        read_star_lists([tmp_path / "j1.csv", tmp_path / "again.ecsv"])
    (tmp_path / "notes.txt").write_text("nothing\n")
    with pytest.raises(InputError, match=r"notes\.txt: is of an unknown kind"):
        read_star_lists(tmp_path / "notes.txt")
    (tmp_path / "MATCHUP").write_text("# xbar ybar mbar xsig ysig msig\n1 2 3 4 5 6\n")
    with pytest.raises(InputError, match=r"a catalogue \(matchup\), but star lists are expected"):
        read_star_lists(tmp_path / "MATCHUP")


@pytest.mark.parametrize("names", [("xcentroid", "ycentroid"), ("x", "y", "tnpix", "xcpeak")])
def test_pixels_that_count_from_zero_are_converted(tmp_path, caplog, names):
    """photutils and sep put the centre of the first pixel at 0."""
    Table({name: [10.0, 20.0] for name in names}).write(tmp_path / "j1.ecsv")
    with caplog.at_level("INFO", "bayesdist"):
        [one] = read_star_lists(tmp_path / "j1.ecsv")
    assert (one.x.tolist(), one.y.tolist()) == ([11.0, 21.0], [11.0, 21.0])
    assert "j1.ecsv: 1 is added to its pixels" in caplog.text


@pytest.mark.parametrize(
    ("flux", "why"),
    [([100.0, -1.0], "not all fluxes are positive"), (["a", "b"], "is not a number")],
)
def test_fluxes_that_make_no_magnitudes_are_named(tmp_path, caplog, flux, why):
    lists, matched = tmp_path / "j1.ecsv", tmp_path / "m.ecsv"
    table = Table({"x": [1.0, 2.0], "y": [3.0, 4.0], "flux": flux})
    table.write(lists)
    [one] = read_star_lists(lists)
    table["u"], table["v"] = table["x"] + 0.1, table["y"] - 0.1
    table["colour"] = ["blue", "red"]
    table.write(matched)
    found = read_matches(matched, unit="pix", sigma=0.1)
    assert one.mag is None and found.mag is None and found.colour is None
    lines = caplog.text.splitlines()
    for words in ((str(lists), "flux", why), (str(matched), "flux", why), (str(matched), "colour")):
        assert any(all(one in line for one in words) for line in lines)


@pytest.mark.plugins
@pytest.mark.parametrize(
    ("names", "factor"),
    [(("XWIN_IMAGE", "YWIN_IMAGE", "ERRX2WIN_IMAGE", "ERRY2WIN_IMAGE"), 1.0),
     (("x_fit", "y_fit", "x_err", "y_err"), 0.5)],
)  # fmt: skip
def test_errors_are_those_of_the_program(tmp_path, names, factor):
    """SExtractor writes variances, photutils standard deviations; fluxes are magnitudes."""
    sigma = np.array([[0.01, 0.02], [0.03, 0.02]])  # of x, of y
    columns = [np.array([10.0, 20.0])] * 2 + list(sigma ** (2 * factor))
    table = Table(dict(zip(names, columns, strict=True)) | {"flux": [100.0, 1.0]})
    table.write(tmp_path / "j1.ecsv")
    [one] = read_star_lists(tmp_path / "j1.ecsv", errors=True)
    np.testing.assert_allclose(one.sigma, np.sqrt((sigma**2).mean(axis=0)))
    np.testing.assert_allclose([one.sigma_x, one.sigma_y], sigma)
    np.testing.assert_allclose(one.mag, [-5.0, 0.0])
    [bare] = read_star_lists(tmp_path / "j1.ecsv")
    assert bare.sigma is None
    np.testing.assert_array_equal(detections_of([one, replace(one)]).sigma, np.tile(one.sigma, 2))
    table[names[2]][1] = 0.0
    table.write(tmp_path / "j2.ecsv")
    with pytest.raises(InputError, match=r"row 2.*error of a pixel coordinate is 0"):
        read_star_lists(tmp_path / "j2.ecsv", errors=True)
    table[names[:2]].write(tmp_path / "j3.ecsv")
    with pytest.raises(InputError, match="no column for 'sigma_x'"):
        read_star_lists(tmp_path / "j3.ecsv", errors=True)
    (tmp_path / "j4.xym").write_text("1 2 -9\n")
    with pytest.raises(
        InputError, match="has no errors of its pixels; set the errors to be measured"
    ):
        read_star_lists(tmp_path / "j4.xym", errors=True)


@pytest.mark.parametrize(
    ("name", "factor"), [("ERRXYWIN_IMAGE", np.array([-0.5, 0.9]) * 3e-4), ("rho_xy", [-0.5, 0.9])]
)
def test_ellipses_of_errors_are_those_of_the_program(tmp_path, name, factor):
    """SExtractor writes covariances, others correlations."""
    variances = name.startswith("ERR")
    names = ("ERRX2WIN_IMAGE", "ERRY2WIN_IMAGE") if variances else ("x_err", "y_err")
    errors = [np.full(2, sigma**2 if variances else sigma) for sigma in (0.01, 0.03)]
    columns = {"x": [10.0, 20.0], "y": [5.0, 6.0], **dict(zip(names, errors, strict=True))}
    Table(columns | {name: factor}).write(tmp_path / "j1.ecsv")
    [one] = read_star_lists(tmp_path / "j1.ecsv", errors=True)
    for covariance, rho in zip(one.covariances, (-0.5, 0.9), strict=True):
        expected = [[1e-4, rho * 3e-4], [rho * 3e-4, 9e-4]]
        np.testing.assert_allclose(covariance, expected)
    Table(columns | {name: [0.0, 1.0]}).write(tmp_path / "j2.ecsv")
    with pytest.raises(InputError, match=r"row 2.*is impossible beside the errors of x and y"):
        read_star_lists(tmp_path / "j2.ecsv", errors=True)


def test_text_of_other_programs_is_a_star_list(tmp_path):
    (tmp_path / "j1.cat").write_text(
        "#   1 XWIN_IMAGE  Windowed position [pixel]\n#   2 YWIN_IMAGE  Windowed position [pixel]\n"
        "#   3 MAG_AUTO  Kron-like magnitude [mag]\n10.5 20.25 -9.5\n"
    )
    (tmp_path / "j2.als").write_text(
        " NL   NX   NY  LOWBAD HIGHBAD  THRESH     AP1  PH/ADU  RNOISE    FRAD\n"
        "  1 2048 2048   -24.2 32000.0   38.53    3.00    2.00    4.00    5.00\n\n"
        "      1   10.500   20.250   14.500   0.0100   97.4      4.    1.02   0.01\n"
    )
    for one in read_star_lists([tmp_path / "j1.cat", tmp_path / "j2.als"]):
        assert (one.x.tolist(), one.y.tolist()) == ([10.5], [20.25])
        assert one.mag.tolist() == [{"j1": -9.5, "j2": 14.5}[one.name]]


@pytest.mark.plugins
def test_real_lists_give_their_raw_pixels(data_dir):
    lists = read_star_lists(data_dir / "hst1pass_uvis" / "*.uvwXYMpq")
    assert [s.name for s in lists] == [f"ie8j01x{c}q_flt" for c in "lmno"]
    published = np.genfromtxt(
        data_dir / "hst1pass_uvis" / "hst1pass_uvis_matched.csv", delimiter=",", names=True
    )
    raw = {(round(x, 4), round(y, 4)) for x, y in zip(lists[1].x, lists[1].y, strict=True)}
    theirs = published[published["frame"] == 2]
    assert all((round(p["x_raw"], 4), round(p["y_raw"], 4)) in raw for p in theirs)
    assert all(s.q is not None and s.mag is not None for s in lists)
