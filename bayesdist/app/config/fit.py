"""Settings of fitting and sampling; each kind of run has the keys that it uses.

Keys that a kind lacks are constants of its class, so that code need not distinguish the kinds.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, PositiveFloat, PositiveInt

from bayesdist.app.config.section import Pair, Section
from bayesdist.diagnose.correlated import DiscrepancyPriors
from bayesdist.infer import Compute, OutlierMixture


class HoldoutBlock(Section):
    """Stars and exposures that are held out before the fit."""

    fraction: Annotated[float, Field(ge=0, le=0.9)] = 0.0
    exposures: list[str] | PositiveInt = Field(default_factory=list)

    def faults(self) -> Iterator[str]:
        """Fault of a section that holds nothing out."""
        if not self.fraction and not self.exposures:
            yield "[holdout] holds nothing out; give a fraction of the stars, or exposures"


class Periods(Section):
    """Periods to be compared."""

    centres: list[float]
    days: PositiveFloat


class BaseFit(Section):
    """Linear fit, with the keys that all kinds of runs have."""

    if TYPE_CHECKING:

        @property
        def radial_weight(self) -> float: ...

    clip_chi2: Annotated[float, Field(gt=0, le=1e9)] = 25.0
    clip_abs: Annotated[float, Field(gt=0, le=1e9)] = 2.0
    skew: bool = False


class Fit(BaseFit):
    """Linear fit."""

    radial_weight: PositiveFloat = 1.0


class BaseOutliers(Section):
    """Errors in addition to the quoted ones, and the fraction of false matches."""

    if TYPE_CHECKING:

        @property
        def model(self) -> str: ...
        @property
        def outlier_scale(self) -> float | None: ...
        @property
        def match_radius(self) -> float | None: ...
        @property
        def jitter_by(self) -> Literal["auto", "one", "chip", "exposure", "filter"]: ...

    jitter: Literal["fit"] | Annotated[float, Field(ge=0)] = "fit"
    fraction_prior: Pair = (1.0, 9.0)
    jitter_scale: PositiveFloat | None = None

    def mixture(self, match_radius: float | None) -> OutlierMixture:
        """Outlier mixture with the given match radius."""
        return OutlierMixture(
            model=self.model,
            match_radius=match_radius,
            jitter=None if self.jitter == "fit" else self.jitter,
            fraction_prior=self.fraction_prior,
            jitter_scale=self.jitter_scale,
            outlier_scale=self.outlier_scale,
        )


class MixtureOutliers(BaseOutliers):
    """Outlier mixture of stars that are matched with a catalogue."""

    model: Literal["gaussian", "uniform", "none"] = "gaussian"
    match_radius: PositiveFloat | None = None
    outlier_scale: PositiveFloat | None = None


class Outliers(MixtureOutliers):
    """Outlier mixture, with jitters of groups of stars."""

    jitter_by: Literal["auto", "one", "chip", "exposure", "filter"] = "auto"

    def faults(self) -> Iterator[str]:
        """Fault of jitters for groups when a single jitter is given."""
        if self.jitter_by not in ("auto", "one") and self.jitter != "fit":
            yield (
                f"outliers.jitter_by is {self.jitter_by!r}, but outliers.jitter gives a single "
                "jitter for all stars; leave one of the two out"
            )


class BaseSampler(Section):
    """Stopping criteria and seed."""

    if TYPE_CHECKING:

        @property
        def walkers(self) -> int | None: ...

    seed: Annotated[int, Field(ge=0)] = 1
    ensembles: Annotated[int, Field(ge=2, le=1000)] = 4
    target_ess: PositiveFloat = 400.0
    target_rhat: Annotated[float, Field(gt=1)] = 1.01
    max_steps: Annotated[int, Field(ge=1, le=100_000_000)] = 20_000
    checkpoint_every: Annotated[int, Field(ge=1, le=100_000_000)] = 200


class Sampler(BaseSampler):
    """Stopping criteria, seed and walkers."""

    walkers: Annotated[int, Field(ge=1, le=100_000)] | None = None


class ComputeBlock(Section):
    """Resources for the computation."""

    engine: Literal["threads", "dask"] = "threads"
    scheduler: str | None = None
    workers: PositiveInt | None = None
    memory_mb: PositiveFloat = 1000.0
    scratch: str | None = None

    def faults(self) -> Iterator[str]:
        """Faults of cluster settings without a cluster, or with an existing cluster."""
        for key in ("scheduler", "workers", "scratch"):
            if self.engine != "dask" and getattr(self, key) is not None:
                yield (
                    f"compute.{key} is given, but compute.engine is {self.engine!r}; set the "
                    f"engine to 'dask', or leave out {key}"
                )
        if self.scheduler is not None and self.workers is not None:
            yield (
                "compute.workers is given, but the cluster of compute.scheduler has its workers "
                "already; leave one of the two out"
            )
        if self.scratch is not None and not Path(self.scratch).is_absolute():
            yield (
                f"compute.scratch is {self.scratch!r}, which each program would resolve to a "
                "different folder; give its absolute path, the same for this program and all "
                "workers"
            )

    def resources(self) -> Compute:
        """Resources for the computation."""
        return Compute(**self.model_dump())


class DiscrepancyBlock(Section):
    """Prior medians of errors that the model does not include; units as in `DiscrepancyPriors`."""

    higher_order: PositiveFloat = DiscrepancyPriors.higher_order
    structure: PositiveFloat = DiscrepancyPriors.structure
    exposure: PositiveFloat = DiscrepancyPriors.exposure
    curvature: PositiveFloat = DiscrepancyPriors.curvature
    star: PositiveFloat = DiscrepancyPriors.star

    def priors(self) -> DiscrepancyPriors:
        """Priors of this section."""
        return DiscrepancyPriors(**self.model_dump())
