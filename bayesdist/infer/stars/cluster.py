"""The Dask engine: pieces of the data stay on the workers that made them, and only sums travel.

Each piece is the result of one task, and stays on the worker that ran it.  A pass is one
map-reduce: a task for each piece, run on its worker, whose results are added in the order of the
pieces, by the tree by which threads add them.  Workers add until few are left, which come back.  So
it is however many workers there are and whatever happens to them: a worker that is lost takes its
pieces along, and Dask makes them again elsewhere.  The result of a kernel for one piece is
reproducible up to rounding: code that was compiled for another processor may differ in the last
bits.

The only module that uses dask and distributed; it is imported when the engine is requested.
"""

from __future__ import annotations

import asyncio
import copy
import logging
import pickle
import tempfile
import threading
import weakref
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import monotonic
from typing import Any, Self

from bayesdist.data.matches import Matches
from bayesdist.errors import FormatError, InputError
from bayesdist.files.records import read_record, write_record
from bayesdist.infer import kernel
from bayesdist.infer.stars.shards import (
    BRANCHES,
    Compute,
    MappedPieces,
    Shards,
    Task,
    shard_of,
    total,
)
from bayesdist.infer.stars.stars import Stars
from bayesdist.infer.stars.survey import Survey
from bayesdist.model import DistortionModel
from bayesdist.version import __version__

try:
    import dask
    from dask.system import CPU_COUNT
    from distributed import Client, Future, KilledWorker, LocalCluster, get_worker
    from distributed.comm import resolve_address
except ModuleNotFoundError as error:
    raise InputError(
        "the Dask engine needs the package distributed",
        where="compute.engine",
        do="pip install 'bayesdist[dask]'",
    ) from error

log = logging.getLogger("bayesdist")

CONNECT = 10.0  # seconds to find the scheduler
PATIENCE = 60.0  # seconds without any worker after which none is expected any more
POLL = 1.0  # seconds between two checks for workers
ALLOWED_FAILURES = 10  # workers that a piece may lose before it counts as their killer
LARGE = 50_000  # bytes of arguments from which one worker passes them on to the others
TOGETHER = 256  # results that are fetched at a time

_one_pass = threading.Lock()  # a pass uses all threads of its process


class _Lease:
    """Held by all pieces on a cluster: without any it is closed."""


