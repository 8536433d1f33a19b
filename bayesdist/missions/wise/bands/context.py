"""Input and sections of the page that compares bands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from bayesdist.report.contents import PageSection, Registry

if TYPE_CHECKING:
    from bayesdist.assess import UncertaintyMap, VectorMap
    from bayesdist.diagnose.residuals.tables import StatisticsTable
    from bayesdist.missions.wise.assess.account import RowAccount
    from bayesdist.missions.wise.assess.distortion_field import BandSums
    from bayesdist.missions.wise.assess.residual_field import ResidualCorrelation, ResidualPartition

BANDS = Registry(
    "bands",
    (
        PageSection("overview", "Overview"),
        PageSection("vectors", "Distortion"),
        PageSection("histograms", "Residuals with and without calibration"),
        PageSection("tables", "Residuals in bins"),
        PageSection("structure", "Structure left in the residuals"),
        PageSection("formal", "Uncertainties"),
        PageSection("coverage", "Coverage"),
        PageSection("provenance", "Provenance"),
    ),
)


@dataclass(frozen=True)
class Printed:
    """Published numbers of a band, in pixels."""

    longest_vector: float  # published longest distortion vector
    longest_vector_here: float  # that of the run, over the same part of the array
    formal_radius: float  # published largest hypot(sigma_x, sigma_y)
    implied_sigma: float  # error per pair that the radius implies for uniformly distributed pairs


@dataclass(frozen=True, eq=False)
class BandResult:
    """Results of one band."""

    name: str  # name of the band
    path: str  # folder of its run
    simulated: bool
    converged: bool
    reasons: tuple[str, ...]  # reasons if it has not converged
    arcsec: float  # arcsec per pixel
    size: tuple[float, float]  # columns and rows of the array
    order: int  # order of the polynomial
    n_pairs: int  # number of all pairs
    n_used: int  # number of pairs in the least-squares fit
    sums: BandSums  # in pixels
    partition: ResidualPartition
    correlation: ResidualCorrelation
    vectors: VectorMap  # distortion without its constant, pixels
    formal_map: UncertaintyMap
    posterior_map: UncertaintyMap
    minus_optical: VectorMap | None  # distortion minus the optical model, pixels
    printed: Printed | None

    @property
    def coverage_chi2(self) -> float:
        """Chi-square of the numbers of pairs per bin, relative to uniform coverage."""
        count = self.sums.bins.count
        return float(((count - count.mean()) ** 2).sum() / count.mean())


@dataclass(frozen=True, eq=False)
class BandsInput:
    """Results of several bands and their comparison."""

    bands: tuple[BandResult, ...]  # in the order of the tables
    # by '5-1', '5-2' and '5-3' as in WSDC D-T033; '5-2' needs at least two bands
    tables: Mapping[str, StatisticsTable]
    accounts: Mapping[str, tuple[RowAccount, ...]]  # by the same keys
    # distortion of later bands minus the first, such as 'W2-W1', in pixels of the first
    differences: Mapping[str, VectorMap]
    n_bins: int  # per axis
    wise: bool  # True if the bands are of WISE and published values are shown
    optical: str  # description of the optical model; empty without one
    provenance: Mapping[str, Any]

    @property
    def provisional(self) -> bool:
        """True if a band has not converged, so that the results are provisional."""
        return bool(self.not_converged)

    @property
    def not_converged(self) -> tuple[BandResult, ...]:
        """Bands that have not converged."""
        return tuple(b for b in self.bands if not b.converged)

    @property
    def simulated(self) -> bool:
        """True if the data of any band are simulated."""
        return any(b.simulated for b in self.bands)

    @property
    def title(self) -> str:
        """Names of the bands, preceded by that of the mission if it is known."""
        return ("WISE " if self.wise else "") + ", ".join(self.names)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the bands."""
        return tuple(b.name for b in self.bands)
