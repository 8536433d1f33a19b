"""The Dask engine gives what threads give, whatever happens to its workers.

Sums are compared to the last bit.  What has gone through a kernel is compared to rounding: a
process that has just compiled it and one that reads it from the cache need not agree in the last
bits.
"""

from __future__ import annotations

import logging
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import dask
import numpy as np
import psutil
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from distributed import Client, LocalCluster

from bayesdist import errors
from bayesdist.data import open_matches
from bayesdist.infer import Compute, fit_linear, load, sample
from bayesdist.infer.stars import cluster as cluster_module
from bayesdist.infer.stars.cluster import ClusterShards
from bayesdist.infer.stars.shards import Shards
from tests.batched import in_batches
from tests.infer.support import TWO_CHIPS, simulated
from tests.infer.workers import local_workers
from tests.reduced import only_in_full

PIECE = 500
N = 2200  # five pieces on three workers

pytestmark = [
    pytest.mark.usefixtures("forked_workers"),
    pytest.mark.timeout(120),
]


@pytest.fixture(scope="module")
def cluster(forked_workers) -> Iterator[LocalCluster]:
    """Three workers that somebody else has started."""
    with local_workers(3) as cluster:
        yield cluster


@pytest.fixture(scope="module")
def compute(cluster) -> Compute:
    return Compute(engine="dask", scheduler=cluster.scheduler_address)


@pytest.fixture(scope="module")
def problem():
    """Model and matches with false matches."""
    model, matches, _ = simulated(11, N, order=3, fraction=0.03)
    return model, in_batches(matches, PIECE)


@pytest.fixture(scope="module")
def by_threads(problem):
    """Fit and posterior as threads find them."""
    model, matches = problem
    fit = fit_linear(matches, model)
    return fit, sample(fit, matches, seed=5)


@pytest.fixture
def there(problem, compute) -> Iterator[ClusterShards]:
    """The matches on the workers."""
    model, matches = problem
    shards = load(model, matches, compute)
    yield shards
    shards.close()


def write(path, matches, **changes):
    """A Parquet file with row groups as large as a piece."""
    matches = matches.load()
    columns = {name: getattr(matches, name) for name in "xyuv"}
    columns |= {"su": matches.sigma_u, "sv": matches.sigma_v, **changes}
    units = {"unit": matches.unit}
    fields = [pa.field(n, pa.float64(), metadata=units if n in "uv" else None) for n in columns]
    table = pa.table([pa.array(c) for c in columns.values()], schema=pa.schema(fields))
    pq.write_table(table, path, row_group_size=PIECE)
    return path


def assert_close(a, b, scale=1.0):
    """To 1e-10 of the larger of the value and its scale."""
    error = np.abs(np.asarray(a) - b) / np.maximum(np.abs(b), scale)
    assert error.max() <= 1e-10, error.max()


def assert_same_fit(a, b):
    sigma = b.sigma
    assert_close(a.mean, b.mean, sigma)
    assert_close(a.cov, b.cov, np.outer(sigma, sigma))
    for name in ("rms_u", "rms_v", "chi2"):
        assert_close(getattr(a, name), getattr(b, name))
    assert (a.n_rows, a.n_used, a.rejected) == (b.n_rows, b.n_used, b.rejected)


def assert_same_draws(a, b):
    """The same random numbers and decisions, hence the same chains."""
    assert a.theta.shape == b.theta.shape
    assert_close(a.theta, b.theta, b.theta.std(axis=(0, 1)))
    assert_close(a.log_prob, b.log_prob)
    for name, values in b.hyper.items():
        assert_close(a.hyper[name], values, values.std())
    assert a.n_flagged == b.n_flagged
    assert_close(a.n_false, b.n_false)


# -- tasks ----------------------------------------------------------------------------------------


def pid_of(stars) -> tuple[int, ...]:
    return (os.getpid(),)


def first_u(stars) -> float:
    return float(stars.u[0])


