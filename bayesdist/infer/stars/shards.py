"""Data in pieces, and the operation on them: apply a task to each piece and sum the results.

All passes over matched stars use `Shards.sum`; the pieces are called shards.  Results are added by
a tree in the order of the shards, which is that of the data.  They depend neither on the number of
threads nor on the engine.
"""

from __future__ import annotations

import io
import tempfile
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import reduce
from itertools import chain, islice
from operator import add
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from bayesdist.data.matches import BatchReader, Matches
from bayesdist.errors import InputError
from bayesdist.infer.stars.stars import Stars, prepare
from bayesdist.model import DistortionModel, Groups, merge_groups
from bayesdist.utils.arrays import Bool, Float, Int
from bayesdist.utils.memory import release_memory

P = ParamSpec("P")
T = TypeVar("T")
Piece_co = TypeVar("Piece_co", covariant=True)
BRANCHES = 16  # number of branches of the summation tree
SAMPLE = 1_000_000  # number of stars used to compute the median error

EMPTY = np.zeros(0)
COLUMNS = ("X", "Y", "u", "v", "var_u", "var_v")

# relative tolerance for stars at the edge of their match circle
ROUNDING = 1e-6


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


class Pieces(ABC, Generic[Piece_co]):
    """Data divided into pieces, in memory, on disk or on a cluster."""

    @abstractmethod
    def sum(
        self, task: Callable[Concatenate[Piece_co, P], T], *args: P.args, **options: P.kwargs
    ) -> T:
        """Sum of ``task(piece, *args, **options)`` over the pieces, added in their order."""

    @abstractmethod
    def close(self) -> None:
        """Release the data."""


class MappedPieces(Pieces[Piece_co]):
    """Pieces that can be mapped to other pieces at the same location."""

    @abstractmethod
    def each(
        self, task: Callable[Concatenate[Piece_co, P], T], *args: P.args, **options: P.kwargs
    ) -> Iterable[T]:
        """Results ``task(piece, *args, **options)`` in the order of the pieces."""

    @abstractmethod
    def map(
        self, task: Callable[Concatenate[Piece_co, P], T], *args: P.args, **options: P.kwargs
    ) -> MappedPieces[T]:
        """New pieces ``task(piece, *args, **options)``.

        They are valid until the original ones are closed.
        """


class Shards(Pieces[Stars]):
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

    def sum(
        self, task: Callable[Concatenate[Stars, P], T], *args: P.args, **options: P.kwargs
    ) -> T:
        """Sum of ``task(stars, *args, **options)`` over the shards, added in their order."""
        return total(task(stars, *args, **options) for stars in self._store)

    def close(self) -> None:
        """Release the data."""
        self._store.close()


