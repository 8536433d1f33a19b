"""Data in pieces, and the operation on them: apply a task to each piece and sum the results.

All passes over matched stars use `Shards.sum`; the pieces are called shards.  Results are added by
a tree in the order of the shards, which is that of the data.  They depend neither on the number of
threads nor on the engine.
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

BRANCHES = 16  # number of branches of the summation tree
SAMPLE = 1_000_000  # number of stars used to compute the median error


@dataclass(frozen=True)
class Compute:
    """Engine and resources for passes over the data.

    Parameters
    ----------
    engine : str
        'threads' for threads of this process, or 'dask' for a Dask cluster.
    memory_mb : float
        With 'threads': memory in MB for columns of stars; further columns are kept in a scratch
        file.
    scheduler : str, optional
        With 'dask': address of a scheduler. By default a cluster of processes is started on this
        machine.
    workers : int, optional
        Number of processes of that cluster; by default the number of cores.
    scratch : str, optional
        Folder that all workers of a cluster see under the same path. Data in memory are passed to
        the workers by files in this folder. By default they are sent through the scheduler, which
        keeps them in memory.

    Raises
    ------
    InputError
        If the memory is negative or not finite, or the engine is unknown.

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
    """Data divided into pieces, in memory, on disk or on a cluster."""

    @abstractmethod
    def sum(self, task: Task, *args: Any) -> Any:
        """Sum of ``task(piece, *args)`` over the pieces, added in their order."""

    @abstractmethod
    def close(self) -> None:
        """Release the data."""


class MappedPieces(Pieces):
    """Pieces that can be mapped to other pieces at the same location."""

    @abstractmethod
    def each(self, task: Task, *args: Any) -> Iterable[Any]:
        """Results ``task(piece, *args)`` in the order of the pieces."""

    @abstractmethod
    def map(self, task: Task, *args: Any) -> Self:
        """New pieces ``task(piece, *args)``; they are valid until the original ones are closed."""


class Shards(Pieces):
    """Stars prepared for a model, divided into shards; each shard is a `Stars` object.

    Parameters
    ----------
    model : DistortionModel

    Attributes
    ----------
    survey : Survey
        Statistics of all stars.
    """

    survey: Survey

    def __init__(self, model: DistortionModel) -> None:
        self.model = model

    def __len__(self) -> int:
        """Number of stars."""
        return self.survey.n

    @property
    def groups(self) -> Groups:
        """Groups of all stars, without their members."""
        return self.survey.groups


class LocalShards(Shards):
    """Shards in this process, with at most `memory_mb` of columns in memory."""

    def __init__(self, model: DistortionModel, matches: Matches, memory_mb: float) -> None:
        super().__init__(model)
        self._store = Store(1e6 * memory_mb)
        surveys = []
        for reader in matches.readers():
            stars, shard_survey = shard_of(model, reader, len(matches))
            self._store.add(stars)
            surveys.append(shard_survey)
        self.survey = total(surveys)
        if not matches.in_memory:
            release_memory()

    def sum(self, task: Task, *args: Any) -> Any:
        """Sum of ``task(stars, *args)`` over the shards, added in their order."""
        return total(task(stars, *args) for stars in self._store)

    def close(self) -> None:
        """Release the data."""
        self._store.close()


def shard_of(model: DistortionModel, reader: BatchReader, n_total: int) -> tuple[Stars, Survey]:
    """Load a shard; return its stars and its survey.  `n_total` is the number of all stars."""
    table = reader.load()
    stars, _ = prepare(model, table)
    return stars, survey(stars, table, max(1, n_total // SAMPLE))


def total(parts: Iterable[Any]) -> Any:
    """Sum of parts, added in their order by a tree with `BRANCHES` branches; None for no parts."""
    remaining = iter(parts)
    sums = [reduce(add, islice(remaining, BRANCHES - 1), first) for first in remaining]
    return total(sums) if len(sums) > 1 else next(iter(sums), None)
