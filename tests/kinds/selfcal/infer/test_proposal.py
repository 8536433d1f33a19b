"""Nodes of the proposal where, on the way, a star lies between two modes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayesdist.errors import DegenerateError
from bayesdist.infer.equations.priors import Prior
from bayesdist.kinds.selfcal.infer import elimination, posterior
from bayesdist.kinds.selfcal.infer.mode import solve
from bayesdist.kinds.selfcal.infer.posterior import SelfTarget
from tests.kinds.selfcal.infer.fields import field, problem_of


def indefinite(when):
    """`expand` with a negative curvature in those passes for which `when(observed, k)` is true."""
    passes = {True: 0, False: 0}
    expand = elimination.expand

    def wrapped(*args, observed=True):
        passes[observed] += 1
        found, modes = expand(*args, observed=observed)
        if when(observed, passes[observed]):
            found = replace(found, curvature=-found.curvature)
        return found, modes

    return wrapped


@pytest.fixture(scope="module")
def target():
    simulated = field(6, 5, 70, order=2, disturbed=0.04)
    problem, _ = problem_of(simulated, min_detections=3)
    K = simulated.model.n_terms
    free = np.setdiff1d(np.arange(simulated.model.n_params), [0, 1, K, K + 1])
    mode = solve(problem, simulated.theta, free, Prior.none(simulated.theta))
    with elimination.in_pieces(mode.problem, mode.stars) as whole:
        yield SelfTarget(mode, whole.map(elimination.to_sample, mode.theta, mode.mixture))


def test_nodes_are_found_past_an_indefinite_curvature(target, monkeypatch):
    plain = posterior.propose(target)
    monkeypatch.setattr(elimination, "expand", indefinite(lambda observed, k: observed and k == 2))
    found = posterior.propose(target)
    sigma = np.sqrt(np.diag(target.solution.cov)[target.solution.free])
    assert len(found.nodes) == len(plain.nodes)
    for a, b in zip(found.nodes, plain.nodes, strict=True):
        assert np.abs((a.mode - b.mode)[:-1] / sigma).max() < 0.1
        assert a.log_marginal == pytest.approx(b.log_marginal, abs=0.3)


def test_what_is_indefinite_with_any_weights_is_refused(target, monkeypatch):
    monkeypatch.setattr(elimination, "expand", indefinite(lambda *_: True))
    with pytest.raises(DegenerateError, match="do not determine"):
        posterior.propose(target)


def test_nodes_between_are_those_found_one_by_one(monkeypatch):
    """Of many detections: modes in parts of their errors; densities much better than they vary."""
    simulated = field(7, 12, 3000, order=2, disturbed=0.04)
    problem, _ = problem_of(simulated, min_detections=3)
    K = simulated.model.n_terms
    free = np.setdiff1d(np.arange(simulated.model.n_params), [0, 1, K, K + 1])
    mode = solve(problem, simulated.theta, free, Prior.none(simulated.theta))
    sigma, passes = np.sqrt(np.diag(mode.cov)[free]), []
    counted = indefinite(lambda *_: bool(passes.append(1)))
    monkeypatch.setattr(elimination, "expand", counted)
    with elimination.in_pieces(mode.problem, mode.stars) as whole:
        target = SelfTarget(mode, whole.map(elimination.to_sample, mode.theta, mode.mixture))
        few, n_few = posterior.propose(target), len(passes)
        monkeypatch.setattr(posterior, "LINEAR", 0.0)
        all_nodes = posterior.propose(target)
    assert n_few < len(few.nodes) < len(passes) - n_few + 1
    for a, b in zip(few.nodes, all_nodes.nodes, strict=True):
        assert np.abs((a.mode - b.mode)[:-1] / sigma).max() < 0.01
        assert a.factor.logdet == pytest.approx(b.factor.logdet, abs=0.1)
        assert a.log_marginal == pytest.approx(b.log_marginal, abs=0.05)
