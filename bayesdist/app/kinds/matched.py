"""What the stage 'match' makes: the stars of a run, and what is known of their matching."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from astropy.table import Table

from bayesdist.app.output import write_table
from bayesdist.data import Matches

__all__ = ["Matched", "Prepared"]

MATCHING = "matching.ecsv"


@dataclass(frozen=True, eq=False)
class Matched:
    """Matches of a run, in two parts, as they were read or found.

    Parameters
    ----------
    stars : Matches
        Those that are fitted.
    held : Matches or None
        Those that are held out; None where none are.
    whole : tuple of str
        Exposures that are held out whole.
    facts : mapping
        Section of summary.json; empty for stars that were given as matches.
    table : astropy.table.Table or None
        One row for each exposure; None for stars that were given as matches.
    """

    stars: Matches
    held: Matches | None = None
    whole: tuple[str, ...] = ()
    facts: Mapping[str, Any] = field(default_factory=dict)
    table: Table | None = None

    @property
    def warnings(self) -> tuple[str, ...]:
        """What was odd in the matching, each as a clause."""
        return tuple(self.facts.get("warnings", ()))

    def save(self, folder: Path) -> None:
        """Write the files of a run's folder that belong to it."""
        if self.table is not None:
            write_table(self.table, folder / MATCHING)


@dataclass(frozen=True, eq=False)
class Prepared:
    """Stars as a fit took them: where its tables move them, with its errors.

    Parameters
    ----------
    stars : Matches
        Those that are fitted.
    held : Matches or None
        Those that are held out, in the same way.
    """

    stars: Matches
    held: Matches | None = None
