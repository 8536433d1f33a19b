"""`bayesdist plan-dither`: compare dither patterns for a self-calibration.

The configuration of a comparison has all keys with their types and defaults; the figure shows
footprints and uncertainty maps.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from astropy.table import Table
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from pydantic import Field, PositiveFloat

from bayesdist.app.config.fit import PolynomialBlock
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
from bayesdist.app.screen import table_text
from bayesdist.app.store.record import attributes, record_folder, write_table
from bayesdist.kinds.selfcal.config import Frames, MinDetections, scale_faults
from bayesdist.kinds.selfcal.patterns.dithers import (
    KINDS,
    Camera,
    PlannedPattern,
    PlannedStars,
    PriorInformation,
    compare_patterns,
    lacking,
    nearly_free,
)
from bayesdist.kinds.selfcal.patterns.exposures import (
    DitherPattern,
    dither_pattern,
    flat_coefficients,
    grid_offsets,
    rolls_in_turn,
)
from bayesdist.model import Chip
from bayesdist.model.grid import mesh, outline_pixels
from bayesdist.report.figures.style import (
    COLORBAR,
    INK,
    PALETTE,
    SEQUENTIAL,
    WIDTH,
    figure_style,
    new_figure,
)
from bayesdist.utils.arrays import Float

if TYPE_CHECKING:
    from matplotlib.collections import QuadMesh

LEGEND = (
    "reach: largest distance of two pointings, pix; free: directions that detections leave free; "
    "the rest is errors of positions over the detector, per axis, 1 sigma, pix (CE68 is 1.51 and "
    "CE95 2.45 times that where both axes are alike); gauge-free: without the free directions; "
    "shape: without shift, rotation and scale, by which patterns are sorted; absolute: without the "
    "zero point alone; -: nothing bounds it"
)

Pair = tuple[PositiveFloat, PositiveFloat]
MOST_EXPOSURES = 10_000  # largest number of exposures of a pattern
# number of exposures, or of grid points per axis
Count = Annotated[int, Field(ge=1, le=MOST_EXPOSURES)]
Pointing = tuple[float, float] | tuple[float, float, float]

SHOWN = ("gauge-free", "shape")
ROW = 2.3  # inches
UNBOUNDED = "#E8ECF0"
FIRST = PALETTE["vermilion"]


def plan_patterns(path: str | Path, output: str | Path | None = None, command: str = "") -> str:
    """Compare the dither patterns of a file by their expected covariance.

    Parameters
    ----------
    path : path
        TOML file with ``[[pattern]]`` blocks.
    output : path, optional
        New or empty folder for table, record and figure.
    command : str
        Command line, for the record.

    Returns
    -------
    str
        Text to print.
    """
    config = load_plan(path)
    camera = config.camera()
    planned = compare_patterns(config.patterns(), camera, config.stars_planned(), config.known())
    if output is not None:
        _write(Path(output), planned, config, command)
    return _text(planned, config)


def _row(one: PlannedPattern) -> dict[str, Any]:
    """Row of the table for one pattern."""
    problem = one.solution.problem
    rolls = np.unique(np.round(np.degrees(one.pattern.rolls), 3))
    row: dict[str, Any] = {
        "pattern": one.pattern.name,
        "exposures": len(one.pattern),
        "rolls": len(rolls),
        "reach": one.pattern.reach,
        "stars": problem.n_stars,
        "detections": len(problem),
        "free": one.n_free,
    }
    for kind in KINDS:
        row[f"{kind} rms"], row[f"{kind} max"] = one.rms(kind), one.largest(kind)
    return row


def _text(found: Sequence[PlannedPattern], config: PlanConfig) -> str:
    s = config.stars
    lines = [
        f"Order {config.model.order}, {s.per_detector:g} stars per exposure of {s.sigma:g} pix "
        f"each, {100 * s.false:g} % of them false",
        "",
        table_text([_row(planned) for planned in found], 3),
        "",
        LEGEND,
    ]
    for planned in found:
        lines += ["", f"{planned.pattern.name}:"]
        sentences = (*lacking(planned), *planned.solution.gauge.sentences, nearly_free(planned))
        lines += [f"  {sentence}" for sentence in sentences if sentence]
    best, mas = found[0], config.detector.scale_mas
    rms, largest = best.rms("shape"), best.largest("shape")
    if np.isfinite(rms):
        angle = "" if mas is None else f" ({mas * rms:.2g} and {mas * largest:.2g} mas)"
        verdict = f"shape known per axis to {rms:.2g} pix rms, {largest:.2g} at worst{angle}"
    else:
        verdict = "and yet nothing bounds the shape, for want of rolls and of commanded offsets"
    lines += ["", f"Best: {best.pattern.name}, {verdict}"]
    return "\n".join(lines)


def _write(output: Path, found: Sequence[PlannedPattern], config: PlanConfig, command: str) -> None:
    from bayesdist.report.drawing import save_figures  # plotting takes seconds to import

    with record_folder(output, "plan.json", command) as (folder, record):
        write_table(_table(found), folder / "patterns.ecsv")
        save_figures({"patterns": pattern_maps(found)}, folder / "figures")
        record |= {"config": config.model_dump(), "unit": "pix"}
        record["patterns"] = [_record(planned) for planned in found]


def _table(found: Sequence[PlannedPattern]) -> Table:
    rows = [
        {key.replace(" ", "_").replace("-", "_"): value for key, value in _row(planned).items()}
        | {f"degree_{k}": value for k, value in planned.by_degree.items()}
        | {"lacks": "; ".join(lacking(planned))}
        for planned in found
    ]
    table = Table(rows)
    for name in table.colnames:
        if name == "reach" or name.startswith("degree_") or name.endswith(("_rms", "_max")):
            table[name].unit = "pix"
    table.meta = {"columns": LEGEND}
    return table


def _record(one: PlannedPattern) -> dict[str, Any]:
    """Record of a pattern for scripts; unbounded values are null."""
    gauge, problem = one.solution.gauge, one.solution.problem
    return {
        "name": one.pattern.name,
        "offsets": one.pattern.offsets,
        "rolls_deg": np.degrees(one.pattern.rolls),
        "reach": one.pattern.reach,
        "n_stars": problem.n_stars,
        "n_detections": len(problem),
        "n_free": one.n_free,
        "held": [one.solution.model.names[k] for k in gauge.held],
        "directions": [
            attributes(d, "name sigma_fixed unit") | {"sigma_detections": d.sigma}
            for d in gauge.directions
        ],
        **{
            kind.replace("-", "_"): {"rms": one.rms(kind), "max": one.largest(kind)}
            for kind in KINDS
        },
        "by_degree": one.by_degree,
        "lacks": list(lacking(one)),
        "sentences": list(gauge.sentences),
        "nearly_free": nearly_free(one),
    }


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
    model: PolynomialBlock
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


@figure_style()
def pattern_maps(found: Sequence[PlannedPattern]) -> Figure:
    """Draw footprints and uncertainty maps of dither patterns, each on a common scale."""
    bounded = [
        pattern.per_axis(kind)
        for pattern in found
        for kind in SHOWN
        if pattern.maps[kind] is not None
    ]
    values = np.concatenate(bounded)
    norm = LogNorm(max(values.min(), 1e-4 * values.max()), values.max() * (1 + 1e-9))
    outlines = [_outlines(pattern) for pattern in found]
    limits = _limits(np.concatenate([o for of_one in outlines for o in of_one]))
    fig = new_figure(WIDTH, ROW * len(found) + 0.5, layout="compressed")
    axes = fig.subplots(len(found), 1 + len(SHOWN), squeeze=False)
    filled: list[QuadMesh] = []
    for k, (row, pattern, of_one) in enumerate(zip(axes, found, outlines, strict=True)):
        last = k == len(found) - 1
        _footprint(row[0], pattern, of_one, limits, last)
        row[0].set_title(
            f"first exposure in orange\n{pattern.pattern.name}" if not k else pattern.pattern.name
        )
        for ax, kind in zip(row[1:], SHOWN, strict=True):
            filled += _map(ax, pattern, kind, norm, last)
            if not k:
                ax.set_title(f"{kind}, rms\n{ax.get_title(loc='left')}")
    label = "per axis (1 σ) [pix]"
    fig.colorbar(filled[0], ax=list(axes[:, 1:].ravel()), label=label, **COLORBAR)
    return fig


def _outlines(one: PlannedPattern) -> list[Float]:
    """Outline (N, 2) of every chip in every exposure, on the sky."""
    model, theta = one.solution.model, one.solution.mean
    return [
        model.predict(theta, *outline_pixels(chip.size), exposure=e, chip=chip.number)
        for e in range(len(model.exposures))
        for chip in model.chips
    ]


def _limits(points: Float) -> tuple[Float, Float]:
    low, high = points.min(axis=0), points.max(axis=0)
    middle, half = (low + high) / 2, 0.52 * float((high - low).max())
    return middle - half, middle + half


def _footprint(
    ax: Axes,
    one: PlannedPattern,
    outlines: Sequence[Float],
    limits: tuple[Float, Float],
    last: bool,
) -> None:
    chips = len(one.camera.chips)
    for k, outline in reversed(list(enumerate(outlines))):
        first = k < chips
        ax.plot(*outline.T, lw=1.1 if first else 0.5, color=FIRST if first else INK,
                alpha=1.0 if first else 0.45)  # fmt: skip
    (x0, y0), (x1, y1) = limits
    ax.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal")
    ax.set_ylabel("v [pix]")
    _sky_axis(ax, last)


def _map(ax: Axes, one: PlannedPattern, kind: str, norm: LogNorm, last: bool) -> list[QuadMesh]:
    """Draw the chips as in the first exposure; a text instead of values for unbounded errors."""
    model, theta, maps = one.solution.model, one.solution.mean, one.maps[kind]
    outlines = [
        model.predict(theta, *outline_pixels(c.size), exposure=0, chip=c.number)
        for c in model.chips
    ]
    filled = []
    for m in maps or ():
        x, y = mesh(m.x, m.y)
        u, v = model.predict(theta, x, y, exposure=0, chip=m.chip).T.reshape(2, len(m.y), len(m.x))
        look: dict[str, Any] = {"cmap": SEQUENTIAL, "shading": "gouraud", "rasterized": True}
        filled.append(ax.pcolormesh(u, v, m.per_axis, norm=norm, **look))
    (x0, y0), (x1, y1) = _limits(np.concatenate(outlines))
    ax.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal")
    if maps is None:
        ax.set_title("not bounded")
        ax.set_facecolor(UNBOUNDED)
    else:
        ax.set_title(f"{one.rms(kind):.2g}, max {one.largest(kind):.2g} pix")
    ax.tick_params(labelleft=False)
    _sky_axis(ax, last)
    return filled


def _sky_axis(ax: Axes, last: bool) -> None:
    ax.tick_params(labelbottom=last)
    ax.locator_params(nbins=4)
    if last:
        ax.set_xlabel("u [pix]")
