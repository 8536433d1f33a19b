"""Parts: results of the matching or the fit that only some kinds of runs have."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from bayesdist.data.matches import Matches
from bayesdist.diagnose.tables import BetweenNodes
from bayesdist.files.records import read_record, write_record
from bayesdist.infer.nodes import corrected_matches, on_the_chips
from bayesdist.model import DistortionModel, LookupTable
from bayesdist.utils.arrays import Float

TABLES = "tables.h5"


class Part:
    """Result of the matching or the fit that only some kinds of runs have.

    Subclasses override what they contribute; the methods of this class contribute nothing.
    """

    title: ClassVar[str]  # what a run lacks without it, for errors
    stage: ClassVar[str] = "fit"  # or "match": the stage that makes it
    # True for a dataclass of numbers, texts and arrays, which is stored in fit.h5 and restored by
    # `read_stored_fit`; other parts are written by `save` and read by `load_fit` of their kind
    recorded: ClassVar[bool] = False
    is_hierarchy: ClassVar[bool] = False  # exposures scatter about the solution of the fit
    applies_errors: ClassVar[bool] = False  # stars from `placed` have their errors already

    def save(self, folder: Path) -> None:
        """Write the part to the folder of a run."""

    def placed(self, stars: Matches, model: DistortionModel) -> Matches:
        """Stars at the positions that the fit has used."""
        return stars

    def gauge_sentence(self) -> str:
        """Sentence that states the gauge of the products; may be empty."""
        return ""


@dataclass(frozen=True, eq=False)
class StoredLookupTables(Part):
    """Look-up tables of a run with their errors."""

    title = "look-up tables"

    tables: tuple[LookupTable, ...] = ()  # tables of the detector come first
    # by chip, (ny, nx, 2): position errors caused by the errors of all tables, in the unit of u, v
    position_sigma: Mapping[int, Float] = field(default_factory=dict)
    # by chip, if measured: distortion between the nodes that no table follows
    between: Mapping[int, BetweenNodes] = field(default_factory=dict)

    def save(self, folder: Path) -> None:
        """Write the tables to the folder of a run."""
        write_tables(folder / TABLES, self)

    def placed(self, stars: Matches, model: DistortionModel) -> Matches:
        """Stars with corrected pixels, without those moved off their chip."""
        if not self.tables or not stars.in_memory:
            return stars
        return on_the_chips(corrected_matches(self.tables, stars), model)


NO_TABLES = StoredLookupTables()


def write_tables(path: Path, stored: StoredLookupTables) -> None:
    """Write look-up tables to a file, or remove the file if there are no tables."""
    if stored.tables:
        write_record(path, stored)
    else:
        path.unlink(missing_ok=True)


def read_tables(path: Path, *, do: str) -> StoredLookupTables:
    """Look-up tables of a file written by `write_tables`; empty if there is no file.

    `do` completes the message of an error: what the user should do.
    """
    if not path.exists():
        return StoredLookupTables()
    return read_record(path, StoredLookupTables, "a file of look-up tables", do=do)
