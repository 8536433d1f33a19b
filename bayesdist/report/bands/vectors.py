"""Vector diagrams of several bands, all at one scale."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from bayesdist.report.bands.panels import band_axes, band_panels
from bayesdist.report.numbers import display_scale
from bayesdist.report.style import CYCLE, figure_style, nice_below, vector_key
from bayesdist.report.uncertainty import crosses
from bayesdist.report.vectors import VectorFlow, spacing

if TYPE_CHECKING:
    from bayesdist.assess import UncertaintyMap, VectorMap

__all__ = ["band_crosses", "band_flows"]

EVERY = 2  # every second vector of a map is drawn: more would hide each other in small panels
FORMAL = 2000.0  # magnification in section 6 of WSDC D-T033
SEEN = 0.15  # part of a grid step below which a cross is a dot


def band_flows(
    vectors: Mapping[str, VectorMap],
    arcsec: Mapping[str, float],
    *,
    magnification: float | None = None,
) -> Figure:
    """Vector-flow diagrams beside each other, as section 4 of WSDC D-T033.

    Panels are equally wide and vectors are longer by one factor than the arrays' own pixels: of
    bands that see the same field, one length in arcsec is the same length on the page.

    Parameters
    ----------
    vectors : mapping of str to VectorMap
        By the panel's title, in pixels.
    arcsec : mapping of str to float
        Arcsec per pixel of each.
    magnification : float, optional
        A round number by default.

    Returns
    -------
    matplotlib.figure.Figure
    """
    flows = {name: VectorFlow.of(v, EVERY) for name, v in vectors.items()}
    M = magnification or min(f.magnification for f in flows.values())
    sizes = {name: f.size for name, f in flows.items()}
    margin = max(f.reach(M) / max(f.size) for f in flows.values()) + 0.02
    # about a step of the grid, a round number of the widest pixels
    widest = max(flows, key=lambda name: arcsec[name])
    key = nice_below(flows[widest].step / M) * arcsec[widest]
    fig, axes = band_panels(sizes)
    with figure_style():
        band_axes(axes, sizes, margin)
        for name, ax in axes.items():
            f = flows[name]
            f.draw(ax, M, fine=True)
            ax.set_title(
                f"{name}\nMax = {f.largest:.4g} pix ({f.largest * arcsec[name]:.3g}″)", pad=17
            )
            vector_key(ax, key / arcsec[name], magnification=M, unit="pix")
    return fig


def band_crosses(maps: Mapping[str, UncertaintyMap]) -> Figure:
    """Formal uncertainties beside each other: four vectors from each place of the array.

    Drawn 2000 times larger as in section 6 of WSDC D-T033, or more where they would be dots, by a
    factor that each panel states.

    Parameters
    ----------
    maps : mapping of str to UncertaintyMap
        By the panel's title.

    Returns
    -------
    matplotlib.figure.Figure
    """
    sizes = {name: (float(m.x[-1]), float(m.y[-1])) for name, m in maps.items()}
    factors = {name: _magnification(m) for name, m in maps.items()}
    widest = {name: max(m.sigma_u_max, m.sigma_v_max) for name, m in maps.items()}
    margin = max(factors[name] * widest[name] / max(sizes[name]) for name in maps) + 0.02
    fig, axes = band_panels(sizes)
    with figure_style():
        band_axes(axes, sizes, margin)
        for name, ax in axes.items():
            m, M = maps[name], factors[name]
            segments = LineCollection(crosses(m, M, EVERY), colors=CYCLE[0], linewidths=0.8)
            ax.add_collection(segments)
            text = display_scale(m.unit, m.radius_max).text(m.radius_max)
            ax.set_title(f"{name}\nmax radius {text}", pad=17)
            key = nice_below(EVERY * spacing(m.x, m.y) / M)
            vector_key(ax, key, magnification=M, unit=m.unit)
    return fig


def _magnification(m: UncertaintyMap) -> float:
    step = EVERY * spacing(m.x, m.y)
    widest = max(m.sigma_u_max, m.sigma_v_max, 1e-300)
    if SEEN * step <= FORMAL * widest <= 0.5 * step:
        return FORMAL
    return nice_below(0.5 * step / widest)
