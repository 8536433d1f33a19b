"""Figures of the histograms and of the spatial correlation of residuals, by band."""

from __future__ import annotations

import numpy as np

from bayesdist.missions.wise.assess.residual_correlation import DRAWS
from bayesdist.missions.wise.bands.context import BANDS, BandsInput
from bayesdist.report.contents import Plot
from bayesdist.report.figures.style import INK, PALETTE, WIDTH, legend_above, new_figure
from bayesdist.utils.numbers import probability

# colour, line width and dashes of each case, in drawing order
CASES = {
    "no correction": (PALETTE["blue"], 1.0, "-"),
    "optical model": (PALETTE["green"], 1.0, (0, (3.5, 1.0))),
    "calibrated": (PALETTE["vermilion"], 1.3, "-"),
}


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
    return f"p < {2 / DRAWS:g}" if below_draws(p) else probability(p)


def below_draws(p: float) -> bool:
    """True if no noise field reached the value of the data, so that p is an upper bound."""
    return p < 1.5 / DRAWS
