"""Sets of files that a mission releases together, for several filters and periods."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from bayesdist.app.config.products import ReleaseBlock
from bayesdist.calibration.calibration import Calibration
from bayesdist.errors import InputError
from bayesdist.infer.solution.solution import Solution
from bayesdist.model import LookupTable
from bayesdist.plugin import mission_objects

Entry = dict[str, Any]  # of a file in summary.json: path, kind, findings and others


@dataclass(frozen=True)
class ReleaseSet:
    """Functions that write the files of a release and read them back.

    Parameters
    ----------
    write : callable
        ``write(block, chip, base, folder, solutions, tables, history)`` writes the files to
        `folder` and returns one entry per file: path, kind, findings and, for files of a period,
        'period' and 'lost'. `block` is the section [products.release], `chip` the number of the
        chip whose axes and zero point define the gauge, `base` the folder that file names are
        relative to, `solutions` a mapping of filter to solution with that of the configuration
        first, `tables` the look-up tables, and `history` lines of text for the files.
    calibrations : callable
        ``calibrations(entries, folder, filter)`` reads the files of a filter back, and returns the
        calibrations by the names of the periods.
    kinds : mapping of str to str
        Description of the files in the report, by their kind.
    """

    write: Callable[
        [
            Any,
            int,
            Path,
            Path,
            Mapping[str, Solution],
            Sequence[LookupTable],
            Sequence[str],
        ],
        list[Entry],
    ]
    calibrations: Callable[[Sequence[Entry], Path, str], dict[str, Calibration]]
    kinds: Mapping[str, str]


@cache
def release_set() -> ReleaseSet:
    """Release of the installed missions; InputError if none has one."""
    sets = mission_objects(lambda mission: mission.releases)
    if not sets:
        raise InputError(
            "no installed mission releases files",
            where="products.release",
            do="install a mission that does, or leave the section out",
        )
    if len(sets) > 1:
        raise InputError(
            f"several missions release files: {', '.join(sorted(sets))}",
            where="products.release",
            do="name the plugin of one of them in the environment variable BAYESDIST_PLUGINS",
        )
    found: ReleaseSet = next(iter(sets.values()))
    return found


def first_segments(
    block: ReleaseBlock, sets: Mapping[str, Calibration], n_segments: int
) -> list[Calibration]:
    """Calibrations of a release, one per segment; that of the first period of each segment."""
    segments: dict[int, Calibration] = {}
    for period in block.period:
        segments.setdefault(period.segment, sets[period.name])
    last = segments[min(segments)]
    return [segments.get(k, last) for k in range(n_segments)]
