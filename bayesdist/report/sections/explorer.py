"""Data embedded in the page for its scripts, to compute the budget and to show maps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypedDict

import matplotlib
import numpy as np
from matplotlib.colors import to_hex
from scipy.interpolate import PchipInterpolator

from bayesdist.assess.budget_surface import JOINT, BudgetSurface, GridRow
from bayesdist.assess.terms.forms import MEASURED, Row
from bayesdist.assess.terms.given import CENTROID
from bayesdist.report.contents import REPORT, needed
from bayesdist.report.figures.style import CYCLE, SEQUENTIAL
from bayesdist.report.run import ReportedRun, mosaic_of, scale_mas, shown_maps
from bayesdist.utils.arrays import Float
from bayesdist.utils.text import ladder

MOMENT_DIGITS = 7  # quadratic forms of moments, and differences of displacements, partly cancel
CURVED_DIGITS = 9  # of moments at more than three epochs, which differ by orders of magnitude
MAP_DIGITS = 5
MOST_POINTS = 65  # along the longer side of a map; a pointer cannot resolve more
_COLORS = 12


Numbers = list[float | None]  # None (null in JSON) for missing numbers


class ChipEntry(TypedDict):
    """A chip and its place in the drawing of the detector."""

    number: int
    name: str
    size: list[float]
    place: list[float]


class PageData(TypedDict):
    """Units, colours and chips of the page."""

    unit: str
    scale_mas: float | None
    ladders: dict[str, Sequence[object]]
    colors: list[str]
    chips: list[ChipEntry]


class RowEntry(TypedDict):
    """A row of the budget."""

    name: str
    kind: str
    source: str


class LocalEntry(RowEntry):
    """A local error: sigma on the grid, by chip and axis."""

    sigma: dict[str, list[Numbers]]


class GivenEntry(RowEntry):
    """An error that is the same everywhere, by axis."""

    sigma: list[float]


class ProductEntry(RowEntry):
    """Displacements on the grid, by span, chip, node and axis."""

    spans: list[dict[str, list[list[Numbers]]]]


class CentroidEntry(RowEntry):
    """Knots of the interpolation in magnitude: logarithms of the errors, and their slopes."""

    mag: list[float]
    log: list[Numbers]
    slope: list[Numbers]


class SpanEntry(TypedDict):
    """Second moments of the errors between two epochs, by chip, part, node and axis."""

    nodes: list[float]
    moments: dict[str, dict[str, list[list[Numbers]]]]


class BudgetData(PageData):
    """Error budget as a function of position, epoch and magnitude."""

    terms: list[tuple[int, int]]  # powers of x and y
    grid: list[int]
    epoch: float | None
    years: list[float] | None
    parts: list[RowEntry]
    joint: str
    spans: list[SpanEntry]
    local: list[LocalEntry]
    given: list[GivenEntry]
    centroid: CentroidEntry | None
    products: list[ProductEntry]
    cycle: list[str]


class MapEntry(TypedDict):
    """Values of a map row by row; the shape has the number of columns first."""

    shape: list[int]
    values: Numbers


class LayerEntry(TypedDict):
    """Maps of one quantity, by chip."""

    name: str
    unit: str
    digits: int
    maps: list[MapEntry]


class MapData(PageData):
    """Maps that are read with a pointer."""

    layers: list[LayerEntry]


@REPORT.data(needs=("evaluation.surface",))
def budget_data(run: ReportedRun) -> BudgetData:
    """Error budget as a function of position, epoch and magnitude."""
    s = needed(run.evaluation.surface)
    nodes = s.spans[0].nodes
    return {
        **_common(run),
        "terms": list(s.model.basis(s.model.chips[0].number).terms),
        "grid": list(s.grid),
        "epoch": s.epoch,
        "years": [nodes[0], s.spans[-1].nodes[-1]] if nodes else None,
        "parts": [_row(row) for row in s.parts],
        "joint": JOINT,
        "spans": [
            {
                "nodes": list(span.nodes),
                "moments": {
                    str(chip): {part: _triangles(m) for part, m in parts.items()}
                    for chip, parts in span.moments.items()
                },
            }
            for span in s.spans
        ],
        "local": [
            {
                **_row(t.row),
                "sigma": {
                    str(chip): [_short(v[0, :, axis], MAP_DIGITS) for axis in (0, 1)]
                    for chip, v in t.values[0].items()
                },
            }
            for t in s.local
        ],
        "given": [{**_row(row), "sigma": sigma.tolist()} for row, sigma in s.constant],
        "centroid": _centroid(s),
        "products": [_product(term) for term in s.products],
        "cycle": list(CYCLE),
    }


@REPORT.data()
def map_data(run: ReportedRun) -> MapData:
    """Maps of the uncertainty per axis and the pixel area, read with a pointer."""
    layers = []
    for maps in zip(*shown_maps(run), strict=True):
        first, sigma = maps[0], [m.per_axis for m in maps]
        layers.append(_layer(f"Uncertainty per axis, {first.kind}", run.model.unit, sigma))
    layers.append(
        _layer("Pixel area, relative", "", [area.area for area in run.evaluation.areas], digits=7)
    )
    return {**_common(run), "layers": layers}


def _common(run: ReportedRun) -> PageData:
    colors = matplotlib.colormaps[SEQUENTIAL](np.linspace(0.0, 1.0, _COLORS))
    return {
        "unit": run.model.unit,
        "scale_mas": scale_mas(run),
        "ladders": {unit: ladder(unit) for unit in (run.model.unit, "mas")},
        "colors": [to_hex(c) for c in colors],
        "chips": [
            {
                "number": chip.number,
                "name": chip.name or f"chip {chip.number}",
                "size": list(chip.size),
                "place": list(place),
            }
            for chip, place in zip(run.model.chips, mosaic_of(run).places, strict=True)
        ],
    }


def _layer(name: str, unit: str, maps: list[Float], digits: int = MAP_DIGITS) -> LayerEntry:
    thin = [m[:: _step(m.shape[0]), :: _step(m.shape[1])] for m in maps]
    return {
        "name": name,
        "unit": unit,
        "digits": digits - 2,
        "maps": [{"shape": list(m.shape[::-1]), "values": _short(m, digits)} for m in thin],
    }


def _step(n: int) -> int:
    """Step between the points that are kept; it includes the outermost points."""
    steps = [k for k in range(1, n) if (n - 1) % k == 0 and (n - 1) // k < MOST_POINTS]
    return steps[0] if steps else 1


def _triangles(moments: Float) -> list[list[Numbers]]:
    """Upper triangles row by row, by node and axis; symmetric elements are added."""
    K = moments.shape[-1]
    i, j = np.triu_indices(K)
    values = moments[..., i, j] * np.where(i == j, 1.0, 2.0)
    digits = MOMENT_DIGITS if len(moments) <= 3 else CURVED_DIGITS
    return [[_short(v, digits) for v in node] for node in values]


def _row(row: Row) -> RowEntry:
    return {"name": row.name, "kind": row.kind, "source": row.source}


def _product(term: GridRow) -> ProductEntry:
    """Displacements on the grid, by span, chip, node and axis."""
    spans: list[dict[str, list[list[Numbers]]]] = [
        {
            str(chip): [[_short(node[:, axis], MOMENT_DIGITS) for axis in (0, 1)] for node in nodes]
            for chip, nodes in shifts.items()
        }
        for shifts in term.values
    ]
    return {**_row(term.row), "spans": spans}


def _short(values: Float, digits: int) -> Numbers:
    """Numbers rounded to `digits` digits; None (null in JSON) for missing numbers."""
    return [float(f"{v:.{digits - 1}e}") if np.isfinite(v) else None for v in np.ravel(values)]


def _centroid(s: BudgetSurface) -> CentroidEntry | None:
    """Knots of the interpolation: logarithms of the errors, and their slopes."""
    errors = s.centroid
    if errors is None:
        return None
    logs = [np.log(sigma) for sigma in (errors.sigma_u, errors.sigma_v)]
    slopes = [
        PchipInterpolator(errors.mag, log).derivative()(errors.mag)
        if len(errors.mag) > 1
        else np.zeros(1)
        for log in logs
    ]
    return {
        "name": CENTROID,
        "kind": "random",
        "source": MEASURED,
        "mag": [float(m) for m in errors.mag],
        "log": [_short(log, MOMENT_DIGITS) for log in logs],
        "slope": [_short(slope, MOMENT_DIGITS) for slope in slopes],
    }
