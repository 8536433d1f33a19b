from __future__ import annotations

import numpy as np
import pytest
from astropy.table import Table

from bayesdist.data.detections import Detections
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
    with pytest.raises(InputError, match="neither a table nor a list"):
        read_star_lists(tmp_path / "notes.txt")


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
