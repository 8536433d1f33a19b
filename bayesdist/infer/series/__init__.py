"""Trends of coefficients of many exposures with time: lines, breaks, scatter, predictions."""

from bayesdist.infer.series.compare import (
    Comparison,
    FilterDependence,
    compare,
    filter_dependence,
    serial_correlation,
)
from bayesdist.infer.series.design import Design
from bayesdist.infer.series.fit import fit_series
from bayesdist.infer.series.heldout import HeldOut, block_folds, exposure_folds, held_out
from bayesdist.infer.series.posterior import Change, Prediction, SeriesPosterior
from bayesdist.infer.series.series import Series
from bayesdist.infer.series.trend import KINDS, TrendModel
from bayesdist.infer.series.verdict import Verdict, default_candidates, describe

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
