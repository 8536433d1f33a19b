"""Periods of a run: differences by separate fits, changes that were put in, and what is refused."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table
from astropy.time import Time
from lxml import html as lxml_html

from bayesdist.app.store.rundir import RunDirectory
from bayesdist.data import Matches, write_partitioned
from bayesdist.diagnose.periods import PeriodSettings, time_variation
from bayesdist.infer import fit_linear
from bayesdist.model import Chip, DistortionModel
from tests.app.support import (
    SIZE,
    as_table,
    cli,
    good,
    model_of,
    one_sentence,
    partly_run,
    refused,
    simulated,
    summary_of,
    truth_of,
    write_config,
    write_job,
)
from tests.reduced import case_in_full, only_in_full

pytestmark = pytest.mark.usefixtures("figures_made")

CENTRES = [55212.5, 55262.5, 55312.5]
NAMES = ["55212.5", "55262.5", "55312.5"]
DAYS = 5.0
PERIODS = {"centres": CENTRES, "days": DAYS}
N = 6000
CHANGE = 0.03  # px at the left and right edges


def dated(n=N, *, seed=1, change=0.0, pattern=0.0, outside=0, **options):
    """Pairs of three periods.

    From the second period on positions move by `change` times the square of the scaled x along u,
    in the third one by `pattern` in stripes that no polynomial of order 2 follows, along v.
    """
    matches, _ = simulated(n, seed=seed, **({"fraction": 0.0, "jitter": 0.0} | options))
    rng = np.random.default_rng(100 + seed)
    period = rng.integers(3, size=n)
    mjd = np.array(CENTRES)[period] + DAYS * rng.uniform(-0.499, 0.499, n)
    mjd[:outside] += 20.0
    X = (2 * matches.x - 1 - SIZE[0]) / SIZE[0]
    u = matches.u + change * (period >= 1) * X**2
    stripes = np.where((2 * X).astype(int) % 2 == 0, 1.0, -1.0) * np.sign(np.sin(8 * np.pi * X))
    v = matches.v + pattern * (period == 2) * stripes
    epoch = Time(mjd, format="mjd", scale="tt").decimalyear
    return replace(matches, u=u, v=v, epoch=epoch), period


def job(folder, matches, **sections):
    defaults = {
        "periods": PERIODS,
        "detector": {"name": "A", "size": SIZE, "scale_mas": 50.0},
        "outliers": {"model": "none"},  # sampled sooner
    }
    return write_job(folder, as_table(matches), **(defaults | sections))


def assessed(folder, matches, **sections):
    config = job(folder / "input", matches, stars="stars.parquet", **sections)
    return partly_run(folder / "run", config, "fit", "sample", "assess")


@pytest.fixture(scope="module")
def quiet(tmp_path_factory):
    """A run without a change, and its pairs; some lie outside all periods."""
    matches, period = dated(outside=40)
    folder = tmp_path_factory.mktemp("quiet")
    limit = {"name": "corner", "statistic": "max", "limit": 5.0, "unit": "mas"}
    return assessed(folder, matches, requirement=[limit]), matches, period


@pytest.fixture(scope="module")
def moved(tmp_path_factory):
    """A whole run with a change after the first period, with a looser and a tighter limit."""
    matches, period = dated(change=CHANGE)
    folder = tmp_path_factory.mktemp("moved")
    config = job(
        folder / "input",
        matches,
        stars="stars.parquet",
        requirement=[
            {"name": "loose", "statistic": "rms", "limit": 0.5},
            {"name": "tight", "statistic": "max", "limit": 0.1, "unit": "mas"},
        ],
    )
    good("run", config, "-o", folder / "run")
    return folder / "run", matches, period


def design(matches, rows):
    """Legendre products of order 2, in the order of the names."""
    X, Y = ((2 * z[rows] - 1 - n) / n for z, n in zip((matches.x, matches.y), SIZE, strict=True))
    P = [np.ones_like, lambda t: t, lambda t: (3 * t**2 - 1) / 2]
    terms = model_of().basis().terms
    return np.stack([P[i](X) * P[j](Y) for i, j in terms], axis=1)


def inside(matches, period):
    """Rows of each period, by the calendar of astropy; none is on an edge."""
    mjd = Time(matches.epoch, format="decimalyear", scale="tt").mjd
    good_ = [np.abs(mjd - c) < DAYS / 2 for c in CENTRES]
    return [g & (period == k) for k, g in enumerate(good_)]


@pytest.mark.slow
@only_in_full("tests/infer/compare has the rate of alarms")
def test_no_change_is_said_where_there_is_none(quiet):
    run, matches, period = quiet
    found = summary_of(run)["periods"]
    assert found["verdict"].startswith("No change is seen") and not found["significant"]
    # 5 mas at 50 mas a pixel
    assert found["tolerance"] == pytest.approx(0.1) and found["unit"] == "pix"
    assert found["verdict"].endswith("all periods are below the tolerance of 0.1 pix.")
    assert "is the same in all periods" in found["pattern"]
    assert found["n_outside"] == 40 and found["n_repeated"] == 0
    assert [row["name"] for row in found["periods"]] == NAMES
    rows = inside(matches, period)
    assert [row["n_pairs"] for row in found["periods"]] == [r.sum() for r in rows]
    assert sum(r.sum() for r in rows) == N - 40
    ends = found["first_vs_last"]
    assert ends["period"] == NAMES[2] and ends["against"] == NAMES[0]
    assert not any("distortion changes" in text for text in summary_of(run)["warnings"])


def test_differences_of_coefficients_are_those_of_separate_fits(quiet):
    """By numpy, from the pairs: all errors are equal, and nothing is clipped but beyond 5 sigma."""
    run, matches, period = quiet
    table = Table.read(run / "periods.ecsv")
    rows = inside(matches, period)
    every = np.any(rows, axis=0)

    def fitted(which):
        A = design(matches, which)
        values = np.column_stack([matches.u, matches.v])[which]
        return np.linalg.lstsq(A, values)[0].T.ravel(), np.linalg.inv(A.T @ A)

    combined, whole = fitted(every)
    scale = table.meta["error_scale"] * 0.02
    for name, which in zip(NAMES, rows, strict=True):
        here = table[(table["period"] == name) & (table["against"] == "combined")]
        own, alone = fitted(which)
        np.testing.assert_allclose(here["difference"], own - combined, atol=1e-9)
        # pairs of the period are in both: the variances subtract
        sigma = scale * np.sqrt(np.tile(np.diag(alone) - np.diag(whole), 2))
        np.testing.assert_allclose(here["sigma"], sigma, rtol=1e-6)
        np.testing.assert_allclose(here["z"], here["difference"] / here["sigma"], rtol=1e-12)
    ends = table[(table["period"] == NAMES[2]) & (table["against"] == NAMES[0])]
    np.testing.assert_allclose(
        ends["difference"], fitted(rows[2])[0] - fitted(rows[0])[0], atol=1e-9
    )
    assert list(ends["name"]) == list(model_of().names)


def test_residuals_are_as_in_table_c_1(quiet):
    """Means of bins by numpy, about the fit of all pairs, those outside included; arcsec."""
    run, matches, period = quiet
    (found,) = summary_of(run)["periods"]["residuals"]
    assert found["unit"] == "arcsec"
    A = design(matches, slice(None))
    uv = np.column_stack([matches.u, matches.v])
    residual = 0.05 * (uv - A @ np.linalg.lstsq(A, uv)[0])
    rows = {row["label"]: row for row in found["rows"]}
    assert list(rows)[:2] == ["combined/X", f"{NAMES[0]}/X"]
    side = round(np.sqrt(rows["combined/X"]["n_bins"]))
    ix, iy = (
        ((z - 0.5) / n * side).astype(int)
        for z, n in zip((matches.x, matches.y), SIZE, strict=True)
    )
    masks = dict(zip(NAMES, inside(matches, period), strict=True))
    masks["combined"] = np.any(list(masks.values()), axis=0)
    for name, mask in masks.items():
        code = (iy * side + ix)[mask]
        for axis, letter in enumerate("XY"):
            n = np.bincount(code, minlength=side**2)
            means = np.bincount(code, residual[mask, axis], minlength=side**2) / n
            row = rows[f"{name}/{letter}"]
            assert row["sigma"] == pytest.approx(means.std(), rel=1e-6)
            assert row["max"] == pytest.approx(means.max(), rel=1e-6)
            assert row["p01"] == pytest.approx(np.percentile(means, 1), rel=1e-6)


def test_a_change_is_found_measured_and_put_on_top(moved):
    run, _, _ = moved
    found = summary_of(run)["periods"]
    assert found["significant"] and found["p_value"] < 1e-6
    assert found["verdict"].startswith("The distortion changes")
    # the tightest limit: 0.1 mas
    assert found["tolerance"] == pytest.approx(0.002)
    assert found["verdict"].endswith(f"beyond the tolerance of 0.002 pix: {', '.join(NAMES)}.")
    ends = found["first_vs_last"]
    assert abs(ends["largest"] - CHANGE) < 4 * ends["sigma"] and ends["p_value"] < 1e-3
    # it grows towards the edges on the left and on the right
    assert ends["at"][0] in (1.0, SIZE[0])
    assert any(text.startswith("The distortion changes") for text in summary_of(run)["warnings"])


def test_the_two_coefficients_that_changed_stand_out(moved):
    """X^2 = 1/3 + 2/3 P_2(X): of the first period against the last these two, in u alone."""
    run, _, _ = moved
    table = Table.read(run / "periods.ecsv")
    ends = table[table["against"] == NAMES[0]]
    truth = dict.fromkeys(ends["name"], 0.0) | {"u_0_0": CHANGE / 3, "u_2_0": 2 * CHANGE / 3}
    pulls = np.array([(r["difference"] - truth[r["name"]]) / r["sigma"] for r in ends])
    assert np.abs(pulls).max() < 4 and 12 * 0.3 < (pulls**2).sum() < 12 * 2.7
    assert set(ends["name"][np.abs(ends["z"]) > 5]) == {"u_0_0", "u_2_0"}


def test_the_report_shows_it(moved, tmp_path):
    run, _, _ = moved
    page = lxml_html.parse(run / "report.html").getroot()
    section = page.get_element_by_id("periods")
    text = section.text_content()
    assert "Time variation" in text and "The distortion changes" in text
    assert "Mean residuals of bins" in text and "Patterns of the residuals" in text
    (image,) = section.xpath(".//figure//img")
    assert "difference vectors between two periods" in image.get("alt")
    assert (run / "figures" / "period_differences.svg").exists()
    # the stage by itself reads the pairs again, and says the same
    shutil.copytree(run, tmp_path / "again")
    good("stage", "report", tmp_path / "again")
    again = lxml_html.parse(tmp_path / "again" / "report.html").getroot()
    assert again.get_element_by_id("periods").text_content() == text


def test_runs_without_periods_have_no_such_section(finished):
    page = lxml_html.parse(finished.path / "report.html").getroot()
    assert not page.xpath("//section[@id='periods']")
    assert not (finished.path / "periods.ecsv").exists()
    assert "periods" not in summary_of(finished.path)


def test_a_pattern_that_no_polynomial_follows_is_found(tmp_path):
    matches, _ = dated(24_000, pattern=0.01)
    found = summary_of(assessed(tmp_path, matches))["periods"]
    assert found["tolerance"] is None
    assert "pattern of the residuals about one model changes: in 55312.5" in found["pattern"]
    by = {(row["period"], row["axis"]): row for row in found["patterns"]}
    worst = min(by, key=lambda key: by[key]["p_value"])
    assert worst == (NAMES[2], "Y") and by[worst]["p_value"] < 1e-6
    assert min(row["p_value"] for key, row in by.items() if key[1] == "X") > 1e-3 / 3


@pytest.mark.slow
@only_in_full("test_at_scale has a run on disk")
def test_pairs_on_disk_give_the_same(quiet, tmp_path):
    run, matches, _ = quiet
    write_partitioned([matches], tmp_path / "stars")
    sections = {"detector": {"name": "A", "size": SIZE, "scale_mas": 50.0}, "periods": PERIODS}
    data = {"matches": str(tmp_path / "stars"), "rows_in_memory": 1700}
    config = write_config(tmp_path / "c.toml", data=data, **sections)
    there = partly_run(tmp_path / "run", config, "fit", "sample", "assess")
    one, other = Table.read(run / "periods.ecsv"), Table.read(there / "periods.ecsv")
    for name in ("difference", "sigma", "monomial_difference"):
        np.testing.assert_allclose(one[name], other[name], rtol=1e-6, atol=1e-12)
    assert summary_of(there)["periods"]["n_outside"] == 40


def test_a_new_run_removes_it(quiet, tmp_path):
    run, _, _ = quiet
    shutil.copytree(run, tmp_path / "run")
    RunDirectory(tmp_path / "run").clear()
    assert not (tmp_path / "run" / "periods.ecsv").exists()


def test_stars_of_several_periods_are_counted():
    """Ten reference stars that two periods have, and pairs outside."""
    matches, period = dated(3000)
    star = np.arange(3000)
    first, last = (np.flatnonzero(period == k)[:10] for k in (0, 2))
    star[last] = star[first]
    matches = replace(matches, star=star)
    model = model_of()
    fit = fit_linear(matches, model)
    edges = Time(np.array([[c - 2.5, c + 2.5] for c in CENTRES]), format="mjd").decimalyear
    spans = {"a": tuple(edges[0]), "c": tuple(edges[2])}
    rng = np.random.default_rng(1)
    found = time_variation(fit, matches, PeriodSettings(spans, bins=4), rng=rng)
    assert found.n_repeated == 10 and found.n_outside == (period == 1).sum()
    assert (found.first, found.last) == ("a", "c")
    outside, repeated = found.cautions
    assert outside.startswith(f"{(period == 1).sum()} pairs lie outside")
    assert repeated.startswith("10 reference stars")


def test_chips_are_compared_together():
    """Two chips, of which one moves: residuals and patterns of each by themselves."""
    chips = (Chip(1, "A", SIZE, (500.5, 400.5)), Chip(2, "B", SIZE, (500.5, 400.5)))
    model = DistortionModel(2, chips)
    theta = np.concatenate([truth_of(model_of())] * 2)
    rng = np.random.default_rng(5)
    n = 8000
    x, y = (rng.uniform(0.5, s + 0.5, n) for s in SIZE)
    chip = rng.integers(2, size=n)
    late = rng.integers(2, size=n)
    uv = model.predict(theta, x, y, chip=chip + 1) + 0.02 * rng.standard_normal((n, 2))
    uv[:, 0] += 0.05 * (late * (chip == 1))
    sigma = np.full(n, 0.02)
    matches = Matches(x, y, *uv.T, sigma_u=sigma, sigma_v=sigma, epoch=2010.05 + late,
                         chip=chip, chip_numbers=(1, 2))  # fmt: skip
    spans = {"early": (2010.0, 2010.1), "late": (2011.0, 2011.1)}
    fit = fit_linear(matches, model)
    found = time_variation(fit, matches, PeriodSettings(spans, bins=8), rng=rng)
    assert found.significant and found.ends.chip == 2
    assert abs(found.ends.largest - 0.05) < 5 * found.ends.sigma
    quiet, loud = ([one.p_value for one in several] for several in found.patterns)
    assert min(quiet) > 1e-4 and min(loud) < 1e-9 and len(found.residuals) == 2


def test_what_cannot_be_compared_is_refused_before_anything_is_sampled(quiet, tmp_path):
    _, matches, _ = quiet
    for k, (sections, words) in enumerate((
        ({"data": {"matches": "stars.ecsv", "columns": {"epoch": ""}}},
         ("needs an epoch for every pair", "data.columns")),
        ({"periods": {"centres": [55212.5], "days": 5.0}}, ("the number of periods is 1",)),
        ({"periods": {"centres": [55212.5, 55214.0], "days": 5.0}}, ("overlap",)),
        ({"periods": {"centres": [55212.5, 55212.5], "days": 5.0}}, ("given twice",)),
        ({"periods": {"centres": [1e9, 55212.5], "days": 5.0}}, ("not a Modified Julian Date",)),
        ({"periods": {"centres": [212.5, 262.5], "days": 5.0}},
         ("MJD 212.5 has no pairs", "the pairs span MJD 552", "210.000 to 215.000")),
        ({"periods": {"centres": CENTRES, "days": 0.0}}, ("periods.days",)),
        ({"periods": {"centres": CENTRES}}, ("periods.days", "missing")),
        ({"model": {"order": 2, "frames": "shift"}}, ("model.frames",)),
        ({"model": {"order": 2, "tdd": {"epoch0": 2010.0, "terms": [("u", 1, 0)]}}},
         ("model.tdd",)),
    )):  # fmt: skip
        folder = tmp_path / str(k)
        config = job(folder, matches, **sections)
        refused(folder, "run", config, "-o", folder / "run", words=words)
    bare = as_table(matches)
    bare.remove_column("epoch")
    folder = tmp_path / "bare"
    config = write_job(folder, bare, periods=PERIODS)
    refused(folder, "run", config, "-o", folder / "run", words=("needs an epoch", "stars.ecsv"))
    refused(folder, "check", config, words=("needs an epoch",))


@pytest.mark.parametrize(
    ("kept", "words"),
    [
        (4, ("the 4 pairs of period 55262.5 do not determine the model", "give longer periods")),
        case_in_full(
            12,
            ("period 55262.5 has 12 pairs, too few for mean residuals", "give longer periods"),
            instead="a period with fewer is run",
        ),
    ],
)
def test_a_period_with_too_few_pairs_is_named(tmp_path, kept, words):
    """An axis has six coefficients; four bins with five pairs each are the least for a pattern."""
    matches, period = dated(3000)
    few = np.flatnonzero(period == 1)[kept:]
    matches = matches.select(np.setdiff1d(np.arange(3000), few))
    config = job(tmp_path / "input", matches)
    run = partly_run(tmp_path / "run", config, "fit", "sample")
    result = cli("stage", "assess", run, "-q")
    assert result.code == 1
    one_sentence(result.err, *words)
    assert not (run / "periods.ecsv").exists()
