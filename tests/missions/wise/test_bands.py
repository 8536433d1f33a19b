"""`bayesdist wise bands` on small sets of two bands, against what is computed from their files."""

from __future__ import annotations

import json
import re
import shutil
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from astropy.io import fits
from astropy.table import Table

from bayesdist.app.store import Record
from bayesdist.infer import load_fit, load_posterior
from bayesdist.missions.wise.meta_data.meta import read_wise_meta
from bayesdist.missions.wise.published import WISE_ARRAYS
from bayesdist.missions.wise.simulate import wise_solution
from bayesdist.model import Chip, DistortionModel
from bayesdist.simulate import simulate_matches
from tests.app.support import (
    REPOSITORY,
    SIZE,
    Result,
    as_table,
    cli,
    good,
    model_of,
    partly_run,
    refused,
    truth_of,
    write_job,
)
from tests.reduced import only_in_full
from tests.sketches import quick, sketched

PAIRS = 8_000
BINS = 9
BANDS = ("W1", "W4")


@dataclass(frozen=True)
class Compared:
    """Two bands, their runs, and what the command made of them."""

    folder: Path
    result: Result

    def run(self, band: str) -> Path:
        return self.folder / f"run_{band.lower()}"

    @property
    def output(self) -> Path:
        return self.folder / "bands"

    def pairs(self, band: str) -> dict[str, np.ndarray]:
        table = pq.read_table(self.folder / "set" / band.lower())
        return {name: table[name].to_numpy() for name in ("x", "y", "u", "v", "sigma")}

    @property
    def record(self) -> dict:
        return json.loads((self.output / "bands.json").read_text(encoding="utf-8"))

    def table(self, name: str) -> Table:
        return Table.read(self.output / f"table_{name}.ecsv")


@pytest.fixture(scope="module", autouse=True)
def quick_reports(full):
    """Runs are quick and figures of bands are not drawn, unless in full."""
    with nullcontext() if full else quick(), nullcontext() if full else sketched():
        yield


@pytest.fixture(scope="module")
def compared(tmp_path_factory) -> Compared:
    folder = tmp_path_factory.mktemp("bands")
    said = good(
        "simulate", "wise", "-o", folder / "set", "--pairs", PAIRS, "--bands", ",".join(BANDS)
    )
    assert f"--optical {folder / 'set' / 'optical_w2.hdr'} --rotation 270" in said.out
    for band in BANDS:
        name = band.lower()
        text = (folder / "set" / f"{name}.toml").read_text(encoding="utf-8")
        text = text.replace(f'matches = "{name}"', f'matches = "{folder / "set" / name}"')
        text += "\n[sampler]\ntarget_ess = 100\ntarget_rhat = 1.05\n"
        config = folder / f"{name}.toml"
        config.write_text(text, encoding="utf-8")
        # what comes after is not needed
        partly_run(folder / f"run_{name}", config, "fit", "sample", "diagnose")
    optical = folder / "set" / "optical_w2.hdr"
    runs = [folder / "run_w4", folder / "run_w1"]  # the tables put them in order
    options = ["--bins", BINS, "--optical", optical, "--rotation", 270]
    return Compared(folder, good("wise", "bands", *runs, "-o", folder / "bands", *options))


def residuals(compared: Compared, band: str) -> tuple[np.ndarray, ...]:
    """x, y, residuals in u and v of all pairs, and which the fit used: plain numpy."""
    p, run = compared.pairs(band), compared.run(band)
    fit, posterior = load_fit(run / "fit.nc"), load_posterior(run / "posterior.nc")
    at = fit.model.predict(posterior.mean, p["x"], p["y"])
    first = np.stack([p["u"], p["v"]], 1) - fit.model.predict(fit.clip.theta, p["x"], p["y"])
    square = (first**2).sum(1)
    used = (square <= fit.clip.abs_limit**2) & (square / p["sigma"] ** 2 <= fit.clip.chi2_limit)
    return p["x"], p["y"], p["u"] - at[:, 0], p["v"] - at[:, 1], used


def means(compared: Compared, band: str) -> dict[str, np.ndarray]:
    """Mean X, Y and length of the residuals in bins."""
    x, y, ru, rv, used = residuals(compared, band)
    nx, ny = WISE_ARRAYS[band].size
    edges = [np.linspace(0.5, n + 0.5, BINS + 1) for n in (ny, nx)]
    where = (y[used], x[used])
    n, _, _ = np.histogram2d(*where, bins=edges)
    values = {"X": ru[used], "Y": rv[used], "radial": np.hypot(ru, rv)[used]}
    return {
        axis: np.histogram2d(*where, bins=edges, weights=r)[0] / n for axis, r in values.items()
    }


