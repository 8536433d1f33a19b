"""Plots of the posterior: corner plot, correlations of the coefficients, ranks of the draws."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from bayesdist.errors import InputError
from bayesdist.report.figures.style import COLORBAR, CYCLE, DIVERGING, PALETTE, Tones
from bayesdist.report.plots.axes import axes_of
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.text import broken_name, display_scale

if TYPE_CHECKING:
    from bayesdist.infer import Posterior

MIXTURE = ("f", "j", "s_out")
MAX_DRAWS = 20_000  # in a corner plot
CORNER_BINS = 26  # along each axis
SHOWN_SIGMA = 4.0  # half width of an axis of a corner plot, in standard deviations
QUANTILES = (0.1587, 0.8413)
# probability inside the contours of 1 and 2 sigma of a Gaussian in two dimensions
CONTENTS = 1.0 - np.exp(-0.5 * np.array([1.0, 2.0]) ** 2)
MAX_TICKS = 3  # per axis of a corner plot
MAX_CORNER = 4  # number of parameters of a corner plot by default
MAX_NAMES = 25  # number of coefficient names along an axis
RANK_BINS = 20

# -- corner plot ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Column:
    """Draws (N,) of one quantity."""

    label: str
    unit: str
    draws: Float
    positive: bool = False  # True if the quantity cannot be negative


def plot_corner(
    posterior: Posterior,
    parameters: Sequence[str] | None = None,
    *,
    fig: Figure | SubFigure | None = None,
) -> NDArray[Any]:
    """Plot the joint posterior of each pair of some parameters, and the histogram of each.

    Contours enclose 39 and 86 %, like 1 and 2 sigma of a Gaussian in two dimensions; dashed lines
    enclose 68 %. Coefficients are shown relative to their posterior means.

    Parameters
    ----------
    posterior : Posterior
    parameters : sequence of str, optional
        Names of coefficients (``posterior.model.names``), or 'f', 'j' and 's_out' for the outlier
        mixture. By default the parameters of the mixture that were sampled or, if there are none,
        the coefficients with the fewest effective draws.
    fig : matplotlib.figure.Figure or SubFigure, optional
        Empty figure to draw into; by default a new figure.

    Returns
    -------
    ndarray of matplotlib.axes.Axes, shape (n, n)
        Panels above the diagonal are None.

    Raises
    ------
    InputError
        If a parameter is unknown or was not sampled, or `fig` is not empty.
    """
    names = default_parameters(posterior) if parameters is None else tuple(parameters)
    if isinstance(parameters, str) or not names:
        raise InputError(
            f"parameters is {parameters!r}", where="plot_corner", do="give a list of names"
        )
    columns = [_column(posterior, name) for name in names]
    if fig is None:
        from matplotlib import pyplot

        side = 2.0 * len(columns) + 1.2
        fig = pyplot.figure(figsize=(side, side), layout="constrained")
    elif isinstance(fig, Figure) and fig.get_layout_engine() is None:
        fig.set_layout_engine("constrained")  # otherwise labels of a large style do not fit
    if fig.axes:
        raise InputError("the figure has axes", where="plot_corner", do="give an empty figure")
    return draw_corner(fig, columns)


def default_parameters(posterior: Posterior) -> tuple[str, ...]:
    """Sampled parameters of the mixture; if there are none, the slowest coefficients."""
    sampled = tuple(name for name in MIXTURE if name in posterior.hyper)
    return sampled or slowest_parameters(posterior, without=fixed_parameters(posterior))


def mixture_column(posterior: Posterior, name: str) -> Column:
    """Draws of 'f' in percent, of 'j' or of 's_out'."""
    draws = _thinned(_draws_of(posterior, name))
    if name == "f":
        return Column(name, "%", 100.0 * draws, positive=True)
    return Column(name, posterior.model.unit, draws, positive=True)


def _column(posterior: Posterior, name: str) -> Column:
    if name in posterior.hyper:
        return mixture_column(posterior, name)
    draws = _thinned(_draws_of(posterior, name))
    if np.ptp(draws) == 0:
        raise InputError(f"{name} is held fixed", where="plot_corner", do="leave it out")
    k = posterior.model.names.index(name)
    unit = posterior.model.parameters[k].unit
    return Column(f"{name} − mean", unit, draws - float(posterior.mean[k]))


def _thinned(draws: Float) -> Float:
    return np.asarray(draws.ravel()[:: max(1, draws.size // MAX_DRAWS)])


def draw_corner(fig: Figure | SubFigure, columns: Sequence[Column]) -> NDArray[Any]:
    """Draw a corner plot into an empty figure; returns its panels (n, n)."""
    n = len(columns)
    limits = np.array([_limits(column) for column in columns])
    # units are chosen for the centre of an axis, since the ticks are not at its largest values
    sizes = [abs(low + high) / 2 if low >= 0 else high for low, high in limits]
    scales = [display_scale(c.unit, size) for c, size in zip(columns, sizes, strict=True)]
    factors = np.array([scale.factor for scale in scales])
    draws = np.stack([column.draws for column in columns]) * factors[:, None]
    ends = limits * factors[:, None]
    edges = [np.linspace(low, high, CORNER_BINS + 1) for low, high in ends]
    panels = fig.subplots(n, n, squeeze=False, gridspec_kw={"wspace": 0.03, "hspace": 0.03})
    for i in range(n):
        for j in range(n):
            if j < i:
                _joint(panels[i, j], draws[j], draws[i], edges[j], edges[i])
            elif j == i:
                _marginal(panels[i, i], draws[i], edges[i])
            else:
                panels[i, j].remove()
                panels[i, j] = None
                continue
            _numbers(panels[i, j], below=i == n - 1, beside=j == 0 and i > 0)
    labels = [
        f"{column.label}\n[{scale.unit or 'no unit'}]"
        for column, scale in zip(columns, scales, strict=True)
    ]
    for j in range(n):
        panels[-1, j].set_xlabel(labels[j])
        if j:
            panels[j, 0].set_ylabel(labels[j])
    panels[0, 0].set_ylabel("density\n[relative]")
    fig.align_labels()
    if n > 1:
        color = to_rgba(PALETTE["blue"], 0.6)
        handles = [Patch(fc=color, label="posterior\n(1 σ and 2 σ)")]
        fig.legend(handles=handles, loc="upper right")
    return np.asarray(panels)


def _limits(column: Column) -> tuple[float, float]:
    """Limits of an axis: four standard deviations about the median."""
    middle, spread = float(np.median(column.draws)), float(np.std(column.draws))
    half = SHOWN_SIGMA * spread if spread > 0 else 1e-6 * abs(middle) + 1e-12
    low = middle - half
    return max(low, 0.0) if column.positive else low, middle + half


def _marginal(ax: Axes, draws: Float, edges: Float) -> None:
    density, _ = np.histogram(draws, edges, density=True)
    ax.stairs(density, edges, color=PALETTE["blue"], lw=1.0)
    for value in np.quantile(draws, QUANTILES):
        ax.axvline(value, color=PALETTE["blue"], ls="--", lw=1.0)
    ax.set_xlim(edges[0], edges[-1])
    ax.xaxis.set_major_locator(MaxNLocator(MAX_TICKS, prune="both"))
    ax.set_ylim(0.0, 1.1 * float(density.max()) or 1.0)
    ax.set_yticks([])


def _joint(ax: Axes, x: Float, y: Float, x_edges: Float, y_edges: Float) -> None:
    """Draw contours of the smoothed density that enclose the probabilities `CONTENTS`."""
    counts, _, _ = np.histogram2d(x, y, (x_edges, y_edges))
    # a border of empty cells closes contours at the edge
    density = np.pad(gaussian_filter(counts, 1.0, mode="constant"), 1)
    levels = contour_heights(density)
    centres = []
    for edges in (x_edges, y_edges):
        step = edges[1] - edges[0]
        centres.append(edges[0] + step * (np.arange(len(edges) + 1) - 0.5))
    colors = [to_rgba(PALETTE["blue"], alpha) for alpha in (0.33, 1.0)]
    top = 1.001 * float(density.max())
    ax.contourf(*centres, density.T, [*levels, top], colors=colors)
    ax.contour(*centres, density.T, levels, colors=PALETTE["blue"], linewidths=1.0)
    ax.set_xlim(x_edges[0], x_edges[-1])
    ax.set_ylim(y_edges[0], y_edges[-1])
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MaxNLocator(MAX_TICKS, prune="both"))


def contour_heights(density: Float) -> Float:
    """Densities, ascending, of the contours that enclose 2 and 1 sigma of the probability."""
    ordered = np.sort(density.ravel())[::-1]
    held = np.cumsum(ordered) / ordered.sum()
    heights = [ordered[np.searchsorted(held, content)] for content in CONTENTS[::-1]]
    # contour levels must differ, even if all draws are in one cell
    heights[1] = max(heights[1], heights[0] * (1 + 1e-6) + 1e-12)
    return np.asarray(heights)


def _numbers(ax: Axes, *, below: bool, beside: bool) -> None:
    """Show tick labels only at the edges of the figure."""
    ax.tick_params(axis="x", labelbottom=below, labelrotation=45)
    ax.tick_params(axis="y", labelleft=beside, labelrotation=45)


# -- correlations ---------------------------------------------------------------------------------


def plot_correlations(posterior: Posterior, ax: Axes | None = None) -> Axes:
    """Plot the correlations between coefficients in the posterior as a matrix of colours.

    Parameters of the frames of exposures and fixed parameters are left out.

    Parameters
    ----------
    posterior : Posterior
    ax : matplotlib.axes.Axes, optional
        By default the axes of a new figure.

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    InputError
        If `ax` is not a single Axes.
    """
    ax = axes_of(ax)
    names, matrix = correlation_matrix(posterior)
    image = ax.imshow(matrix, vmin=-1, vmax=1, cmap=DIVERGING, interpolation="nearest")
    step = -(-len(names) // MAX_NAMES)
    ax.set_xticks(range(0, len(names), step), names[::step], rotation=90)
    ax.set_yticks(range(0, len(names), step), names[::step])
    ax.set_xlabel("coefficient [name]")
    ax.set_ylabel("coefficient [name]")
    ax.figure.colorbar(image, ax=ax, label="correlation [no unit]", **COLORBAR)
    return ax


def fixed_parameters(posterior: Posterior) -> frozenset[str]:
    """Names of the coefficients with the same value in all draws."""
    fixed = np.ptp(posterior.flat, axis=0) == 0
    return frozenset(posterior.model.names[k] for k in np.flatnonzero(fixed))


def correlation_matrix(posterior: Posterior) -> tuple[list[str], Float]:
    """Names and correlations (n, n) of the free coefficients, without those of exposures."""
    fixed = fixed_parameters(posterior)
    parameters = enumerate(posterior.model.parameters)
    chosen = [k for k, p in parameters if p.kind != "frame" and p.name not in fixed]
    cov = np.asarray(posterior.cov)[np.ix_(chosen, chosen)]
    sd = np.sqrt(np.diag(cov))
    return [posterior.model.names[k] for k in chosen], cov / np.outer(sd, sd)


# -- ranks ----------------------------------------------------------------------------------------


def plot_ranks(
    posterior: Posterior,
    parameter: str | None = None,
    ax: Axes | None = None,
    *,
    legend: bool = True,
) -> Axes:
    """Plot the ranks of the draws of each ensemble among the draws of all ensembles.

    Ensembles that sample the same distribution have flat histograms within the 2 sigma band.

    Parameters
    ----------
    posterior : Posterior
    parameter : str, optional
        Name of a coefficient, or 'f', 'j' or 's_out'; by default the coefficient with the fewest
        effective draws.
    ax : matplotlib.axes.Axes, optional
        By default the axes of a new figure.
    legend : bool
        True for a legend inside the axes.

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    InputError
        If the parameter is unknown, or `ax` is not a single Axes.
    """
    name = parameter
    if name is None:
        name = slowest_parameters(posterior, without=fixed_parameters(posterior))[0]
    ax = axes_of(ax)
    farthest = draw_ranks(ax, posterior, name, rank_band(posterior))
    ax.set_xlim(0, 1)
    ax.set_ylim(max(0.0, 1 - 1.2 * farthest), 1 + 1.2 * farthest)
    ax.set_xlabel("rank [fraction]")
    ax.set_ylabel("draws / expected [no unit]")
    if legend:
        ax.legend(ncols=2)
    return ax


def rank_band(posterior: Posterior) -> float:
    """Twice the standard deviation of the fraction of an ensemble's draws in a bin, relative to it.

    The uncertainty of the fraction 1 / `RANK_BINS` follows from the number of effective draws of
    the slowest parameter.
    """
    ensembles, draws = posterior.theta.shape[:2]
    finite = [v for v in posterior.convergence.ess_bulk if np.isfinite(v)]
    worst = min(finite, default=float(ensembles * draws))
    variance = (1.0 - 1.0 / ensembles) * (RANK_BINS - 1) * ensembles / max(worst, 1.0)
    return float(2.0 * np.sqrt(variance))


def draw_ranks(ax: Axes, posterior: Posterior, name: str, band: float) -> float:
    """Draw a rank histogram per ensemble; returns the largest distance from 1, at least `band`."""
    draws = _draws_of(posterior, name)
    ax.axhspan(1 - band, 1 + band, color=Tones.of(ax).outline, alpha=0.25, lw=0)
    edges, farthest = np.linspace(0.0, 1.0, RANK_BINS + 1), band
    for k, counts in enumerate(rank_counts(draws, RANK_BINS)):
        share = counts * RANK_BINS / draws.shape[1]
        farthest = max(farthest, float(np.abs(share - 1).max()))
        color = CYCLE[k % len(CYCLE)]
        ax.stairs(share, edges, color=color, lw=1.1, baseline=None, label=f"ensemble {k + 1}")
    ax.set_title(broken_name(name).replace("\n", " "))
    return farthest


def _draws_of(posterior: Posterior, name: str) -> Float:
    """Draws (ensembles, draws) of a coefficient or a mixture parameter; raises InputError."""
    if name in posterior.hyper:
        return np.asarray(posterior.hyper[name], float)
    names = posterior.model.names
    if name not in names:
        raise InputError(
            f"the posterior has no parameter {name!r}",
            where="plot",
            do=f"give names such as {', '.join([*posterior.hyper, *names[:2]])}",
        )
    return np.asarray(posterior.theta[..., names.index(name)])


def rank_counts(draws: Float, bins: int) -> Int:
    """Counts (ensembles, bins) of draws (ensembles, draws) in equal bins of their ranks."""
    order = np.argsort(draws, axis=None, kind="stable")
    bins_of_draws = np.empty(draws.size, np.int64)
    bins_of_draws[order] = np.arange(draws.size) * bins // draws.size
    return np.array([np.bincount(w, minlength=bins) for w in bins_of_draws.reshape(draws.shape)])


def slowest_parameters(
    posterior: Posterior, *, without: Collection[str] = (), n: int = MAX_CORNER
) -> tuple[str, ...]:
    """Names of the n coefficients with the fewest effective draws, except those in `without`."""
    names = posterior.model.names
    ess_of = dict(zip(posterior.convergence.names, posterior.convergence.ess_bulk, strict=True))
    ess = np.array([ess_of.get(name, np.inf) for name in names], float)
    order = np.argsort(np.where(np.isfinite(ess), ess, -np.inf), kind="stable")
    return tuple(names[k] for k in order if names[k] not in without)[:n]
