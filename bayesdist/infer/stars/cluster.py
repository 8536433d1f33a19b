"""The Dask engine: pieces of the data stay on the workers, and only sums are transferred.

Each piece is the result of a task and stays on the worker that computed it.  A pass is a map-reduce
operation: one task per piece, run on its worker, with the results added in the order of the pieces,
by the same tree as with threads.  Most additions are done on the workers.  The order of summation
does not depend on the number of workers.  If a worker is lost, Dask computes its pieces again on
another one.  Results for a piece are reproducible up to rounding, since code that was compiled for
a different processor may differ in the last bits.

This is the only module that uses dask and distributed; it is imported when the engine is requested.
"""

from __future__ import annotations

import asyncio
import copy
import logging
import pickle
import tempfile
import threading
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import monotonic
from typing import Any, Concatenate, Generic, cast

from bayesdist.data.matches import Matches
from bayesdist.errors import FormatError, InputError
from bayesdist.files.hdf5 import read_record, write_record
from bayesdist.infer import kernel
from bayesdist.infer.stars.shards import (
    BRANCHES,
    Compute,
    MappedPieces,
    P,
    Piece_co,
    Shards,
    Survey,
    T,
    shard_of,
    total,
)
from bayesdist.infer.stars.stars import Stars
from bayesdist.model import DistortionModel
from bayesdist.version import __version__

try:
    import dask
    from dask.system import CPU_COUNT
    from distributed import Client, Future, KilledWorker, LocalCluster, get_worker
    from distributed.comm import resolve_address
    from distributed.utils import silence_logging_cmgr
except ModuleNotFoundError as error:
    raise InputError(
        "the Dask engine needs the package distributed",
        where="compute.engine",
        do="pip install 'bayesdist[dask]'",
    ) from error

log = logging.getLogger("bayesdist")

CONNECT = 10.0  # timeout in seconds for connecting to the scheduler
PATIENCE = 60.0  # seconds without any worker before giving up
SILENCE = 5.0  # seconds without any worker before a warning
POLL = 1.0  # seconds between two checks for workers
ALLOWED_FAILURES = 10  # number of workers that may die while processing the same piece
LARGE = 50_000  # larger arguments (bytes) are sent once and distributed by a worker
TOGETHER = 256  # number of results that are fetched at a time

_one_pass = threading.Lock()  # a pass uses all threads of its process


class _Lease:
    """Token shared by all pieces on a cluster, which is closed when no piece holds it any more."""