class ClusterPieces(MappedPieces):
    """Pieces on the workers of a Dask cluster, made there by one function.

    With a `scheduler` in `compute`, the cluster is that one; the version of bayesdist must be the
    same on its workers.  Otherwise `workers` processes are started here and ended by `close`, or
    when this object or the program goes; a script that does so needs the usual
    ``if __name__ == "__main__":``.  With a `scratch` in `compute` the sources, which are records
    then, are files below it until `close`; else the scheduler stores them.

    InputError when the cluster cannot be reached or started, has no workers, or has workers with
    another version of bayesdist; when the scratch folder cannot be written to, or be read there.
    """

    def __init__(self, make: Task, sources: Iterable[Any], compute: Compute) -> None:
        self._pieces: list[Future] = []
        self._loading: set[str] = set()  # workers that sources are tied to
        self._client, cluster = _connected(compute)
        self._where = self._client.scheduler.address
        self._lease = _Lease()
        files = ExitStack()
        self._end = weakref.finalize(self._lease, _end, self._client, cluster, files)
        try:
            folder = _folder_in(compute.scratch, files) if compute.scratch is not None else None
            places = _places(self._client)
            self._loading = set(places)
            _require_version(self._client)
            # sources stay in files or in the scheduler, so that a lost piece can be made again
            with _large_graphs():
                for k, source in enumerate(sources):
                    self._pieces.append(
                        self._client.submit(
                            _made_from,
                            make,
                            source if folder is None else _Written.as_number(k, source, folder),
                            workers=[places[k % len(places)]],
                            allow_other_workers=True,
                            pure=False,
                        )
                    )
            for _ in self._results(self._on_each(_made)):
                pass
            self._settle()
        except BaseException:
            self.close()
            raise

    def sum(self, task: Task, *args: Any) -> Any:
        """Sum over the pieces of ``task(piece, *args)``, in their order.

        InputError when there are no workers any more, or when they die of the task; else any
        exception that the task raises on the first piece, in their order, that it fails on; of more
        than `BRANCHES` pieces, on one of the first branch.
        """
        with _large_graphs():
            parts = self._tasks(task, args)
            while len(parts) > BRANCHES:
                parts = [
                    self._client.submit(total, parts[k : k + BRANCHES], pure=False)
                    for k in range(0, len(parts), BRANCHES)
                ]
            return total(self._results(parts))

    def each(self, task: Task, *args: Any) -> Iterator[Any]:
        """Results ``task(piece, *args)`` in the order of the pieces; errors as `sum`."""
        with _large_graphs():
            yield from self._results(self._tasks(task, args))

    def map(self, task: Task, *args: Any) -> Self:
        """Pieces ``task(piece, *args)``, each on the worker that has the piece.

        They are made again from the first ones where a worker is lost.  Errors as `sum`.
        """
        out = copy.copy(self)
        with _large_graphs():
            out._pieces = self._tasks(task, args)
        for _ in out._results(out._on_each(_made)):
            pass
        out._settle()
        return out

    def close(self) -> None:
        """Release the data, and the cluster where it was started for them."""
        self._pieces = []
        self._end()

    def _tasks(self, task: Task, args: tuple[Any, ...]) -> list[Future]:
        """A task on each piece."""
        work: _Work | Future = _Work(task, args)
        if len(pickle.dumps(args, protocol=5)) > LARGE:
            # sent once; a task's result, unlike scattered data, outlives its worker
            work = self._client.submit(_same, work, pure=False)
        return self._on_each(_pass, work=work)

    def _on_each(self, function: Task, **options: Any) -> list[Future]:
        # Tied to some workers, loosely.  Tasks that are not, and few, count as roots of a graph:
        # Dask then spreads them without regard to the positions of the pieces, which would travel.
        workers = sorted(self._workers()) or None
        return self._client.map(
            function,
            self._pieces,
            workers=workers,
            allow_other_workers=workers is not None,
            pure=False,
            **options,
        )

    def _results(self, futures: Sequence[Future]) -> Iterator[Any]:
        """Results in the order of the pieces, or the first error in that order."""
        try:
            for k in range(0, len(futures), TOGETHER):
                yield from self._awaited(futures[k : k + TOGETHER])
        except KilledWorker as error:
            raise InputError(
                "workers die again and again while they work on the same stars",
                where=f"cluster {self._where}",
                do="look into their logs, and give them more memory",
            ) from error
        except CancelledError as error:
            raise InputError(
                "the connection to the scheduler is lost",
                where=f"cluster {self._where}",
                do="start it and the run again",
            ) from error
        finally:
            # after an error the rest of the pass would go on as long as its traceback exists
            unfinished = [future for future in futures if not future.done()]
            if unfinished and self._client.status == "running":
                self._client.cancel(unfinished, force=True)

    def _awaited(self, futures: Sequence[Future]) -> list[Any]:
        """Results of tasks, waited for as long as there are workers."""
        loop = self._client.loop.asyncio_loop
        results = asyncio.run_coroutine_threadsafe(_in_order(self._client, futures), loop)
        seen = monotonic()
        try:
            while True:
                try:
                    return results.result(timeout=POLL)
                except TimeoutError:
                    if results.done():  # the task's own
                        raise
                workers = self._workers()
                if workers:
                    seen = monotonic()
                    if self._loading and not self._loading & workers:
                        raise InputError(
                            "all workers were lost while they read the stars",
                            where=f"cluster {self._where}",
                            do="look into their logs, give them more memory, and start again",
                        )
                elif monotonic() - seen > PATIENCE:
                    raise InputError(
                        f"has had no workers for {PATIENCE:g} seconds",
                        where=f"cluster {self._where}",
                        do="start workers, then the run again",
                    )
        finally:
            results.cancel()

    def _workers(self) -> set[str]:
        try:
            return set(self._client.nthreads())
        except OSError:  # the scheduler is gone: tasks will be cancelled
            return set()

    def _settle(self) -> None:
        """Untie the pieces from the workers over which they were spread.

        Dask takes no other worker for a tied task when, for a moment, there was none at all: it
        would wait for the lost one for ever.
        """
        free: dict[Any, list[str]] = {piece.key: [] for piece in self._pieces}
        self._client.sync(self._client.scheduler.set_restrictions, worker=free)
        self._loading = set()


