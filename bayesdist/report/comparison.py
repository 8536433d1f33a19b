"""The difference of two calibrations over the detector, shaded by its significance."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.stats import chi2 as chi_square
from scipy.stats import norm

from bayesdist.report.mosaic import Mosaic
from bayesdist.report.numbers import display_scale
from bayesdist.report.style import (
    PALETTE,
    WIDTH,
    draw_vectors,
    figure_style,
    new_figure,
    nice_below,
    vector_key,
)
from bayesdist.report.vectors import grid_size, spacing, square_cells

if TYPE_CHECKING:
    from bayesdist.assess.comparison import Comparison

__all__ = ["change_over_time", "difference_vectors", "gaussian_sigmas"]

Float = NDArray[np.float64]

LEVELS = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)
# from white to a blue on which black arrows are still seen
_SHADES = LinearSegmentedColormap.from_list("significance", ["#FFFFFF", PALETTE["sky"]])


def gaussian_sigmas(chi2: Float) -> Float:
    """Chi-square of two axes as the sigmas that one axis would pass as rarely.

    Parameters
    ----------
    chi2 : ndarray

    Returns
    -------
    ndarray, same shape
        NaN stays NaN; not above 37, where probabilities underflow.
    """
    p = np.clip(chi_square.sf(chi2, 2), 1e-300, 1.0)
    return np.asarray(norm.isf(p / 2))


def difference_vectors(
    *found: Comparison,
    mosaic: Mosaic | None = None,
    names: tuple[str, str] = ("A", "B"),
    magnification: float | None = None,
) -> Figure:
    """Arrows of A minus B, over shades of how significant each is by itself.

    Parameters
    ----------
    *found : Comparison
        One for each chip; all are drawn to the same scale.
    mosaic : Mosaic, optional
        How the chips lie; one above the other by default.
    names : tuple of str
        What A and B are called.
    magnification : float, optional
        Pixels of the axes for one pixel of the difference; a round number by default.

    Returns
    -------
    matplotlib.figure.Figure
        Without shades where no covariance is known.
    """
    mosaic = mosaic or Mosaic.column(*(grid_size(c.x, c.y) for c in found))
    shaded = all(c.chi2 is not None for c in found)
    cells = [square_cells(c.x, c.y) for c in found]
    largest = max(c.largest for c in found)
    step = min(
        spacing(c.x[columns], c.y[rows]) for c, (rows, columns) in zip(found, cells, strict=True)
    )
    M = magnification or (nice_below(1.5 * step / largest) if largest > 1e-12 else 1.0)
    margin = M * largest + 0.02 * max(max(s) for s in mosaic.sizes)
    fig, panels = mosaic.panels(colorbar=shaded)
    shades = None
    with figure_style():
        for k, (c, (rows, columns), (ax,)) in enumerate(zip(found, cells, panels, strict=True)):
            mosaic.draw(ax, k, margin=margin)
            if c.chi2 is not None and shaded:
                shades = ax.contourf(
                    c.x,
                    c.y,
                    gaussian_sigmas(c.chi2),
                    levels=LEVELS,
                    cmap=_SHADES,
                    extend="max",
                    zorder=1,
                )
            gx, gy = np.meshgrid(c.x[columns], c.y[rows])
            draw_vectors(ax, gx, gy, c.du[rows, columns], c.dv[rows, columns], magnification=M)
            x, y = c.position_of_largest
            ax.plot(x, y, "o", ms=5, mfc="none", mec=PALETTE["vermilion"], mew=1.3, zorder=5)
            text = (
                f"{names[0]} minus {names[1]}: rms {display_scale('pix', c.rms).text(c.rms)}, "
                f"largest {display_scale('pix', c.largest).text(c.largest)}"
            )
            ax.set_title(mosaic.title(k, text), pad=20)
            vector_key(ax, nice_below(largest / 1.5), magnification=M, unit="pix")
        if shades is not None:
            fig.colorbar(
                shades,
                ax=[ax for (ax,) in panels],
                label="significance of each place by itself [σ]",
                fraction=0.05,
                pad=0.02,
            )
    return fig


def change_over_time(first: Float, gain: Float, dof: int, p_value: float | None) -> Figure:
    """Chi-square that a change from each date on takes up.

    Parameters
    ----------
    first : ndarray, shape (P,)
        First date of each period, decimal years.
    gain : ndarray, shape (P,)
    dof : int
        Degrees of freedom of a change.
    p_value : float or None
        Of the largest, the search over the dates accounted for.

    Returns
    -------
    matplotlib.figure.Figure
    """
    first, gain = np.asarray(first, float), np.asarray(gain, float)
    low, high = chi_square.ppf([0.025, 0.975], dof)
    with figure_style():
        fig = new_figure(WIDTH, 2.8)
        ax = fig.subplots()
        ax.axhspan(low, high, color=PALETTE["sky"], alpha=0.3, lw=0, zorder=0)
        ax.plot(first, gain, "o-", ms=4, color=PALETTE["blue"])
        best = int(gain.argmax())
        ax.plot(first[best], gain[best], "o", ms=9, mfc="none", mec=PALETTE["vermilion"], mew=1.3)
        ax.set_ylim(0, 1.1 * max(float(gain.max()), float(high)))
        ax.set_xlabel("a change from this date on [yr]")
        ax.set_ylabel(f"chi-square it takes up ({dof} d.o.f.)")
        told = ""
        if p_value is not None:
            p = "p < 1e-12" if p_value < 1e-12 else f"p = {p_value:.2g}"
            told = f"; {p} for the largest of {len(gain)}"
        ax.set_title(f"band: where 95 % of single dates lie by chance{told}")
    return fig
