"""Trends of coefficients of many exposures with time: lines, breaks, scatter, predictions."""

from bayesdist.kinds.campaign.series.compare import (
    FilterDependence,
    TrendComparison,
    TrendVerdict,
    compare,
    default_candidates,
    describe,
    filter_dependence,
    serial_correlation,
)
from bayesdist.kinds.campaign.series.posterior import (
    ChangeAtBreak,
    HeldOut,
    SeriesPosterior,
    SeriesPrediction,
    block_folds,
    exposure_folds,
    fit_series,
    held_out,
)
from bayesdist.kinds.campaign.series.series import Series
from bayesdist.kinds.campaign.series.trend import KINDS, Design, TrendModel

__all__ = [
    "KINDS",
    "ChangeAtBreak",
    "Design",
    "FilterDependence",
    "HeldOut",
    "Series",
    "SeriesPosterior",
    "SeriesPrediction",
    "TrendComparison",
    "TrendModel",
    "TrendVerdict",
    "block_folds",
    "compare",
    "default_candidates",
    "describe",
    "exposure_folds",
    "filter_dependence",
    "fit_series",
    "held_out",
    "serial_correlation",
]
