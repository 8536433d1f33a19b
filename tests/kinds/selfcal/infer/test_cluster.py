"""Detections on the workers of a cluster give what they give in one process.

Random numbers and decisions are the same, and sums over pieces differ from those over the whole by
rounding alone.
"""

from __future__ import annotations

import os
import shutil
import signal
import sys
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import pytest

from bayesdist.errors import InputError
from bayesdist.files.hdf5 import write_record
from bayesdist.infer import Compute
from bayesdist.infer.equations.priors import Prior
from bayesdist.infer.stars import cluster as cluster_module
from bayesdist.infer.stars import shards
from bayesdist.infer.stars.cluster import ClusterPieces
from bayesdist.kinds.selfcal import grouping as friends
from bayesdist.kinds.selfcal.grouping import friends_of_friends, grouped
from bayesdist.kinds.selfcal.infer import (
    elimination,
    sample_selfcal,
    self_calibrate,
    star_catalogue,
)
from bayesdist.kinds.selfcal.infer.elimination import (
    Mixture,
    StarModes,
    StarPiece,
    each_of,
    expand,
    in_pieces,
    log_density,
    slope,
    to_sample,
)
from bayesdist.kinds.selfcal.infer.mode import mode_at, solve_in_gauge
from bayesdist.kinds.selfcal.infer.posterior import SelfTarget
from bayesdist.kinds.selfcal.infer.problem import StarPriors, places_of
from tests.infer.workers import local_workers
from tests.kinds.selfcal.infer import fields
from tests.reduced import only_in_full

PIECE = 320  # detections: three pieces on two workers
SMALL = 150  # of which there are more, for trees and files

pytestmark = [pytest.mark.usefixtures("forked_workers"), pytest.mark.timeout(300)]


@pytest.fixture(scope="module")
def start():
    """Problem with false detections, and stars that have a prior; parameters to begin with."""
    simulated = fields.field(3, 8, 300, n_chips=2, disturbed=0.03)
    problem, stars = fields.problem_of(simulated, min_detections=3)
    priors = StarPriors.none(problem.n_stars, problem.n_star)
    priors.precision[::5] += np.eye(2) / 0.02**2
    priors.centre[::5] = stars[::5]
    problem.priors.centre[:], problem.priors.precision[:] = priors.centre, priors.precision
    return problem, simulated.theta


@pytest.fixture(scope="module")
def solution(start):
    return solve_in_gauge(*start, Prior.none)


@pytest.fixture(scope="module")
def cluster(forked_workers):
    """Two workers that somebody else has started."""
    with local_workers(2) as cluster:
        yield cluster


@pytest.fixture
def compute(cluster, monkeypatch) -> Compute:
    monkeypatch.setattr(elimination, "PIECE", PIECE)
    monkeypatch.setattr(friends, "CELL", PIECE)
    return Compute(engine="dask", scheduler=cluster.scheduler_address)


def assert_close(a, b, scale=1.0):
    """To 1e-10 of the larger of the value and its scale."""
    error = np.abs(np.asarray(a) - b) / np.maximum(np.abs(b), scale)
    assert error.max() <= 1e-10, error.max()


def assert_same_draws(a, b):
    """The same random numbers and decisions, hence the same chains."""
    assert a.theta.shape == b.theta.shape
    free = b.theta.std(axis=(0, 1)) > 0
    assert_close(a.theta[..., free], b.theta[..., free], b.theta.std(axis=(0, 1))[free])
    assert_close(a.log_prob, b.log_prob)
    for name, values in b.hyper.items():
        assert_close(a.hyper[name], values, values.std())


# -- tasks ----------------------------------------------------------------------------------------


def pid_of(piece) -> tuple[int, ...]:
    return (os.getpid(),)


def content(piece) -> tuple[np.ndarray, ...]:
    return (piece.problem.var,)


def inverse_variances(piece) -> np.ndarray:
    """Numbers of all sizes, whose sum depends on the order."""
    return np.array([np.sum(1 / piece.problem.var), np.sum(piece.problem.X)])


def failing(piece) -> float:
    return 1 / 0


def die_once(piece, mark, first) -> np.ndarray:
    """Takes the worker down in the middle of the task, the first time it sees one piece."""
    if piece.problem.X[0] == first and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return piece.problem.var[:1]


def grouped_after_death(cell, mark, last):
    """Takes the worker down that has the last detection, the first time."""
    if not mark.exists() and cell.rows[cell.inside][-1] == last:
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return grouped(cell)


