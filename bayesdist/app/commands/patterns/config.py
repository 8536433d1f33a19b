"""The file of a comparison of dither patterns: every key, its type and its default."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, PositiveFloat

from bayesdist.app.config.model import Polynomials
from bayesdist.app.config.reading import load_text, validated
from bayesdist.app.config.section import (
    ChipBlock,
    Detector,
    Section,
    chips_of,
    detector_faults,
    one_chip,
    reference_first,
    same_names,
)
from bayesdist.app.config.selfcal import Frames, MinDetections, scale_faults
from bayesdist.assess.planning.dithers import Camera, PlannedStars, PriorInformation
from bayesdist.model import Chip
from bayesdist.simulate.dithers import dither_pattern
from bayesdist.simulate.patterns import (
    DitherPattern,
    flat_coefficients,
    grid_offsets,
    rolls_in_turn,
)
from bayesdist.utils.arrays import Float

Pair = tuple[PositiveFloat, PositiveFloat]
MOST_EXPOSURES = 10_000  # of one pattern
Count = Annotated[int, Field(ge=1, le=MOST_EXPOSURES)]  # of exposures, or of one side of their grid
Pointing = tuple[float, float] | tuple[float, float, float]


class PlannedChip(ChipBlock):
    """One of several chips."""

    place: tuple[float, float] | None = None


class PlannedSelfcal(Section):
    """Settings of a self-calibration that matter before there are detections."""

    frames: Frames = "shift_rotation"
    min_detections: MinDetections = 2


class PlannedScale(Section):
    """Error with which the size of a pixel will be known."""

    sigma: PositiveFloat


class PlannedGauge(Section):
    """Constraints that there will be beside the detections, each by its error."""

    offset_sigma: PositiveFloat | None = None
    roll_sigma_deg: PositiveFloat | None = None
    exposure_scale_sigma: PositiveFloat | None = None
    scale: PlannedScale | None = None


class StarsBlock(Section):
    """The field of stars."""

    per_detector: PositiveFloat
    sigma: PositiveFloat
    false: Annotated[float, Field(ge=0, lt=1)] = 0.0
    seed: Annotated[int, Field(ge=0)] = 1


class GridBlock(Section):
    """Offsets on a regular grid."""

    n: tuple[Count, Count]
    step: PositiveFloat | Pair


class ScalesBlock(Section):
    """Offsets of all lengths, in all directions."""

    least: PositiveFloat = 5.0
    largest: PositiveFloat = 0.75


class PatternBlock(Section):
    """One pattern."""

    name: str
    offsets: list[Pointing] | None = None
    grid: GridBlock | None = None
    scales: ScalesBlock | None = None
    unit: Literal["pix", "detector"] = "pix"
    rolls: list[float] | None = None
    exposures: Count | None = None

    def faults(self) -> Iterator[str]:
        """Anything but one kind of offsets, and what does not go with them."""
        where = f"pattern {self.name!r}"
        if sum(one is not None for one in (self.offsets, self.grid, self.scales)) != 1:
            yield f"{where} has offsets, a grid, or scales; give one of the three"
        on_grid = 0 if self.grid is None else self.grid.n[0] * self.grid.n[1]
        if on_grid > MOST_EXPOSURES:
            yield (
                f"{where} has {on_grid} exposures, and {MOST_EXPOSURES} are the most; "
                "give a smaller grid"
            )
        if self.offsets == [] or self.rolls == []:
            key = "offsets" if self.offsets == [] else "rolls"
            yield f"{where} has an empty list of {key}; fill it or leave it out"
        if self.rolls is not None and any(len(one) == 3 for one in self.offsets or []):
            yield f"{where} has rolls in its offsets and a list of rolls; give one of the two"
        if self.scales is not None:
            if self.exposures is None:
                yield f"{where} has scales without a number of exposures; give it"
            if self.unit != "pix":
                yield (
                    f"{where} has a unit, and scales go from least, in pixels, to largest, a part "
                    "of the detector; leave the unit out"
                )


class PlanConfig(Section):
    """The whole file."""

    detector: Detector = Detector()
    chip: list[PlannedChip] = Field(default_factory=list)
    model: Polynomials
    selfcal: PlannedSelfcal = PlannedSelfcal()
    gauge: PlannedGauge = PlannedGauge()
    stars: StarsBlock
    pattern: list[PatternBlock] = Field(default_factory=list)

    def faults(self) -> Iterator[str]:
        """Chips, frames and patterns that do not go together."""
        yield from detector_faults(self.chip, self.detector, self.model.reference_pixel)
        given = sum(c.place is not None for c in self.chip)
        if 0 < given < len(self.chip):
            yield "some [[chip]] blocks have the key place and some do not; give all or none"
        yield from scale_faults(self.gauge.exposure_scale_sigma, self.selfcal.frames)
        if not self.pattern:
            yield "there is no pattern; give [[pattern]] blocks, each with a name"
        yield from same_names("pattern", [p.name for p in self.pattern])
        for pattern in self.patterns():
            if len(pattern) < 2:
                yield (
                    f"pattern {pattern.name!r} has one exposure, which says nothing of the "
                    "distortion; give at least two"
                )
            if self.selfcal.frames == "shift" and np.ptp(pattern.rolls) > 0:
                yield (
                    f"pattern {pattern.name!r} has rolls, and selfcal.frames is 'shift'; set it to "
                    "'shift_rotation'"
                )

    def chips(self) -> tuple[Chip, ...]:
        """Chips of the model, also for a detector of one."""
        if self.chip:
            return chips_of(self.chip)
        return (one_chip(self.detector, self.model.reference_pixel, 1, "detector"),)

    def camera(self) -> Camera:
        """The detector that is planned for."""
        chips = self.chips()
        places = [c.place for c in reference_first(self.chip)]
        given = [p for p in places if p is not None]
        flat = flat_coefficients(self.model.order, chips, given or None)
        return Camera(chips, flat, self.selfcal.frames)

    def stars_planned(self) -> PlannedStars:
        """The field of stars."""
        s, least = self.stars, self.selfcal.min_detections
        return PlannedStars(s.per_detector, s.sigma, s.false, least, s.seed)

    def known(self) -> PriorInformation:
        """Constraints that there will be beside the detections."""
        g = self.gauge
        return PriorInformation(
            g.offset_sigma,
            None if g.roll_sigma_deg is None else float(np.radians(g.roll_sigma_deg)),
            g.exposure_scale_sigma,
            None if g.scale is None else g.scale.sigma,
        )

    def patterns(self) -> tuple[DitherPattern, ...]:
        """The patterns, each against its first exposure."""
        side = self.camera().side
        return tuple(_pattern(block, side, self.stars.seed) for block in self.pattern)


def _pattern(block: PatternBlock, side: float, seed: int) -> DitherPattern:
    unit = side if block.unit == "detector" else 1.0
    own = block.rolls or [0.0]
    if block.offsets is not None:
        round_ = unit * np.array([one[:2] for one in block.offsets])
        if any(len(one) == 3 for one in block.offsets):
            listed = np.array([one[2] if len(one) == 3 else 0.0 for one in block.offsets])
            n = block.exposures or len(round_)
            return _against_first(block.name, round_, listed[np.arange(n) % len(listed)])
    elif block.grid is not None:
        step = block.grid.step
        pair = step if isinstance(step, tuple) else (step, step)
        round_ = unit * grid_offsets(block.grid.n, pair)
    elif block.scales is not None and block.exposures is not None:
        # the same offsets for patterns that differ in their rolls alone
        rng = np.random.default_rng([seed, 2])
        low, high = block.scales.least, block.scales.largest
        round_, _ = dither_pattern(
            block.exposures, (side, side), [0.0], rng, least=low, largest=high
        )
    else:
        raise ValueError(f"pattern {block.name!r} has no offsets, grid or scales; give one")
    n = block.exposures or len(round_) * len(own)
    return _against_first(block.name, round_, rolls_in_turn(n, len(round_), own))


def _against_first(name: str, round_: Float, rolls_deg: Float) -> DitherPattern:
    offsets = round_[np.arange(len(rolls_deg)) % len(round_)]
    return DitherPattern(name, offsets - offsets[0], np.radians(rolls_deg - rolls_deg[0]))


def load_plan(path: str | Path) -> PlanConfig:
    """Read a file of patterns."""
    config: PlanConfig = validated(
        PlanConfig, load_text(path), str(path), begin="give it [[pattern]] blocks"
    )
    return config
