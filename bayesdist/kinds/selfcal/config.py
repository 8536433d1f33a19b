"""Configuration of a self-calibration, which begins with star lists alone, and of its gauge."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import Field, PositiveFloat

from bayesdist.app.config.fit import (
    BaseOutliers,
    BaseSampler,
    ComputeBlock,
    Fit,
    PriorBlock,
    StructureBlock,
    TablesBlock,
    Tdd,
)
from bayesdist.app.config.results import SingleProducts, with_formats
from bayesdist.app.config.run import POSTERIOR, RunConfig
from bayesdist.app.config.section import Epoch, Section, Unit, names_nominal
from bayesdist.infer import OutlierMixture
from bayesdist.kinds.star_lists import StarListsBlock

Frames = Literal["shift", "shift_rotation", "shift_rotation_scale"]
MinDetections = Annotated[int, Field(ge=2)]


def scale_faults(sigma: float | None, frames: Frames) -> Iterator[str]:
    """Fault of a scatter of scales when the exposures have no scales."""
    if sigma is not None and "scale" not in frames:
        yield (
            "gauge.exposure_scale_sigma is given, but the exposures have no scales; set "
            "selfcal.frames to 'shift_rotation_scale'"
        )


class SelfcalBlock(StarListsBlock):
    """Star lists of dithered exposures, and the matching of their detections to stars."""

    exposures: str | None = None
    sigma: Literal["measured", "columns"] | PositiveFloat = "measured"
    initial_distortion: str | None = None
    unit: Literal["pix", "arcsec", "mas"] = "pix"
    frames: Frames = "shift_rotation"
    match_radius: PositiveFloat = 0.5
    start_radius: PositiveFloat | None = None
    min_detections: MinDetections = 2
    max_iterations: Annotated[int, Field(ge=2)] = 12
    motion: Literal["none", "proper_motion", "parallax"] = "none"

    def faults(self) -> Iterator[str]:
        """Fault of a match radius that would increase."""
        if self.start_radius is not None and self.start_radius < self.match_radius:
            yield (
                "selfcal.start_radius is smaller than selfcal.match_radius; make it at least as "
                "large"
            )


class ScaleTie(Section):
    """Pixel size as measured by another detector."""

    mas: PositiveFloat
    sigma: PositiveFloat
    detector: str = ""


class ReferenceBlock(Section):
    """Reference stars in a catalogue."""

    catalog: str
    columns: dict[str, str] | None = None
    unit: Unit | None = None
    epoch: Epoch | None = None
    tangent_point: tuple[float, float] | None = None
    radius: PositiveFloat = 2.0
    motion_prior: PositiveFloat | None = None  # mas per year


class GaugeBlock(Section):
    """Constraints in addition to the detections, each with its error."""

    offsets: str | None = None
    offset_sigma: PositiveFloat | None = None
    roll_sigma_deg: PositiveFloat | None = None
    exposure_scale_sigma: PositiveFloat | None = None
    scale: ScaleTie | None = None
    reference: ReferenceBlock | None = None

    def faults(self) -> Iterator[str]:
        """Faults of errors without the offsets that they apply to."""
        for key in ("offset_sigma", "roll_sigma_deg"):
            if getattr(self, key) is not None and self.offsets is None:
                yield (
                    f"gauge.{key} is given without gauge.offsets; name the file of the commanded "
                    f"offsets, or leave {key} out"
                )


class SelfcalModel(StructureBlock):
    """Structure of the distortion model; the frames of the exposures are in [selfcal]."""

    frames: ClassVar[Literal["none"]] = "none"

    tdd: Tdd | None = None


class SelfcalOutliers(BaseOutliers):
    """False detections, which are uniform within the match radius."""

    match_radius: ClassVar[None] = None
    outlier_scale: ClassVar[None] = None
    jitter_by: ClassVar[Literal["auto"]] = "auto"

    model: Literal["uniform"] = "uniform"


class SelfcalSampler(BaseSampler):
    """Stopping criteria and seed of a self-calibration."""

    walkers: ClassVar[None] = None


@with_formats("wise_meta")
class SelfcalProducts(SingleProducts):
    """Products of a self-calibration."""


class SelfcalConfig(RunConfig):
    """Configuration of a run that begins with star lists alone."""

    kind: ClassVar[str] = "bayesdist.kinds.selfcal.kind:SELFCAL"
    title: ClassVar[str] = "star lists alone"
    tables: ClassVar[TablesBlock] = TablesBlock()
    fit: ClassVar[Fit] = Fit()
    periods: ClassVar[None] = None
    holdout: ClassVar[None] = None
    prior_calibration: ClassVar[None] = None
    renamed: ClassVar[Mapping[str, str]] = {
        **RunConfig.renamed,
        "selfcal.least_detections": "min_detections",
        "selfcal.rounds": "max_iterations",
        "selfcal.start": "initial_distortion",
    }
    instead: ClassVar[Mapping[str, str]] = {
        "model.frames": "set selfcal.frames",
        "outliers.match_radius": "set selfcal.match_radius",
        "prior_calibration": "set selfcal.initial_distortion, which is where it begins",
        "products.wise_meta": "ask for sip or idctab",
    }

    selfcal: SelfcalBlock
    gauge: GaugeBlock = GaugeBlock()
    model: SelfcalModel
    outliers: SelfcalOutliers = SelfcalOutliers()
    sampler: SelfcalSampler = SelfcalSampler()
    compute: ComputeBlock = ComputeBlock()
    prior: list[PriorBlock] = Field(default_factory=list)
    products: SelfcalProducts = SelfcalProducts()

    def faults(self) -> Iterator[str]:
        """Faults of any run, and of settings that contradict the frames or need a scale."""
        yield from super().faults()
        if self.catalogue is not None:
            yield (
                "[catalogue] states the errors of reference positions, which a self-calibration "
                "does not use; leave it out"
            )
        if names_nominal(self.selfcal.columns):
            yield (
                "nominal positions belong to matches in [data], but a [selfcal] finds its matches "
                "itself; leave out u_nominal and v_nominal"
            )
        yield from scale_faults(self.gauge.exposure_scale_sigma, self.selfcal.frames)
        if self.gauge.roll_sigma_deg is not None and "rotation" not in self.selfcal.frames:
            yield (
                "gauge.roll_sigma_deg is given, but the exposures have no rotations; set "
                "selfcal.frames to 'shift_rotation'"
            )
        angles = self.gauge.scale is not None or self.gauge.reference is not None
        if (angles or self.selfcal.unit != "pix") and self.detector.scale_mas is None:
            yield "detector.scale_mas is missing, which converts pixels to arcseconds; give it"

    def named_files(self, base: Path) -> list[Path]:
        """Star lists, log, initial distortion, and files of the constraints."""
        block, gauge = self.selfcal, self.gauge
        first, reference = block.initial_distortion, gauge.reference
        if first is not None and (base / first).is_dir():
            first = f"{first}/{POSTERIOR}"  # posterior of a run
        named = [*block.list_names, block.exposures, first, gauge.offsets]
        named.append(None if reference is None else reference.catalog)
        return [base / name for name in dict.fromkeys(named) if name is not None]

    def mixture(self, stated: float | None = None) -> OutlierMixture:  # noqa: ARG002 - used for matched stars
        """Outlier mixture, within the configured match radius of a detection."""
        return self.outliers.mixture(self.selfcal.match_radius)
