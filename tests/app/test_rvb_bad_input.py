"""Wrong RvB pairs: one sentence and nothing written; and what looks right must not be believed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.table import Table, vstack

from tests.app.rvb_jobs import DETECTORS, rvb_job, rvb_pairs
from tests.app.support import EXACT, cli, good, refused, summary_of
from tests.reduced import case_in_full, only_in_full

W1 = {"detector": DETECTORS["W1"]}


def both() -> Table:
    return vstack([rvb_pairs(), rvb_pairs(300, "W1", seed=2)])


def _set(column: str, row: int, value: float) -> Callable[[], Table]:
    def make() -> Table:
        table = rvb_pairs()
        table[column][row - 1] = value
        return table

    return make


def _without(*columns: str) -> Callable[[], Table]:
    def make() -> Table:
        table = rvb_pairs()
        table.remove_columns(list(columns))
        return table

    return make


def _called(name: str, make: Callable[[], Table]) -> Callable[[], Table]:
    def renamed() -> Table:
        table = make()
        table["band"] = name
        return table

    return renamed


def _swapped(one: str, other: str) -> Callable[[], Table]:
    def make() -> Table:
        table = rvb_pairs()
        table[one], table[other] = table[other].copy(), table[one].copy()
        return table

    return make


def arcseconds() -> Table:
    table = rvb_pairs()
    for name in ("u", "v", "sigma_u", "sigma_v"):
        table[name] = 5.5 * np.asarray(table[name])
    return table


def w1() -> Table:
    return rvb_pairs(band="W1")


CASES: dict[str, tuple[Callable[[], Table], dict[str, Any], list[str]]] = {
    "several bands": (both, {}, ["several bands: W1 (300 pairs), W4 (600 pairs)", "choose"]),
    "a band that is not there": (both, {"data": {"band": "W2"}} | W1, ["contain W2", "W4 (600"]),
    "no band": (rvb_pairs, {"data": {"band": "W9"}}, ["'W9' is not a band", "W1, W2, W3, W4"]),
    "W4 declared W1": (_called("W1", rvb_pairs), W1, ["x <= 508", "1016 x 1016", "smaller array"]),
    "W1 declared W4": (_called("W4", w1), {}, ["outside the 508 pixels of W4's array", "row "]),
    "W4 on the detector of W1": (rvb_pairs, W1, ["W4 are within", "1016 x 1016"]),
    "W1 on the detector of W4": (w1, {"data": {"band": "W1"}}, ["array of W1 has 1016", "508"]),
    "another array": (w1, {"detector": {"name": "W1", "size": (1024, 1024)}}, ["1016 x 1016"]),
    "no errors": (_without("sigma_u", "sigma_v"), {}, ["pairs", "errors"]),
    "one error": (_without("sigma_v"), {}, ["'sigma_v' is given without its partner"]),
    "no u": (_without("u"), {}, ["no column for 'u'"]),
    "no frames": (
        _without("frame"),
        {"data": {"columns": None, "rvb": {"bluest": 5}}},
        ["no column of frames"],
    ),
    "no colours": (_without("colour"), {"data": {"rvb": {"bluest": 5}}}, ["no colours"]),
    "nan": (_set("x", 7, np.nan), {}, ["row 7, column 'x'", "nan"]),
    "infinite": (_set("v", 8, np.inf), {}, ["row 8, column 'v'", "inf"]),
    "negative error": (_set("sigma_u", 9, -0.1), {}, ["row 9, column 'sigma_u'", "-0.1"]),
    "a column that is not there": (rvb_pairs, {"data": {"columns": {"u": "ux"}}}, ["'ux'"]),
    "not a known quantity": (
        rvb_pairs,
        {"data": {"columns": {"hue": "colour"}}},
        ["'hue'", "not a known quantity"],
    ),
    "nothing is left": (
        rvb_pairs,
        {"data": {"rvb": {"colour": (8.0, 9.0)}}},
        ["none of the 600 pairs", "no colour (", "widen"],
    ),
    "all too far": (
        rvb_pairs,
        {"data": {"rvb": {"accept_centre": 1e-6, "accept_corner": 1e-6}}},
        ["offset beyond the radial limit (600)"],
    ),
    "arcseconds called pixels": (arcseconds, {}, ["u, v is more than 25 pixels from x, y"]),
    "u and v swapped": (_swapped("u", "v"), {}, ["more than 25 pixels", "which column is which"]),
    "x and y swapped": (_swapped("x", "y"), {}, ["more than 25 pixels", "which column is which"]),
    "arcseconds": (
        rvb_pairs,
        {"data": {"unit": "arcsec", "rvb": {"accept_centre": 1.0, "accept_corner": 2.0}}},
        ["u, v are in arcsec", "pixels"],
    ),
    # -- the configuration
    "selection of other tables": (
        rvb_pairs,
        {"data": {"format": "auto", "rvb": {"bluest": 3}}},
        ["data.rvb", "'auto'", "set the format to 'rvb'"],
    ),
    "band of other tables": (
        rvb_pairs,
        {"data": {"format": "table", "band": "W1"}},
        ["data.band", "'table'"],
    ),
    "unknown key": (rvb_pairs, {"data": {"rvb": {"color": (0, 1)}}}, ["'color'", "'colour'"]),
    "no range": (rvb_pairs, {"data": {"rvb": {"colour": (1.0, 0.0)}}}, ["from 1 to 0"]),
    "half a limit": (
        rvb_pairs,
        {"data": {"rvb": {"accept_corner": 2.0}}},
        ["accept_corner is given alone", "accept_centre"],
    ),
    "chips": (
        rvb_pairs,
        {
            "detector": None,
            "chip": [{"number": 1, "name": "a", "size": (508, 508), "reference_pixel": (9, 9)}],
            "model": {"order": 2},
        },
        ["one array", "[[chip]]"],
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_what_is_wrong_is_said_in_one_sentence(tmp_path, name):
    make, sections, words = CASES[name]
    suffix = ".parquet" if name in ("W4 declared W1", "nan", "u and v swapped") else ".tbl"
    config = rvb_job(tmp_path / "job", make(), suffix, **sections)
    refused(tmp_path, "run", config, "-o", tmp_path / "run", words=words)


@pytest.mark.parametrize("cut", [5, 90])
def test_a_truncated_table_is_refused(tmp_path, cut):
    config = rvb_job(tmp_path / "job", rvb_pairs())
    path: Path = tmp_path / "job" / "pairs.tbl"
    path.write_text(path.read_text()[:-cut])
    refused(tmp_path, "run", config, "-o", tmp_path / "run", words=["pairs.tbl, row 600", "trunc"])


# -- no error of the format, and no answer to be sure of -------------------------------------------

REQUIREMENTS = [
    {"name": "anywhere", "statistic": "max", "limit": 9.0},
    {"name": "inside", "statistic": "max", "limit": 9.0, "region": "inner 40 %"},
]


def believed(tmp_path, table: Table, **sections: Any) -> dict[str, Any]:
    """The summary of a run, whose screen and file of margins say the same."""
    config = rvb_job(
        tmp_path / "job",
        table,
        model={"order": 4},
        requirement=REQUIREMENTS,
        budget=[EXACT],
        **sections,
    )
    result = good("run", config, "-o", tmp_path / "run")
    summary = summary_of(tmp_path / "run")
    shown = " ".join(result.out.split())
    assert all(" ".join(f"WARNING: {text}".split()) in shown for text in summary["warnings"])
    margins = Table.read(tmp_path / "run" / "margins.ecsv")
    assert [m["verdict"] for m in summary["margins"]] == list(margins["verdict"])
    summary["report"] = (tmp_path / "run" / "report.html").exists() and (
        tmp_path / "run" / "report.html"
    ).read_text(encoding="utf-8")
    return summary


def test_pairs_in_the_centre_say_nothing_of_the_corners(tmp_path):
    found = believed(tmp_path, rvb_pairs(3000, half=0.6))
    (text,) = [t for t in found["warnings"] if "extrapolated" in t]
    share = float(text.split(" %")[0])
    assert abs(share - 64.0) < 3.0
    anywhere, inside = found["margins"]
    assert anywhere["verdict"] == "undecided" and "extrapolated" in anywhere["reason"]
    assert inside["verdict"] == "met" and anywhere["probability_met"] > 0.95
    assert "the polynomial is extrapolated" in found["report"]
    result = good("check", tmp_path / "job" / "config.toml")
    assert "WARNING" in result.out and "extrapolated" in result.out
    # nor does `validate` with the same requirement
    path = tmp_path / "req.toml"
    path.write_text('[[requirement]]\nname = "r"\nstatistic = "rms"\nlimit = 9.0\n')
    result = cli("requirements", tmp_path / "run", "--requirements", path)
    assert result.code == 6 and "extrapolated" in result.out


CIRCLE = {"model": "uniform", "match_radius": 3.0}


@pytest.mark.usefixtures("no_report")
@pytest.mark.parametrize(
    "outliers",
    [{"model": "gaussian"}, case_in_full(CIRCLE, instead="outliers of the other shape are run")],
)
def test_a_table_of_mostly_false_pairs_is_not_believed(tmp_path, outliers):
    circle = 3.0 if outliers is CIRCLE else None
    table = rvb_pairs(6000, false=0.9, circle=circle)
    found = believed(tmp_path, table, outliers=outliers)
    assert abs(found["outliers"]["fraction"]["mean"] - 0.9) < 0.03
    (text,) = [t for t in found["warnings"] if t.startswith("The mixture takes")]
    assert (
        text.startswith("The mixture takes 90 % of the pairs") or "89 %" in text or "91 %" in text
    )
    for margin in found["margins"]:
        assert margin["verdict"] == "undecided" and "false" in margin["reason"]
        assert margin["probability_met"] > 0.95  # it would have been called met


@pytest.mark.slow
@only_in_full("false pairs of its shape are run")
@pytest.mark.usefixtures("no_report")
def test_false_pairs_of_another_shape_than_the_mixture_are_not_taken_for_true(tmp_path):
    """Gaussian outliers cannot hold a circle of false pairs: all become true with a wide error."""
    table = rvb_pairs(1500, false=0.95, circle=3.0)
    sampler = {"target_ess": 50, "target_rhat": 1.1, "max_steps": 50}
    found = believed(tmp_path, table, sampler=sampler)
    assert found["outliers"]["fraction"]["mean"] < 0.5
    assert found["outliers"]["jitter"]["mean"] > 1.0
    (text,) = [t for t in found["warnings"] if "false" in t]
    assert "times the quoted one" in text
    assert {m["verdict"] for m in found["margins"]} == {"undecided"}


@pytest.mark.slow
@only_in_full("tests/app/test_rvb runs good pairs")
@pytest.mark.usefixtures("no_report")
def test_good_pairs_are_believed(tmp_path):
    found = believed(tmp_path, rvb_pairs(3000))
    assert found["warnings"] == []
    assert [m["verdict"] for m in found["margins"]] == ["met", "met"]
