from __future__ import annotations

import numpy as np
import pytest

from bayesdist.data import read_matches
from bayesdist.data.starlists import read_star_lists
from bayesdist.errors import FormatError, InputError
from bayesdist.formats.hst1pass import read_hst1pass, read_matchup

LIST = """\
# ARGUMENTS
#     FILT:      F814W
#    EXPTI:         87.0000
#     rDAT:       2020.19904900
#  FILEOUT: {name}
# (01)  u -- u ref-frame           c002-c010    F001
# (02)  v -- v ref-frame           c012-c020    F002
# (03)  M -- instl mag (1000s)     c030-c036    F003
# (04)  X -- dist-cor x posn       c038-c046    F008
# (05)  Y -- dist-cor y posn       c048-c056    F009
#....u.... ....v.... ...M... ....X.... ....Y....
  157.6324   86.4352 -12.669  153.2518    5.9927
  361.3400   99.0173  -9.207  358.3996    6.2207
"""


@pytest.fixture
def small(tmp_path):
    path = tmp_path / "ie8j01xlq_flt.uvMXY"
    path.write_text(LIST.format(name=path.name))
    return path


def test_the_header_names_the_columns(small):
    one = read_hst1pass(small)
    assert tuple(one.columns) == ("u", "v", "M", "X", "Y")
    assert (one.filter, one.epoch, one.exptime) == ("F814W", 2020.199049, 87.0)
    t = one.matches()
    assert t.x.tolist() == [153.2518, 358.3996] and t.u.tolist() == [157.6324, 361.34]
    assert t.exposure_names == ("ie8j01xlq_flt",) and t.filter_names == ("F814W",)
    assert t.sigma_u is None and t.unit == "pix" and t.mag.tolist() == [-12.669, -9.207]


def test_auto_finds_a_list_by_its_content(small):
    assert len(read_matches(small, sigma=0.01)) == 2


def test_damage_is_named(small):
    text = small.read_text()
    for damaged, message in (
        (text[:100], "no FILEOUT block"),
        (text[: text.index("# (01)")], "names no columns"),
        (text[: text.index("  157.63")], "holds no stars"),
        (text[:-20] + "\n", r"row 2: has [34] of 5 columns"),
        (text[:-3], "last line is cut off"),
        (text.replace("358.3996", "********"), r"row 2: could not convert"),
    ):
        small.write_text(damaged)
        with pytest.raises(FormatError, match=message):
            read_hst1pass(small)


def test_a_list_without_raw_positions_is_refused(small):
    small.write_text(small.read_text().replace("  X --", "  r --"))
    with pytest.raises(FormatError, match="has no columns X, Y or x, y"):
        read_hst1pass(small).matches()


RAW = """\
#     FILT:      F606W
#  FILEOUT: {name}
# (01)  x -- x posn (no CTE corr)  c002-c010    F006
# (02)  y -- y posn (no CTE corr)  c012-c020    F007
# (03)  m -- instl mag             c022-c028    F002
# (04)  q -- quality of fit        c030-c034    F019
# (05)  K -- chip number           c036-c037    F030
#....x.... ....y.... ...m... ..q.. .K
  100.2500   12.5000 -12.700 0.031 K1
 2040.1250 2000.7500  -9.200 0.120 K2
"""


@pytest.mark.parametrize("head", ["", "# x y m q\n", "# photometry of one exposure\n", RAW])
def test_lists_of_raw_positions(tmp_path, head):
    """As hst1pass and jwst1pass write `.xymq`, and as others do: with names, or without any."""
    path = tmp_path / "jw01501_nis_cal.xymq"
    rows = "100.250 12.500 -12.700 0.031\n2040.125 2000.750 -9.200 0.120\n"
    path.write_text(head.format(name=path.name) if head is RAW else head + rows)
    [one] = read_star_lists(path)
    assert one.name == "jw01501_nis_cal"
    assert (one.x.tolist(), one.y.tolist()) == ([100.25, 2040.125], [12.5, 2000.75])
    assert (one.mag.tolist(), one.q.tolist()) == ([-12.7, -9.2], [0.031, 0.12])
    with pytest.raises(FormatError, match=r"no columns u, v \(it has x y m q( K)?\)"):
        read_matches(path)


FRAME = """\
# BDRY_xy_K1:         1.0000000     2.0000000
# BDRY_xy_K2:      4095.0000000  4095.0000000
"""


