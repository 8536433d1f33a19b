"""What the configuration says of a self-calibration, and of what fixes its gauge."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, PositiveFloat, model_validator

from bayesdist.app.config.campaign import StarListsBlock
from bayesdist.app.config.section import Section

__all__ = ["GaugeBlock", "SelfcalBlock"]


class SelfcalBlock(StarListsBlock):
    """Star lists of dithered exposures, and how their detections become stars."""

    exposures: str | None = None
    sigma: Literal["measured"] | PositiveFloat = "measured"
    initial_distortion: str | None = None
    unit: Literal["pix", "arcsec", "mas"] = "pix"
    frames: Literal["shift", "shift_rotation", "shift_rotation_scale"] = "shift_rotation"
    match_radius: PositiveFloat = 0.5
    start_radius: PositiveFloat | None = None
    min_detections: Annotated[int, Field(ge=2)] = 2
    max_iterations: Annotated[int, Field(ge=2)] = 12
    motion: Literal["none", "proper_motion", "parallax"] = "none"

    @model_validator(mode="after")
    def _radii_in_order(self) -> SelfcalBlock:
        if self.start_radius is not None and self.start_radius < self.match_radius:
            raise ValueError(
                "selfcal.start_radius is smaller than selfcal.match_radius; begin with the larger "
                "one"
            )
        return self


class ScaleTie(Section):
    """The size of a pixel, as another detector has it."""

    mas: PositiveFloat
    sigma: PositiveFloat
    detector: str = ""


class ReferenceBlock(Section):
    """Stars of a catalogue that are among the detected ones."""

    catalog: str
    columns: dict[str, str] | None = None
    unit: Literal["pix", "arcsec", "mas", "deg"] | None = None
    epoch: float | None = None
    tangent_point: tuple[float, float] | None = None
    radius: PositiveFloat = 2.0


class GaugeBlock(Section):
    """What is known beside the detections: each piece with its error."""

    offsets: str | None = None
    offset_sigma: PositiveFloat | None = None
    roll_sigma_deg: PositiveFloat | None = None
    exposure_scale_sigma: PositiveFloat | None = None
    scale: ScaleTie | None = None
    reference: ReferenceBlock | None = None

    @model_validator(mode="after")
    def _errors_of_something(self) -> GaugeBlock:
        for key in ("offset_sigma", "roll_sigma_deg"):
            if getattr(self, key) is not None and self.offsets is None:
                raise ValueError(
                    f"gauge.{key} is given without gauge.offsets; name the file of the commanded "
                    f"offsets, or leave {key} out"
                )
        return self
