"""What comes in: matched positions, reference catalogues, and how these are matched.

`read_matches` is the way in.  Behind it each kind of file has a module of its own, and all of them
end in a `MatchTable`, where units, errors and row numbers have been checked.  What outgrows the
memory is Parquet: `open_matches` leaves it on disk and gives `PartitionedMatches`, whose pieces are
MatchTables; `write_partitioned` makes such files.
"""

from bayesdist.data.catalog import ReferenceCatalog, catalog_from_table, read_catalog
from bayesdist.data.columns import matches_from_table
from bayesdist.data.files import atomic_path, is_leftover, remove_leftovers, sha256_of
from bayesdist.data.hst1pass import Hst1passList, read_hst1pass, read_matchup
from bayesdist.data.linear_map import LinearMap
from bayesdist.data.magnitude_errors import MagnitudeErrors
from bayesdist.data.matches import MatchTable
from bayesdist.data.matching import Matching, match_table, match_to_catalog
from bayesdist.data.partitioned import PartitionedMatches, open_matches
from bayesdist.data.pieces import PIECE, Piece
from bayesdist.data.readers import FORMATS, input_files, read_matches
from bayesdist.data.tangent import mean_direction, tangent_plane
from bayesdist.data.units import UNITS
from bayesdist.data.writing import write_partitioned

__all__ = [
    "FORMATS",
    "PIECE",
    "UNITS",
    "Hst1passList",
    "LinearMap",
    "MagnitudeErrors",
    "MatchTable",
    "Matching",
    "PartitionedMatches",
    "Piece",
    "ReferenceCatalog",
    "atomic_path",
    "catalog_from_table",
    "input_files",
    "is_leftover",
    "match_table",
    "match_to_catalog",
    "matches_from_table",
    "mean_direction",
    "open_matches",
    "read_catalog",
    "read_hst1pass",
    "read_matches",
    "read_matchup",
    "remove_leftovers",
    "sha256_of",
    "tangent_plane",
    "write_partitioned",
]
