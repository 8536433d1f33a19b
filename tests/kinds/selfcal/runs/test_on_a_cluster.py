"""A self-calibration that asks for the Dask engine is solved and sampled by its workers."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.app.config.fit import ComputeBlock
from bayesdist.app.pipeline import fit, match, sample
from bayesdist.infer.stars import cluster
from bayesdist.kinds.selfcal.infer import elimination
from tests.app.support import in_memory
from tests.kinds.selfcal.runs.support import list_table, small, write_selfcal
from tests.reduced import only_in_full


@pytest.mark.slow
@pytest.mark.timeout(300)
@only_in_full("tests/kinds/selfcal/infer/test_cluster samples on one")
def test_draws_are_those_of_one_process(tmp_path, monkeypatch):
    passes = []

    class Counted(cluster.ClusterPieces):
        def sum(self, task, *args):
            passes.append(task)
            return super().sum(task, *args)

    monkeypatch.setattr(elimination, "PIECE", 500)
    monkeypatch.setattr(cluster, "ClusterPieces", Counted)
    sections = {"sampler": {"target_ess": 100}, "compute": {"engine": "dask", "workers": 2}}
    path = write_selfcal(tmp_path, list_table(small()), **sections)
    run = fit(match(in_memory(path)))
    assert {elimination.expansion_of, elimination.expansion} == set(passes)
    passes.clear()
    there = sample(run).posterior
    assert {elimination.log_density, elimination.slope} == set(passes)
    alone = run.with_config(run.config.model_copy(update={"compute": ComputeBlock()}))
    here = sample(alone).posterior
    sd = here.theta.std(axis=(0, 1))
    assert (np.abs(there.theta - here.theta) <= 1e-10 * np.maximum(sd, np.abs(here.theta))).all()
    np.testing.assert_allclose(there.log_prob, here.log_prob, rtol=1e-10)
