"""What comes in: matched positions, reference catalogues, and how these are matched.

`read_matches` is the way in, `read_rvb` that of WISE's pairs.  Behind them each kind of file has a
module of its own, and all of them end in a `MatchTable`, where units, errors and row numbers have
been checked.  What outgrows the memory is Parquet: `open_matches` leaves it on disk and gives
`PartitionedMatches`, whose pieces are MatchTables; `write_partitioned` makes such files.
"""

from bayesdist.data.catalog import ReferenceCatalog, catalog_from_table, read_catalog
from bayesdist.data.exposure_log import Exposure, ExposureLog
from bayesdist.data.exposures import read_exposures, write_exposures
from bayesdist.data.hst1pass import Hst1passList, read_hst1pass, read_matchup
from bayesdist.data.magnitude_errors import MagnitudeErrors
from bayesdist.data.matches import MatchTable
from bayesdist.data.matching.campaign import CampaignMatches, match_campaign
from bayesdist.data.matching.linear_map import LinearMap
from bayesdist.data.matching.reports import ExposureReport
from bayesdist.data.matching.search_radius import SearchRadius, search_radius
from bayesdist.data.matching.similarity import find_similarity, pattern_index
from bayesdist.data.matching.table import Matching, match_table, match_to_catalog
from bayesdist.data.motions import (
    MotionErrorLine,
    derive_motions,
    motion_error_line,
    select_motions,
)
from bayesdist.data.partitioned import PartitionedMatches, open_matches
from bayesdist.data.pieces import PIECE, Piece
from bayesdist.data.preparing import centroid_errors, neutralise_aberration, with_centroid_errors
from bayesdist.data.reading.formats import FORMATS, input_files
from bayesdist.data.reading.options import ReadOptions
from bayesdist.data.reading.read import read_matches
from bayesdist.data.reading.table import matches_from_table
from bayesdist.data.rvb import read_rvb, rvb_bands, stream_rvb
from bayesdist.data.rvb_accept import RadialLimit
from bayesdist.data.rvb_linear import fit_transform, linear_moments
from bayesdist.data.rvb_pairs import RvbPairs
from bayesdist.data.rvb_select import RvbSelection, SelectedPairs
from bayesdist.data.rvb_solutions import read_solutions
from bayesdist.data.rvb_transform import RvbTransform, rereference, transformed
from bayesdist.data.rvb_write import write_rvb
from bayesdist.data.sky.earth import velocity_aberration
from bayesdist.data.sky.tangent import mean_direction, tangent_plane
from bayesdist.data.starlists import StarCuts, StarList, read_star_lists, star_list_of_hst1pass
from bayesdist.data.tables.units import UNITS
from bayesdist.data.write import write_partitioned

__all__ = [
    "FORMATS",
    "PIECE",
    "UNITS",
    "CampaignMatches",
    "Exposure",
    "ExposureLog",
    "ExposureReport",
    "Hst1passList",
    "LinearMap",
    "MagnitudeErrors",
    "MatchTable",
    "Matching",
    "MotionErrorLine",
    "PartitionedMatches",
    "Piece",
    "RadialLimit",
    "ReadOptions",
    "ReferenceCatalog",
    "RvbPairs",
    "RvbSelection",
    "RvbTransform",
    "SearchRadius",
    "SelectedPairs",
    "StarCuts",
    "StarList",
    "catalog_from_table",
    "centroid_errors",
    "derive_motions",
    "find_similarity",
    "fit_transform",
    "input_files",
    "linear_moments",
    "match_campaign",
    "match_table",
    "match_to_catalog",
    "matches_from_table",
    "mean_direction",
    "motion_error_line",
    "neutralise_aberration",
    "open_matches",
    "pattern_index",
    "read_catalog",
    "read_exposures",
    "read_hst1pass",
    "read_matches",
    "read_matchup",
    "read_rvb",
    "read_solutions",
    "read_star_lists",
    "rereference",
    "rvb_bands",
    "search_radius",
    "select_motions",
    "star_list_of_hst1pass",
    "stream_rvb",
    "tangent_plane",
    "transformed",
    "velocity_aberration",
    "with_centroid_errors",
    "write_exposures",
    "write_partitioned",
    "write_rvb",
]