def count_and_fail(stars, folder, bad) -> int:
    """Leaves a mark for each run; fails on shards that begin with a star in `bad`."""
    (folder / f"{time.monotonic_ns()}-{os.getpid()}").touch()
    if stars.u[0] in bad:
        raise errors.InputError("the star is bad", where=f"u = {stars.u[0]!r}", do="drop it")
    return 1


def die_once(stars, mark, u) -> float:
    """Takes the worker down in the middle of the task, the first time it sees one shard."""
    if stars.u[0] == u and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return float(stars.u.sum())


def die(stars) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def sum_of_u(stars) -> float:
    return float(stars.u.sum())


def add_large(stars, array) -> np.ndarray:
    return stars.u.sum() * array


def rest(stars, seconds) -> int:
    time.sleep(seconds)
    return 1


def first_shard(stars) -> tuple[tuple[float, ...], ...]:
    return (tuple(stars.u),)


# -- the same result ------------------------------------------------------------------------------


def test_table_in_memory(problem, compute, by_threads):
    model, matches = problem
    fit = fit_linear(matches, model, compute=compute)
    assert_same_fit(fit, by_threads[0])
    assert_same_draws(sample(fit, matches, seed=5, compute=compute), by_threads[1])


def test_table_in_memory_by_files(problem, compute, by_threads, tmp_path):
    model, matches = problem
    shards = load(model, matches.load(), replace(compute, scratch=str(tmp_path)))
    try:
        assert [path.name for path in tmp_path.rglob("*.h5")] == ["000000.h5"]
        assert_same_fit(fit_linear(shards, model), by_threads[0])
    finally:
        shards.close()
    assert not list(tmp_path.iterdir())


def test_table_on_disk_by_a_relative_path(problem, compute, by_threads, tmp_path, monkeypatch):
    """The workers stand in another folder than we do."""
    model, matches = problem
    write(tmp_path / "stars.parquet", matches)
    monkeypatch.chdir(tmp_path)
    opened = open_matches("stars.parquet", batch_rows=PIECE)
    assert len(opened.readers()) == 5
    (tmp_path / "scratch").mkdir()
    shards = load(model, opened, replace(compute, scratch=str(tmp_path / "scratch")))
    try:
        assert len(shards) == N
        assert not list(tmp_path.rglob("*.h5"))  # they are files already
        assert np.concatenate(shards.sum(first_shard)).tobytes() == matches.load().u.tobytes()
        assert_same_fit(fit_linear(shards, model), by_threads[0])
        assert_same_draws(sample(by_threads[0], shards, seed=5), by_threads[1])
    finally:
        shards.close()


def test_pieces_that_hold_other_exposures(compute):
    model, matches, _ = simulated(3, N, frames="shift_rotation", n_exposures=4, chips=TWO_CHIPS)
    matches = matches.select(np.argsort(matches.exposure, kind="stable"))
    matches = in_batches(matches, PIECE)
    assert_same_fit(fit_linear(matches, model, compute=compute), fit_linear(matches, model))


