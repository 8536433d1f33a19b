"""The data in pieces, and the one operation on them: a task on each, and the sum.

All passes over matched stars go through `Shards.sum`, where the pieces are called shards.  Results
add up by a tree in the order of the shards, which is that of the data, so that they depend neither
on the threads nor on the engine.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import reduce
from itertools import islice
from operator import add
from typing import Any, Self

from bayesdist.data.matches import BatchReader, Matches
from bayesdist.errors import InputError
from bayesdist.infer.stars.scratch import Store
from bayesdist.infer.stars.stars import Stars, prepare
from bayesdist.infer.stars.survey import Survey, survey
from bayesdist.model import DistortionModel, Groups
from bayesdist.utils.memory import release_memory

Task = Callable[..., Any]

BRANCHES = 16  # of the tree by which results add up
SAMPLE = 1_000_000  # stars from whose errors the median error is computed


@dataclass(frozen=True)
class Compute:
    """Engine and resources of the passes over the data.

    Parameters
    ----------
    engine : str
        'threads', or 'dask'.
    memory_mb : float
        Columns of stars in memory; the rest is in a scratch file.
    scheduler : str, optional
        Address of a Dask scheduler; without one a cluster of this machine's processes is started.
    workers : int, optional
        Processes of that cluster; as many as there are cores by default.
    scratch : str, optional
        Folder that all workers of a cluster see under this path: what is in memory goes to them by
        files in it, which the workers read.  By default it is sent, and the scheduler holds it.

    Examples
    --------
    >>> compute = bd.Compute(memory_mb=200)
    >>> compute.engine
    'threads'
    """

    engine: str = "threads"
    memory_mb: float = 1000.0
    scheduler: str | None = None
    workers: int | None = None
    scratch: str | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.memory_mb < float("inf"):
            raise InputError(
                f"memory_mb is {self.memory_mb}",
                where="compute.memory_mb",
                do="give 0 or a positive number",
            )
        if self.engine not in ("threads", "dask"):
            raise InputError(
                f"there is no engine {self.engine!r}",
                where="compute.engine",
                do="choose threads or dask",
            )


class Pieces(ABC):
    """The data in pieces, in memory, on disk or on a cluster."""

    @abstractmethod
    def sum(self, task: Task, *args: Any) -> Any:
        """Sum over the pieces of ``task(piece, *args)``, in their order."""

    @abstractmethod
    def close(self) -> None:
        """Release the data."""


class MappedPieces(Pieces):
    """Pieces from which others are made, where they are."""

    @abstractmethod
    def each(self, task: Task, *args: Any) -> Iterable[Any]:
        """Results ``task(piece, *args)``, in the order of the pieces."""

    @abstractmethod
    def map(self, task: Task, *args: Any) -> Self:
        """Pieces ``task(piece, *args)``, which live no longer than the first ones."""


class Shards(Pieces):
    """Stars of a model, whose pieces are `Stars`.

    Parameters
    ----------
    model : DistortionModel

    Attributes
    ----------
    survey : Survey
        Of all stars.
    """

    survey: Survey

    def __init__(self, model: DistortionModel) -> None:
        self.model = model

    def __len__(self) -> int:
        """Number of stars."""
        return self.survey.n

    @property
    def groups(self) -> Groups:
        """Groups of the whole, without members."""
        return self.survey.groups


class LocalShards(Shards):
    """Shards in this process, with at most `memory_mb` of columns in memory."""

    def __init__(self, model: DistortionModel, matches: Matches, memory_mb: float) -> None:
        super().__init__(model)
        self._store = Store(1e6 * memory_mb)
        surveys = []
        for reader in matches.readers():
            stars, found = shard_of(model, reader, len(matches))
            self._store.add(stars)
            surveys.append(found)
        self.survey = total(surveys)
        if not matches.in_memory:
            release_memory()

    def sum(self, task: Task, *args: Any) -> Any:
        """Sum over the shards of ``task(stars, *args)``, in their order."""
        return total(task(stars, *args) for stars in self._store)

    def close(self) -> None:
        """Release the data."""
        self._store.close()


def shard_of(model: DistortionModel, reader: BatchReader, n_total: int) -> tuple[Stars, Survey]:
    """One shard, and its survey."""
    table = reader.load()
    stars, _ = prepare(model, table)
    return stars, survey(stars, table, max(1, n_total // SAMPLE))


def total(parts: Iterable[Any]) -> Any:
    """Sum of one or more parts in their order, by a tree: of so many that follow one another first.

    None for no parts.
    """
    rest, sums = iter(parts), []
    for first in rest:
        sums.append(reduce(add, islice(rest, BRANCHES - 1), first))
    return total(sums) if len(sums) > 1 else next(iter(sums), None)
