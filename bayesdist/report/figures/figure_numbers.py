"""Numbers of a figure as CSV: the data of its marks, panel by panel."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PathCollection, PolyCollection
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Rectangle, StepPatch
from matplotlib.quiver import Quiver

HEADS = ("panel", "mark", "label", "x", "y", "value", "value_2")
MOST_ROWS = 20_000  # a figure with more data shows a table that is available as a file


def numbers_of(figure: Figure) -> str:
    """CSV of the marks of a figure in the units of its axes, with at most `MOST_ROWS` rows.

    Lines that begin with # name the panels and their axes. The values of arrows are their
    components, those of segments their other end, and those of cells and contours the value that
    their colour represents.
    """
    out = io.StringIO()
    panels = [ax for ax in figure.axes if ax.get_label() != "<colorbar>"]
    for k, ax in enumerate(panels, start=1):
        title = ax.get_title() or ax.get_title(loc="left")
        words = (title, f"x: {ax.get_xlabel()}", f"y: {ax.get_ylabel()}")
        out.write(f"# panel {k}: {'; '.join(' '.join(text.split()) for text in words if text)}\n")
    out.write(",".join(HEADS) + "\n")
    out.writelines(islice(_lines(panels), MOST_ROWS))
    return out.getvalue()


def _lines(panels: Sequence[Axes]) -> Iterator[str]:
    for k, ax in enumerate(panels, start=1):
        for mark, label, rows in _marks(ax):
            head = f"{k},{mark},{_quoted(label)}"
            for row in rows.tolist() if isinstance(rows, np.ndarray) else rows:
                yield head + (",%.6g" * len(row) % tuple(row)) + "\n"


def _marks(ax: Axes) -> Iterator[tuple[str, str, Iterable[Sequence[float]]]]:
    """Kind, label and numbers of each artist that represents data."""
    for line in ax.lines:
        if line.get_transform() == ax.transData:
            yield "line", _label(line), np.asarray(line.get_xydata(), float)
    for collection in ax.collections:
        kind, rows = _of_collection(collection)
        yield kind, _label(collection), rows
    for image in ax.images:
        yield "cell", _label(image), _cells(image)
    for patch in ax.patches:
        if isinstance(patch, StepPatch):
            values, edges, _ = patch.get_data()
            yield "bar", _label(patch), np.column_stack([edges[:-1], edges[1:], values])
    for bars in ax.containers:
        if bars and all(isinstance(bar, Rectangle) for bar in bars):
            boxes = [bar.get_bbox() for bar in bars]
            yield "bar", _label(bars), [(b.x1, (b.y0 + b.y1) / 2, b.width) for b in boxes]


def _of_collection(one: Any) -> tuple[str, Iterable[Sequence[float]]]:
    if isinstance(one, Quiver):
        return "arrow", np.column_stack([one.XY, np.ravel(one.U), np.ravel(one.V)])
    if isinstance(one, ContourSet):
        if one.filled:
            return "contour", ()
        lines = zip(one.levels, one.get_paths(), strict=True)
        return "contour", (
            (*xy, level) for level, path in lines for xy in np.asarray(path.vertices).tolist()
        )
    if isinstance(one, LineCollection):
        paths = [np.asarray(path.vertices, float) for path in one.get_paths()]
        ends = np.array([path for path in paths if len(path) == 2])
        complete = np.isfinite(ends).all(axis=(1, 2)) if ends.size else []
        return "segment", ends.reshape(-1, 4)[complete]
    if isinstance(one, PathCollection | PolyCollection):
        at, values = np.asarray(one.get_offsets(), float), one.get_array()
        if values is not None and len(np.ravel(values)) == len(at):
            at = np.column_stack([at, np.ravel(values)])
        return "point", at if len(at) > 1 else ()
    return "other", ()


def _cells(image: AxesImage) -> Iterator[Sequence[float]]:
    values: Any = np.ma.filled(np.ma.asarray(image.get_array(), float), np.nan)
    if values.ndim != 2:
        return
    x_start, right, bottom, top = image.get_extent()
    ny, nx = values.shape
    x = x_start + (np.arange(nx) + 0.5) * (right - x_start) / nx
    y = bottom + (np.arange(ny) + 0.5) * (top - bottom) / ny
    if image.origin == "upper":
        y = y[::-1]
    across, up = np.meshgrid(x, y)
    yield from np.column_stack([across.ravel(), up.ravel(), values.ravel()]).tolist()


def _quoted(text: str) -> str:
    """Text as a field of a CSV line."""
    line = io.StringIO()
    csv.writer(line, lineterminator="").writerow([text])
    return line.getvalue() if text else ""


def _label(artist: Any) -> str:
    text = str(artist.get_label() or "")
    return "" if text.startswith("_") else " ".join(text.split())