# -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1, 50, PIECE, 10**9])
def test_pieces_hold_each_star_once_with_all_its_detections(solution, size):
    whole = StarPiece(solution.problem, solution.stars)
    parts = list(whole.split(size))
    problems = [part.problem for part in parts]
    counts = np.concatenate([p.counts for p in problems])
    assert np.array_equal(counts, solution.problem.counts)
    for name in ("X", "Y", "offset", "W", "var"):
        joined = np.concatenate([getattr(p, name) for p in problems])
        assert np.array_equal(joined, getattr(solution.problem, name)), name
    assert np.array_equal(np.concatenate([part.stars for part in parts]), solution.stars)
    most = solution.problem.counts.max()
    assert max(len(p) for p in problems) < size + most
    assert (len(parts) == 1) == (size > len(solution.problem))


def test_density_and_slope_are_those_of_the_whole(solution, compute):
    """At draws about the mode, and at the mode itself, where the slope vanishes."""
    rng = np.random.default_rng(1)
    off = np.zeros((20, len(solution.theta)))
    off[:, solution.free] = rng.multivariate_normal(
        np.zeros(len(solution.free)), np.linalg.inv(solution.precision), 20
    )
    theta = solution.theta + off
    mixtures = np.column_stack([rng.uniform(0.001, 0.05, 20), rng.uniform(0.001, 0.1, 20)])
    all_stars = solution.problem, solution.stars
    with in_pieces(*all_stars) as here, in_pieces(*all_stars, compute) as there:
        here, there = (
            one.map(to_sample, solution.theta, solution.mixture) for one in (here, there)
        )
        assert len(set(there.sum(pid_of))) == 2
        assert_close(
            there.sum(log_density, theta, mixtures), here.sum(log_density, theta, mixtures)
        )
        for observed in (True, False):
            mixture = Mixture(0.01, 0.02)
            a, b = (one.sum(slope, theta[0], mixture, observed) for one in (there, here))
            root = np.sqrt(np.diag(b.curvature))
            assert_close(a.gradient, b.gradient, root)
            assert_close(a.curvature, b.curvature, np.outer(root, root))
        found = here.sum(slope, solution.theta, solution.mixture, True)
    known = solution.expansion
    root = np.sqrt(np.diag(known.curvature))
    assert_close(found.curvature, known.curvature, np.outer(root, root))
    assert np.abs(found.gradient[solution.free] / root[solution.free]).max() < 0.01
    _, again = expand(solution.problem, theta[0], Mixture(0.01, 0.02), solution.stars.copy())
    modes = StarModes.at(solution.problem, solution.theta, solution.mixture, solution.stars)
    assert np.abs(modes.moved(solution.problem, theta[0]) - again).max() < 0.01


def test_sums_by_a_tree_of_workers_are_those_of_one_process(solution, compute, monkeypatch):
    """In the same order, bit for bit; and only the last branches come back."""
    monkeypatch.setattr(elimination, "PIECE", SMALL)
    monkeypatch.setattr(shards, "BRANCHES", 2)
    monkeypatch.setattr(cluster_module, "BRANCHES", 2)
    fetched, inner = [], ClusterPieces._results

    def counted(self, futures):
        fetched.append(len(futures))
        return inner(self, futures)

    with in_pieces(solution.problem, solution.stars, compute) as there:
        parts = list(there.each(inverse_variances))
        assert len(parts) > 4  # three levels
        monkeypatch.setattr(ClusterPieces, "_results", counted)
        assert np.array_equal(there.sum(inverse_variances), shards.total(parts))
        assert np.array_equal(np.concatenate(there.sum(content)), solution.problem.var)
        assert fetched and max(fetched) <= 2
        with pytest.raises(ZeroDivisionError):
            there.sum(failing)


def assert_same_mode(a, b):
    """Parameters, stars, curvatures, and detections as linearised there."""
    sigma = np.sqrt(np.diag(b.cov))
    free = sigma > 0
    assert np.array_equal(a.free, b.free) and np.array_equal(a.decision.held, b.decision.held)
    assert_close(a.theta[free], b.theta[free], sigma[free])
    assert_close(a.stars, b.stars, b.error * b.problem.pixel)
    assert_close(a.mixture.jitter, b.mixture.jitter)
    assert_close(a.mixture.fraction, b.mixture.fraction)
    for one, other in (
        (a.expansion.curvature, b.expansion.curvature),
        *zip(a.curvatures, b.curvatures, strict=True),
    ):
        root = np.sqrt(np.diag(other))
        assert_close(one, other, np.outer(root, root))
    for name in ("X", "Y", "offset", "W"):
        assert_close(getattr(a.problem, name), getattr(b.problem, name)), name


