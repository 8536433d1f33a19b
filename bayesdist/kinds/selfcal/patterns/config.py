"""Configuration of a comparison of dither patterns: all keys with their types and defaults."""

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
from bayesdist.kinds.selfcal.config import Frames, MinDetections, scale_faults
from bayesdist.kinds.selfcal.patterns.dithers import Camera, PlannedStars, PriorInformation
from bayesdist.kinds.selfcal.patterns.exposures import (
    DitherPattern,
    dither_pattern,
    flat_coefficients,
    grid_offsets,
    rolls_in_turn,
)
from bayesdist.model import Chip
from bayesdist.utils.arrays import Float

Pair = tuple[PositiveFloat, PositiveFloat]
MOST_EXPOSURES = 10_000  # largest number of exposures of a pattern
# number of exposures, or of grid points per axis
Count = Annotated[int, Field(ge=1, le=MOST_EXPOSURES)]
Pointing = tuple[float, float] | tuple[float, float, float]


class PlannedChip(ChipBlock):
    """One of several chips."""

    place: tuple[float, float] | None = None


class PlannedSelfcal(Section):
    """Settings of a self-calibration that matter without detections."""

    frames: Frames = "shift_rotation"
    min_detections: MinDetections = 2


class PlannedScale(Section):
    """Expected error of the pixel scale."""

    sigma: PositiveFloat


class PlannedGauge(Section):
    """Expected errors of the constraints in addition to the detections."""

    offset_sigma: PositiveFloat | None = None
    roll_sigma_deg: PositiveFloat | None = None
    exposure_scale_sigma: PositiveFloat | None = None
    scale: PlannedScale | None = None


class StarsBlock(Section):
    """Star field."""

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
    """Dither pattern."""

    name: str
    offsets: list[Pointing] | None = None
    grid: GridBlock | None = None
    scales: ScalesBlock | None = None
    unit: Literal["pix", "detector"] = "pix"
    rolls: list[float] | None = None
    exposures: Count | None = None

    def faults(self) -> Iterator[str]:
        """Faults of offsets that are missing or given in several ways."""
        name = f"pattern {self.name!r}"
        if sum(entry is not None for entry in (self.offsets, self.grid, self.scales)) != 1:
            yield f"{name} has offsets, a grid, or scales; give one of the three"
        on_grid = 0 if self.grid is None else self.grid.n[0] * self.grid.n[1]
        if on_grid > MOST_EXPOSURES:
            yield (
                f"{name} has {on_grid} exposures, but at most {MOST_EXPOSURES} are possible; give "
                "a smaller grid"
            )
        if self.offsets == [] or self.rolls == []:
            key = "offsets" if self.offsets == [] else "rolls"
            yield f"{name} has an empty list of {key}; fill it or leave it out"
        if self.rolls is not None and any(len(entry) == 3 for entry in self.offsets or []):
            yield f"{name} has rolls in its offsets and a list of rolls; give one of the two"
        if self.scales is not None:
            if self.exposures is None:
                yield f"{name} has scales without a number of exposures; give it"
            if self.unit != "pix":
                yield (
                    f"{name} has a unit, but scales range from `least`, in pixels, to `largest`, a "
                    "fraction of the detector; leave out the unit"
                )


