"""Residual tables of the WISE report (WSDC D-T033, section 5 and Appendix C)."""

from bayesdist.diagnose.statistics.bands import (
    BAND_AXES,
    WISE_ARCSEC,
    BandBins,
    band_bins,
)
from bayesdist.diagnose.statistics.changes import PatternChange, pattern_changes
from bayesdist.diagnose.statistics.pairs import pair_statistics
from bayesdist.diagnose.statistics.rows import (
    STATISTICS,
    BinValues,
    StatisticsRow,
    bin_row,
    pair_row,
)
from bayesdist.diagnose.statistics.tables import (
    StatisticsTable,
    band_to_band_table,
    fitting_table,
    multiframe_table,
    period_table,
)

__all__ = [
    "BAND_AXES",
    "STATISTICS",
    "WISE_ARCSEC",
    "BandBins",
    "BinValues",
    "PatternChange",
    "StatisticsRow",
    "StatisticsTable",
    "band_bins",
    "band_to_band_table",
    "bin_row",
    "fitting_table",
    "multiframe_table",
    "pair_row",
    "pair_statistics",
    "pattern_changes",
    "period_table",
]