class ClusterPieces(MappedPieces[Piece_co]):
    """Pieces on the workers of a Dask cluster, made there from sources by a function.

    If `compute` has a `scheduler`, that cluster is used; its workers must have the same version of
    bayesdist.  Otherwise `workers` processes are started on this machine.  They are ended by
    `close`, or when this object is deleted or the program ends.  A script that starts them needs
    the usual ``if __name__ == "__main__":``.  If `compute` has a `scratch` folder, the sources
    (which must be records) are written to files in it until `close`; otherwise the scheduler keeps
    them in memory.

    Raises InputError if the cluster cannot be reached or started, has no workers, or has workers
    with another version of bayesdist, or if the scratch folder cannot be written here or read by
    the workers.
    """

    def __init__(
        self, make: Callable[[Any], Piece_co], sources: Iterable[Any], compute: Compute
    ) -> None:
        self._pieces: list[Future] = []
        self._loading: set[str] = set()  # workers that sources are tied to
        self._client, cluster = _connected(compute)
        self._where = self._client.scheduler.address
        self._lease = _Lease()
        files = ExitStack()
        files.enter_context(_without_messages(self._client))
        self._end = weakref.finalize(self._lease, _end, self._client, cluster, files)
        try:
            folder = _folder_in(compute.scratch, files) if compute.scratch is not None else None
            with self._connection():
                places = _places(self._client, self._where)
                self._loading = set(places)
                _require_version(self._client)
            # sources stay in files or in the scheduler, so that a lost piece can be made again
            with _large_graphs():
                for k, source in enumerate(sources):
                    record = source if folder is None else _PieceFile.as_number(k, source, folder)
                    with self._connection():
                        self._pieces.append(
                            self._client.submit(
                                _made_from,
                                make,
                                record,
                                workers=[places[k % len(places)]],
                                allow_other_workers=True,
                                pure=False,
                            )
                        )
            with self._connection():
                futures = self._on_each(_made)
            for _ in self._results(futures):
                pass
            self._settle()
        except BaseException:
            self.close()
            raise

    def sum(
        self, task: Callable[Concatenate[Piece_co, P], T], *args: P.args, **options: P.kwargs
    ) -> T:
        """Sum of ``task(piece, *args, **options)`` over the pieces, added in their order.

        Raises InputError if there are no workers any more, or if workers die while they run the
        task.  Otherwise an exception of the task is raised: that of the first piece that fails or,
        with more than `BRANCHES` pieces, of a piece in the first branch that fails.
        """
        with _large_graphs():
            with self._connection():
                parts = self._tasks(task, args, options)
                while len(parts) > BRANCHES:
                    parts = [
                        self._client.submit(total, parts[k : k + BRANCHES], pure=False)
                        for k in range(0, len(parts), BRANCHES)
                    ]
            return total(self._results(parts))

    def each(
        self, task: Callable[Concatenate[Piece_co, P], T], *args: P.args, **options: P.kwargs
    ) -> Iterator[T]:
        """Yield ``task(piece, *args, **options)`` in their order; see `sum` for exceptions."""
        with _large_graphs():
            with self._connection():
                futures = self._tasks(task, args, options)
            yield from self._results(futures)

    def map(
        self, task: Callable[Concatenate[Piece_co, P], T], *args: P.args, **options: P.kwargs
    ) -> ClusterPieces[T]:
        """New pieces ``task(piece, *args, **options)``, each on the worker that has the piece.

        If a worker is lost, they are computed again from the original pieces.  See `sum` for
        exceptions.
        """
        out = cast("ClusterPieces[T]", copy.copy(self))
        with _large_graphs(), self._connection():
            out._pieces = self._tasks(task, args, options)
            futures = out._on_each(_made)
        for _ in out._results(futures):
            pass
        out._settle()
        return out

    def close(self) -> None:
        """Release the data, and shut down the cluster if it was started here."""
        self._pieces = []
        self._end()

    def _tasks(
        self, task: Callable[..., object], args: tuple[Any, ...], options: dict[str, Any]
    ) -> list[Future]:
        """Submit a task for each piece."""
        work: _Work | Future = _Work(task, args, options)
        if len(pickle.dumps((args, options), protocol=5)) > LARGE:
            # sent once, as the result of a task, which unlike scattered data survives its worker
            work = self._client.submit(_same, work, pure=False)
        return self._on_each(_pass, work=work)

    def _on_each(self, function: Callable[..., object], **options: Any) -> list[Future]:
        # Restrict the tasks loosely to the workers. Without a restriction, Dask would treat a small
        # number of tasks as roots of a graph and distribute them regardless of where the pieces
        # are, so that the pieces would have to be transferred.
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
        """Yield results in the order of the pieces; raise the first error in that order."""
        try:
            for k in range(0, len(futures), TOGETHER):
                yield from self._awaited(futures[k : k + TOGETHER])
        except KilledWorker as error:
            raise InputError(
                "workers die repeatedly while they process the same stars",
                where=f"cluster {self._where}",
                do="look into their logs, and give them more memory",
            ) from error
        except CancelledError as error:
            raise _lost_connection(self._where) from error
        finally:
            # after an error, the remaining tasks would continue as long as the traceback exists
            unfinished = [future for future in futures if not future.done()]
            if unfinished and self._client.status == "running":
                self._client.cancel(unfinished, force=True)

    def _awaited(self, futures: Sequence[Future]) -> list[Any]:
        """Wait for the results of tasks as long as there are workers."""
        loop = self._client.loop.asyncio_loop
        results = asyncio.run_coroutine_threadsafe(_in_order(self._client, futures), loop)
        last_seen, warned = monotonic(), False
        try:
            while True:
                try:
                    return results.result(timeout=POLL)
                except TimeoutError:
                    if results.done():  # raised by the task
                        raise
                workers = self._workers()
                if workers:
                    last_seen, warned = monotonic(), False
                    if self._loading and not self._loading & workers:
                        raise InputError(
                            "all workers were lost while they read the stars",
                            where=f"cluster {self._where}",
                            do="look into their logs, give them more memory, and start again",
                        )
                elif monotonic() - last_seen > SILENCE and not warned:
                    warned = True
                    log.warning(
                        "cluster %s has no workers any more: waiting for %g seconds",
                        self._where,
                        PATIENCE,
                    )
                elif monotonic() - last_seen > PATIENCE:
                    raise InputError(
                        f"has had no workers for {PATIENCE:g} seconds",
                        where=f"cluster {self._where}",
                        do="start workers, then restart the run",
                    )
        finally:
            results.cancel()

    def _connection(self) -> AbstractContextManager[None]:
        """Context that raises InputError if the scheduler does not answer any more."""
        return _naming_lost_connection(self._client, self._where)

    def _workers(self) -> set[str]:
        try:
            return set(self._client.nthreads())
        except OSError:  # the scheduler is gone, so tasks will be cancelled
            return set()

    def _settle(self) -> None:
        """Remove the restriction of the pieces to the workers on which they were placed.

        If all workers are temporarily lost, Dask would otherwise wait for the original worker
        forever, even though other workers are allowed.
        """
        free: dict[Any, list[str]] = {piece.key: [] for piece in self._pieces}
        with self._connection():
            self._client.sync(self._client.scheduler.set_restrictions, worker=free)
        self._loading = set()