@pytest.mark.parametrize("n_shards", [3, 5, 12])
def test_shards_are_spread_evenly_and_stay(problem, compute, n_shards):
    """Only sums travel: no shard has been copied after some passes."""
    model, matches = problem
    shards = load(model, in_batches(matches.load(), -(-N // n_shards)), compute)
    pids = shards.sum(pid_of)
    assert len(pids) == n_shards
    counts = [pids.count(pid) for pid in set(pids)]
    assert len(counts) == 3 and max(counts) - min(counts) <= 1
    for _ in range(8):
        assert shards.sum(pid_of) == pids
    copies = shards._pieces._client.who_has(shards._pieces._pieces).values()
    assert [len(workers) for workers in copies] == [1] * n_shards
    shards.close()


def test_large_arguments_are_the_same_everywhere(there, problem):
    large = np.arange(30_000.0)
    here = load(*problem)
    assert there.sum(add_large, large).tobytes() == here.sum(add_large, large).tobytes()


def test_scheduler_knows_how_large_a_shard_is(there, cluster):
    """Otherwise it would move shards as if they were nothing."""
    n_columns = 5  # var_u and var_v are one
    held = cluster.scheduler.tasks[there._pieces._pieces[0].key].nbytes
    assert held >= 8 * n_columns * N / 5


# -- workers that die -----------------------------------------------------------------------------


@dataclass
class Interrupted(Shards):
    """Shards, of whose workers one is killed while a pass is under way."""

    shards: Shards
    victim: int
    at: int
    passes: int = 0
    killed: bool = False

    def __post_init__(self):
        self.model, self.survey = self.shards.model, self.shards.survey

    def close(self):
        self.shards.close()

    def sum(self, task, *args):
        self.passes += 1
        if self.passes != self.at:
            return self.shards.sum(task, *args)
        timer = threading.Timer(0.01, os.kill, (self.victim, signal.SIGKILL))
        timer.start()
        try:
            return self.shards.sum(task, *args)
        finally:
            timer.join()
            self.killed = True


def test_one_of_three_workers_is_killed_while_sampling(there, problem, by_threads):
    fit, expected = by_threads
    before = there.sum(pid_of)
    counted = Interrupted(load(*problem), 0, -1)
    sample(fit, counted, seed=5)
    struck = Interrupted(there, before[0], counted.passes // 2)
    assert_same_draws(sample(fit, struck, seed=5), expected)
    assert struck.killed and struck.passes == counted.passes
    after = there.sum(pid_of)
    assert before[0] not in after and len(after) == len(before)


@pytest.mark.slow
@only_in_full("one of three is killed while sampling")
def test_worker_dies_of_a_task_that_then_succeeds(there, problem, tmp_path):
    """It was at work on the shard when it died, and held another."""
    here = load(*problem)
    u = load(*problem).sum(lambda stars: (stars.u[0],))[3]
    assert there.sum(die_once, tmp_path / "mark", u) == here.sum(sum_of_u)
    assert (tmp_path / "mark").exists()


@pytest.mark.slow
@only_in_full("a worker's death, and that of all while they read, are run")
def test_task_that_kills_every_worker_ends_with_an_error(there, cluster):
    before = cluster.scheduler.allowed_failures
    # with 0, a shard that is read again where such a task runs would be given up as well
    cluster.scheduler.allowed_failures = 2
    try:
        with pytest.raises(errors.InputError, match="workers die repeatedly"):
            there.sum(die)
    finally:
        cluster.scheduler.allowed_failures = before
    # all three were gone for a moment; now that they are back, so are the shards
    with Client(cluster) as client:
        client.wait_for_workers(3, timeout=60)
    assert isinstance(there.sum(first_u), float)


@pytest.mark.slow
@only_in_full("three workers are run, and one is lost")
def test_worker_of_two_threads_and_then_none(problem, by_threads, monkeypatch):
    """Its two threads do not get into each other's way; without workers there is an end of it."""
    monkeypatch.setattr(cluster_module, "PATIENCE", 1.5)
    model, matches = problem
    with LocalCluster(
        n_workers=1,
        processes=True,
        threads_per_worker=2,
        dashboard_address="127.0.0.1:0",
        silence_logs=logging.CRITICAL,
    ) as lonely:
        shards = load(model, matches, Compute(engine="dask", scheduler=lonely.scheduler_address))
        assert_same_fit(fit_linear(shards, model), by_threads[0])
        lonely.scale(0)
        started = time.monotonic()
        with pytest.raises(errors.InputError, match=r"has had no workers for 1\.5 seconds; start"):
            shards.sum(rest, 0.1)
        assert time.monotonic() - started < 15
        shards.close()
        with pytest.raises(errors.InputError, match=r"has no workers after 1\.5 seconds"):
            load(model, matches, Compute(engine="dask", scheduler=lonely.scheduler_address))


@dataclass(frozen=True)
class DeadlyReader:
    """Kills who reads it."""

    def __len__(self) -> int:
        return 1

    def load(self):
        os.kill(os.getpid(), signal.SIGKILL)


class DeadlyMatches:
    in_memory = False

    def __len__(self) -> int:
        return 1

    def readers(self):
        return (DeadlyReader(),)


def test_all_workers_lost_while_they_read(problem):
    """Dask would wait for ever for the worker that the piece was given to."""
    before = worker_pids()
    with pytest.raises(errors.InputError, match="all workers were lost while they read the stars"):
        ClusterShards(problem[0], DeadlyMatches(), Compute(engine="dask", workers=1))
    assert worker_pids() == before


# -- errors ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name",
    [
        name
        for name in errors.__all__
        if isinstance(getattr(errors, name), type)
        and issubclass(getattr(errors, name), errors.BayesdistError)
    ],
)
def test_errors_survive_the_wire(name):
    error = getattr(errors, name)("sigma is -0.1.", where="a.parquet, row 3", do="drop it.")
    back = pickle.loads(pickle.dumps(error))
    assert type(back) is type(error)
    assert (str(back), back.cause, back.where, back.do, back.exit_code) == (
        str(error), error.cause, error.where, error.do, error.exit_code,
    )  # fmt: skip


def test_bad_row_found_by_a_worker(problem, compute, tmp_path):
    """The file has got a NaN since it was opened: the sentence is that of threads."""
    model, matches = problem
    path = write(tmp_path / "stars.parquet", matches)
    opened = open_matches(path, batch_rows=PIECE)
    v = matches.load().v.copy()
    v[1234] = np.nan
    write(path, matches, v=v)
    said = []
    for engine in (Compute(), compute):
        with pytest.raises(errors.InputError) as caught:
            load(model, opened, engine)
        said.append((type(caught.value), str(caught.value)))
    assert said[0] == said[1]
    assert all(part in said[1][1] for part in (str(path), "row group 3 of 5", "row 1235"))


def test_the_first_error_in_the_order_of_the_shards_and_no_second_try(there, problem, tmp_path):
    u = load(*problem).sum(lambda stars: (stars.u[0],))
    with pytest.raises(errors.InputError) as caught:
        there.sum(count_and_fail, tmp_path, (u[3], u[1]))
    assert caught.value.where == f"u = {u[1]!r}"
    # a second try would stand in the queues of the workers before the next pass does
    assert there.sum(first_u) == load(*problem).sum(first_u)
    assert len(list(tmp_path.iterdir())) <= 5


@pytest.mark.parametrize(
    "address", ["tcp://127.0.0.1:9", "not an address", "nothing://here:1", "tcp://here"]
)
def test_unreachable_scheduler(problem, address, monkeypatch):
    monkeypatch.setattr(cluster_module, "CONNECT", 0.5)
    with pytest.raises(errors.InputError, match="no Dask scheduler answers at") as caught:
        load(*problem, Compute(engine="dask", scheduler=address))
    assert address in str(caught.value) and caught.value.where == "compute.scheduler"


def test_other_version_on_the_workers(problem, compute, monkeypatch):
    monkeypatch.setattr(cluster_module, "__version__", "99.0")
    with pytest.raises(errors.InputError, match=r"has bayesdist .*, but here it is 99\.0"):
        load(*problem, compute)


def test_distributed_is_not_installed(problem, monkeypatch):
    monkeypatch.delitem(sys.modules, "bayesdist.infer.stars.cluster")
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(errors.InputError, match=r"pip install 'bayesdist\[dask\]'"):
        load(*problem, Compute(engine="dask"))


def test_no_workers_are_asked_for(problem):
    with pytest.raises(errors.InputError, match="the number of workers is 0"):
        load(*problem, Compute(engine="dask", workers=0))


# -- our own cluster ------------------------------------------------------------------------------


SCRIPT = """
import sys
from bayesdist.infer import Compute, load
from tests.infer.support import simulated

def main():
    model, matches, _ = simulated(1, 300)
    shards = load(model, matches, Compute(engine="dask", workers=1))
    print(len(shards), flush=True)
    raise SystemExit(5)

if __name__ == "__main__":
    main()
"""


def worker_pids() -> set[int]:
    """Our children, zombies included, but for the resource tracker that multiprocessing keeps."""
    out = set()
    for process in psutil.Process().children(recursive=True):
        try:
            if "resource_tracker" not in " ".join(process.cmdline()):
                out.add(process.pid)
        except psutil.ZombieProcess:
            out.add(process.pid)
        except psutil.NoSuchProcess:
            pass
    return out


def test_own_cluster_ends_with_the_shards(problem, by_threads):
    """With its processes: none is left, not even as a zombie.

    Until then scheduler and workers listen at the loopback alone, with all their ports.
    """
    before = worker_pids()
    model, matches = problem
    shards = load(model, matches, Compute(engine="dask", workers=1))
    try:
        assert len(worker_pids() - before) == 1
        assert_same_fit(fit_linear(shards, model), by_threads[0])
        processes = [psutil.Process(), *map(psutil.Process, worker_pids())]
        listening = {
            one.laddr.ip
            for process in processes
            for one in process.net_connections("inet")
            if one.status == psutil.CONN_LISTEN
        }
    finally:
        shards.close()
    assert worker_pids() == before
    shards.close()  # once more does no harm
    assert listening == {"127.0.0.1"}


@pytest.fixture
def secured(tmp_path) -> dict[str, str]:
    """Settings of distributed for a cluster that asks for a certificate of its own authority."""
    certificate, key = tmp_path / "cert.pem", tmp_path / "key.pem"
    try:
        subprocess.run(
            [
                *"openssl req -x509 -newkey rsa:2048 -nodes -days 1 -subj /CN=cluster".split(),
                *("-keyout", str(key), "-out", str(certificate)),
            ],
            check=True,
            capture_output=True,
        )
    except FileNotFoundError:
        pytest.skip("there is no openssl to make a certificate")
    names = ("scheduler", "worker", "client")
    tls = "distributed.comm.tls"
    own = {f"{tls}.{one}.{part}": str(path) for one in names
           for part, path in (("cert", certificate), ("key", key))}  # fmt: skip
    return {"distributed.comm.require-encryption": True, f"{tls}.ca-file": str(certificate)} | own


@pytest.mark.slow
@only_in_full("a cluster without them is run")
def test_cluster_that_asks_for_certificates(problem, by_threads, secured, tmp_path):
    """The settings of docs/scaling.md: with them the pass goes on, without them nobody connects."""
    model, matches = problem
    options = {"n_workers": 1, "threads_per_worker": 1, "memory_limit": 0, "protocol": "tls"}
    options |= {"dashboard_address": "127.0.0.1:0", "silence_logs": logging.CRITICAL}
    with dask.config.set(secured), LocalCluster(**options) as safe:
        compute = Compute(engine="dask", scheduler=safe.scheduler_address)
        assert safe.scheduler_address.startswith("tls://")
        shards = load(model, matches, compute)
        assert_same_fit(fit_linear(shards, model), by_threads[0])
        shards.close()
        without = {key: None for key in secured if "require" not in key}
        with (
            dask.config.set({**without, "distributed.comm.require-encryption": False}),
            pytest.raises(errors.InputError, match="no Dask scheduler answers at"),
        ):
            load(model, matches, compute)


def test_own_cluster_ends_when_the_program_does(tmp_path):
    """By an error, without a word, and with the error's own exit code."""
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    run = subprocess.run(
        [sys.executable, "-W", "error", str(script)],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        timeout=60,
    )
    assert (run.returncode, run.stdout, run.stderr) == (5, "300\n", "")
