"""Draw figures to files: each is laid out and drawn once, and again as PDF on request.

The numbers of a figure are written as CSV: the data of its marks, panel by panel.
"""

from __future__ import annotations

import csv
import io
import logging
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import islice
from multiprocessing import get_context, parent_process
from pathlib import Path
from pickle import PickleError
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PathCollection, PolyCollection
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Rectangle, StepPatch
from matplotlib.quiver import Quiver
from matplotlib.spines import Spine
from matplotlib.transforms import Bbox
from PIL import Image

from bayesdist.files.atomic import announce, atomic_path, made_folder
from bayesdist.files.faults import blocked_interrupts
from bayesdist.report.contents import Item, Plot, Registry
from bayesdist.report.figures.style import figure_style, plain_ticks

log = logging.getLogger("bayesdist")

Kind = Literal["png", "svg"]

DPI = 150
MARGIN = 8  # pixels around the drawing
MOST_VECTORS = 1000  # marks; figures with more are faster to draw, and smaller, as PNG
MIN_FIGURES_SHARED = 20  # fewer are drawn faster than another process starts

_received: list[Any] = []  # results, in a process that draws for another one

HEADS = ("panel", "mark", "label", "x", "y", "value", "value_2")
MOST_ROWS = 20_000  # a figure with more data shows a table that is available as a file


@dataclass(frozen=True)
class Drawing:
    """A figure as a file, with the texts of its `Plot` and its numbers."""

    file: bytes
    kind: Kind
    width: float  # inches, at which text has its nominal size
    pdf: bytes | None = None
    title: str = ""
    text: str = ""
    alt: str = ""
    numbers: str = ""  # CSV


@figure_style()  # mathematical text and ticks read rcParams only when drawn
def render(plot: Plot, kind: Kind = "png", *, pdf: bool = False) -> Drawing:
    """Draw a figure as PNG or SVG, and as PDF on request; equal figures give equal files."""
    box = _laid_out(plot.figure)
    return Drawing(
        _png(plot.figure, box) if kind == "png" else _svg(plot.figure, box),
        kind,
        box.width,
        _pdf(plot.figure, box) if pdf else None,
        plot.title,
        plot.text,
        plot.alt,
        numbers_of(plot.figure),
    )


@figure_style()
def draw_all(
    registry: Registry, results: Any, *, pdf: bool = False, processes: int = 1
) -> dict[str, Drawing]:
    """Make and draw all figures of a page; returns them by name in the order of the page.

    Figures that are printed or have few marks are drawn as SVG, others as PNG. `pdf`: True to draw
    them as PDF, too.

    If `processes` is larger than 1, new processes import the main module again: a script must guard
    its work by ``if __name__ == "__main__"``.
    """
    items = registry.items(results, "figure")
    if processes > 1 and len(items) >= MIN_FIGURES_SHARED:
        try:
            return _drawn_together(items, results, pdf, processes)
        except (BrokenProcessPool, OSError, PickleError) as error:
            log.warning("report: figures are drawn by one process, others failed: %s", error)
    return {item.name: _drawing(item, results, pdf) for item in items}


def _drawn_together(
    items: Sequence[Item], results: Any, pdf: bool, processes: int
) -> dict[str, Drawing]:
    # do not fork, because threads of numerical libraries are running
    with ProcessPoolExecutor(
        processes, mp_context=get_context("spawn"), initializer=_receive, initargs=(results,)
    ) as pool:
        with blocked_interrupts():  # inherited by the processes, which are started here
            drawn = pool.map(partial(_drawn, pdf=pdf), items)
        return {item.name: drawing for item, drawing in zip(items, drawn, strict=True)}


def _receive(results: Any) -> None:
    """Store the results once per process, because they may be large."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _received.append(results)


def _end_with_parent() -> None:
    """End this process when the one that started it has ended, even if that was killed."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _drawn(item: Item, pdf: bool) -> Drawing:
    return _drawing(item, _received[0], pdf)


def _drawing(item: Item, results: Any, pdf: bool) -> Drawing:
    plot = item.made(results)
    vectors = item.printed or _count_marks(plot.figure) <= MOST_VECTORS
    return render(plot, "svg" if vectors else "png", pdf=pdf)


def _count_marks(figure: Figure) -> int:
    """Number of marks of a figure drawn as vectors: points, arrows, segments, cells."""
    n_marks = 0
    for ax in figure.axes:
        for collection in ax.collections:
            n_marks += max(len(collection.get_paths()), len(np.asarray(collection.get_offsets())))
        for line in ax.lines:
            if str(line.get_marker()) != "None" and not line.get_rasterized():
                n_marks += len(np.atleast_1d(line.get_xdata()))
    return n_marks


@figure_style()
def png_of(figure: Figure) -> bytes:
    """PNG file of a figure with 256 colours: a third of the size without a visible difference."""
    return _png(figure, _laid_out(figure))