class PlanConfig(Section):
    """Complete file."""

    detector: Detector = Detector()
    chip: list[PlannedChip] = Field(default_factory=list)
    model: Polynomials
    selfcal: PlannedSelfcal = PlannedSelfcal()
    gauge: PlannedGauge = PlannedGauge()
    stars: StarsBlock
    pattern: list[PatternBlock] = Field(default_factory=list)

    def faults(self) -> Iterator[str]:
        """Faults of chips, frames and patterns."""
        yield from detector_faults(self.chip, self.detector, self.model.reference_pixel)
        n_places = sum(c.place is not None for c in self.chip)
        if 0 < n_places < len(self.chip):
            yield "some [[chip]] blocks have the key place and some do not; give all or none"
        yield from scale_faults(self.gauge.exposure_scale_sigma, self.selfcal.frames)
        if not self.pattern:
            yield "there is no pattern; give [[pattern]] blocks, each with a name"
        yield from same_names("pattern", [p.name for p in self.pattern])
        for pattern in self.patterns():
            if len(pattern) < 2:
                yield (
                    f"pattern {pattern.name!r} has one exposure, which cannot determine the "
                    "distortion; give at least two"
                )
            if self.selfcal.frames == "shift" and np.ptp(pattern.rolls) > 0:
                yield (
                    f"pattern {pattern.name!r} has rolls, but selfcal.frames is 'shift'; set it to "
                    "'shift_rotation'"
                )

    def chips(self) -> tuple[Chip, ...]:
        """Chips of the model, also for a detector with one chip."""
        if self.chip:
            return chips_of(self.chip)
        return (one_chip(self.detector, self.model.reference_pixel, 1, "detector"),)

    def camera(self) -> Camera:
        """Detector that the patterns are planned for."""
        chips = self.chips()
        places = [c.place for c in reference_first(self.chip)]
        known_places = [p for p in places if p is not None]
        flat = flat_coefficients(self.model.order, chips, known_places or None)
        return Camera(chips, flat, self.selfcal.frames)

    def stars_planned(self) -> PlannedStars:
        """Star field."""
        s, min_detections = self.stars, self.selfcal.min_detections
        return PlannedStars(s.per_detector, s.sigma, s.false, min_detections, s.seed)

    def known(self) -> PriorInformation:
        """Expected constraints in addition to the detections."""
        g = self.gauge
        return PriorInformation(
            g.offset_sigma,
            None if g.roll_sigma_deg is None else float(np.radians(g.roll_sigma_deg)),
            g.exposure_scale_sigma,
            None if g.scale is None else g.scale.sigma,
        )

    def patterns(self) -> tuple[DitherPattern, ...]:
        """Patterns, with offsets and rolls relative to the first exposure."""
        side = self.camera().side
        return tuple(_pattern(block, side, self.stars.seed) for block in self.pattern)


def _pattern(block: PatternBlock, side: float, seed: int) -> DitherPattern:
    unit = side if block.unit == "detector" else 1.0
    rolls = block.rolls or [0.0]
    if block.offsets is not None:
        round_ = unit * np.array([offset[:2] for offset in block.offsets])
        if any(len(offset) == 3 for offset in block.offsets):
            listed = np.array([offset[2] if len(offset) == 3 else 0.0 for offset in block.offsets])
            n = block.exposures or len(round_)
            return _against_first(block.name, round_, listed[np.arange(n) % len(listed)])
    elif block.grid is not None:
        step = block.grid.step
        pair = step if isinstance(step, tuple) else (step, step)
        round_ = unit * grid_offsets(block.grid.n, pair)
    elif block.scales is not None and block.exposures is not None:
        # equal seeds give equal offsets to patterns that differ only in their rolls
        rng = np.random.default_rng([seed, 2])
        low, high = block.scales.least, block.scales.largest
        round_, _ = dither_pattern(
            block.exposures, (side, side), [0.0], rng, least=low, largest=high
        )
    else:
        raise ValueError(f"pattern {block.name!r} has no offsets, grid or scales; give one")
    n = block.exposures or len(round_) * len(rolls)
    return _against_first(block.name, round_, rolls_in_turn(n, len(round_), rolls))


def _against_first(name: str, round_: Float, rolls_deg: Float) -> DitherPattern:
    offsets = round_[np.arange(len(rolls_deg)) % len(round_)]
    return DitherPattern(name, offsets - offsets[0], np.radians(rolls_deg - rolls_deg[0]))


def load_plan(path: str | Path) -> PlanConfig:
    """Read a file of patterns."""
    config: PlanConfig = validated(
        PlanConfig, load_text(path), str(path), begin="give it [[pattern]] blocks"
    )
    return config
