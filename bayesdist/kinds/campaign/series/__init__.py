"""Trends of coefficients of many exposures with time: lines, breaks, scatter, predictions."""

from bayesdist.kinds.campaign.series.compare import (
    Comparison,
    FilterDependence,
    Verdict,
    compare,
    default_candidates,
    describe,
    filter_dependence,
    serial_correlation,
)
from bayesdist.kinds.campaign.series.posterior import (
    Change,
    HeldOut,
    Prediction,
    SeriesPosterior,
    block_folds,
    exposure_folds,
    fit_series,
    held_out,
)
from bayesdist.kinds.campaign.series.series import KINDS, Design, Series, TrendModel

__all__ = [
    "KINDS",
    "Change",
    "Comparison",
    "Design",
    "FilterDependence",
    "HeldOut",
    "Prediction",
    "Series",
    "SeriesPosterior",
    "TrendModel",
    "Verdict",
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
