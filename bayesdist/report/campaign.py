"""What the report of a campaign is made from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from astropy.table import Table

    from bayesdist.assess import BinnedResiduals
    from bayesdist.data import MagnitudeErrors
    from bayesdist.diagnose.overlap import OverlapTest
from bayesdist.model import Chip, LookupTable

__all__ = [
    "CampaignResults",
    "CatalogStars",
    "ChipResiduals",
    "Detections",
    "Footprints",
    "LinearSeries",
]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CatalogStars:
    """Errors of the catalogue, as quoted, and the limit above which its motions are not used.

    Parameters
    ----------
    mag : ndarray, shape (N,)
        Instrumental.
    sigma : ndarray, shape (N,), or None
        Errors of the positions, hypot of both axes.
    sigma_motion : ndarray, shape (N,), or None
        Errors of the proper motions, the larger one of the axes.
    limit : tuple of ndarray, or None
        Magnitudes and largest errors of a motion that is used; None where all are.
    unit : str
    n_used : int
        Stars that the selection leaves.
    """

    mag: Float
    sigma: Float | None
    sigma_motion: Float | None
    limit: tuple[Float, Float] | None
    unit: str
    n_used: int


@dataclass(frozen=True, eq=False)
class Detections:
    """Quality of the detections, and the cuts.

    Parameters
    ----------
    mag, q : ndarray, shape (N,)
        Of those that are drawn.
    kept : ndarray of bool, shape (N,)
        Whether they pass the cuts.
    n_total, n_kept : int
        Of all.
    mag_cuts : tuple of float
        Magnitudes beyond which detections are left out.
    q_max : float or None
    """

    mag: Float
    q: Float
    kept: NDArray[np.bool_]
    n_total: int
    n_kept: int
    mag_cuts: tuple[float, ...]
    q_max: float | None


@dataclass(frozen=True, eq=False)
class Footprints:
    """Where the exposures lie on the catalogue.

    Parameters
    ----------
    u, v : ndarray, shape (N,)
        Catalogue stars.
    outlines : tuple of ndarray, each (M, 2)
        Closed outline of each chip in each exposure.
    epoch : ndarray
        Of each outline.
    unit : str
    """

    u: Float
    v: Float
    outlines: tuple[Float, ...]
    epoch: Float
    unit: str


@dataclass(frozen=True, eq=False)
class ChipResiduals:
    """Residuals on one chip, without the look-up tables and, where there are any, with them.

    Each time the polynomial is fitted, and a linear map of each exposure.

    Parameters
    ----------
    chip : Chip
    without : ndarray, shape (N, 2)
    with_tables : ndarray, shape (N, 2), or None
        The same pairs, data minus model, brought to the detector's axes: exposures are rolled, and
        what belongs to the detector shows only along x and y.  Pixels.
    binned_without : BinnedResiduals
    binned_with : BinnedResiduals or None
        Of the same cells.
    """

    chip: Chip
    without: Float
    with_tables: Float | None
    binned_without: BinnedResiduals
    binned_with: BinnedResiduals | None


@dataclass(frozen=True, eq=False)
class LinearSeries:
    """Linear terms of the exposures, each fitted by itself.

    Parameters
    ----------
    exposures : Table
        As series.ecsv.
    drift : Table
        As drift.ecsv.
    vafactor, pa_v3 : ndarray, shape (E,)
        PA_V3 in degrees, NaN where it is not known.
    breaks : tuple of float
    """

    exposures: Table
    drift: Table
    vafactor: Float
    pa_v3: Float
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
    def segment(self) -> NDArray[np.int64]:
        """Segment of each exposure, from 0."""
        return np.searchsorted(np.asarray(self.breaks, float), self.epoch, side="right")

    @property
    def outlying(self) -> NDArray[np.bool_]:
        """Exposures that are more likely off the course than not."""
        return np.asarray(self.exposures["outlier_probability"], float) > 0.5


@dataclass(frozen=True, eq=False)
class CampaignResults:
    """What a campaign adds to a run.

    Parameters
    ----------
    summary : mapping
        As summary.json.
    config : mapping
        The resolved configuration.
    filter : str
    matching : Table
        As matching.ecsv.
    chips : tuple of Chip
        In the order of the model.
    unit : str
        Of u and v.
    catalog : CatalogStars or None
    centroids : MagnitudeErrors or None
        Errors of single detections, from the residuals.
    detections : Detections or None
    footprints : Footprints or None
    residuals : tuple of ChipResiduals
    tables : tuple of LookupTable
    series : LinearSeries or None
    overlap : OverlapTest or None
    held : tuple of str
        Parameters of which nothing is known but their prior.
    """

    summary: Mapping[str, Any]
    config: Mapping[str, Any]
    filter: str
    matching: Table
    chips: tuple[Chip, ...]
    unit: str
    catalog: CatalogStars | None = None
    centroids: MagnitudeErrors | None = None
    detections: Detections | None = None
    footprints: Footprints | None = None
    residuals: tuple[ChipResiduals, ...] = ()
    tables: tuple[LookupTable, ...] = field(default=())
    series: LinearSeries | None = None
    overlap: OverlapTest | None = None
    held: tuple[str, ...] = ()

    def section(self, name: str) -> Mapping[str, Any]:
        """A part of summary.json; empty where there is none."""
        found: Mapping[str, Any] = self.summary.get(name) or {}
        return found

    @property
    def table_filters(self) -> tuple[str, ...]:
        """Filters of the tables in order; '' is the detector's own."""
        return tuple(dict.fromkeys(table.filter for table in self.tables))

    def chip_name(self, number: int) -> str:
        """Name of a chip."""
        return next(c.name or f"chip {number}" for c in self.chips if c.number == number)