class ClusterShards(Shards):
    """Shards on the workers of a Dask cluster.

    Batches of stars in memory are sent to the workers.  Batches on disk are read by the workers,
    which must see the files under the same absolute paths.

    Raises InputError for the reasons given at `ClusterPieces`, `prepare` and `BatchReader.load`.
    """

    def __init__(self, model: DistortionModel, matches: Matches, compute: Compute) -> None:
        super().__init__(model)
        make = partial(shard_of, model, n_total=len(matches))
        if not matches.in_memory:
            compute = replace(compute, scratch=None)
        self._pieces = ClusterPieces(make, matches.readers(), compute)
        try:
            self.survey = self._pieces.sum(_survey)
        except BaseException:
            self.close()
            raise

    def sum(
        self, task: Callable[Concatenate[Stars, P], T], *args: P.args, **options: P.kwargs
    ) -> T:
        """Sum of ``task(stars, *args, **options)`` over the shards; see `ClusterPieces.sum`."""
        return self._pieces.sum(_OfStars(task), *args, **options)

    def close(self) -> None:
        """Release the data, and shut down the cluster if it was started here."""
        self._pieces.close()


def _survey(shard: tuple[Stars, Survey]) -> Survey:
    """Survey of a shard (runs on a worker)."""
    return shard[1]


@dataclass(frozen=True)
class _OfStars(Generic[P, T]):
    """Task for the stars of a shard (runs on a worker)."""

    task: Callable[Concatenate[Stars, P], T]

    def __call__(self, shard: tuple[Stars, Survey], /, *args: P.args, **options: P.kwargs) -> T:
        return self.task(shard[0], *args, **options)


@dataclass(frozen=True, eq=False)
class _Work:
    """A task and its arguments, wrapped so that Dask does not inspect them."""

    task: Callable[..., object]
    args: tuple[Any, ...]
    options: dict[str, Any]


@dataclass(frozen=True)
class _PieceFile:
    """Path of a record that the workers read."""

    path: Path

    @classmethod
    def as_number(cls, k: int, record: Any, folder: Path) -> _PieceFile:
        """Write a record to a folder under the number `k`."""
        path = folder / f"{k:06d}.h5"
        write_record(path, record)
        return cls(path)

    def read(self) -> Any:
        """Read the record; raises InputError if the file is missing, FormatError if damaged."""
        do = "resume the run, which writes it again, and check the disk of compute.scratch"
        try:
            return read_record(self.path, object, "a part of the data", do=do)
        except FormatError:
            raise
        except InputError as error:
            do = "name a folder in compute.scratch that all workers see under the same path"
            raise InputError(error.cause, where=error.where, do=do) from error


def _made_from(make: Callable[[Any], T], source: Any) -> T:
    """Make a piece from a source, which may be in a file (runs on a worker)."""
    return make(source.read() if isinstance(source, _PieceFile) else source)


def _made(_: Any) -> None:
    """Return None once a piece has been made (runs on a worker)."""


def _same(work: _Work) -> _Work:
    """Return the arguments, so that other workers can fetch them (runs on a worker)."""
    return work


def _pass(piece: object, work: _Work) -> object:
    """Result of a task for a piece (runs on a worker)."""
    with _one_pass:
        # the setting belongs to the thread, which may differ from call to call
        kernel.set_threads(get_worker().state.nthreads)
        return work.task(piece, *work.args, **work.options)


async def _in_order(client: Any, futures: Sequence[Future]) -> list[Any]:
    for future in futures:
        if await future.exception() is not None:
            await future  # raises it
    return await client.gather(futures, asynchronous=True)


@contextmanager
def one_cluster(compute: Compute) -> Iterator[Compute]:
    """Context with a single cluster for all pieces, started here if `compute` has no scheduler.

    Yields a `Compute` with the address of the scheduler.  Raises InputError like `ClusterPieces`.
    """
    if compute.scheduler is not None:
        yield compute
        return
    with _local_cluster(compute.workers) as cluster:
        yield replace(compute, scheduler=cluster.scheduler_address)


