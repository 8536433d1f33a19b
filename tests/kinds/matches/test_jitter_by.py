"""Axes and chips whose scatter differs, from the table to the held-out stars of a run."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.table import Table

from tests.app.support import (
    SIZE,
    begin_stagewise,
    good,
    partly_run,
    refused,
    summary_of,
    write_config,
    write_job,
)
from tests.reduced import only_in_full

QUOTED, SIZES = 0.02, (0.043, 0.060)
N = 6000
CHIPS = [
    {"number": k, "name": f"C{k}", "size": SIZE, "reference_pixel": (500.5, 400.5)} for k in (1, 2)
]


def stars(seed=1, n=N, sizes=SIZES, chips=1):
    """Positions with 3 % false matches, whose errors are quoted as 0.02 px on both axes."""
    rng = np.random.default_rng(seed)
    x, y = (rng.uniform(1, side, n) for side in SIZE)
    X, Y = x / SIZE[0] - 0.5, y / SIZE[1] - 0.5
    chip = np.arange(n) % chips
    noise = rng.normal(size=(n, 2)) * np.broadcast_to(sizes, (chips, 2))[chip]
    bad = rng.uniform(size=n) < 0.03
    noise[bad] = rng.normal(0, 0.5, (int(bad.sum()), 2))
    table = Table({"x": x, "y": y})
    table["u"], table["v"] = x + 4 * X**2 * Y + noise[:, 0], y - 3 * X * Y + noise[:, 1]
    table["sigma_u"], table["sigma_v"] = np.full(n, QUOTED), np.full(n, QUOTED)
    if chips > 1:
        table["chip"] = chip + 1
    for name in ("u", "v", "sigma_u", "sigma_v"):
        table[name].unit = "pix"
    return table


def job(folder, table=None, **sections):
    sections = {"model": {"order": 3}, "holdout": {"fraction": 0.3}} | sections
    return write_job(folder, stars() if table is None else table, **sections)


def covered(summary):
    """Fraction within one sigma on each axis, less the predicted, in binomial errors."""
    return {
        c["axis"]: (c["value"] - c["expected"])
        / np.sqrt(c["expected"] * (1 - c["expected"]) / c["n"])
        for c in summary["holdout"]["coverage"]
        if c["sigma"] == 1
    }


@pytest.fixture(scope="module")
def split(tmp_path_factory):
    folder = tmp_path_factory.mktemp("split")
    config = job(folder / "input")
    result = good("run", config, "-o", folder / "run")
    return config, folder / "run", result.err


def test_both_axes_cover_as_predicted(split):
    summary = summary_of(split[1])
    assert summary["sampler"]["converged"] and summary["holdout"]["level"] == "pass"
    assert max(abs(z) for z in covered(summary).values()) < 3


def test_sizes_are_those_of_the_data(split):
    summary = summary_of(split[1])
    found = summary["fit"]["added_errors"]
    assert found["grouping"] == "axis" and found["evidence"]["axis"] > 50
    true = np.sqrt(np.square(SIZES) - QUOTED**2)
    for row, size in zip(found["groups"], true, strict=True):
        assert abs(row["added"] - size) < 4 * row["added_error"]
    u, v = found["groups"]
    assert u["excess"] == 0 and v["excess"] ** 2 == pytest.approx(v["variance"] - u["variance"])
    jitter = summary["outliers"]["jitter"]  # it stays sampled, and is the least
    assert abs(jitter["mean"] - true[0]) < 4 * jitter["sd"]


def test_it_is_told_wherever_the_run_is_read(split):
    config, folder, log = split
    (line,) = (one for one in log.splitlines() if "beyond the quoted ones differ by axis" in one)
    assert "pix along u" in line and "ln evidence" in line
    out = good("check", config).out
    assert line.removeprefix("fit: ") in out
    html = (folder / "report.html").read_text(encoding="utf-8")
    assert "Errors beyond the quoted ones" in html
    assert "j is the least of those beyond the quoted" in html


@pytest.mark.slow
@only_in_full("test_run has stages by themselves")
def test_stages_by_themselves_and_a_fit_made_anew_see_the_same_errors(split, tmp_path):
    config, whole, _ = split
    folder = begin_stagewise(tmp_path / "run", config, "fit", "fit", "sample", "assess")
    assert summary_of(folder)["fit"] == summary_of(whole)["fit"]
    assert (folder / "holdout.ecsv").read_bytes() == (whole / "holdout.ecsv").read_bytes()


@pytest.mark.slow
@only_in_full("tests/diagnose/test_holdout names such an axis")
def test_one_jitter_for_unequal_axes_is_flagged(tmp_path):
    config = job(tmp_path / "input", outliers={"jitter_by": "one"})
    folder = partly_run(tmp_path / "run", config, "fit", "sample", "assess")
    summary = summary_of(folder)
    assert "added_errors" not in summary["fit"]
    found = summary["holdout"]
    assert found["level"] == "fail"
    assert found["verdict"].startswith("along v the residuals of held-out stars are ")
    assert "times as large as predicted" in found["verdict"]
    (along_v,) = (t for t in found["tests"] if t["where"] == "along v")
    true = SIZES[1] / np.sqrt(np.mean(np.square(SIZES)))
    assert abs(along_v["value"] / true - 1) < 4 / np.sqrt(2 * found["n"])
    z = covered(summary)
    assert z["u"] > 4 and z["v"] < -4


def test_equal_axes_keep_one_jitter(tmp_path):
    config = job(tmp_path / "input", stars(2, sizes=(0.05, 0.05)))
    found = good("check", config).out
    assert "jitter       one jitter for both axes (ln evidence" in found
    folder = partly_run(tmp_path / "run", config, "fit")
    groups = summary_of(folder)["fit"]["added_errors"]
    assert groups["grouping"] == "one" and groups["evidence"]["axis"] < 3
    assert {row["excess"] for row in groups["groups"]} == {0.0}


@pytest.mark.slow
@only_in_full("axes have them, and chips in tests/infer")
def test_chips_have_jitters_of_their_own_on_request(tmp_path):
    sizes = [(0.04, 0.06), (0.07, 0.05)]
    config = job(
        tmp_path / "input",
        stars(3, sizes=sizes, chips=2),
        outliers={"jitter_by": "chip"},
        detector=None,
        model={"order": 3},
        chip=CHIPS,
    )
    folder = partly_run(tmp_path / "run", config, "fit", "sample", "assess")
    summary = summary_of(folder)
    found = summary["fit"]["added_errors"]
    assert (found["grouping"], found["by"]) == ("chip and axis", "chip")
    true = np.sqrt(np.square(sizes) - QUOTED**2).ravel()
    for row, size in zip(found["groups"], true, strict=True):
        assert abs(row["added"] - size) < 4 * row["added_error"]
    assert [(row["label"], row["axis"]) for row in found["groups"]] == [
        (chip, axis) for chip in "12" for axis in "uv"
    ]
    assert summary["holdout"]["level"] == "pass"
    assert max(abs(z) for z in covered(summary).values()) < 3


def test_exposures_whose_noise_differs_have_jitters_of_their_own_as_advised(tmp_path):
    """One of six has errors four times as large as quoted: the finding names what mends it."""
    table, rng = stars(seed=7, n=2400, sizes=(QUOTED, QUOTED)), np.random.default_rng(8)
    which = np.arange(len(table)) % 6
    table["exposure"] = [f"e{k}" for k in which]
    for name in ("u", "v"):
        table[name][which == 2] += QUOTED * np.sqrt(15) * rng.standard_normal((which == 2).sum())
    outliers = {}
    found, flagged = [], []
    for folder in ("one", "each"):
        config = job(tmp_path / folder, table, holdout=None, outliers=outliers)
        summary = summary_of(
            partly_run(tmp_path / f"{folder}-run", config, "fit", "sample", "assess")
        )
        found.append([text for text in summary["warnings"] if "noise differs" in text])
        flagged.append(summary["outliers"]["n_flagged"] / len(table))
        outliers = {"jitter_by": "exposure"}
    assert "outliers.jitter_by = 'exposure'" in "".join(found[0])
    assert not found[1]
    # 3 % are false matches, and some of those are within the errors of the others
    assert flagged[0] > 0.08 and 0.015 < flagged[1] < 0.035


def test_bright_stars_whose_noise_differs_have_errors_by_magnitude_as_advised(tmp_path):
    """Errors of the brighter half are three times as large as quoted."""
    table, rng = stars(seed=9, n=2400, sizes=(QUOTED, QUOTED)), np.random.default_rng(10)
    table["mag"] = rng.uniform(12.0, 18.0, len(table))
    bright = table["mag"] < 15.0
    for name in ("u", "v"):
        table[name][bright] += QUOTED * np.sqrt(8) * rng.standard_normal(bright.sum())
    found = []
    for sigma in ("columns", "by_magnitude"):
        if sigma != "columns":
            table.remove_columns(["sigma_u", "sigma_v"])
        data = {"matches": "stars.ecsv", "sigma": sigma}
        config = job(tmp_path / sigma, table, holdout=None, data=data)
        run = partly_run(tmp_path / f"{sigma}-run", config, "fit", "sample", "assess")
        warnings = summary_of(run)["warnings"]
        found.append([text for text in warnings if "from bright to faint" in text])
    assert "data.sigma = 'by_magnitude'" in "".join(found[0])
    assert not found[1]


def test_errors_far_too_small_are_scaled_first(tmp_path):
    """What is common to both axes is in the factor, what is not in the jitters."""
    table = stars(4)
    for name in ("sigma_u", "sigma_v"):
        table[name] /= 1000
    folder = partly_run(tmp_path / "run", job(tmp_path / "input", table), "fit")
    fit = summary_of(folder)["fit"]
    assert fit["error_scale"] > 1000 and fit["added_errors"]["grouping"] == "axis"


@pytest.mark.parametrize(
    ("sections", "words"),
    [
        ({"outliers": {"jitter_by": "axes"}}, ("outliers.jitter_by", "'axes'", "'exposure'")),
        ({"outliers": {"jitter_by": True}}, ("outliers.jitter_by",)),
        ({"outliers": {"jiter_by": "chip"}}, ("jiter_by", "'jitter_by'")),
        ({"outliers": {"jitter_by": "exposure", "jitter": 0.1}}, ("outliers.jitter gives",)),
        ({"outliers": {"jitter_by": "chip"}}, ("there is only one chip",)),
        ({"outliers": {"jitter_by": "exposure"}}, ("all matches have the same exposure",)),
        ({"outliers": {"jitter_by": "filter"}}, ("all matches have the same filter",)),
        (
            {
                "outliers": {"jitter_by": "exposure"},
                "data": {"matches": "stars.ecsv", "sigma": "by_magnitude"},
            },
            ("data.sigma = 'by_magnitude'", "outliers.jitter_by"),
        ),
    ],
)
def test_what_makes_no_sense_is_refused_before_anything_is_written(tmp_path, sections, words):
    config = job(tmp_path, stars(5, 300), holdout=None, **sections)
    for command in (("check", config), ("run", config, "-o", tmp_path / "run")):
        refused(tmp_path, *command, words=words)


def test_matches_in_circles_are_refused_and_not_compared(tmp_path):
    table = stars(6, 600)
    table["u_nominal"], table["v_nominal"] = table["u"], table["v"]
    for name in ("u_nominal", "v_nominal"):
        table[name].unit = "pix"
    outliers = {"model": "uniform", "match_radius": 1.0}
    config = job(tmp_path / "a", table, holdout=None, outliers=outliers | {"jitter_by": "exposure"})
    refused(tmp_path, "check", config, words=("match circle", "outliers.jitter_by"))
    config = job(tmp_path / "b", table, holdout=None, outliers=outliers)
    assert "ln evidence" not in good("check", config).out


@pytest.mark.parametrize("kind", ["campaign", "selfcal"])
def test_other_models_of_errors_have_no_jitters_of_groups(tmp_path, kind):
    block = {
        "campaign": {
            "lists": "l",
            "catalog": "c.ecsv",
            "exposures": "e.ecsv",
            "initial_distortion": "s.fits",
        },
        "selfcal": {"lists": "l", "match_radius": 1.0},
    }[kind]
    sections = {"data": None, kind: block, "outliers": {"jitter_by": "exposure"}}
    if kind == "campaign":
        sections |= {"chip": CHIPS, "detector": None, "model": {"order": 3}}
    path = write_config(tmp_path / "config.toml", **sections)
    refused(
        tmp_path,
        "check",
        path,
        words=("outliers.jitter_by", f"it is of [data], and this is a [{kind}]"),
    )
