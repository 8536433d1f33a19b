"""Input of the page that compares bands, and its sections."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from bayesdist.report.contents import Registry, Section

if TYPE_CHECKING:
    from bayesdist.assess import UncertaintyMap, VectorMap
    from bayesdist.diagnose.residuals.tables import StatisticsTable
    from bayesdist.missions.wise.assess.account import RowAccount
    from bayesdist.missions.wise.assess.histograms import BandSums
    from bayesdist.missions.wise.assess.residual_correlation import ResidualCorrelation
    from bayesdist.missions.wise.assess.residual_structure import ResidualPartition

BANDS = Registry(
    "bands",
    (
        Section("overview", "Overview"),
        Section("vectors", "Distortion"),
        Section("histograms", "Residuals with and without calibration"),
        Section("tables", "Residuals in bins"),
        Section("structure", "Structure left in the residuals"),
        Section("formal", "Uncertainties"),
        Section("coverage", "Coverage"),
        Section("provenance", "Provenance"),
    ),
)


@dataclass(frozen=True)
class Printed:
    """Numbers of a band that a published report gives."""

    longest_vector: float  # printed, found over the same part of the array, and printed; pixels
    longest_vector_here: float
    formal_radius: float
    # error of a pair that the radius implies, with all pairs evenly over the array; pixels
    implied_sigma: float


@dataclass(frozen=True, eq=False)
class BandResult:
    """One band."""

    name: str  # of the band, and of its run
    path: str
    simulated: bool
    converged: bool
    reasons: tuple[str, ...]  # why it has not
    arcsec: float  # per pixel
    size: tuple[float, float]  # columns and rows of the array
    order: int
    n_pairs: int  # all pairs, and those that the least-squares fit used
    n_used: int
    sums: BandSums  # in pixels
    partition: ResidualPartition
    correlation: ResidualCorrelation
    vectors: VectorMap  # the distortion without its constant, pixels
    formal_map: UncertaintyMap
    posterior_map: UncertaintyMap
    minus_optical: VectorMap | None  # the distortion less the optical model, pixels
    printed: Printed | None

    @property
    def coverage_chi2(self) -> float:
        """Chi-square of the pairs used in bins against their mean."""
        count = self.sums.bins.count
        return float(((count - count.mean()) ** 2).sum() / count.mean())


@dataclass(frozen=True, eq=False)
class BandsInput:
    """Several bands, and what is said of them together."""

    bands: tuple[BandResult, ...]  # in the order of the tables
    # by '5-1', '5-2', '5-3' as WSDC D-T033 numbers them; the second only of two bands or more
    tables: Mapping[str, StatisticsTable]
    accounts: Mapping[str, tuple[RowAccount, ...]]  # likewise
    # later bands less the first, as 'W2-W1', in pixels of the first
    differences: Mapping[str, VectorMap]
    n_bins: int  # on each axis
    wise: bool  # True if published values stand beside ours, which are those of WISE
    optical: str  # what the optical model is; empty without one
    provenance: Mapping[str, Any]

    @property
    def provisional(self) -> bool:
        """True if some band must not be relied on."""
        return bool(self.not_converged)

    @property
    def not_converged(self) -> tuple[BandResult, ...]:
        """Bands whose sampling has not reached its targets."""
        return tuple(b for b in self.bands if not b.converged)

    @property
    def simulated(self) -> bool:
        """True if the data of some band are simulated."""
        return any(b.simulated for b in self.bands)

    @property
    def title(self) -> str:
        """Names of the bands, after that of the mission where it is known."""
        return ("WISE " if self.wise else "") + ", ".join(self.names)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the bands."""
        return tuple(b.name for b in self.bands)
