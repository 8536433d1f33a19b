"""Figures of several bands: histograms and correlation of residuals, and maps side by side.

Each map is in pixels of its band.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from bayesdist.missions.wise.assess.residual_field import CORRELATION_DRAWS
from bayesdist.missions.wise.bands.context import BANDS, BandsInput
from bayesdist.report.contents import Plot
from bayesdist.report.figures.arrows import Arrows, cross_map, magnification_of, spacing, vector_map
from bayesdist.report.figures.fields import Grid, scalar_map
from bayesdist.report.figures.panels import ArrayPanels
from bayesdist.report.figures.style import INK, PALETTE, WIDTH, legend_above, new_figure, nice_below
from bayesdist.utils.arrays import Float
from bayesdist.utils.text import number, probability, size_of

if TYPE_CHECKING:
    from bayesdist.assess import UncertaintyMap, VectorMap

# colour, line width and dashes of each case, in drawing order
CASES = {
    "no correction": (PALETTE["blue"], 1.0, "-"),
    "optical model": (PALETTE["green"], 1.0, (0, (3.5, 1.0))),
    "calibrated": (PALETTE["vermilion"], 1.3, "-"),
}

Size = tuple[float, float]

EVERY = 2  # only every second vector of a map is drawn, to avoid overlaps in small panels
FORMAL = 2000.0  # magnification in section 6 of WSDC D-T033
SEEN = 0.15  # smallest visible size of a cross, in grid steps
DIVERGING = "RdBu_r"  # red and blue are distinguishable with all common types of colour blindness
AXES = "xy"


@BANDS.figure("histograms", printed=True)
def histograms(inputs: BandsInput) -> Plot:
    """Histograms of the residuals along x and y of all pairs, with logarithmic counts."""
    fig = new_figure(WIDTH, 0.5 + 1.75 * len(inputs.bands))
    axes = fig.subplots(len(inputs.bands), 2, sharey="row", sharex="row", squeeze=False)
    for band, row in zip(inputs.bands, axes, strict=True):
        name, cases = band.name, band.sums.histograms
        for k, (ax, axis) in enumerate(zip(row, "XY", strict=True)):
            for case, (color, width, dashes) in CASES.items():
                if case not in cases:
                    continue
                histogram = cases[case]
                ax.stairs(
                    histogram.counts[k],
                    histogram.edges,
                    color=color,
                    lw=width,
                    ls=dashes,
                    label=case,
                )
            reach = next(iter(cases.values())).reach
            ax.set_xlim(-reach, reach)
            ax.set_yscale("log")
            ax.set_ylim(bottom=0.7)
            ax.set_title(f"{name} {axis}", pad=3)
        row[0].set_ylabel("pairs per bin")
    for ax in axes[-1]:
        ax.set_xlabel("residual [pix]")
    legend_above(fig, axes[0, 0])
    cases_text = "Without correction (blue)"
    if inputs.optical:
        cases_text += ", corrected by the optical model (green, dashed)"
    return Plot(
        fig,
        "Residuals of all pairs",
        f"{cases_text} and calibrated (orange); counts are logarithmic. The constant is that of the"
        " calibration in all cases. The tails far from zero, common to all cases, are false"
        " matches.",
        "Histograms of the residuals in X and Y for each band: calibration makes a narrow peak.",
    )


@BANDS.figure("structure", printed=True)
def correlation(inputs: BandsInput) -> Plot:
    """Correlation of mean residuals of bins against their separation, with its noise level."""
    bands = inputs.bands
    columns = min(2, len(bands))
    rows = -(-len(bands) // columns)
    fig = new_figure(WIDTH, 0.5 + 2.1 * rows)
    axes = fig.subplots(rows, columns, squeeze=False).ravel()
    for ax in axes[len(bands) :]:
        ax.remove()
    for band, ax in zip(bands, axes, strict=False):
        c = band.correlation
        axes_shown = (("X", c.uu, c.sigma_uu, "blue", "-"), ("Y", c.vv, c.sigma_vv, "orange", "--"))
        for label, values, sigma, color, dashes in axes_shown:
            ax.fill_between(
                c.separation,
                -2e6 * sigma,
                2e6 * sigma,
                color=PALETTE[color],
                alpha=0.25,
                lw=0,
                label=f"±2 σ of noise in {label}",
            )
            ax.plot(
                c.separation,
                1e6 * values,
                color=PALETTE[color],
                ls=dashes,
                marker="o",
                ms=2.5,
                label=f"{label} with {label}",
            )
        ax.axhline(0.0, color=INK, lw=0.5)
        ax.set_xlim(0.0, float(np.max(c.separation)) * 1.02)
        ax.set_title(f"{band.name}: {chance_of(c.p_value)}", pad=3)
        ax.set_xlabel("separation [pix]")
    for ax in axes[: len(bands) : columns]:
        ax.set_ylabel("mean product [10⁻⁶ pix²]")
    legend_above(fig, axes[0])
    return Plot(
        fig,
        "Correlation of mean residuals",
        "Mean product of the residuals of two bins against their separation, minus the expectation"
        " for noise. Points outside of the shaded bands are structure that the polynomial does not"
        " describe.",
        "Curves of the correlation of residuals against separation for each band.",
    )


def chance_of(p: float) -> str:
    """p-value from random draws as text; an upper bound if it is the smallest possible one."""
    return f"p < {2 / CORRELATION_DRAWS:g}" if below_draws(p) else probability(p)


def below_draws(p: float) -> bool:
    """True if no noise field reached the value of the data, so that p is an upper bound."""
    return p < 1.5 / CORRELATION_DRAWS


@BANDS.figure("vectors", printed=True)
def vectors(inputs: BandsInput) -> Plot:
    """Distortion of each band without its constant."""
    bands = inputs.bands
    fig = _flows({b.name: b.vectors for b in bands}, {b.name: b.arcsec for b in bands})
    return Plot(
        fig,
        "Distortion",
        "Vectors from each position on the array to its undistorted position, without the constant."
        " All bands have the same scale in arcsec; the ring marks the longest vector.",
        "Maps of arrows over the array of each band, longest in the corners.",
    )


@BANDS.figure("vectors", needs=("differences",), printed=True)
def differences(inputs: BandsInput) -> Plot:
    """Later bands minus the first one."""
    first = inputs.names[0]
    arcsec = dict.fromkeys(inputs.differences, inputs.bands[0].arcsec)
    fig = _flows(inputs.differences, arcsec)
    return Plot(
        fig,
        "Differences of bands",
        f"Later bands minus {first} at the same position in the field, in pixels of {first},"
        " without constants.",
        "Maps of arrows: how the distortion of each band differs from that of the first.",
    )


@BANDS.figure(
    "vectors", when=lambda inputs: any(b.minus_optical for b in inputs.bands), printed=True
)
def minus_optical(inputs: BandsInput) -> Plot:
    """Distortion of each band minus an optical model."""
    maps_and_scales = {b.name: (b.minus_optical, b.arcsec) for b in inputs.bands}
    maps = {f"{name} − optical": v for name, (v, _) in maps_and_scales.items() if v is not None}
    arcsec = {f"{name} − optical": size for name, (_, size) in maps_and_scales.items()}
    fig = _flows(maps, arcsec)
    return Plot(
        fig,
        "Bands minus the optical model",
        f"In pixels of each band, without constants. Optical model: {inputs.optical}.",
        "Maps of arrows: difference between each band's distortion and the optical model.",
    )


def _flows(maps: Mapping[str, VectorMap], arcsec: Mapping[str, float]) -> Figure:
    """Vector maps side by side, as in section 4 of WSDC D-T033.

    All panels have the same width and magnification relative to the pixels of the band.  For bands
    with the same field of view, equal lengths on the page are therefore equal lengths in arcsec.
    """
    arrows = {name: Arrows.of_map(v, EVERY) for name, v in maps.items()}
    longest = {name: float(np.hypot(*v.on_detector).max()) for name, v in maps.items()}
    sizes = {name: (float(v.x.max()), float(v.y.max())) for name, v in maps.items()}
    M = min(
        magnification_of(1.5 * arrow_map.step, longest[name]) for name, arrow_map in arrows.items()
    )
    panels = ArrayPanels(sizes)
    panels.frame(
        max(
            arrow_map.reach(M, sizes[name]) / max(sizes[name]) for name, arrow_map in arrows.items()
        )
        + 0.02
    )
    # a round number of the largest pixels, about one grid step
    widest = max(arrows, key=lambda name: arcsec[name])
    key = nice_below(arrows[widest].step / M) * arcsec[widest]
    vector_map(
        panels,
        list(arrows.values()),
        [
            f"{name}\nMax = {number(length, 4)} pix ({number(length * arcsec[name], 3)}″)"
            for name, length in longest.items()
        ],
        magnification=M,
        key=[key / arcsec[name] for name in arrows],
        pad=17,
        fine=True,
    )
    return panels.figure


@BANDS.figure(
    "structure", each=lambda inputs: {f"residuals_{axis}": axis for axis in AXES}, printed=True
)
def residuals(inputs: BandsInput, axis: str) -> Plot:
    """Mean residuals in bins, along x or along y."""
    images = {b.name: b.sums.bins.values(axis.upper()).mean for b in inputs.bands}
    sizes = {b.name: b.size for b in inputs.bands}
    return Plot(
        _images(images, sizes, axis.upper(), "pix"),
        f"Mean residuals in {axis.upper()}",
        f"Pairs used in the fit, in {_bins(inputs)}; one colour scale for all bands, symmetric"
        " about zero. Titles give the extremes. Blocks with sharp edges are not distortion.",
        f"Images of the mean residual in {axis.upper()} over the array of each band.",
    )


@BANDS.figure(
    "structure",
    needs=("differences",),
    each=lambda inputs: {f"alignment_{axis}": axis for axis in AXES},
    printed=True,
)
def alignment(inputs: BandsInput, axis: str) -> Plot:
    """Mean residuals of each pair of bands, one minus the other."""
    images, sizes = {}, {}
    for k, earlier in enumerate(inputs.bands):
        for later in inputs.bands[k + 1 :]:
            name = f"{later.name}−{earlier.name}"
            later_values, earlier_values = (
                b.sums.bins.values(axis.upper()).scaled(b.arcsec) for b in (later, earlier)
            )
            images[name], sizes[name] = later_values.minus(earlier_values).mean, earlier.size
    return Plot(
        _images(images, sizes, axis.upper(), "arcsec", own_scale=True),
        f"Mean residuals in {axis.upper()} of two bands, one minus the other",
        f"In arcsec, in {_bins(inputs)}: misalignment of two bands observed together."
        " Each panel has its own colour scale.",
        f"Images of differences of mean residuals in {axis.upper()} for each pair of bands.",
    )


def _bins(inputs: BandsInput) -> str:
    return f"{inputs.n_bins} × {inputs.n_bins} bins"


def _images(
    images: Mapping[str, Float],
    sizes: Mapping[str, Size],
    axis: str,
    unit: str,
    *,
    own_scale: bool = False,
) -> Figure:
    titles = [
        f"{name} {axis}: {_signed(np.nanmin(image))} to {_signed(np.nanmax(image))}"
        for name, image in images.items()
    ]
    label = f"mean residual in {axis} [{unit}]"
    return _cells(images, sizes, titles, label, own_scale=own_scale)


def _signed(value: float) -> str:
    return f"{value:+.3f}".replace("-", "−")


def _cells(
    images: Mapping[str, Float],
    sizes: Mapping[str, Size],
    titles: list[str],
    label: str,
    *,
    centre: float = 0.0,
    own_scale: bool = False,
) -> Figure:
    """Images of bins with a symmetric colour scale that includes 99.5 % of the bins."""
    grids = []
    for name, image in images.items():
        steps = (n / cells for n, cells in zip(sizes[name], image.shape[::-1], strict=True))
        x, y = (
            0.5 + step * (np.arange(cells) + 0.5)
            for step, cells in zip(steps, image.shape[::-1], strict=True)
        )
        grids.append(Grid(x, y, image))
    norms = []
    for shown in [[g] for g in grids] if own_scale else [grids]:
        away = np.concatenate([np.abs(g.values - centre).ravel() for g in shown])
        reach = max(float(np.quantile(away[np.isfinite(away)], 0.995)), 1e-12)
        norms.append(Normalize(centre - reach, centre + reach))
    panels = ArrayPanels(sizes, colorbar=True)
    panels.frame()
    norm = norms if own_scale else norms[0]
    scalar_map(panels, grids, titles, label=label, norm=norm, cmap=DIVERGING)
    return panels.figure


@BANDS.figure("formal", printed=True)
def formal_uncertainty(inputs: BandsInput) -> Plot:
    """Four vectors from each position of the array, as in section 6 of WSDC D-T033.

    They are magnified 2000 times, as there, or by another factor if they would not be visible; each
    panel states its factor.
    """
    maps = {b.name: b.formal_map for b in inputs.bands}
    sizes = {name: (float(m.x[-1]), float(m.y[-1])) for name, m in maps.items()}
    factors = {name: _magnification(m) for name, m in maps.items()}
    widest = {name: max(m.sigma_u_max, m.sigma_v_max) for name, m in maps.items()}
    panels = ArrayPanels(sizes)
    panels.frame(max(factors[n] * widest[n] / max(sizes[n]) for n in maps) + 0.02)
    cross_map(
        panels,
        list(maps.values()),
        [f"{name}\nmax radius {size_of(m.radius_max, m.unit)}" for name, m in maps.items()],
        magnification=list(factors.values()),
        key=[nice_below(EVERY * spacing(m.x, m.y) / factors[name]) for name, m in maps.items()],
        every=EVERY,
    )
    fig = panels.figure
    return Plot(
        fig,
        "Formal uncertainty",
        "Least squares: four vectors from each position to all combinations of ±1 σ in x and in y."
        " Each panel states its magnification: 2000, or another if vectors would not be visible.",
        "Maps of small crosses over the array of each band, largest in the corners.",
    )


def _magnification(m: UncertaintyMap) -> float:
    step = EVERY * spacing(m.x, m.y)
    widest = max(m.sigma_u_max, m.sigma_v_max, 1e-300)
    if SEEN * step <= FORMAL * widest <= 0.5 * step:
        return FORMAL
    return nice_below(0.5 * step / widest)


@BANDS.figure("coverage", printed=True)
def coverage(inputs: BandsInput) -> Plot:
    """Number of pairs used in each bin relative to the mean of all bins."""
    images, titles = {}, []
    for b in inputs.bands:
        count = b.sums.bins.count
        expected = float(count.mean())
        images[b.name] = count / expected
        titles.append(
            f"{b.name}: {expected:.0f} ± {np.sqrt(expected):.0f} expected,\n"
            f"{count.min()} to {count.max()} found"
        )
    sizes = {b.name: b.size for b in inputs.bands}
    fig = _cells(images, sizes, titles, "pairs over those of even coverage", centre=1.0)
    return Plot(
        fig,
        "Coverage by pairs",
        "Number of pairs used in each bin relative to the mean of all bins. Titles give the mean"
        " with the Poisson error of one bin, and the lowest and highest number.",
        "Images of the number of pairs over the array of each band.",
    )
