"""Matches that stay on disk give what they give in memory, with no more than some of them held."""

from __future__ import annotations

from functools import partial

import numpy as np
import pyarrow.parquet as pq
import pytest

from bayesdist.app.config import load_config
from bayesdist.app.pipeline import fit
from bayesdist.app.run import Run
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.data import Matches, read_matches, write_partitioned
from bayesdist.data.storage import StoredRows
from bayesdist.infer import load_fit, load_posterior
from bayesdist.kinds.matches.sources import load_matches
from bayesdist.model import TimeDependence
from bayesdist.simulate import simulate_matches
from tests.app.support import (
    as_table,
    begin_stagewise,
    good,
    model_of,
    partly_run,
    refused,
    simulated,
    summary_of,
    truth_of,
    write_config,
)
from tests.reduced import only_in_full

N = 6000


@pytest.fixture(scope="module")
def job(tmp_path_factory):
    """A folder of three parts, and a configuration that names it by its whole path."""
    folder = tmp_path_factory.mktemp("job")
    matches, _ = simulated(N, seed=4, mag=np.linspace(12.0, 18.0, N))
    thirds = [matches.select(np.arange(k, N, 3)) for k in range(3)]
    write_partitioned(thirds, folder / "stars", rows_per_group=500)
    return _job(folder / "config.toml", folder / "stars", rows_in_memory=1700)


def _job(path, stars, **data):
    return write_config(path, data={"matches": str(stars), **data})


def _numbers(value, path=""):
    if isinstance(value, dict):
        for k, v in value.items():
            yield from _numbers(v, f"{path}.{k}")
    elif isinstance(value, list):
        for k, v in enumerate(value):
            yield from _numbers(v, f"{path}[{k}]")
    else:
        yield path, value


def test_which_stay_on_disk(job, tmp_path):
    """Parquet of more than `rows_in_memory` rows, as one file or several; nothing else."""
    folder = job.parent / "stars"
    files = sorted(folder.iterdir())
    for limit, in_memory in ((N, True), (N - 1, False)):
        for path in (folder, str(folder / "*.parquet"), files):
            assert load_matches(path, rows_in_memory=limit).in_memory is in_memory
        found = load_matches(folder, format="table", rows_in_memory=limit)
        assert found.in_memory is in_memory
    table = read_matches(files[0])
    as_table(table).write(tmp_path / "stars.ecsv")
    assert load_matches(tmp_path / "stars.ecsv", rows_in_memory=1).in_memory


def test_a_run_on_disk_is_the_run_in_memory(job, tmp_path):
    stages = ("fit", "sample", "assess")
    disk = begin_stagewise(tmp_path / "disk", job, *stages)
    whole = _job(tmp_path / "config.toml", job.parent / "stars")
    memory = begin_stagewise(tmp_path / "memory", whole, *stages)

    one, other = load_fit(disk / "fit.nc"), load_fit(memory / "fit.nc")
    # sums over pieces round otherwise: far less than a formal error
    assert (np.abs(one.mean - other.mean) < 1e-6 * other.sigma).all()
    assert (one.n_rows, one.n_used, one.rejected) == (other.n_rows, other.n_used, other.rejected)
    a, b = load_posterior(disk), load_posterior(memory)
    assert (np.abs(a.mean - b.mean) < 0.01 * b.sigma).all()
    assert (a.n_stars, a.n_flagged) == (b.n_stars, b.n_flagged)
    assert a.n_false == pytest.approx(b.n_false, rel=1e-3)
    found, expected = (dict(_numbers(summary_of(run))) for run in (disk, memory))
    assert found.keys() == expected.keys()
    for key in found:
        if key.startswith((".data", ".fit", ".misfit", ".warnings")):
            value = expected[key]
            exact = value is None or isinstance(value, str | bool)
            assert found[key] == (value if exact else pytest.approx(value, rel=1e-6)), key

    parts = [pq.read_table(path) for path in sorted((disk / "stars").iterdir())]
    assert len(parts) >= 4 and max(map(len, parts)) <= 1700
    (whole,) = [pq.read_table(path) for path in (memory / "stars").iterdir()]
    for name in ("source", "row", "x", "y", "used"):
        joined = [value for part in parts for value in part[name].to_pylist()]
        assert joined == whole[name].to_pylist(), name


@pytest.mark.usefixtures("figures_made")
def test_no_stage_takes_all_rows_into_memory(job, tmp_path, monkeypatch):
    """The largest table that is ever made has the rows of one piece, or of the sample."""
    sizes = []
    complete = Matches._complete
    monkeypatch.setattr(
        Matches, "_complete", lambda self: (sizes.append(np.size(self.x)), complete(self))[1]
    )
    for name in ("app.stars", "kinds.matches.kind", "kinds.matches.init"):
        monkeypatch.setattr(f"bayesdist.{name}.SAMPLE", 900)
    monkeypatch.setattr("bayesdist.infer.solution.linear.MEDIAN_STARS", 900)
    on_disk = partial(load_matches, rows_in_memory=1700)
    monkeypatch.setattr("bayesdist.kinds.matches.init.load_matches", on_disk)
    good("init", tmp_path / "c.toml", "--matches", job.parent / "stars")
    good("check", job)
    run = tmp_path / "run"
    good("run", job, "-o", run)
    assert 900 <= max(sizes) <= 1700
    page = (run / "report.html").read_text(encoding="utf-8")
    assert "a sample of 858 of 6\u202f000 stars" in page  # every seventh
    assert "of 6000 stars flagged" in good("inspect", run).out


