"""Storage of shards in memory up to a limit, and beyond it in a scratch file."""

from __future__ import annotations

import io
import tempfile
import weakref
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from bayesdist.errors import InputError
from bayesdist.infer.stars.stars import Stars

EMPTY = np.zeros(0)
COLUMNS, OFFSETS = ("X", "Y", "u", "v", "var_u", "var_v"), ("off_u", "off_v")


class Store:
    """Sequence of shards, with at most `budget` bytes of columns in memory."""

    def __init__(self, budget: float) -> None:
        self._left = budget
        self._kept: list[tuple[Stars, tuple[io.FileIO, int] | None]] = []
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
            for column in (*stars.columns, *stars.offsets):
                _write(self._file, np.ascontiguousarray(column).view(np.uint8).data)
        except OSError as error:
            raise InputError(
                f"the stars do not fit into the scratch folder ({error.strerror})",
                where=_folder(),
                do="set TMPDIR to a folder with more space, or increase compute.memory_mb",
            ) from error
        none: dict[str, Any] = dict.fromkeys(COLUMNS + OFFSETS[: len(stars.offsets)], EMPTY)
        frame = replace(stars, **none)
        frame.__dict__.update(blocks=stars.blocks, pieces=stars.pieces)
        self._kept.append((frame, place))

    def close(self) -> None:
        """Release the shards and the scratch file."""
        self._kept = []
        if self._file is not None:
            self._closed()
            self._file = None

    def __iter__(self) -> Iterator[Stars]:
        for stars, place in self._kept:
            yield stars if place is None else self._restored(stars, *place)

    def _restored(self, frame: Stars, file: io.FileIO, place: int) -> Stars:
        n = int(frame.starts[-1])
        names = COLUMNS + OFFSETS[: len(frame.offsets)]
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