def shard_of(model: DistortionModel, reader: BatchReader, n_total: int) -> tuple[Stars, Survey]:
    """Load a shard and return its stars and its survey.

    `n_total` is the number of all stars, of which the survey samples a fraction.
    """
    table = reader.load()
    stars, order = prepare(model, table)
    measured = ~table.motion_is_assumed[order]
    return stars, survey(stars, table, max(1, n_total // SAMPLE), measured)


def total(parts: Iterable[T]) -> T:
    """Sum of parts, added in their order by a tree with `BRANCHES` branches.

    Raises ValueError if there are no parts.
    """
    remaining = iter(parts)
    sums = [reduce(add, islice(remaining, BRANCHES - 1), first) for first in remaining]
    if not sums:
        raise ValueError("there are no parts to add")
    return total(sums) if len(sums) > 1 else sums[0]


# -- storage of shards in memory up to a limit, and beyond it in a scratch file --------------------


class Store:
    """Sequence of shards, with at most `budget` bytes of columns in memory."""

    def __init__(self, budget: float) -> None:
        self._left = budget
        # stars, and if their columns are in a scratch file: the file, the place, and their names
        self._kept: list[tuple[Stars, tuple[io.FileIO, int, tuple[str, ...]] | None]] = []
        self._file: io.FileIO | None = None

    def __len__(self) -> int:
        return len(self._kept)

    def add(self, stars: Stars) -> None:
        """Append a shard; raises InputError if the disk is full."""
        if stars.nbytes <= self._left:
            self._left -= stars.nbytes
            self._kept.append((stars, None))
            return
        stars.blocks, stars.pieces  # noqa: B018  computed once and kept in memory
        try:
            if self._file is None:
                # an unnamed file, which is removed when the process ends for any reason
                self._file = tempfile.TemporaryFile(buffering=0, prefix="bayesdist-")  # noqa: SIM115
                self._closed = weakref.finalize(self, self._file.close)
            place = (self._file, self._file.seek(0, 2))
            for name in _names(stars):
                column = getattr(stars, name)
                _write(self._file, np.ascontiguousarray(column).view(np.uint8).data)
        except OSError as error:
            raise InputError(
                f"the stars do not fit into the scratch folder ({error.strerror})",
                where=_folder(),
                do="set TMPDIR to a folder with more space, or increase compute.memory_mb",
            ) from error
        none: dict[str, Any] = dict.fromkeys(_names(stars), EMPTY)
        frame = replace(stars, **none)
        frame.__dict__.update(blocks=stars.blocks, pieces=stars.pieces)
        self._kept.append((frame, (*place, _names(stars))))

    def close(self) -> None:
        """Release the shards and the scratch file."""
        self._kept = []
        if self._file is not None:
            self._closed()
            self._file = None

    def __iter__(self) -> Iterator[Stars]:
        for stars, place in self._kept:
            yield stars if place is None else self._restored(stars, *place)

    def _restored(self, frame: Stars, file: io.FileIO, place: int, names: tuple[str, ...]) -> Stars:
        n = int(frame.starts[-1])
        columns = np.empty((len(names), n))
        file.seek(place)
        view, done = columns.ravel().view(np.uint8).data, 0
        while done < len(view):
            got = file.readinto(view[done:])
            if not got:
                raise InputError("the scratch file has been truncated", do="start again")
            done += got
        read: dict[str, Any] = dict(zip(names, columns, strict=True))
        stars = replace(frame, **read)
        stars.__dict__.update(blocks=frame.blocks, pieces=frame.pieces)
        return stars


def _names(stars: Stars) -> tuple[str, ...]:
    """Names of the columns that stars have."""
    offsets = ("off_u", "off_v")[: len(stars.offsets)]
    return COLUMNS + offsets + (("cos", "sin") if stars.is_correlated else ())


def _write(file: io.FileIO, view: memoryview) -> None:
    """Write all bytes, repeatedly, since a write to an almost full disk may be partial."""
    while len(view):
        view = view[file.write(view) :]


def _folder() -> str:
    """Path of the scratch folder, or "TMPDIR" if none is usable."""
    try:
        return tempfile.gettempdir()
    except OSError:
        return "TMPDIR"


# -- statistics of the stars that are needed before a fit, as sums over chunks of the data ---------


@dataclass(frozen=True, eq=False)
class ChipSurvey:
    """Number and extent of the stars on one chip."""

    n: int  # number of stars
    # vertices (m, 2) of the convex hull, FITS 1-based pixels; all points if they span no area
    corners: Float
    sums: Float  # sums (5,) of x, y, x^2, xy, y^2 in units of the chip's size
    outside: str  # message about the first star outside the chip; empty if there is none

    def __add__(self, other: ChipSurvey) -> ChipSurvey:
        return ChipSurvey(
            self.n + other.n,
            _hull(np.concatenate([self.corners, other.corners])),
            self.sums + other.sums,
            self.outside or other.outside,
        )


@dataclass(frozen=True, eq=False)
class Survey:
    """Statistics of stars; the surveys of different chunks of the data can be added."""

    n: int  # number of stars
    groups: Groups  # without members
    exposures: Int  # number (E,) of stars in each exposure of the model
    chips: tuple[ChipSurvey, ...]  # in the order of the model's chips
    # evenly spaced samples of the squared errors of both axes, and True where the motion of the
    # star is measured
    variance: tuple[Float, ...]
    measured: tuple[Bool, ...]
    sources: tuple[str, ...]  # names of the files
    # largest distance of a star from its nominal position, and the name of the star; the distance
    # is negative if nominal positions are unknown
    farthest: tuple[float, str] = (-1.0, "")

    def __add__(self, other: Survey) -> Survey:
        return Survey(
            self.n + other.n,
            merge_groups(self.groups, other.groups)[0],
            self.exposures + other.exposures,
            tuple(a + b for a, b in zip(self.chips, other.chips, strict=True)),
            self.variance + other.variance,
            self.measured + other.measured,
            self.sources,
            max(self.farthest, other.farthest, key=lambda one: one[0]),
        )

    @property
    def reference_sigma(self) -> float:
        """Median quoted error per axis, in the unit of u and v; the scale of the priors.

        Stars whose motion is assumed are left out, unless there are no others: their errors are no
        scale of those of the others.
        """
        variance, measured = np.concatenate(self.variance), np.concatenate(self.measured)
        return float(np.sqrt(np.median(variance[measured] if measured.any() else variance)))

    def check_circle(self, radius: float | None) -> None:
        """Raise InputError if a star is outside its match circle.

        `radius` is in the unit of u, v; None if there is no match circle.  The message names the
        star that is farthest from its nominal position.
        """
        distance, star_name = self.farthest
        if radius is not None and distance > radius * (1 + ROUNDING):
            raise InputError(
                f"is {distance:.6g} from its nominal position, outside the match circle of "
                f"radius {radius:g}",
                where=star_name,
                do="set outliers.match_radius to the radius with which the stars were matched, or "
                "correct the row",
            )

    @property
    def where(self) -> str:
        """Names of the files, for error messages."""
        return ", ".join(self.sources)


def survey(stars: Stars, matches: Matches, every: int, measured: Bool | None = None) -> Survey:
    """Survey of a chunk of the data.

    The errors of every `every`-th star are sampled.  `measured` (N,), in the order of `stars`, is
    True for those whose motion is not assumed; by default all of them.
    """
    if measured is None:
        measured = np.ones(len(stars), bool)
    model = stars.model
    numbers = matches.chip_number
    chips = []
    for chip in model.chips:
        rows = np.flatnonzero(numbers == chip.number) if len(model.chips) > 1 else slice(None)
        x, y = matches.x[rows], matches.y[rows]
        out = (x < 0.5) | (x > chip.size[0] + 0.5) | (y < 0.5) | (y > chip.size[1] + 0.5)
        sentence = ""
        if out.any():
            k = int(np.arange(len(matches))[rows][np.argmax(out)])
            file = f" of {matches.sources[matches.source[k]]}" if len(matches.sources) > 1 else ""
            sentence = (
                f"row {matches.row[k] + 1}{file} lies at pixel ({matches.x[k]:.2f}, "
                f"{matches.y[k]:.2f}), outside the {chip.size[0]:g} x {chip.size[1]:g} detector"
            )
            if bool(((x <= chip.size[1] + 0.5) & (y <= chip.size[0] + 0.5)).all()):
                sentence += " (all rows would lie inside if x and y, or the size, are swapped)"
        a, b = x / chip.size[0], y / chip.size[1]
        sums = np.array([a.sum(), b.sum(), a @ a, a @ b, b @ b])
        chips.append(ChipSurvey(len(x), _hull(np.column_stack([x, y])), sums, sentence))
    return Survey(
        n=len(stars),
        groups=stars.groups,
        # truncated to the exposures of the model, which may be fewer if it has no frames
        exposures=np.bincount(matches.exposure, minlength=len(model.exposures))[
            : len(model.exposures)
        ],
        chips=tuple(chips),
        variance=tuple(variance[::every] for variance in stars.variances()),
        measured=2 * (measured[::every],),
        sources=matches.sources,
        farthest=_farthest(matches),
    )


def _farthest(matches: Matches) -> tuple[float, str]:
    """Largest distance of a star from its nominal position, and the file and row of the star."""
    if matches.u_nominal is None or matches.v_nominal is None:
        return -1.0, ""
    distance = np.hypot(matches.u - matches.u_nominal, matches.v - matches.v_nominal)
    k = int(np.argmax(distance))
    return float(distance[k]), f"{matches.sources[matches.source[k]]}, row {matches.row[k] + 1}"


def _hull(points: Float) -> Float:
    """Vertices of the convex hull, or all points if it has no area."""
    if len(points) < 4:
        return points
    try:
        if len(points) > 1000:  # drop points inside the octagon of the extremes, for speed
            x, y = points.T
            projections = (x, y, x + y, x - y)
            extreme = points[sorted(set(chain(*((p.argmin(), p.argmax()) for p in projections))))]
            inner = ConvexHull(extreme).equations
            beyond = np.zeros(len(points), bool)
            for a, b, c in inner:
                beyond |= a * x + b * y + c > -1e-9
            points = points[beyond]
        return points[ConvexHull(points).vertices]
    except QhullError:  # nearly collinear: no area
        return points