def columns(values: np.ndarray) -> list[float]:
    low, median, high = np.percentile(values, [1, 50, 99])
    return [values.mean(), values.std(), values.min(), values.max(), median, low, high]


HEADS = ("Mean", "Sigma", "Min", "Max", "Median", "1%-tile", "99%-tile")


def test_table_5_1_is_that_of_the_bins(compared):
    table = compared.table("5_1")
    assert list(table["Band/Axis"]) == [f"{b}/{a}" for b in BANDS for a in ("X", "Y", "radial")]
    for row in table:
        band, axis = row["Band/Axis"].split("/")
        wanted = columns(means(compared, band)[axis])
        np.testing.assert_allclose([row[h] for h in HEADS], wanted, atol=1e-9, rtol=1e-7)


def test_table_5_2_is_the_difference_in_arcsec(compared):
    one, four = (means(compared, band) for band in BANDS)
    table = compared.table("5_2")
    assert list(table["Bands/Axis"]) == ["W4-W1/X", "W4-W1/Y"]
    for row, axis in zip(table, "XY", strict=True):
        wanted = columns(5.5 * four[axis] - 2.75 * one[axis])
        np.testing.assert_allclose([row[h] for h in HEADS], wanted, atol=1e-9, rtol=1e-7)


def test_table_5_3_is_of_all_pairs_of_bins(compared):
    for row in compared.table("5_3"):
        band, axis = row["Band/Axis"].split("/")
        bins = WISE_ARRAYS[band].scale * means(compared, band)[axis].ravel()
        wanted = columns((bins[:, None] - bins).ravel())
        np.testing.assert_allclose([row[h] for h in HEADS], wanted, atol=1e-9, rtol=1e-7)


def test_the_parts_of_sigma_add_up(compared):
    rows = [row for table in compared.record["tables"].values() for row in table["rows"]]
    assert len(rows) == 6 + 2 + 4
    for row in rows:
        structure = row["noise_free"]["sigma"]
        parts = [row["sigma_partition"] or 0.0, row["sigma_rest"]]
        if parts[0] < structure:
            assert np.hypot(*parts) == pytest.approx(structure, rel=1e-9)
        else:
            assert parts[1] == 0
        if structure > 0:
            total = np.hypot(structure, row["sigma_noise"])
            assert total == pytest.approx(row["value"]["sigma"], rel=1e-9)


def test_without_31_bins_no_printed_table_but_printed_maxima(compared):
    record = compared.record
    assert not any("printed" in row for t in record["tables"].values() for row in t["rows"])
    assert [b["printed"]["longest_vector"] for b in record["bands"]] == [2.931, 1.435]


def test_histograms_count_every_pair(compared):
    for band, found in zip(BANDS, compared.record["bands"], strict=True):
        _, _, ru, rv, _ = residuals(compared, band)
        assert set(found["histograms"]) == {"calibrated", "no correction", "optical model"}
        for one in found["histograms"].values():
            for axis in "xy":
                assert sum(one[f"counts_{axis}"]) + one[f"outside_{axis}"] == PAIRS == one["n"]
        one = found["histograms"]["calibrated"]
        edges = np.linspace(-one["reach"], one["reach"], len(one["counts_x"]) + 1)
        for axis, r in (("x", ru), ("y", rv)):
            wanted, _ = np.histogram(r, edges)
            # the two ways to find the bin may round a value at an edge otherwise
            assert np.abs(np.array(one[f"counts_{axis}"]) - wanted).sum() <= 4
        # without correction: u - x, but for the calibrated constant at the reference pixel
        fit, posterior = (
            load_fit(compared.run(band) / "fit.nc"),
            load_posterior(compared.run(band) / "posterior.nc"),
        )
        [constant] = fit.model.predict(posterior.mean, *np.array(WISE_ARRAYS[band].centre)[:, None])
        p = compared.pairs(band)
        for k, (axis, name) in enumerate((("x", "u"), ("y", "v"))):
            plain = p[name] - p[axis] - (constant[k] - WISE_ARRAYS[band].centre[k])
            wanted, _ = np.histogram(plain, edges)
            counts = np.array(found["histograms"]["no correction"][f"counts_{axis}"])
            assert np.abs(counts - wanted).sum() <= 4


def test_calibration_narrows_the_histograms(compared):
    one = compared.record["bands"][0]["histograms"]
    widths = [one[c]["half_width_x"] for c in ("calibrated", "optical model", "no correction")]
    assert widths[0] < widths[1] < widths[2]