class ClusterShards(ClusterPieces, Shards):
    """Shards on the workers of a Dask cluster.

    Batches of stars in memory are sent; those on disk are read by the workers, which have to see
    the files under the same absolute paths.

    InputError as `ClusterPieces`, `prepare` and `BatchReader.load`.
    """

    def __init__(self, model: DistortionModel, matches: Matches, compute: Compute) -> None:
        Shards.__init__(self, model)
        make = partial(shard_of, model, n_total=len(matches))
        if not matches.in_memory:
            compute = replace(compute, scratch=None)
        ClusterPieces.__init__(self, make, matches.readers(), compute)
        try:
            self.survey = super().sum(_survey)
        except BaseException:
            self.close()
            raise

    def sum(self, task: Task, *args: Any) -> Any:
        """As `ClusterPieces.sum`, of ``task(stars, *args)``."""
        return super().sum(_of_stars, task, *args)


def _survey(shard: tuple[Stars, Survey]) -> Survey:
    """On a worker: survey of a shard."""
    return shard[1]


def _of_stars(shard: tuple[Stars, Survey], task: Task, *args: Any) -> Any:
    """On a worker: result of a task on the stars of a shard."""
    return task(shard[0], *args)


@dataclass(frozen=True, eq=False)
class _Work:
    """A task and its arguments, hidden from Dask."""

    task: Task
    args: tuple[Any, ...]


@dataclass(frozen=True)
class _Written:
    """A record in a file that workers read."""

    path: Path

    @classmethod
    def as_number(cls, k: int, record: Any, folder: Path) -> _Written:
        """The record of a number, written to a folder."""
        path = folder / f"{k:06d}.h5"
        write_record(path, record)
        return cls(path)

    def read(self) -> Any:
        """The record; InputError where the file is not seen, FormatError where it is damaged."""
        do = "resume the run, which writes it anew, and check the disk of compute.scratch"
        try:
            return read_record(self.path, object, "a part of the data", do=do)
        except FormatError:
            raise
        except InputError as error:
            do = "name a folder in compute.scratch that all workers see under the same path"
            raise InputError(error.cause, where=error.where, do=do) from error


def _made_from(make: Task, source: Any) -> Any:
    """On a worker: the piece of a source, which may be in a file."""
    return make(source.read() if isinstance(source, _Written) else source)


def _made(_: Any) -> None:
    """On a worker: nothing of a piece, once it has been made."""


def _same(work: _Work) -> _Work:
    """On a worker: arguments, to be fetched by the others."""
    return work


def _pass(piece: Any, work: _Work) -> Any:
    """On a worker: result of a task on one piece."""
    with _one_pass:
        # of this thread, which may be another one each time
        kernel.set_threads(get_worker().state.nthreads)
        return work.task(piece, *work.args)


async def _in_order(client: Any, futures: Sequence[Future]) -> list[Any]:
    for future in futures:
        if await future.exception() is not None:
            await future  # raises it
    return await client.gather(futures, asynchronous=True)


@contextmanager
def one_cluster(compute: Compute) -> Iterator[Compute]:
    """Context with one cluster for all pieces of its compute, started here where none is given.

    InputError as `ClusterPieces`.
    """
    if compute.scheduler is not None:
        yield compute
        return
    with _local_cluster(compute.workers) as cluster:
        yield replace(compute, scheduler=cluster.scheduler_address)


