"""Vectors in panels, and errors as crosses, drawn at a common scale that a key states."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.quiver import Quiver

from bayesdist.report.figures.panels import Panels
from bayesdist.report.figures.style import (
    COLORBAR,
    CYCLE,
    PALETTE,
    SIZES,
    Tones,
    figure_style,
    nice_below,
    small_font,
)
from bayesdist.utils.arrays import Bool, Float
from bayesdist.utils.distributions import f_isf
from bayesdist.utils.text import size_of

if TYPE_CHECKING:
    from bayesdist.assess import UncertaintyMap, VectorMap
    from bayesdist.assess.solution import ChipFrame
    from bayesdist.diagnose.residuals.binned import BinnedResiduals

MOST_CROSSES = 13  # along each axis; more would overlap
CHANCE = 0.0455  # probability that noise alone puts one axis beyond 2 sigma

# -- grids ----------------------------------------------------------------------------------------


def spacing(x: Float, y: Float) -> float:
    """Smallest distance between neighbouring points of a grid, in pixels."""
    steps = [np.diff(np.unique(a)) for a in (x, y)]
    return float(min((s.min() for s in steps if s.size), default=1.0))


def square_cells(x: Float, y: Float, every: int = 1) -> tuple[slice, slice]:
    """Rows and columns of a grid such that the spacing is similar along both axes.

    Only steps that include both ends are used, because distortions are largest in the corners.
    `every` is an additional step for small panels.
    """
    steps = [(a[-1] - a[0]) / (len(a) - 1) for a in (y, x)]
    out = []
    for a, step in zip((y, x), steps, strict=True):
        stride = round(max(steps) / step)
        fitting = [s for s in (stride * every, stride, 1) if (len(a) - 1) % s == 0]
        out.append(slice(None, None, fitting[0]))
    return out[0], out[1]


def sparse_step(maps: Sequence[UncertaintyMap], most: int = MOST_CROSSES) -> int:
    """Smallest additional step of `square_cells` that leaves at most `most` points per axis.

    1 if there is no such step that includes both ends of the grids.
    """
    for step in range(1, max(len(m.x) + len(m.y) for m in maps)):
        cells = [square_cells(m.x, m.y, step) for m in maps]
        points = [
            (len(m.y[rows]), len(m.x[columns]))
            for m, (rows, columns) in zip(maps, cells, strict=True)
        ]
        if max(map(max, points)) <= most:
            return step
    return 1


def significant_cells(binned: BinnedResiduals) -> Bool:
    """Boolean mask of the cells with a mean that noise produces with a probability below `CHANCE`.

    False if a standard error is unknown or zero.
    """
    # standard errors come from the few stars of a cell, so the F distribution applies
    beyond = 2.0 * f_isf(CHANCE, 2, np.maximum(binned.count - 1, 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        z2 = (binned.mean_u / binned.sem_u) ** 2 + (binned.mean_v / binned.sem_v) ** 2
    return np.isfinite(z2) & (z2 > beyond)


# -- vectors --------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Arrows:
    """Vectors of one chip as drawn."""

    x: Float  # (N,), tails, pixels
    y: Float
    du: Float  # (N,), in the unit of the map
    dv: Float
    step: float  # spacing of the vectors, pixels
    clear: Bool | None = None  # (N,), True if significant; others are pale; None without noise
    ring: tuple[float, float] | None = None  # position of the largest vector, marked by a ring

    @classmethod
    def of_grid(
        cls, x: Float, y: Float, du: Float, dv: Float, *, every: int = 1, clear: Bool | None = None
    ) -> Arrows:
        """Vectors from a grid (ny, nx), thinned out, with a ring at the largest one."""
        rows, columns = square_cells(x, y, every)
        gx, gy = np.meshgrid(x[columns], y[rows])
        iy, ix = np.unravel_index(int(np.hypot(du, dv).argmax()), du.shape)
        return cls(
            gx.ravel(),
            gy.ravel(),
            du[rows, columns].ravel(),
            dv[rows, columns].ravel(),
            spacing(x[columns], y[rows]),
            None if clear is None else clear[rows, columns].ravel(),
            (float(x[ix]), float(y[iy])),
        )

    @classmethod
    def of_map(cls, vectors: VectorMap, every: int = 1) -> Arrows:
        """Distortion vectors along the axes of the detector, in its pixels."""
        return cls.of_grid(vectors.x, vectors.y, *vectors.on_detector, every=every)

    def placed(self, frame: ChipFrame, *, ringed: bool) -> Arrows:
        """The vectors in the focal plane, with the ring only if `ringed`."""
        x, y = frame(self.x, self.y)
        du, dv = frame.turn @ np.stack([self.du, self.dv])
        ring = None
        if ringed and self.ring is not None:
            (across,), (up,) = frame(*np.array(self.ring)[:, None])
            ring = float(across), float(up)
        return replace(self, x=x, y=y, du=du, dv=dv, ring=ring)

    @classmethod
    def of_cells(cls, binned: BinnedResiduals, min_count: int = 1) -> Arrows:
        """Mean residuals of the cells with at least `min_count` stars; empty cells stay empty."""
        full = np.isfinite(binned.mean_u) & np.isfinite(binned.mean_v)
        full &= np.asarray(binned.count) >= min_count
        gx, gy = np.meshgrid(binned.x, binned.y)
        vectors = binned.mean_u[full], binned.mean_v[full]
        clear = significant_cells(binned)[full]
        return cls(gx[full], gy[full], *vectors, spacing(binned.x, binned.y), clear)

    @property
    def length(self) -> Float:
        """Lengths of the vectors, shape (N,)."""
        return np.hypot(self.du, self.dv)

    @property
    def n_clear(self) -> int:
        """Number of significant vectors."""
        return self.x.size if self.clear is None else int(self.clear.sum())

    def reach(self, magnification: float, size: tuple[float, float]) -> float:
        """Largest extent of the vectors beyond a chip of the given size, in pixels."""
        over = [
            np.abs(a + magnification * d - (n + 1) / 2).max() - n / 2
            for a, d, n in ((self.x, self.du, size[0]), (self.y, self.dv, size[1]))
        ]
        return float(max(*over, 0.0))


def cell_magnification(step: float, length: float) -> float:
    """Factor of two digits, rounded down, by which a length is drawn as one step of a grid.

    1 if the length is a rounding error.
    """
    if not length > 1e-10 * step:
        return 1.0
    unit = 10.0 ** (math.floor(math.log10(step / length)) - 1)
    return float(f"{math.floor(step / length / unit * (1 + 1e-9)) * unit:.6g}")


def magnification_of(step: float, length: float) -> float:
    """Round factor by which a length is drawn about one step long; 1 for rounding errors."""
    return nice_below(step / length) if length > 1e-10 * step else 1.0


@figure_style()
def vector_map(
    panels: Panels,
    chips: Sequence[Arrows | None],
    titles: Sequence[str],
    *,
    magnification: float,
    key: float | Sequence[float],
    unit: str = "pix",
    pad: float = 9.0,
    fine: bool = False,
    colored: bool = False,
) -> None:
    """Draw the vectors of each chip at a common scale that a key states.

    `panels`: already framed, because their limits must be final. `magnification`: in pixels of the
    axes per unit of the vectors. `key`: length of the arrow above each panel, in `unit`. `pad`:
    distance of titles in points, at least 17 to be above the key. `fine`: True for small panels.
    `colored`: True to show the length of a vector by its colour, with a colour bar next to the
    panels.
    """
    norm = length_norm([arrows for arrows in chips if arrows is not None]) if colored else None
    drawn: Quiver | None = None
    keys: dict[Axes, float] = {}
    for k, (arrows, key_length) in enumerate(
        zip(chips, np.broadcast_to(np.asarray(key, float), len(chips)), strict=True)
    ):
        if arrows is None:
            continue
        ax = panels.axes[k][0]
        look: dict[str, Any] = {"magnification": magnification, "fine": fine, "norm": norm}
        drawn = draw_arrows(ax, arrows, panels.offset(k), **look)
        keys.setdefault(ax, float(key_length))
    for ax, title in zip(panels.all_axes, titles, strict=True):
        ax.set_title(title, pad=pad)
    for ax, length in keys.items():
        draw_key(ax, length, magnification=magnification, unit=unit)
    if norm is not None and drawn is not None:
        bar = {"label": f"length [{unit}]", **COLORBAR}
        panels.figure.colorbar(drawn, ax=panels.all_axes, **bar)


def length_norm(chips: Sequence[Arrows]) -> Normalize:
    """Colour scale from 0 to the length of the longest vector of all chips."""
    longest = max((float(arrows.length.max()) for arrows in chips if arrows.x.size), default=0.0)
    return Normalize(0.0, longest if longest > 0 else 1.0)


def draw_arrows(
    ax: Axes,
    arrows: Arrows,
    offset: tuple[float, float] = (0.0, 0.0),
    *,
    magnification: float,
    fine: bool = False,
    norm: Normalize | None = None,
) -> Quiver:
    """Draw arrows from (x, y) to (x + M du, y + M dv) in pixels of the axes; pale unless clear.

    With `norm` their colour is their length.
    """
    tones = Tones.of(ax)
    x, y = arrows.x + offset[0], arrows.y + offset[1]
    parts: list[tuple[Any, str]] = [(slice(None), tones.ink)]
    if arrows.clear is not None:
        parts = [(~arrows.clear, tones.pale), (arrows.clear, tones.ink)]
        ax.plot(x, y, ".", ms=1.2, color=tones.pale, zorder=2)
    heads = (3.2, 4.0, 3.6) if fine else (4.0, 5.0, 4.5)
    head: dict[str, Any] = dict(
        zip(("headwidth", "headlength", "headaxislength"), heads, strict=True)
    )
    for chosen, color in parts:
        lengths = () if norm is None else (arrows.length[chosen],)
        look = {"color": color} if norm is None else {"norm": norm, "cmap": SIZES}
        drawn = ax.quiver(
            x[chosen],
            y[chosen],
            arrows.du[chosen],
            arrows.dv[chosen],
            *lengths,
            angles="xy",
            scale_units="xy",
            scale=1.0 / magnification,
            units="inches",
            width=0.007 if fine else 0.011,
            minlength=0.3,
            zorder=3,
            **look,
            **head,
        )
    if arrows.ring is not None:
        at = np.add(arrows.ring, offset)
        ax.plot(*at, "o", ms=5, mfc="none", mec=PALETTE["vermilion"], mew=1.3, zorder=5)
    return drawn


def draw_key(
    ax: Axes,
    length: float,
    *,
    magnification: float,
    unit: str = "pix",
    scale_mas: float | None = None,
) -> None:
    """Draw an arrow of a stated length above the right end of axes with final limits.

    `length` is in `unit`. It is stated in mas if it is in pixels and `scale_mas`, the size of a
    pixel, is given.
    """
    end = ax.get_xlim()[1]
    drawn = length * magnification
    start = end - drawn
    transform, color = ax.get_xaxis_transform(), Tones.of(ax).ink
    times = f"×{magnification:,.6g}".replace(",", "\u202f")
    how = times if unit == "pix" else f"as {drawn:.3g} pix"
    ax.annotate(
        "",
        xy=(end, 1.035),
        xytext=(start, 1.035),
        xycoords=transform,
        textcoords=transform,
        arrowprops={
            "arrowstyle": "-|>,head_width=0.18,head_length=0.35",
            "shrinkA": 0,
            "shrinkB": 0,
            "lw": 1.0,
            "color": color,
            "mutation_scale": 9,
        },
        annotation_clip=False,
    )
    stated = size_of(length, unit)
    if scale_mas is not None and unit == "pix":
        stated = size_of(length * scale_mas, "mas")
    text = ax.text(start, 1.035, f"{stated}, drawn {how} ", transform=transform)
    text.set(ha="right", va="center", fontsize=small_font(), color=color)


# -- crosses --------------------------------------------------------------------------------------


@figure_style()
def cross_map(
    panels: Panels,
    maps: Sequence[UncertaintyMap],
    titles: Sequence[str],
    *,
    magnification: float | Sequence[float],
    key: float | Sequence[float],
    every: int = 1,
) -> None:
    """Draw errors as four vectors from each point, to all combinations of (±sigma_u, ±sigma_v).

    `maps`: maps of the first chip, followed by those of the next one. `magnification` and `key`:
    for all panels or for each. `every`: see `square_cells`. `panels` must be framed.
    """
    places = [(column, ax) for several in panels.axes for column, ax in enumerate(several)]
    scales, keys = (np.broadcast_to(np.asarray(a, float), len(maps)) for a in (magnification, key))
    for (column, ax), errors, title, M, length in zip(
        places, maps, titles, scales, keys, strict=True
    ):
        draw_crosses(ax, errors, magnification=float(M), every=every, color=CYCLE[column])
        ax.set_title(title, pad=20)
        # one key would be enough, but a panel that is cut out must also state its scale
        draw_key(ax, float(length), magnification=float(M), unit=errors.unit)


def draw_crosses(
    ax: Axes, errors: UncertaintyMap, *, magnification: float, every: int = 1, color: str = CYCLE[0]
) -> None:
    """Draw four vectors from each point of a map, to all combinations of (±sigma_u, ±sigma_v)."""
    segments = list(_crosses(errors, magnification, every))
    ax.add_collection(LineCollection(segments, colors=color, linewidths=0.8))


def crosses_magnification(maps: Sequence[UncertaintyMap], every: int = 1) -> float:
    """Round factor by which the largest error is drawn as at most 0.8 of a grid step."""
    widest = max(max(m.sigma_u_max, m.sigma_v_max) for m in maps)
    steps = []
    for m in maps:
        rows, columns = square_cells(m.x, m.y, every)
        steps.append(spacing(m.x[columns], m.y[rows]))
    # crosses overlap beyond half a step: a few in the corners may, so that inner ones are visible
    return nice_below(0.8 * min(steps) / max(widest, 1e-300))


def _crosses(m: UncertaintyMap, magnification: float, every: int) -> Float:
    """End points (4 N, 2, 2) of the four segments at each point."""
    rows, columns = square_cells(m.x, m.y, every)
    gx, gy = np.meshgrid(m.x[columns], m.y[rows])
    start = np.stack([gx.ravel(), gy.ravel()], axis=-1)
    sigma = [s[rows, columns].ravel() for s in (m.sigma_u, m.sigma_v)]
    half = magnification * np.stack(sigma, axis=-1)
    ends = [start + half * np.array(s) for s in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    return np.concatenate([np.stack([start, end], axis=1) for end in ends])
