"""Data that the figures of a campaign draw: markers, outlines, residuals and linear terms.

Processes that draw import this module, and not those that the data are made with.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from astropy.table import Table

from bayesdist.diagnose.residuals.binned import BinnedResiduals
from bayesdist.model import Chip
from bayesdist.report.run import ReportedRun
from bayesdist.utils.arrays import Bool, Float, Int


@dataclass(frozen=True, eq=False)
class CatalogStars:
    """Quoted errors of the catalogue, and the limit above which its proper motions are not used."""

    mag: Float  # (N,), instrumental
    sigma: Float | None  # (N,), errors of the positions, hypot of both axes
    sigma_motion: Float | None  # (N,), errors of the proper motions, the larger axis
    limit: tuple[Float, Float] | None  # magnitudes and largest errors used; None for no limit
    unit: str
    n_used: int  # number of selected stars


@dataclass(frozen=True, eq=False)
class DetectionQuality:
    """Quality of the detections, and the selection cuts."""

    mag: Float  # (N,), of the detections that are drawn
    q: Float  # (N,)
    kept: Bool  # (N,), True if they pass the cuts
    n_total: int  # number of all detections
    n_kept: int  # number of all detections that pass the cuts
    mag_cuts: tuple[float, ...]  # limits in magnitude
    q_max: float | None


@dataclass(frozen=True, eq=False)
class Footprints:
    """Positions of the exposures on the catalogue."""

    u: Float  # (N,), catalogue stars
    v: Float
    outlines: tuple[Float, ...]  # (M, 2), closed, of each chip in each exposure
    epoch: Float  # of each outline
    unit: str


@dataclass(frozen=True, eq=False)
class TableResiduals:
    """Residuals on one chip, without look-up tables and, if there are any, with them.

    In both cases the polynomial and a linear map of each exposure are fitted. Residuals (N, 2) are
    data minus model of the same matches in pixels, rotated to the detector axes, because exposures
    have different rolls and effects of the detector are visible only along x and y.
    """

    chip: Chip
    without: Float
    with_tables: Float | None
    binned_without: BinnedResiduals
    binned_with: BinnedResiduals | None  # in the same cells


@dataclass(frozen=True, eq=False)
class LinearSeries:
    """Linear terms of the exposures, each fitted separately."""

    exposures: Table  # content of series.ecsv
    drift: Table  # content of drift.ecsv
    vafactor: Float  # (E,)
    pa_v3: Float  # (E,), degrees, NaN if unknown
    breaks: tuple[float, ...]

    @property
    def epoch(self) -> Float:
        """Epochs of the exposures."""
        return np.asarray(self.exposures["epoch"], float)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the terms with their chips, 'WFC1.A_2'."""
        names = self.exposures.colnames
        return tuple(n for n in names if f"sigma_{n}" in names)

    @property
    def segment(self) -> Int:
        """Segment of each exposure, from 0."""
        return np.searchsorted(np.asarray(self.breaks, float), self.epoch, side="right")

    @property
    def outlying(self) -> Bool:
        """Mask of the exposures that are more likely outliers than not."""
        return np.asarray(self.exposures["outlier_probability"], float) > 0.5


@dataclass(frozen=True, eq=False)
class CampaignData:
    """Data that figures and tables of a campaign show in addition to the artefacts of its run."""

    filter: str
    matching: Table  # content of matching.ecsv
    catalog: CatalogStars | None = None
    detections: DetectionQuality | None = None
    footprints: Footprints | None = None
    residuals: tuple[TableResiduals, ...] = ()
    series: LinearSeries | None = None


def campaign_data(run: ReportedRun) -> CampaignData:
    """Data of the figures of a run, which is a campaign."""
    data: CampaignData = run.report_data
    return data


def summary_section(run: ReportedRun, name: str) -> Mapping[str, Any]:
    """Section of summary.json; empty if there is none."""
    section: Mapping[str, Any] = run.summary.get(name) or {}
    return section


def chip_name(run: ReportedRun, number: int) -> str:
    """Name of a chip."""
    return next(c.name or f"chip {number}" for c in run.model.chips if c.number == number)
