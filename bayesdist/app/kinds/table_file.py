"""tables.h5: the look-up tables of a run, their errors, and what lies between their nodes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.diagnose.tables.between_nodes import BetweenNodes
from bayesdist.infer.sampler.checkpoints import read_arrays, write_arrays
from bayesdist.model import LookupTable
from bayesdist.reading.faults import restoring

__all__ = ["StoredLookupTables", "read_tables", "write_tables"]

Float = NDArray[np.float64]

ERRORS, BETWEEN = "position_sigma", "between"


@dataclass(frozen=True, eq=False)
class StoredLookupTables:
    """Look-up tables of a run, with their errors.

    Parameters
    ----------
    tables : tuple of LookupTable
        The detector's first.
    position_sigma : mapping of int to ndarray, shape (ny, nx, 2)
        By chip: errors of positions by those of all tables, in the unit of u, v.
    between : mapping of int to BetweenNodes
        By chip, where it has been measured: what all tables leave between their nodes.
    """

    tables: tuple[LookupTable, ...] = ()
    position_sigma: Mapping[int, Float] = field(default_factory=dict)
    between: Mapping[int, BetweenNodes] = field(default_factory=dict)


def write_tables(path: Path, stored: StoredLookupTables) -> None:
    """Write the file; without tables there is none."""
    if not stored.tables:
        path.unlink(missing_ok=True)
        return
    arrays: dict[str, Any] = {
        f"{chip}.{ERRORS}": sigma for chip, sigma in stored.position_sigma.items()
    }
    for one in stored.between.values():
        n = np.full(2, one.n_pairs)
        arrays[f"{one.chip}.{BETWEEN}"] = np.stack([one.square, one.error, n])
    for table in stored.tables:
        of = f"{table.chip}.{table.filter}." if table.filter else f"{table.chip}."
        arrays |= {
            f"{of}values": table.values,
            f"{of}first": np.array(table.first),
            f"{of}step": np.array(table.step),
        }
        if table.sigma is not None:
            arrays[f"{of}sigma"] = table.sigma
    write_arrays(path, "", arrays)


def read_tables(path: Path, *, do: str) -> StoredLookupTables:
    """Read what `write_tables` wrote; nothing where there is no file.

    Raises
    ------
    InputError
        For a damaged file, with `do` as the advice.
    """
    if not path.exists():
        return StoredLookupTables()
    arrays = read_arrays(path, "", do=do)
    with restoring(path, "a file of look-up tables", do=do):
        return _restored(arrays)


def _restored(arrays: Mapping[str, NDArray[Any]]) -> StoredLookupTables:
    """Tables from the arrays of their file."""
    of_all = [name.removesuffix("values") for name in arrays if name.endswith(".values")]
    tables = []
    # the detector's before those of filters, and chips by their numbers
    for of in sorted(of_all, key=lambda of: (of.count(".") > 1, of)):
        chip, _, filter = of.removesuffix(".").partition(".")
        tables.append(
            LookupTable(
                int(chip),
                arrays[f"{of}values"],
                filter,
                tuple(arrays[f"{of}first"]),
                tuple(arrays[f"{of}step"]),
                arrays.get(f"{of}sigma"),
            )
        )
    errors, between = (
        {
            int(name.partition(".")[0]): values
            for name, values in arrays.items()
            if name.endswith(f".{kind}")
        }
        for kind in (ERRORS, BETWEEN)
    )
    measured = {
        chip: BetweenNodes(chip, square, error, int(n[0]))
        for chip, (square, error, n) in between.items()
    }
    return StoredLookupTables(tuple(tables), errors, measured)
