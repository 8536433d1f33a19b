"""Public names and the modules that define them; each is imported on first use."""

from .catalog import ReferenceCatalog as ReferenceCatalog
from .detections import Detections as Detections
from .exposures import (
    Exposure as Exposure,
    ExposureLog as ExposureLog,
    read_exposures as read_exposures,
    write_exposures as write_exposures,
)
from .formats import (
    FORMATS as FORMATS,
    MatchFormat as MatchFormat,
    input_files as input_files,
)
from .magnitude_errors import MagnitudeErrors as MagnitudeErrors
from .matches import Matches as Matches
from .matching.campaign import (
    CampaignMatches as CampaignMatches,
    match_campaign as match_campaign,
)
from .matching.pairs import LinearMap as LinearMap
from .matching.reports import ExposureReport as ExposureReport
from .matching.rough_wcs import match as match
from .matching.exposure import (
    SearchRadius as SearchRadius,
    search_radius as search_radius,
)
from .matching.similarity import (
    find_similarity as find_similarity,
    pattern_index as pattern_index,
)
from .matching.table import (
    Matching as Matching,
    match_table as match_table,
    match_to_catalog as match_to_catalog,
)
from .preparing import (
    centroid_errors as centroid_errors,
    motion_error_line as motion_error_line,
    neutralise_aberration as neutralise_aberration,
    select_motions as select_motions,
    with_measured_motions as with_measured_motions,
)
from .read import read_matches as read_matches
from .reading.catalog import (
    catalog_from_table as catalog_from_table,
    read_catalog as read_catalog,
)
from .reading.options import ReadOptions as ReadOptions
from .sky import velocity_aberration as velocity_aberration
from .starlists import (
    StarCuts as StarCuts,
    read_star_lists as read_star_lists,
)
from .storage import open_matches as open_matches
from .tables.column import UNITS as UNITS
from .tangent import (
    mean_direction as mean_direction,
    tangent_plane as tangent_plane,
)
from .writing import write_partitioned as write_partitioned
