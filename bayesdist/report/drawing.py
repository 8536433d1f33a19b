"""Figures as files: each laid out and drawn once, and once more as PDF if asked for."""

from __future__ import annotations

import io
import logging
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from pickle import PickleError
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.spines import Spine
from matplotlib.transforms import Bbox
from PIL import Image

from bayesdist.files.atomic import announce, atomic_path, made_folder
from bayesdist.report.contents import Item, Plot, Registry
from bayesdist.report.figures.figure_numbers import numbers_of
from bayesdist.report.figures.style import figure_style, plain_ticks

log = logging.getLogger("bayesdist")

Kind = Literal["png", "svg"]

DPI = 150
MARGIN = 8  # pixels around the drawing
MOST_VECTORS = 1000  # marks: more are sooner drawn, and smaller, as pixels
MIN_FIGURES_SHARED = 20  # fewer are drawn sooner than another process has started

_received: list[Any] = []  # of a process that draws for another one


@dataclass(frozen=True)
class Drawing:
    """Figure as a file, with the words of its `Plot` and its numbers."""

    file: bytes
    kind: Kind
    width: float  # inches, at which its letters have the size they were set in
    pdf: bytes | None = None
    title: str = ""
    text: str = ""
    alt: str = ""
    numbers: str = ""  # CSV


@figure_style()  # mathematical text and ticks read the settings only when drawn
def render(plot: Plot, kind: Kind = "png", *, pdf: bool = False) -> Drawing:
    """Figure as a file of one kind, and as PDF if asked for; equal figures give equal files."""
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
    """Figures of a page, by name in its order, each made, drawn and released; `pdf`: as PDF too.

    Each is drawn once: as SVG what is on paper or has few marks, else as PNG.

    More than one of `processes` import the main module of this process anew: a script must guard
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
    # not a fork: threads of numerical libraries run here
    with ProcessPoolExecutor(
        processes, mp_context=get_context("spawn"), initializer=_receive, initargs=(results,)
    ) as pool:
        drawn = pool.map(partial(_drawn, pdf=pdf), items)
        return {item.name: one for item, one in zip(items, drawn, strict=True)}


def _receive(results: Any) -> None:
    """Store the input of the figures: once for each process, as it may be large."""
    _received.append(results)


def _drawn(item: Item, pdf: bool) -> Drawing:
    return _drawing(item, _received[0], pdf)


def _drawing(item: Item, results: Any, pdf: bool) -> Drawing:
    plot = item.made(results)
    vectors = item.printed or _marks(plot.figure) <= MOST_VECTORS
    return render(plot, "svg" if vectors else "png", pdf=pdf)


def _marks(figure: Figure) -> int:
    """Number of marks a figure has as vectors: points, arrows, segments, cells."""
    found = 0
    for ax in figure.axes:
        for one in ax.collections:
            found += max(len(one.get_paths()), len(np.asarray(one.get_offsets())))
        for line in ax.lines:
            if str(line.get_marker()) != "None" and not line.get_rasterized():
                found += len(np.atleast_1d(line.get_xdata()))
    return found


@figure_style()
def png_of(figure: Figure) -> bytes:
    """PNG file of 256 colours of a figure: a third of the size, without a visible difference."""
    return _png(figure, _laid_out(figure))


def _laid_out(figure: Figure) -> Bbox:
    """Box (inches) of the area of a figure that is drawn on, with room around it.

    All positions are fixed, so that each file is drawn once.
    """
    plain_ticks(figure)
    for ax in figure.axes:
        for spine in ax.spines.values():
            if type(spine) is Spine:  # it lies on the frame, and would measure all ticks again
                spine.set_in_layout(False)
        for axis in (ax.xaxis, ax.yaxis):
            if not axis.label.get_text():  # it would be placed all the same
                axis.label.set_visible(False)
    figure.set_dpi(DPI)
    renderer = FigureCanvasAgg(figure).get_renderer()
    engine = figure.get_layout_engine()
    if engine is not None:
        with _measured_once(figure):
            engine.execute(figure)
    box = _with_labels(figure.get_tightbbox(renderer), figure, renderer)
    figure.set_layout_engine(None)  # an engine, even 'none', would have each file drawn twice
    return Bbox(box.padded(MARGIN / DPI).get_points())


def _with_labels(box: Bbox, figure: Figure, renderer: Any) -> Bbox:
    """Box (inches) that also holds labels which are longer than their axes.

    Matplotlib before 3.11.2 leaves out what of them is beyond the ends of the axis.
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
    """Context in which the labels of each panel keep the room that they had at first.

    Matplotlib measures them again after it has moved the panels, which takes as long as drawing
    them.
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
    """The function `get_tightbbox` of a panel, whose labels keep their room when it is moved."""
    measure, beyond = ax.get_tightbbox, list[Any]()

    def box(renderer: Any, *options: Any, **more: Any) -> Any:
        if beyond:
            place = ax.get_axes_locator()
            ax.apply_aspect(None if place is None else place(ax, renderer))
            return Bbox(ax.bbox.get_points() + beyond[0])
        found = measure(renderer, *options, **more)
        if found is not None:
            beyond.append(found.get_points() - ax.bbox.get_points())
        return found

    return box


def _png(figure: Figure, box: Bbox) -> bytes:
    drawn = io.BytesIO()
    quick = {"compress_level": 0}
    figure.savefig(drawn, format="png", dpi=DPI, bbox_inches=box, pil_kwargs=quick)
    image = Image.open(drawn).convert("RGB")
    # colours are chosen on every other pixel each way, in a fourth of the time
    some = image.resize((-(-image.width // 2), -(-image.height // 2)), Image.Resampling.NEAREST)
    colors = some.quantize(256, method=Image.Quantize.MEDIANCUT)
    few = image.quantize(palette=colors, dither=Image.Dither.NONE)
    palette = few.getpalette() or []
    page = 3 * int(few.getpixel((0, 0)))  # type: ignore[arg-type]  # one number of such an image
    palette[page : page + 3] = image.crop((0, 0, 1, 1)).tobytes()  # it would be a shade darker
    few.putpalette(palette)
    buffer = io.BytesIO()
    few.save(buffer, format="png", dpi=(DPI, DPI))
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
    """Paths of figures, drawn and written as PNG files to a folder, which is made if need be."""
    images = {f"{name}.png": png_of(figure) for name, figure in figures.items()}
    return _saved(images, made_folder(folder))


def save_drawings(
    drawings: Mapping[str, Drawing], folder: str | os.PathLike[str]
) -> tuple[Path, ...]:
    """Paths of figures, written as they were drawn to a folder, which is made if need be."""
    files = {f"{name}.{one.kind}": one.file for name, one in drawings.items()}
    files |= {f"{name}.pdf": one.pdf for name, one in drawings.items() if one.pdf}
    return _saved(files, made_folder(folder))


def _saved(files: Mapping[str, bytes], folder: Path) -> tuple[Path, ...]:
    paths = {folder / name: content for name, content in files.items()}
    announce(tuple(paths))
    for path, content in paths.items():
        with atomic_path(path) as temporary:
            temporary.write_bytes(content)
    return tuple(paths)
