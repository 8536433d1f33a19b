"""What a comparison of bands is shown from, and the sections of its page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from bayesdist.report.registry import Registry, Section

if TYPE_CHECKING:
    from bayesdist.assess import UncertaintyMap, VectorMap
    from bayesdist.diagnose.residuals import StatisticsTable
    from bayesdist.missions.wise.assess.account import RowAccount
    from bayesdist.missions.wise.assess.histograms import BandSums
    from bayesdist.missions.wise.assess.residual_correlation import ResidualCorrelation
    from bayesdist.missions.wise.assess.residual_structure import ResidualPartition

__all__ = ["BANDS", "BandResult", "BandsInput", "Printed"]

BANDS = Registry(
    "bands",
    (
        Section("overview", "Overview"),
        Section("vectors", "Distortion"),
        Section("histograms", "Residuals with and without calibration"),
        Section("tables", "Residuals in bins"),
        Section("structure", "Structure left in the residuals"),
        Section("formal", "Formal uncertainties"),
        Section("coverage", "Coverage"),
        Section("provenance", "Provenance"),
    ),
)


@dataclass(frozen=True)
class Printed:
    """What a published report says of a band.

    Parameters
    ----------
    longest_vector, longest_here, formal_radius : float
        Printed, found over the same part of the array, and printed; pixels.
    implied_sigma : float
        Error of a pair that the radius implies, with all pairs evenly over the array; pixels.
    """

    longest_vector: float
    longest_here: float
    formal_radius: float
    implied_sigma: float


@dataclass(frozen=True, eq=False)
class BandResult:
    """One band.

    Parameters
    ----------
    name, path : str
        Of the band, and of its run.
    converged : bool
    reasons : tuple of str
        Why it has not.
    arcsec : float
        Per pixel.
    size : tuple of float
        Columns and rows of the array.
    order : int
    n_pairs, n_used : int
        All pairs, and those that the least-squares fit used.
    sums : BandSums
        In pixels.
    partition : ResidualPartition
    correlation : ResidualCorrelation
    vectors : VectorMap
        The distortion without its constant, pixels.
    formal_map, posterior_map : UncertaintyMap
    minus_optical : VectorMap or None
        The distortion less the optical model, pixels.
    printed : Printed or None
    """

    name: str
    path: str
    converged: bool
    reasons: tuple[str, ...]
    arcsec: float
    size: tuple[float, float]
    order: int
    n_pairs: int
    n_used: int
    sums: BandSums
    partition: ResidualPartition
    correlation: ResidualCorrelation
    vectors: VectorMap
    formal_map: UncertaintyMap
    posterior_map: UncertaintyMap
    minus_optical: VectorMap | None = None
    printed: Printed | None = None


@dataclass(frozen=True, eq=False)
class BandsInput:
    """Several bands, and what is said of them together.

    Parameters
    ----------
    bands : tuple of BandResult
        In the order of the tables.
    tables : mapping of str to StatisticsTable
        By '5-1', '5-2', '5-3' as WSDC D-T033 numbers them; the second only of two bands or more.
    accounts : mapping of str to tuple of RowAccount
        Likewise.
    differences : mapping of str to VectorMap
        Later bands less the first, as 'W2-W1', in pixels of the first.
    n_bins : int
        On each axis.
    wise : bool
        Whether published values stand beside ours, which are those of WISE.
    optical : str
        What the optical model is; empty without one.
    provenance : mapping
    """

    bands: tuple[BandResult, ...]
    tables: Mapping[str, StatisticsTable]
    accounts: Mapping[str, tuple[RowAccount, ...]]
    differences: Mapping[str, VectorMap]
    n_bins: int = 31
    wise: bool = False
    optical: str = ""
    provenance: Mapping[str, Any] = field(default_factory=dict)

    @property
    def provisional(self) -> bool:
        """Whether some band must not be relied on."""
        return bool(self.not_converged)

    @property
    def not_converged(self) -> tuple[BandResult, ...]:
        """Bands whose sampling has not reached its targets."""
        return tuple(b for b in self.bands if not b.converged)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the bands."""
        return tuple(b.name for b in self.bands)