def _laid_out(figure: Figure) -> Bbox:
    """Lay out a figure; returns the bounding box (inches) of its content with a margin.

    All positions are fixed afterwards, so that each file is drawn only once.
    """
    plain_ticks(figure)
    for ax in figure.axes:
        for spine in ax.spines.values():
            if type(spine) is Spine:  # spines are on the frame and would measure all ticks again
                spine.set_in_layout(False)
        for axis in (ax.xaxis, ax.yaxis):
            if not axis.label.get_text():  # an empty label would be placed nevertheless
                axis.label.set_visible(False)
    figure.set_dpi(DPI)
    renderer = FigureCanvasAgg(figure).get_renderer()
    engine = figure.get_layout_engine()
    if engine is not None:
        with _measured_once(figure):
            engine.execute(figure)
    box = _with_labels(figure.get_tightbbox(renderer), figure, renderer)
    figure.set_layout_engine(None)  # any engine, even 'none', would draw each file twice
    return Bbox(box.padded(MARGIN / DPI).get_points())


def _with_labels(box: Bbox, figure: Figure, renderer: Any) -> Bbox:
    """Extend a box (inches) by labels that are longer than their axes.

    Matplotlib before 3.11.2 ignores the part of a label beyond the ends of its axis.
    """
    inches = figure.dpi_scale_trans.inverted()
    ends = {"x": [box.x0, box.x1], "y": [box.y0, box.y1]}
    for ax in figure.axes:
        for name, axis in (("x", ax.xaxis), ("y", ax.yaxis)):
            if ax.get_visible() and ax.axison and axis.get_visible() and axis.label.get_visible():
                label = axis.label.get_window_extent(renderer).transformed(inches)
                ends[name] += [label.x0, label.x1] if name == "x" else [label.y0, label.y1]
    return Bbox([[min(ends["x"]), min(ends["y"])], [max(ends["x"]), max(ends["y"])]])


@contextmanager
def _measured_once(figure: Figure) -> Iterator[None]:
    """Context manager in which the labels of each panel are measured only once.

    Matplotlib measures them again after moving the panels, which takes as long as drawing them.
    """
    panels = figure.axes
    for ax in panels:
        ax.get_tightbbox = _measuring_once(ax)  # type: ignore[method-assign]
    try:
        yield
    finally:
        for ax in panels:
            del ax.get_tightbbox


def _measuring_once(ax: Axes) -> Callable[..., Any]:
    """Replacement for `get_tightbbox` of a panel that measures its labels only once."""
    measure, beyond = ax.get_tightbbox, list[Any]()

    def box(renderer: Any, *options: Any, **more: Any) -> Any:
        if beyond:
            place = ax.get_axes_locator()
            ax.apply_aspect(None if place is None else place(ax, renderer))
            return Bbox(ax.bbox.get_points() + beyond[0])
        extent = measure(renderer, *options, **more)
        if extent is not None:
            beyond.append(extent.get_points() - ax.bbox.get_points())
        return extent

    return box


def _png(figure: Figure, box: Bbox) -> bytes:
    drawn = io.BytesIO()
    quick = {"compress_level": 0}
    figure.savefig(drawn, format="png", dpi=DPI, bbox_inches=box, pil_kwargs=quick)
    image = Image.open(drawn).convert("RGB")
    # the palette is chosen from every other pixel in each direction, in a quarter of the time
    subsample = image.resize(
        (-(-image.width // 2), -(-image.height // 2)), Image.Resampling.NEAREST
    )
    colors = subsample.quantize(256, method=Image.Quantize.MEDIANCUT)
    reduced = image.quantize(palette=colors, dither=Image.Dither.NONE)
    palette = reduced.getpalette() or []
    page = 3 * int(reduced.getpixel((0, 0)))  # type: ignore[arg-type]  # a single number
    palette[page : page + 3] = image.crop((0, 0, 1, 1)).tobytes()  # exact background colour
    reduced.putpalette(palette)
    buffer = io.BytesIO()
    reduced.save(buffer, format="png", dpi=(DPI, DPI))
    return buffer.getvalue()


def _pdf(figure: Figure, box: Bbox) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="pdf", dpi=DPI, bbox_inches=box, metadata={"CreationDate": None})
    return buffer.getvalue()


def _svg(figure: Figure, box: Bbox) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", dpi=DPI, bbox_inches=box, metadata={"Date": None})
    return buffer.getvalue()


def save_figures(figures: Mapping[str, Figure], folder: str | os.PathLike[str]) -> tuple[Path, ...]:
    """Draw figures and write them as PNG files to a folder, created if needed; returns paths."""
    images = {f"{name}.png": png_of(figure) for name, figure in figures.items()}
    return _saved(images, made_folder(folder))


def save_drawings(
    drawings: Mapping[str, Drawing], folder: str | os.PathLike[str]
) -> tuple[Path, ...]:
    """Write drawn figures to a folder, created if needed; returns their paths."""
    files = {f"{name}.{drawing.kind}": drawing.file for name, drawing in drawings.items()}
    files |= {f"{name}.pdf": drawing.pdf for name, drawing in drawings.items() if drawing.pdf}
    return _saved(files, made_folder(folder))


def _saved(files: Mapping[str, bytes], folder: Path) -> tuple[Path, ...]:
    paths = {folder / name: content for name, content in files.items()}
    announce(tuple(paths))
    for path, content in paths.items():
        with atomic_path(path) as temporary:
            temporary.write_bytes(content)
    return tuple(paths)


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