def test_coverage_counts_the_pairs_used(compared):
    for band, found in zip(BANDS, compared.record["bands"], strict=True):
        *_, used = residuals(compared, band)
        c = found["coverage"]
        assert found["n_used"] == used.sum()
        assert c["expected"] * BINS**2 == pytest.approx(used.sum())
        assert c["poisson_error"] == pytest.approx(np.sqrt(used.sum() / BINS**2))
        # the simulated stars lie evenly: chi-square within five of its standard deviations
        assert abs(c["chi2"] - c["dof"]) < 5 * np.sqrt(2 * c["dof"])


def test_differences_are_those_of_the_true_models(compared):
    """At the corners, where they are largest, within the errors of both fits."""
    fields = []
    share = np.linspace(0.5, 1015.5, 33) / 1016  # where the pixel centres of W1 lie in its array
    for band in BANDS:
        model, theta = wise_solution(band)
        nx = WISE_ARRAYS[band].size[0]
        x, y = np.meshgrid(0.5 + nx * share, 0.5 + nx * share)
        xy = np.stack([x.ravel(), y.ravel()], 1)
        d = model.predict(theta, *xy.T) - xy
        centre = np.array(WISE_ARRAYS[band].centre)
        d -= model.predict(theta, *centre[:, None]) - centre
        fields.append(d * WISE_ARRAYS[band].scale / 2.75)
    truth = np.hypot(*(fields[1] - fields[0]).T).max()
    [found] = compared.record["differences"]
    assert found["name"] == "W4−W1" and found["pixels_of"] == "W1"
    radii = [b["formal_radius"]["posterior"] for b in compared.record["bands"]]
    assert abs(found["max"] - truth) < 5 * np.hypot(radii[0], 2 * radii[1])


def test_the_meta_data_are_those_of_the_bands(compared):
    for band, one in zip(BANDS, read_wise_meta(compared.output / "wise_meta.tbl"), strict=True):
        posterior = load_posterior(compared.run(band) / "posterior.nc")
        x, y = np.random.default_rng(3).uniform(1, WISE_ARRAYS[band].size[0], (2, 50))
        U, V = one.sip.forward(x, y)
        centre = WISE_ARRAYS[band].centre
        wanted = posterior.model.predict(posterior.mean, x, y) - np.array(centre)
        np.testing.assert_allclose(np.stack([U, V], 1), wanted, atol=2e-5)  # seven digits


def test_every_file_is_there_and_the_page_needs_no_other(compared):
    record, folder = compared.record, compared.output
    files = {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}
    assert files == {*record["files"], "bands.json"}
    page = (folder / "bands.html").read_text(encoding="utf-8")
    # the documentation is linked, and asked by readers alone
    assert not re.search(r'(?:src|href)="(?!data:|#)', page)
    assert not re.search(r"<(?:link|script|iframe|img)[^>]*https:", page)
    assert page.count("<figure") == len([f for f in files if f.endswith((".svg", ".png"))])
    assert "NOT CONVERGED" not in page
    assert page.index(record["verdict"]["headline"]) < page.index("Overview")
    assert page.count("SIMULATED DATA") == 2  # on the screen, and on each page of paper
    assert "W4" in compared.result.out and "bands.html" in compared.result.out


def test_the_stand_in_says_what_it_is(compared):
    text = (compared.folder / "set" / "optical_w2.hdr").read_text(encoding="ascii")
    assert "not the Code V model" in text


def test_an_optical_model_of_another_field_is_refused(compared, tmp_path):
    text = (compared.folder / "set" / "optical_w2.hdr").read_text(encoding="ascii")
    header = fits.Header.fromstring(text, sep="\n")
    for key in ("CD1_1", "CD2_2"):  # pixels of 0.05 arcsec
        header[key] *= 0.05 / 2.75
    header.totextfile(tmp_path / "camera.hdr")
    options = ["--bins", BINS, "--optical", tmp_path / "camera.hdr"]
    words = ["camera.hdr", "0.847 arcmin", "W1 covers 46.6", "band's field"]
    refused(
        tmp_path, "wise", "bands", compared.run("W1"), "-o", tmp_path / "out", *options, words=words
    )


@pytest.mark.slow
@only_in_full("tests/app/test_run has one")
def test_a_run_that_has_not_converged_is_said_on_top(compared, tmp_path):
    text = (compared.run("W4") / "config.toml").read_text(encoding="utf-8")
    text = text.replace("target_ess = 100", "target_ess = 100000\nmax_steps = 20")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.toml").write_text(text, encoding="utf-8")
    for stage in ("fit", "sample", "diagnose"):
        cli("stage", stage, tmp_path / "run")
    result = good("wise", "bands", tmp_path / "run", "-o", tmp_path / "out", "--bins", BINS)
    assert "WARNING: W4 has not converged" in result.out
    page = (tmp_path / "out" / "bands.html").read_text(encoding="utf-8")
    assert page.index("NOT CONVERGED: W4") < page.index("Overview")
    record = json.loads((tmp_path / "out" / "bands.json").read_text())
    assert record["converged"] is False and record["verdict"]["level"] == "fail"


