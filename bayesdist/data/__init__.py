"""Input: matched positions, reference catalogues, and the matching of star lists with catalogues.

`read_matches` reads any known kind of file.  Each kind has a module of its own, and all of them end
in `Matches`, where units, errors and row numbers have been checked.  Tables that are larger than
the memory are Parquet: `open_matches` leaves them on disk, to be read in batches;
`write_partitioned` makes such files.
"""

from __future__ import annotations

from typing import Any

from bayesdist.lazy import lazy_name

_HOMES = {
    "bayesdist.data.catalog": ("ReferenceCatalog", "catalog_from_table", "read_catalog"),
    "bayesdist.data.detections": ("Detections",),
    "bayesdist.data.exposures": (
        "Exposure",
        "ExposureLog",
        "read_exposures",
        "write_exposures",
    ),
    "bayesdist.data.formats.hst1pass": ("Hst1passList", "read_hst1pass", "read_matchup"),
    "bayesdist.data.magnitude_errors": ("MagnitudeErrors",),
    "bayesdist.data.matches": ("Matches",),
    "bayesdist.data.matching.campaign": ("CampaignMatches", "match_campaign"),
    "bayesdist.data.matching.linear_map": ("LinearMap",),
    "bayesdist.data.matching.reports": ("ExposureReport",),
    "bayesdist.data.matching.search_radius": ("SearchRadius", "search_radius"),
    "bayesdist.data.matching.similarity": ("find_similarity", "pattern_index"),
    "bayesdist.data.matching.table": ("Matching", "match_table", "match_to_catalog"),
    "bayesdist.data.storage.on_disk": ("open_matches",),
    "bayesdist.data.preparing": (
        "centroid_errors",
        "motion_error_line",
        "neutralise_aberration",
        "select_motions",
    ),
    "bayesdist.data.formats.files": ("FORMATS", "MatchFormat", "input_files"),
    "bayesdist.data.reading.options": ("ReadOptions",),
    "bayesdist.data.read": ("read_matches",),
    "bayesdist.data.reading.table": ("matches_from_table",),
    "bayesdist.data.sky.earth": ("velocity_aberration",),
    "bayesdist.data.sky.tangent": ("mean_direction", "tangent_plane"),
    "bayesdist.data.starlists": ("StarCuts", "read_star_lists"),
    "bayesdist.data.tables.units": ("UNITS",),
    "bayesdist.data.storage.write": ("write_partitioned",),
}

__all__ = sorted(name for names in _HOMES.values() for name in names)


def __getattr__(name: str) -> Any:
    return lazy_name(__name__, _HOMES, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
