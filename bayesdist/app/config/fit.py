"""Settings by which a model is fitted and sampled; a kind of run has the keys that it uses.

What a kind does not have is a constant of its class, so that nobody has to ask for the kind.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import Field, PositiveFloat, PositiveInt

from bayesdist.app.config.section import Pair, Section
from bayesdist.diagnose.correlated import DiscrepancyPriors
from bayesdist.infer import Compute, OutlierMixture


class HoldoutBlock(Section):
    """Stars and exposures that are set aside before anything is fitted."""

    fraction: Annotated[float, Field(ge=0, le=0.9)] = 0.0
    exposures: list[str] | PositiveInt = Field(default_factory=list)

    def faults(self) -> Iterator[str]:
        """Nothing that is set aside."""
        if not self.fraction and not self.exposures:
            yield "[holdout] sets nothing aside; give a fraction of the stars, or exposures"


class _Fit(Section):
    clip_chi2: Annotated[float, Field(gt=0, le=1e9)] = 25.0
    clip_abs: Annotated[float, Field(gt=0, le=1e9)] = 2.0
    skew: bool = False


class Fit(_Fit):
    """The linear fit."""

    radial_weight: PositiveFloat = 1.0


class CampaignFit(_Fit):
    """The linear fit of a campaign."""

    radial_weight: ClassVar[float] = 1.0


class _Outliers(Section):
    """Errors beyond the quoted ones, and the fraction of false matches."""

    if TYPE_CHECKING:

        @property
        def model(self) -> str: ...
        @property
        def outlier_scale(self) -> float | None: ...

    jitter: Literal["fit"] | Annotated[float, Field(ge=0)] = "fit"
    fraction_prior: Pair = (1.0, 9.0)
    jitter_scale: PositiveFloat | None = None

    def mixture(self, match_radius: float | None) -> OutlierMixture:
        """The outlier mixture within a radius of the match."""
        return OutlierMixture(
            model=self.model,
            match_radius=match_radius,
            jitter=None if self.jitter == "fit" else self.jitter,
            fraction_prior=self.fraction_prior,
            jitter_scale=self.jitter_scale,
            outlier_scale=self.outlier_scale,
        )


class SelfcalOutliers(_Outliers):
    """False detections, which are uniform within the radius of the match."""

    match_radius: ClassVar[None] = None
    outlier_scale: ClassVar[None] = None
    jitter_by: ClassVar[Literal["auto"]] = "auto"

    model: Literal["uniform"] = "uniform"


class _Mixture(_Outliers):
    model: Literal["gaussian", "uniform", "none"] = "gaussian"
    match_radius: PositiveFloat | None = None
    outlier_scale: PositiveFloat | None = None


class CampaignOutliers(_Mixture):
    """The outlier mixture of a campaign."""

    jitter_by: ClassVar[Literal["auto"]] = "auto"


class Outliers(_Mixture):
    """The outlier mixture, with jitters of groups of stars."""

    jitter_by: Literal["auto", "one", "chip", "exposure", "filter"] = "auto"

    def faults(self) -> Iterator[str]:
        """Jitters of groups beside the one that is given."""
        if self.jitter_by not in ("auto", "one") and self.jitter != "fit":
            yield (
                f"outliers.jitter_by is {self.jitter_by!r}, and outliers.jitter gives the one "
                "jitter of all stars; leave one of the two out"
            )


class _Sampler(Section):
    seed: Annotated[int, Field(ge=0)] = 1
    ensembles: Annotated[int, Field(ge=2, le=1000)] = 4
    target_ess: PositiveFloat = 400.0
    target_rhat: Annotated[float, Field(gt=1)] = 1.01
    max_steps: Annotated[int, Field(ge=1, le=100_000_000)] = 20_000
    checkpoint_every: Annotated[int, Field(ge=1, le=100_000_000)] = 200


class Sampler(_Sampler):
    """Method of sampling, when to stop, and from which seed."""

    method: Literal["exact", "certified"] = "exact"
    second_stage: Literal["auto", "always", "never"] = "auto"
    walkers: Annotated[int, Field(ge=1, le=100_000)] | None = None


class SelfcalSampler(_Sampler):
    """When to stop, and from which seed."""

    method: ClassVar[Literal["exact"]] = "exact"
    second_stage: ClassVar[Literal["auto"]] = "auto"
    walkers: ClassVar[None] = None


class ComputeBlock(Section):
    """Where the work is done."""

    engine: Literal["threads", "dask"] = "threads"
    scheduler: str | None = None
    workers: PositiveInt | None = None
    memory_mb: PositiveFloat = 1000.0
    scratch: str | None = None

    def faults(self) -> Iterator[str]:
        """Settings of a cluster where there is none, or another's."""
        for key in ("scheduler", "workers", "scratch"):
            if self.engine != "dask" and getattr(self, key) is not None:
                yield (
                    f"compute.{key} is given, but compute.engine is {self.engine!r}; set the "
                    f"engine to 'dask', or leave {key} out"
                )
        if self.scheduler is not None and self.workers is not None:
            yield (
                "compute.workers is given, but the cluster of compute.scheduler has its own; "
                "leave one of the two out"
            )
        if self.scratch is not None and not Path(self.scratch).is_absolute():
            yield (
                f"compute.scratch is {self.scratch!r}, which is another folder for each program; "
                "give its absolute path, the same for this program and all workers"
            )

    def resources(self) -> Compute:
        """Where the work is done."""
        return Compute(**self.model_dump())


class DiscrepancyBlock(Section):
    """Prior medians of what the model may leave out."""

    higher_order: PositiveFloat = DiscrepancyPriors.higher_order
    structure: PositiveFloat = DiscrepancyPriors.structure
    exposure: PositiveFloat = DiscrepancyPriors.exposure
    curvature: PositiveFloat = DiscrepancyPriors.curvature
    star: PositiveFloat = DiscrepancyPriors.star

    def priors(self) -> DiscrepancyPriors:
        """The block as priors."""
        return DiscrepancyPriors(**self.model_dump())