# -- what is refused ------------------------------------------------------------------------------


def test_a_run_that_is_not_finished_is_refused(compared, tmp_path):
    shutil.copytree(compared.run("W4"), tmp_path / "run")
    record = Record.read(tmp_path / "run" / "run.json")
    del record.artefacts["sample"]
    record.write(tmp_path / "run" / "run.json")
    words = ["needs stage 'sample'", "bayesdist stage sample"]
    refused(tmp_path, "wise", "bands", tmp_path / "run", "-o", tmp_path / "out", words=words)


def test_two_runs_of_one_band_are_refused(compared, tmp_path):
    run = compared.run("W1")
    words = ["is of band W1", "one run for each band"]
    refused(tmp_path, "wise", "bands", run, run, "-o", tmp_path / "out", words=words)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--optical", "nowhere.hdr"], ["nowhere.hdr", "there is no such file"]),
        (["--optical", "README.md"], ["README.md"]),
        (["--optical", "a.hdr,b.hdr"], ["2 optical models", "1 runs"]),
        (["--bins", "5"], ["--bins", "give at least 6"]),
    ],
)
def test_options_that_cannot_be_used_are_refused(compared, tmp_path, monkeypatch, options, words):
    monkeypatch.chdir(REPOSITORY)
    run = compared.run("W1")
    refused(tmp_path, "wise", "bands", run, "-o", tmp_path / "out", *options, words=words)


def test_a_folder_in_use_is_refused(compared):
    words = ["holds other files", "never overwritten"]
    refused(
        compared.output, "wise", "bands", compared.run("W1"), "-o", compared.output, words=words
    )


def test_bands_of_another_instrument_have_no_word_of_wise(tmp_path):
    """And where its stars are no longer those of the run, it is refused."""
    detector = {"name": "blue", "size": SIZE, "scale_mas": 50.0}
    config = write_job(tmp_path / "in", detector=detector)
    run = partly_run(tmp_path / "run", config, "fit", "sample", "diagnose")
    good("wise", "bands", run, "-o", tmp_path / "out", "--bins", 6)
    page = (tmp_path / "out" / "bands.html").read_text(encoding="utf-8")
    text = re.sub(r'src="data:[^"]*"', "", page)
    for word in ("published", "printed", "WISE", "W1", "frameset", "5-1"):
        assert word not in text
    assert not (tmp_path / "out" / "wise_meta.tbl").exists()
    assert not (tmp_path / "out" / "table_5_2.ecsv").exists()  # one band has no other
    stars = config.parent / "stars.ecsv"
    stars.write_text(stars.read_text(encoding="utf-8") + "\n", encoding="utf-8")
    words = ["stars.ecsv", "changed since the run began"]
    refused(tmp_path, "wise", "bands", run, "-o", tmp_path / "other", words=words)


def test_a_missing_scale_is_refused(tmp_path):
    config = write_job(tmp_path / "in", detector={"name": "blue", "size": SIZE})
    run = partly_run(tmp_path / "run", config, "fit", "sample", "diagnose")
    words = ["pixel scale", "detector.scale_mas"]
    refused(tmp_path, "wise", "bands", run, "-o", tmp_path / "out", words=words)


def test_several_chips_are_refused(tmp_path):
    chips = tuple(Chip(k, f"C{k}", (1000.0, 800.0), (500.5, 400.5)) for k in (1, 2))
    model = DistortionModel(2, chips)
    truth = np.concatenate([truth_of(model_of())] * 2)
    matches, _ = simulate_matches(model, truth, 600, rng=np.random.default_rng(4), sigma=0.02)
    table = as_table(matches)
    table["chip"] = matches.chip_number
    blocks = [
        {"number": c.number, "name": c.name, "size": c.size, "reference_pixel": c.reference_pixel}
        for c in chips
    ]
    settings = {"detector": {"name": "D", "scale_mas": 50.0}, "model": {"order": 2}}
    config = write_job(tmp_path / "in", table, chip=blocks, **settings)
    run = partly_run(tmp_path / "run", config, "fit", "sample", "diagnose")
    refused(
        tmp_path,
        "wise",
        "bands",
        run,
        "-o",
        tmp_path / "out",
        words=["has 2 chips", "one chip each"],
    )