@pytest.mark.slow
@only_in_full("the run on disk is that in memory")
def test_the_data_are_read_once_for_all_passes(job, tmp_path):
    """The scan, the median position, the passes, what is said of each star, and the sample."""
    read = []
    real = StoredRows.load
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(StoredRows, "load", lambda self: (read.append(1), real(self))[1])
        good("run", job, "-o", tmp_path / "run")
    pieces = len(load_matches(job.parent / "stars", rows_in_memory=1700).readers())
    assert len(read) == 4 * pieces


def test_sums_over_pieces_are_those_of_the_whole(job, tmp_path):
    sums = []
    for path in (job, _job(tmp_path / "whole.toml", job.parent / "stars")):
        config, text = load_config(path)
        run = RunDirectory.plan(tmp_path / "none", config, text, job.parent)
        with Run.of(run) as results:
            sums.append(fit(results).diagnostics.sums)
    one, other = sums
    np.testing.assert_array_equal(one.exposures.n_used, other.exposures.n_used)
    for name in ("uu", "vv"):
        np.testing.assert_allclose(getattr(one.exposures, name), getattr(other.exposures, name))
    assert one.binned.keys() == other.binned.keys()
    for bins, found in one.binned.items():
        expected = other.binned[bins].residuals()
        np.testing.assert_array_equal(found.count, expected.count)
        np.testing.assert_allclose(found.residuals().mean_u, expected.mean_u, atol=1e-12)
        np.testing.assert_allclose(found.residuals().sem_v, expected.sem_v, rtol=1e-9)


@pytest.mark.slow
@only_in_full("test_kinds_of_data has such errors in memory")
def test_errors_by_magnitude_on_disk(tmp_path):
    """From the residuals of a sample, given to all: a bright star is good to 0.01 px."""

    def quoted(mag):
        sigma = 0.01 * 10 ** (0.13 * (mag - 12.0))
        return sigma, sigma

    rng = np.random.default_rng(5)
    matches, _ = simulated(
        N, seed=10, mag=rng.uniform(12, 18, N), sigma=quoted, jitter=0.0, fraction=0.02
    )
    write_partitioned([matches], tmp_path / "stars", rows_per_group=500)
    data = {
        "matches": str(tmp_path / "stars"),
        "sigma": "by_magnitude",
        "rows_in_memory": 1700,
    }
    exact = {"name": "reference catalogue", "kind": "random", "sigma_u": 0.0, "sigma_v": 0.0}
    budget = [exact | {"source": "exact in the simulation"}]
    config = write_config(tmp_path / "c.toml", data=data, budget=budget)
    assert "(by magnitude)" in good("check", config).out
    run = partly_run(tmp_path / "run", config, "fit", "sample", "assess")
    posterior = load_posterior(run)
    assert posterior.n_stars == N and 0.01 < posterior.n_flagged / N < 0.03
    assert not summary_of(run)["warnings"]


@pytest.mark.slow
@only_in_full("the run on disk is that in memory")
def test_the_epoch_of_the_assessment_is_the_latest_of_the_data(tmp_path):
    names = ("a", "b", "c")
    model = model_of(time=TimeDependence((("u", 1, 0),), (2004.5,)), exposures=names)
    matches, _ = simulate_matches(
        model, truth_of(model), 3000, rng=np.random.default_rng(6), sigma=0.02, outlier_scale=0.5,
        epochs=(2004.0, 2007.0, 2008.0),
    )  # fmt: skip
    write_partitioned([matches], tmp_path / "stars", rows_per_group=500)
    config = write_config(
        tmp_path / "c.toml",
        data={"matches": str(tmp_path / "stars"), "rows_in_memory": 1700},
        **{"model.tdd": {"epoch0": 2004.5, "terms": [["u", 1, 0]]}},
    )
    run = partly_run(tmp_path / "run", config, "fit", "sample", "assess")
    assert summary_of(run)["map"]["epoch"] == 2008.0


def test_a_run_inside_the_folder_of_its_input_is_refused(job, tmp_path):
    """Its own files would be read as input when it is resumed."""
    matches, _ = simulated(400)
    write_partitioned([matches], tmp_path / "stars")
    config = write_config(tmp_path / "c.toml", data={"matches": "stars"})
    words = ["stars/run", "inside the folder of its input"]
    refused(tmp_path, "run", config, "-o", tmp_path / "stars" / "run", words=words)