def _local_cluster(workers: int | None) -> LocalCluster:
    """Processes of this machine that share its cores evenly."""
    workers = CPU_COUNT if workers is None else workers
    if workers < 1:
        raise InputError(
            f"{workers} workers do no work", where="compute.workers", do="give 1 or more"
        )
    with dask.config.set({"distributed.scheduler.allowed-failures": ALLOWED_FAILURES}):
        try:
            return LocalCluster(
                n_workers=workers,
                threads_per_worker=max(1, CPU_COUNT // workers),
                host="127.0.0.1",  # whoever reaches a scheduler runs code there: nobody else does
                processes=True,
                memory_limit=0,
                dashboard_address="127.0.0.1:0",  # None is port 8787, which may be taken
                scheduler_kwargs={"dashboard": False},
                silence_logs=logging.CRITICAL,
            )
        except (RuntimeError, OSError) as error:
            raise InputError(
                f"{workers} worker processes do not start",
                where="compute.workers",
                do="ask for fewer, and begin a script of your own with if __name__ == '__main__'",
            ) from error


def _connected(compute: Compute) -> tuple[Any, LocalCluster | None]:
    """Client, and the cluster where it is our own."""
    if compute.scheduler is not None:
        try:
            # a client that fails on a bad address would never be closed
            resolve_address(compute.scheduler)
            return Client(compute.scheduler, timeout=CONNECT, set_as_default=False), None
        except (OSError, ValueError, TypeError) as error:
            raise InputError(
                f"no Dask scheduler answers at {compute.scheduler!r}",
                where="compute.scheduler",
                do="start one, correct the address, or leave it out for a cluster of this machine",
            ) from error
    cluster = _local_cluster(compute.workers)
    try:
        return Client(cluster, set_as_default=False), cluster
    except BaseException:
        cluster.close()
        raise


def _places(client: Any) -> list[str]:
    """Addresses of the workers, each as often as it has threads, in turn."""
    if not client.nthreads():
        log.warning(
            "cluster %s has no workers yet: waiting for %g seconds",
            client.scheduler.address,
            PATIENCE,
        )
    try:
        client.wait_for_workers(1, timeout=PATIENCE)
    except TimeoutError as error:
        raise InputError(
            f"has no workers after {PATIENCE:g} seconds",
            where=f"cluster {client.scheduler.address}",
            do="start workers",
        ) from error
    except OSError as error:
        raise InputError(
            "the connection to the scheduler is lost",
            where=f"cluster {client.scheduler.address}",
            do="start it and the run again",
        ) from error
    threads = sorted(client.nthreads().items())
    most = max(n for _, n in threads)
    return [address for k in range(most) for address, n in threads if k < n]


def _require_version(client: Any) -> None:
    """Raise InputError for workers with another version of bayesdist."""

    def version() -> str:  # a local function travels whole, and needs no bayesdist over there
        try:
            from bayesdist.version import __version__
        except ImportError:
            return "none"
        return __version__

    for address, found in sorted(client.run(version).items()):
        if found != __version__:
            raise InputError(
                f"has bayesdist {found}, and here it is {__version__}",
                where=f"worker {address}",
                do="install one version everywhere",
            )


def _large_graphs() -> Any:
    """Context without the warning of data inside graphs, where they must be to be made again."""
    return dask.config.set({"distributed.admin.large-graph-warning-threshold": "1 PB"})


def _folder_in(scratch: str, files: ExitStack) -> Path:
    """New folder in the scratch folder, which `files` removes."""
    try:
        made = tempfile.TemporaryDirectory(prefix="bayesdist-", dir=scratch)
        return Path(files.enter_context(made))
    except OSError as error:
        raise InputError(
            f"no folder can be made in {scratch} ({error.strerror})",
            where="compute.scratch",
            do="name a folder that can be written to, and that all workers see",
        ) from error


def _end(client: Any, cluster: LocalCluster | None, files: ExitStack) -> None:
    """Close the client and its own cluster, and remove the files of the sources."""

    def close() -> None:
        client.close()
        if cluster is not None:
            cluster.close()
        files.close()

    # garbage may be collected in the thread that closing has to wait for
    if client.loop.asyncio_loop is _running_loop():
        threading.Thread(target=close).start()
    else:
        close()


def _running_loop() -> asyncio.AbstractEventLoop | None:
    try:
        return asyncio.get_running_loop()
    except RuntimeError:
        return None