def test_solution_and_stars_are_those_of_one_process(start, solution, compute):
    found = solve_in_gauge(*start, Prior.none, compute=compute)
    assert_same_mode(found, solution)
    again = mode_at(
        *(solution.problem, solution.theta, solution.stars, solution.mixture, solution.free),
        *(solution.prior, solution.decision),
        compute=compute,
    )
    assert_same_mode(again, solution)
    here, there = star_catalogue(solution), star_catalogue(solution, compute=compute)
    assert np.array_equal(here.values, there.values) and np.array_equal(here.n, there.n)
    assert_close(there.n_members, here.n_members)
    for name in ("cov", "own"):
        one, other = getattr(there, name), getattr(here, name)
        root = np.sqrt(np.diagonal(other, axis1=1, axis2=2))
        assert_close(one, other, root[:, :, None] * root[:, None])


@pytest.mark.slow
@only_in_full("solution and stars are those of one process")
@pytest.mark.parametrize("by_files", [False, True])
def test_stars_are_those_of_one_process(compute, by_files, tmp_path):
    """Detections are grouped, solved and grouped again on the workers."""
    if by_files:
        compute = replace(compute, scratch=str(tmp_path))
    simulated = fields.field(4, 6, 200, disturbed=0.03)
    given = simulated.model, simulated.unlabelled, simulated.theta
    more = {"match_radius": 1.0, "start_radius": 4.0, "min_detections": 3}
    here, there = self_calibrate(*given, **more), self_calibrate(*given, **more, compute=compute)
    assert np.array_equal(there.friends.star, here.friends.star)
    assert there.friends.n_ambiguous == here.friends.n_ambiguous
    assert there.iterations == here.iterations > 1
    assert_same_mode(there.mode, here.mode)
    assert not list(tmp_path.iterdir())


def test_workers_read_pieces_from_files_again_where_one_is_lost(
    solution, compute, tmp_path, monkeypatch
):
    """The scheduler has their paths alone; they are removed at the end."""
    monkeypatch.setattr(elimination, "PIECE", SMALL)
    folder, mark = tmp_path / "scratch", tmp_path / "mark"
    folder.mkdir()
    compute = replace(compute, scratch=str(folder))
    with in_pieces(solution.problem, solution.stars, compute) as there:
        files = list(folder.glob("bayesdist-*/*.h5"))
        parts = list(there.each(content))
        assert len(files) == len(parts) > 4
        assert sum(f.stat().st_size for f in files) > 80 * len(solution.problem)
        there.sum(die_once, mark, solution.problem.X[0])
        assert mark.exists()
        assert np.array_equal(np.concatenate(there.sum(content)), solution.problem.var)
    assert not list(folder.iterdir())


def test_scratch_folder_that_workers_do_not_see(solution, compute, tmp_path, monkeypatch):
    monkeypatch.setattr(cluster_module, "write_record", lambda *_: None)
    given = solution.problem, solution.stars
    unseen, missing = (replace(compute, scratch=str(p)) for p in (tmp_path, tmp_path / "nowhere"))
    message = r"000000\.h5.*compute.scratch that all workers see"
    with pytest.raises(InputError, match=message), in_pieces(*given, unseen):
        pass
    assert not list(tmp_path.iterdir())
    message = r"compute\.scratch: .*nowhere.*name a writable folder"
    with pytest.raises(InputError, match=message), in_pieces(*given, missing):
        pass


