"""RUN/stars: what the posterior says of each star, beside the star it says it of."""

from __future__ import annotations

import shutil
from contextlib import chdir

import numpy as np
import pyarrow.parquet as pq
import pytest
import xarray as xr
from scipy.special import logsumexp
from scipy.stats import norm

from bayesdist.app.stages import write_star_files
from bayesdist.app.store.rundir import RunDirectory, part_files
from bayesdist.data import read_matches
from bayesdist.files.parquet import parquet_units
from bayesdist.infer import load_fit, load_posterior
from tests.app.support import begin_stagewise, good, snapshot, summary_of, write_job
from tests.batched import in_batches


@pytest.fixture(scope="module")
def matches(finished):
    with chdir(finished.config.parent):  # a run names its files relative to its configuration
        return read_matches("stars.ecsv")


@pytest.fixture(scope="module")
def part(finished):
    (path,) = (finished.path / "stars").iterdir()
    return pq.read_table(path)


def test_each_star_stands_beside_what_is_said_of_it(finished, matches, part):
    assert part.column_names == [
        "source", "row", "x", "y", "chip", "residual_u", "residual_v", "used",
        "outlier_probability", "log_likelihood", "log_likelihood_variance",
    ]  # fmt: skip
    stars = part.to_pydict()
    assert set(stars["source"]) == {"stars.ecsv"}
    for name in ("row", "x", "y"):
        np.testing.assert_array_equal(stars[name], getattr(matches, name))
    posterior = load_posterior(finished.path)
    model = posterior.model.predict(posterior.mean, matches.x, matches.y)
    np.testing.assert_allclose(stars["residual_u"], matches.u - model[:, 0], atol=1e-10)
    np.testing.assert_allclose(stars["residual_v"], matches.v - model[:, 1], atol=1e-10)
    assert sum(stars["used"]) == load_fit(finished.path / "fit.nc").n_used
    flagged = np.array(stars["outlier_probability"]) > 0.5
    assert flagged.sum() == posterior.n_flagged
    with xr.open_datatree(finished.path / "posterior.nc", engine="h5netcdf") as tree:
        np.testing.assert_array_equal(tree["constant_data/row"], stars["row"])
        known = tree["constant_data/outlier_probability"].values
    np.testing.assert_allclose(stars["outlier_probability"], known, rtol=1e-12)


def test_units_are_those_of_the_input(part):
    assert parquet_units(part.schema) == dict.fromkeys(
        ("x", "y", "residual_u", "residual_v"), "pix"
    )


def test_log_likelihoods_are_those_of_the_mixture(finished, matches, part):
    """By scipy, star by star, over all draws: the files average some of them."""
    posterior = load_posterior(finished.path)
    every = slice(None, None, 7)
    theta = posterior.flat[every]
    f, j, s = (posterior.hyper[k].ravel()[every, None] for k in ("f", "j", "s_out"))
    r = np.stack([matches.u, matches.v], axis=-1) - posterior.model.predict(
        theta, matches.x, matches.y
    )
    su, sv = np.hypot(matches.sigma_u, j), np.hypot(matches.sigma_v, j)
    core = np.log1p(-f) + norm.logpdf(r[..., 0], scale=su) + norm.logpdf(r[..., 1], scale=sv)
    false = np.log(f) + norm.logpdf(r, scale=s[..., None]).sum(axis=-1)
    both = logsumexp([core, false], axis=0)
    spread = both.std(axis=0)
    off = (part["log_likelihood"].to_numpy() - both.mean(axis=0)) / spread
    # 64 draws: the mean of each star scatters by 1/8 of the spread; 400 stars
    assert np.abs(off).max() < 5 / 8 and np.abs(off).std() < 2 / 8
    ratio = part["log_likelihood_variance"].to_numpy() / spread**2
    assert 0.8 < np.median(ratio) < 1.25


def test_one_part_for_each_piece(finished, matches, part, tmp_path):
    """Together they say what one part for all says, and parts of more pieces do not stay."""
    fit, posterior = load_fit(finished.path / "fit.nc"), load_posterior(finished.path)
    folder = tmp_path / "stars"
    write_star_files(in_batches(matches, 90), fit, posterior, folder)
    parts = part_files(folder)
    assert [p.name for p in parts] == [f"part-{k:05d}.parquet" for k in range(5)]
    both = [pq.read_table(p).to_pydict() for p in parts]
    for name, values in part.to_pydict().items():
        joined = [v for one in both for v in one[name]]
        if isinstance(values[0], float):
            np.testing.assert_allclose(joined, values, rtol=1e-12, atol=1e-15)
        else:
            assert joined == values
    (folder / "notes.txt").write_text("mine")
    write_star_files(matches, fit, posterior, folder)
    assert sorted(snapshot(folder)) == ["notes.txt", "part-00000.parquet"]


def test_force_removes_the_parts_and_nothing_else(finished, tmp_path, no_report):
    path = shutil.copytree(finished.path, tmp_path / "run")
    (path / "stars" / ".bayesdist-0a1b2c3d-part-00002.parquet").write_text("of a killed run")
    (path / "stars" / "mine.parquet").write_text("precious")
    RunDirectory(shutil.copytree(path, tmp_path / "other")).clear()
    assert sorted(snapshot(tmp_path / "other" / "stars")) == ["mine.parquet"]
    RunDirectory(shutil.copytree(finished.path, tmp_path / "third")).clear()
    assert not (tmp_path / "third" / "stars").exists()
    config = write_job(tmp_path / "job")
    good("run", config, "-o", path, "--force")
    assert sorted(snapshot(path / "stars")) == ["mine.parquet", "part-00000.parquet"]
    assert (path / "stars" / "mine.parquet").read_text() == "precious"


def test_the_stage_writes_them_again(finished, tmp_path):
    path = begin_stagewise(tmp_path / "run", finished.config, "fit", "sample")
    before = snapshot(path / "stars")
    shutil.rmtree(path / "stars")
    good("stage", "sample", path)
    assert snapshot(path / "stars") == before
    assert summary_of(path)["outliers"]["n_flagged"] > 0
