"""Residuals in bins and samples: their tables, and whether they are those of noise."""

from bayesdist.diagnose.residuals.binned import (
    BAND_AXES,
    BinnedResiduals,
    BinnedSums,
    BinValues,
    band_bins,
    binned_residuals,
    binned_sums,
)
from bayesdist.diagnose.residuals.changes import PatternChange, pattern_changes
from bayesdist.diagnose.residuals.rows import (
    STATISTICS,
    StatisticsRow,
    bin_row,
    pair_row,
    pair_statistics,
)
from bayesdist.diagnose.residuals.tables import StatisticsTable, period_table

__all__ = [
    "BAND_AXES",
    "STATISTICS",
    "BinValues",
    "BinnedResiduals",
    "BinnedSums",
    "PatternChange",
    "StatisticsRow",
    "StatisticsTable",
    "band_bins",
    "bin_row",
    "binned_residuals",
    "binned_sums",
    "pair_row",
    "pair_statistics",
    "pattern_changes",
    "period_table",
]