def test_damaged_file_in_the_scratch_folder(solution, compute, tmp_path, monkeypatch):
    def cut(path, record):
        write_record(path, record)
        os.truncate(path, path.stat().st_size // 2)

    monkeypatch.setattr(cluster_module, "write_record", cut)
    compute = replace(compute, scratch=str(tmp_path))
    message = r"000000\.h5: this is not a part of the data .* damaged .*; resume the run.*disk"
    with (
        pytest.raises(InputError, match=message),
        in_pieces(solution.problem, solution.stars, compute),
    ):
        pass
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@only_in_full("tests/infer/stars kills one of them")
def test_one_of_two_workers_is_killed_while_grouping(compute, tmp_path):
    simulated = fields.field(3, 8, 300, n_chips=2, disturbed=0.03)
    d = simulated.unlabelled
    given = places_of(simulated.model, d, simulated.theta), d.exposure, 1.0
    expected, mark = friends_of_friends(*given), tmp_path / "mark"

    def each(function, sources):
        assert function is grouped
        dying = partial(grouped_after_death, mark=mark, last=len(d) - 1)
        return each_of(compute, dying, sources)

    found = friends_of_friends(*given, each=each)
    assert mark.exists()
    assert np.array_equal(found.star, expected.star)


@pytest.mark.slow
@only_in_full("tests/infer/stars kills one of them")
def test_one_of_two_workers_is_killed_while_solving(start, solution, compute, strike):
    found = solve_in_gauge(*start, Prior.none, compute=compute)
    assert strike.victims and strike.passes > strike.at
    assert_same_mode(found, solution)


def test_posterior_is_that_of_one_process(solution, compute):
    expected = sample_selfcal(solution, seed=5, target_ess=100)
    assert_same_draws(sample_selfcal(solution, seed=5, target_ess=100, compute=compute), expected)


class InterruptionError(Exception):
    """Of a run, by its user."""


def test_run_that_was_interrupted_on_a_cluster_is_resumed(solution, compute, tmp_path, monkeypatch):
    """There or in one process: with what was computed before, and the draws of a whole run."""
    points, inner, reached = [], SelfTarget.log_density, []

    def counted(self, psi):
        points.append(len(psi))
        return inner(self, psi)

    def interrupting(step, _):
        reached.append(step)
        if len(reached) == 3:
            raise InterruptionError

    given = {"seed": 5, "target_ess": 400, "checkpoint_every": 20}
    monkeypatch.setattr(SelfTarget, "log_density", counted)
    expected, begun = sample_selfcal(solution, **given), tmp_path / "begun"
    whole = sum(points)
    begun.mkdir()
    with pytest.raises(InterruptionError):
        sample_selfcal(solution, **given, folder=begun, progress=interrupting, compute=compute)
    for name, where in (("here", None), ("there", compute)):
        shutil.copytree(begun, tmp_path / name)
        points.clear()
        resumed = sample_selfcal(solution, **given, folder=tmp_path / name, compute=where)
        assert 0 < sum(points) < 0.8 * whole
        assert_same_draws(resumed, expected)


@dataclass
class Strike:
    """Kills one worker before a pass."""

    at: int = 8
    passes: int = 0
    victims: list[int] = field(default_factory=list)


@pytest.fixture
def strike(monkeypatch) -> Strike:
    struck, inner = Strike(), ClusterPieces.sum

    def interrupted(self, task, *args):
        struck.passes += 1
        if struck.passes == struck.at:
            struck.victims.append(inner(self, pid_of)[0])
            os.kill(struck.victims[0], signal.SIGKILL)
        return inner(self, task, *args)

    monkeypatch.setattr(ClusterPieces, "sum", interrupted)
    return struck


@pytest.mark.slow
@only_in_full("tests/infer/stars kills one of them")
def test_one_of_two_workers_is_killed_while_sampling(solution, compute, strike):
    expected = sample_selfcal(solution, seed=5, target_ess=100)
    assert_same_draws(sample_selfcal(solution, seed=5, target_ess=100, compute=compute), expected)
    assert strike.victims and strike.passes > strike.at


@pytest.mark.slow
@only_in_full("tests/infer/stars kills one")
def test_worker_dies_of_a_task_and_its_pieces_are_made_again(solution, compute, tmp_path):
    with in_pieces(solution.problem, solution.stars, compute) as loaded:
        there = loaded.map(to_sample, solution.theta, solution.mixture)
        before = there.sum(content)
        first = solution.problem.X[0]
        assert there.sum(die_once, tmp_path / "mark", first) is not None
        assert (tmp_path / "mark").exists()
        after = there.sum(content)
    assert np.array_equal(np.concatenate(before), np.concatenate(after))
    assert np.array_equal(np.concatenate(after), solution.problem.var)


def test_a_cluster_knows_how_large_a_piece_is(solution):
    """Otherwise it would move pieces as if they were nothing."""
    p = solution.problem
    piece = StarPiece(p, solution.stars)
    assert sys.getsizeof(piece) > 10 * 8 * len(p)
    assert sys.getsizeof(to_sample(piece, solution.theta, solution.mixture)) > 9 * 8 * len(p)
