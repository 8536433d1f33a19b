"""The posterior as a data tree: the content of posterior.nc, opened by ArviZ."""

from __future__ import annotations

import json
import os
import subprocess
import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from bayesdist.infer import fit_linear, posterior_datatree, sample, save_posterior

from ..support import simulated

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def posterior():
    model, matches, _ = simulated(5, 200)
    return sample(fit_linear(matches, model), matches, max_steps=60, seed=8), matches


def test_the_tree_has_the_content_of_the_file(posterior, tmp_path):
    drawn, matches = posterior
    tree = posterior_datatree(drawn, matches)
    save_posterior(drawn, matches, tmp_path / "posterior.nc")
    with xr.open_datatree(tmp_path / "posterior.nc", engine="h5netcdf") as stored:
        assert set(tree.groups) == set(stored.groups)
        for name in stored.groups:
            assert set(tree[name].data_vars) == set(stored[name].data_vars), name
            for key, values in stored[name].data_vars.items():
                np.testing.assert_array_equal(tree[name][key], values)
                assert tree[name][key].dims == values.dims
            assert set(tree[name].attrs) == set(stored[name].attrs) - {"checked", "checksum"}, name
    alone = drawn.to_datatree()
    assert set(alone.children) == {"posterior", "sample_stats", "diagnostics"}
    assert alone["posterior"]["theta"].dims == ("chain", "draw", "parameter")
    assert list(alone["posterior"]["parameter"].values) == list(drawn.model.names)
    assert json.loads(alone["posterior"].attrs["units"]) == list(drawn.model.units)


def test_arviz_takes_the_tree_and_its_file(posterior, tmp_path):
    drawn, matches = posterior
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        az = pytest.importorskip("arviz")
    tree = posterior_datatree(drawn, matches)
    tree.to_netcdf(tmp_path / "tree.nc", engine="h5netcdf")
    for data in (az.from_datatree(tree), az.from_netcdf(tmp_path / "tree.nc")):
        summary = az.summary(data, var_names=["theta"], kind="stats", round_to="none")
        np.testing.assert_allclose(summary["mean"], drawn.mean, rtol=1e-9, atol=1e-12)


NEW_ARVIZ = """
import sys, numpy, arviz, xarray
assert int(arviz.__version__.split(".")[0]) >= 1
for path in sys.argv[1:]:
    tree = xarray.open_datatree(path, engine="h5netcdf")
    summary = arviz.summary(tree, round_to="none")
    mean = tree["posterior"]["theta"].mean(("chain", "draw")).values
    found = summary["mean"].values[: mean.size].astype(float)
    numpy.testing.assert_allclose(found, mean, rtol=1e-9, atol=1e-12)
    assert arviz.ess(tree)["theta"].shape == mean.shape
"""


def test_arviz_1_takes_both_files(posterior, tmp_path):
    """With ARVIZ_1_PYTHON, an interpreter that has ArviZ 1.x (Python 3.12), h5netcdf and h5py."""
    python = os.environ.get("ARVIZ_1_PYTHON", "")
    if not python or not Path(python).exists():
        pytest.skip("ARVIZ_1_PYTHON names no interpreter with ArviZ 1.x")
    drawn, matches = posterior
    drawn.to_datatree().to_netcdf(tmp_path / "tree.nc", engine="h5netcdf")
    save_posterior(drawn, None, tmp_path / "posterior.nc")
    save_posterior(drawn, matches, tmp_path / "whole.nc")
    paths = [str(tmp_path / name) for name in ("tree.nc", "posterior.nc", "whole.nc")]
    done = subprocess.run(
        [python, "-c", NEW_ARVIZ, *paths], capture_output=True, text=True, cwd=tmp_path,
        env={k: v for k, v in os.environ.items() if k != "PYTHONPATH"}, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
