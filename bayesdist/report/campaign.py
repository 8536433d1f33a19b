"""Input of the report of a campaign."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesdist.model import Chip, LookupTable
from bayesdist.utils.arrays import Bool, Float, Int

if TYPE_CHECKING:
    from astropy.table import Table

    from bayesdist.data import MagnitudeErrors
    from bayesdist.diagnose.overlap import OverlapTest
    from bayesdist.diagnose.residuals.binned import BinnedResiduals


@dataclass(frozen=True, eq=False)
class CatalogStars:
    """Errors of the catalogue, as quoted, and the limit above which its motions are not used."""

    mag: Float  # (N,), instrumental
    sigma: Float | None  # (N,), of the positions, hypot of both axes
    sigma_motion: Float | None  # (N,), of the proper motions, the larger axis
    limit: tuple[Float, Float] | None  # magnitudes and largest errors used; None where all are
    unit: str
    n_used: int  # stars that the selection leaves


@dataclass(frozen=True, eq=False)
class Detections:
    """Quality of the detections, and the cuts."""

    mag: Float  # (N,), of those that are drawn
    q: Float  # (N,)
    kept: Bool  # (N,), True where they pass the cuts
    n_total: int  # of all
    n_kept: int  # of all
    mag_cuts: tuple[float, ...]  # magnitudes beyond which detections are left out
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
class ChipResiduals:
    """Residuals on one chip, without the look-up tables and, where there are any, with them.

    Each time the polynomial is fitted, and a linear map of each exposure.  Residuals (N, 2) are of
    the same matches, data minus model in pixels, brought to the detector's axes: exposures are
    rolled, and what belongs to the detector shows only along x and y.
    """

    chip: Chip
    without: Float
    with_tables: Float | None
    binned_without: BinnedResiduals
    binned_with: BinnedResiduals | None  # of the same cells


@dataclass(frozen=True, eq=False)
class LinearSeries:
    """Linear terms of the exposures, each fitted by itself."""

    exposures: Table  # as series.ecsv
    drift: Table  # as drift.ecsv
    vafactor: Float  # (E,)
    pa_v3: Float  # (E,), degrees, NaN where it is not known
    breaks: tuple[float, ...]

    @property
    def epoch(self) -> Float:
        """Epochs of the exposures."""
        return np.asarray(self.exposures["epoch"], float)

    @property
    def labels(self) -> tuple[str, ...]:
        """Terms with the names of their chips, 'WFC1.A_2'."""
        names = self.exposures.colnames
        return tuple(n for n in names if f"sigma_{n}" in names)

    @property
    def segment(self) -> Int:
        """Segment of each exposure, from 0."""
        return np.searchsorted(np.asarray(self.breaks, float), self.epoch, side="right")

    @property
    def outlying(self) -> Bool:
        """Mask of the exposures that are more likely off the line than not."""
        return np.asarray(self.exposures["outlier_probability"], float) > 0.5


@dataclass(frozen=True, eq=False)
class CampaignResults:
    """Results that a campaign adds to a run."""

    summary: Mapping[str, Any]  # as summary.json
    config: Mapping[str, Any]  # resolved
    filter: str
    matching: Table  # as matching.ecsv
    chips: tuple[Chip, ...]  # in the order of the model
    unit: str  # of u and v
    catalog: CatalogStars | None = None
    centroids: MagnitudeErrors | None = None  # errors of single detections, from the residuals
    detections: Detections | None = None
    footprints: Footprints | None = None
    residuals: tuple[ChipResiduals, ...] = ()
    tables: tuple[LookupTable, ...] = field(default=())
    series: LinearSeries | None = None
    overlap: OverlapTest | None = None
    held: tuple[str, ...] = ()  # parameters constrained by their prior alone

    def section(self, name: str) -> Mapping[str, Any]:
        """Part of summary.json; empty where there is none."""
        found: Mapping[str, Any] = self.summary.get(name) or {}
        return found

    @property
    def table_filters(self) -> tuple[str, ...]:
        """Filters of the tables in order; '' is the detector's own."""
        return tuple(dict.fromkeys(table.filter for table in self.tables))

    def chip_name(self, number: int) -> str:
        """Name of a chip."""
        return next(c.name or f"chip {number}" for c in self.chips if c.number == number)