def _local_cluster(workers: int | None) -> LocalCluster:
    """Cluster of processes on this machine that share its cores evenly."""
    workers = CPU_COUNT if workers is None else workers
    if workers < 1:
        raise InputError(
            f"the number of workers is {workers}", where="compute.workers", do="give 1 or more"
        )
    with dask.config.set({"distributed.scheduler.allowed-failures": ALLOWED_FAILURES}):
        try:
            return LocalCluster(
                n_workers=workers,
                threads_per_worker=max(1, CPU_COUNT // workers),
                host="127.0.0.1",  # local only, since a scheduler runs any code that it receives
                processes=True,
                memory_limit=0,
                dashboard_address="127.0.0.1:0",  # None means port 8787, which may be in use
                scheduler_kwargs={"dashboard": False},
                silence_logs=logging.CRITICAL,
            )
        except (RuntimeError, OSError) as error:
            raise InputError(
                f"{workers} worker processes do not start",
                where="compute.workers",
                do="use fewer, and protect the code of a script with if __name__ == '__main__'",
            ) from error


def _connected(compute: Compute) -> tuple[Any, LocalCluster | None]:
    """Client, and the cluster if it was started here."""
    if compute.scheduler is not None:
        try:
            # check the address first: a client that fails on it could not be closed
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


def _places(client: Any, where: str) -> list[str]:
    """Addresses of the workers, each repeated once per thread, in round-robin order."""
    if not client.nthreads():
        log.warning("cluster %s has no workers yet: waiting for %g seconds", where, PATIENCE)
    try:
        client.wait_for_workers(1, timeout=PATIENCE)
    except TimeoutError as error:
        raise InputError(
            f"has no workers after {PATIENCE:g} seconds",
            where=f"cluster {where}",
            do="start workers",
        ) from error
    threads = sorted(client.nthreads().items())
    max_threads = max(n for _, n in threads)
    return [address for k in range(max_threads) for address, n in threads if k < n]


def _require_version(client: Any) -> None:
    """Raise InputError if a worker has another version of bayesdist."""

    def version() -> str:  # a local function is sent by value and does not need bayesdist there
        try:
            from bayesdist.version import __version__
        except ImportError:
            return "none"
        return __version__

    for address, worker_version in sorted(client.run(version).items()):
        if worker_version != __version__:
            raise InputError(
                f"has bayesdist {worker_version}, but here it is {__version__}",
                where=f"worker {address}",
                do="install one version everywhere",
            )


def _lost_connection(where: str) -> InputError:
    return InputError(
        "the connection to the scheduler is lost",
        where=f"cluster {where}",
        do="restart it and the run",
    )


@contextmanager
def _naming_lost_connection(client: Any, where: str) -> Iterator[None]:
    """Raise InputError if the scheduler does not answer any more; `where` is its address."""
    try:
        yield
    except InputError:
        raise
    except (Exception, CancelledError, asyncio.CancelledError) as error:
        closed = client.status in ("closing", "closed")  # sends nothing, with an error of its own
        if not closed and not isinstance(error, OSError | CancelledError | asyncio.CancelledError):
            raise
        raise _lost_connection(where) from error


@contextmanager
def _without_messages(client: Any) -> Iterator[None]:
    """Context in which distributed and its event loop print no messages and no tracebacks.

    Whatever ends a run is an exception with a message of its own.
    """
    loop = client.loop.asyncio_loop
    handler = loop.get_exception_handler()
    loop.set_exception_handler(_ignore)  # of tasks that nobody awaits any more
    try:
        with silence_logging_cmgr(logging.CRITICAL):
            yield
    finally:
        loop.set_exception_handler(handler)


def _ignore(*_: object) -> None:
    """Handler of exceptions in an event loop that does nothing."""


def _large_graphs() -> Any:
    """Context without Dask's warning about data in graphs, which is needed to redo lost pieces."""
    return dask.config.set({"distributed.admin.large-graph-warning-threshold": "1 PB"})


def _folder_in(scratch: str, files: ExitStack) -> Path:
    """New folder in the scratch folder; it is removed when `files` is closed."""
    try:
        folder = tempfile.TemporaryDirectory(prefix="bayesdist-", dir=scratch)
        return Path(files.enter_context(folder))
    except OSError as error:
        raise InputError(
            f"no folder can be created in {scratch} ({error.strerror})",
            where="compute.scratch",
            do="name a writable folder that all workers see",
        ) from error


def _end(client: Any, cluster: LocalCluster | None, files: ExitStack) -> None:
    """Close the client and, if any, the cluster, and remove the files of the sources."""

    def close() -> None:
        client.close()
        if cluster is not None:
            cluster.close()
        files.close()

    # avoid a deadlock: garbage collection may run in the thread for which closing waits
    if client.loop.asyncio_loop is _running_loop():
        threading.Thread(target=close).start()
    else:
        close()


def _running_loop() -> asyncio.AbstractEventLoop | None:
    try:
        return asyncio.get_running_loop()
    except RuntimeError:
        return None
