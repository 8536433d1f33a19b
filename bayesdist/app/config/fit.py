"""Settings of the distortion model with its priors and tables, and of fitting and sampling.

Each kind of run has the keys that it uses.  Keys that a kind lacks are constants of its class, so
that code need not distinguish the kinds.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import Field, PositiveFloat, PositiveInt

from bayesdist.app.config.section import Epoch, Pair, Section
from bayesdist.diagnose.correlated import DiscrepancyPriors
from bayesdist.infer import Compute, OutlierMixture
from bayesdist.model import TimeDependence
from bayesdist.model.basis import MAX_ORDER

FrameKind = Literal["none", "shift", "shift_rotation", "shift_rotation_scale", "affine"]


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


class BaseTdd(Section):
    """Terms that drift linearly with time, with the keys that all kinds of runs have."""

    if TYPE_CHECKING:

        @property
        def rates(self) -> str: ...

    epoch0: Epoch | list[Epoch]
    terms: list[tuple[Literal["u", "v"], Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]]]
    breaks: list[Epoch] = Field(default_factory=list)

    def time(self) -> TimeDependence | None:
        """Time dependence of the model; None without terms."""
        if not self.terms:
            return None
        epochs = self.epoch0 if isinstance(self.epoch0, list) else [self.epoch0]
        return TimeDependence(tuple(self.terms), tuple(epochs), tuple(self.breaks))


class Tdd(BaseTdd):
    """Terms that drift linearly with time."""

    rates: ClassVar[str] = "free"


class PolynomialBlock(Section):
    """Order and reference pixel of the polynomials."""

    order: Annotated[int, Field(ge=1, le=MAX_ORDER)]
    reference_pixel: Pair | None = None


class StructureBlock(PolynomialBlock):
    """Structure of the distortion model, with the keys that all kinds of runs have."""

    if TYPE_CHECKING:

        @property
        def frames(self) -> FrameKind: ...
        @property
        def tdd(self) -> BaseTdd | None: ...


class MatchedModel(StructureBlock):
    """Structure of the distortion model, with the frames of the exposures."""

    frames: FrameKind = "none"
    tdd: Tdd | None = None


class PriorBlock(Section):
    """Gaussian prior on one parameter."""

    parameter: str
    mean: float
    sigma: PositiveFloat


class PriorCalibrationBlock(Section):
    """Earlier calibration of the detector that is used as a prior."""

    source: str
    frame: FrameKind | None = None
    filter: str | None = None
    epoch: float | None = None
    change_pix: Annotated[float, Field(ge=0)] = 0.0


class TablesBlock(Section):
    """Look-up tables to fit: of the detector, or of the filter in addition to the detector's."""

    detector: str | None = None
    method: Literal["field", "binned", "none"] = "field"
    step: tuple[PositiveFloat, PositiveFloat] = (64.0, 64.0)
    max_iterations: Annotated[int, Field(ge=1)] = 8