@pytest.mark.parametrize(
    ("name", "head", "rows", "chip", "y"),
    [
        ("j8c0.xympqks", "", "1 90.5 -9 7 .1 1 3\n1 3000.5 -9 7 .1 2 3\n", [2, 1], [90.5, 952.5]),
        ("j8c0.xymK", "", "1 90.5 -9 K1\n1 300.5 -9 K2\n", [2, 1], [90.5, 300.5]),
        ("j8c0.xymk", FRAME, "1 90.5 -9 1\n1 80.5 -9 1\n", [2, 2], [90.5, 80.5]),
        ("u2.xymk", "", "1 90.5 -9 3\n1 80.5 -9 1\n", [3, 1], [90.5, 80.5]),
        ("jw.xymk", "", "1 90.5 -9 1\n1 80.5 -9 1\n", [1, 1], [90.5, 80.5]),
    ],
)
def test_chips_are_those_of_hst(tmp_path, name, head, rows, chip, y):
    """k = 1 is the lower half of the frame of ACS/WFC and UVIS, which is CCDCHIP 2."""
    (tmp_path / name).write_text(head + rows)
    [one] = read_star_lists(tmp_path / name)
    assert (one.chip.tolist(), one.y.tolist()) == (chip, y)
    path = tmp_path / name.replace("xym", "uvxym")
    path.write_text(head + "".join(f"5 6 {row}\n" for row in rows.splitlines()))
    m = read_matches(path, sigma=0.01)
    assert np.array(m.chip_numbers)[m.chip].tolist() == chip and m.y.tolist() == y


def test_positions_corrected_for_charge_transfer_come_first(tmp_path):
    path = tmp_path / "j8c0_flc.xymXYMq"
    path.write_text("1.0 2.0 -9.0 1.5 2.5 -9.5 0.1\n")
    [one] = read_star_lists(path)
    assert (one.x[0], one.y[0], one.mag[0]) == (1.5, 2.5, -9.5)


def test_a_list_without_its_columns_is_named(tmp_path):
    path = tmp_path / "j8c0_flc.xymq"
    path.write_text("100.250 12.500 -12.700\n")
    with pytest.raises(FormatError, match="row 1: has 3 of 4 columns"):
        read_star_lists(path)
    for name in ("MATCHUP.XYMEEE", "stars.lst"):
        path = tmp_path / name
        path.write_text("1 2 3 4 5 6\n")
        with pytest.raises(FormatError, match="is of an unknown kind"):
            read_star_lists(path)


def test_the_real_headers_count_their_stars(data_dir):
    for path in sorted((data_dir / "hst1pass_uvis").glob("*.uvwXYMpq")):
        one = read_hst1pass(path)
        text = path.read_text()
        # the header's own count of stars, unsaturated and saturated
        counted = [int(line.split()[2]) for line in text.splitlines() if "..good " in line]
        assert len(one.columns["u"]) == sum(counted)
        assert tuple(one.columns) == tuple("uvwXYMpq")
        assert one.epoch == pytest.approx(2020 + 72.654 / 366, abs=0.002)  # 2020-03-13 15:41


def test_raw_and_corrected_positions_fit_the_corners_of_the_chip(data_dir):
    # the header's BDRY rows: raw corners beside corrected ones, from hst1pass itself
    path = data_dir / "hst1pass_uvis" / "ie8j01xlq_flt.uvwXYMpq"
    rows = {
        key: np.array(line.split()[2:], float).reshape(4, 2)
        for line in path.read_text().splitlines()
        for key in ("BDRY_xy_K1", "BDRY_uv_K1")
        if key in line
    }
    t = read_hst1pass(path).matches()
    design = lambda x, y: np.column_stack([x**i * y**j for i in range(4) for j in range(4 - i)])  # noqa: E731
    scale = 1000.0
    A = design(t.x / scale, t.y / scale)
    fit = np.linalg.lstsq(A, np.column_stack([t.u, t.v]), rcond=None)[0]
    corners = rows["BDRY_xy_K1"] / scale
    np.testing.assert_allclose(design(*corners.T) @ fit, rows["BDRY_uv_K1"], atol=0.1)


def test_both_kinds_of_matchup(data_dir):
    master = read_matchup(data_dir / "hst1pass_uvis" / "MATCHUP_XYMEEE_final")
    assert len(master) == 1776
    assert (master.u[0], master.v[0], master.mag[0]) == (157.6361, 86.4281, -12.6758)
    assert (master.sigma_u[0], master.sigma_v[0]) == (0.0036, 0.0037)
    calibrated = data_dir / "flystar" / "2011_10_31_F606W_MATCHUP_XYMEEE_final.calib"
    master = read_matchup(calibrated, epoch=2011.83)
    assert len(master) == 4301 and master.epoch == 2011.83
    assert (master.u[1], master.sigma_v[1]) == (557.8213, 0.0177)


def test_a_master_alone_has_no_detections(data_dir):
    with pytest.raises(InputError, match="a master alone has no detector positions"):
        read_matches(data_dir / "hst1pass_uvis" / "MATCHUP_XYMEEE_final")


def test_what_is_no_matchup_is_refused(small):
    with pytest.raises(FormatError, match="no MATCHUP master"):
        read_matchup(small)
