"""Figures as files: each laid out and drawn once as PNG, and once more as PDF if asked for."""

from __future__ import annotations

import io
import logging
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from pickle import PickleError
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.spines import Spine
from matplotlib.transforms import Bbox
from numpy.typing import NDArray
from PIL import Image

from bayesdist.files import atomic_path, made_folder
from bayesdist.report.figures.figure_numbers import numbers_of
from bayesdist.report.figures.style import figure_style, plain_ticks
from bayesdist.report.registry import Item, Plot, Registry

__all__ = [
    "DPI",
    "MARGIN",
    "Drawing",
    "draw_all",
    "png_of",
    "render",
    "save_drawings",
    "save_figures",
]

log = logging.getLogger("bayesdist")

Pixels = NDArray[np.uint8]  # (rows, columns, colours), rows from the top

DPI = 150
MARGIN = 8  # pixels around the drawing
MIN_FIGURES_SHARED = 20  # fewer are drawn sooner than another process has started

_received: list[Any] = []  # of a process that draws for another one


@dataclass(frozen=True)
class Drawing:
    """Figure as files, with the title, text and text alternative of its `Plot`, and its numbers."""

    png: bytes
    pdf: bytes | None = None
    title: str = ""
    text: str = ""
    alt: str = ""
    numbers: str = ""  # CSV
    svg: str = ""  # of figures that are printed


@figure_style()  # mathematical text and ticks read the settings only when drawn
def render(plot: Plot, *, pdf: bool = False, svg: bool = False) -> Drawing:
    """Figure as PNG, and as PDF and SVG with text as letters; equal figures give equal files."""
    pixels, box = _laid_out(plot.figure)
    return Drawing(
        _png(pixels),
        _pdf(plot.figure, box) if pdf else None,
        plot.title,
        plot.text,
        plot.alt,
        numbers_of(plot.figure),
        _svg(plot.figure, box) if svg else "",
    )


def draw_all(
    registry: Registry, results: Any, *, pdf: bool = False, processes: int = 1
) -> dict[str, Drawing]:
    """Figures of a page, by name in its order, each made, drawn and released; `pdf`: as PDF too.

    More than one of `processes` import the main module of this process anew: a script must guard
    its work by ``if __name__ == "__main__"``.
    """
    items = registry.items(results, "figure")
    if processes > 1 and len(items) >= MIN_FIGURES_SHARED:
        try:
            return _drawn_together(items, results, pdf, processes)
        except (BrokenProcessPool, OSError, PickleError) as error:
            log.warning("report: figures are drawn by one process, others failed: %s", error)
    return {item.name: render(item.made(results), pdf=pdf, svg=item.printed) for item in items}


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
    return render(item.made(_received[0]), pdf=pdf, svg=item.printed)


@figure_style()
def png_of(figure: Figure) -> bytes:
    """PNG file of 256 colours of a figure: a third of the size, without a visible difference."""
    return _png(_laid_out(figure)[0])


def _laid_out(figure: Figure) -> tuple[Pixels, Bbox]:
    """Pixels and box (inches) of the area of a figure that is drawn on, with room around it.

    The figure is laid out and drawn once; a second time where artists lie outside the page as well.
    """
    plain_ticks(figure)
    for ax in figure.axes:
        for spine in ax.spines.values():
            if type(spine) is Spine:  # it lies on the frame, and would measure all ticks again
                spine.set_in_layout(False)
    figure.set_dpi(DPI)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    _settle(figure)
    page = np.asarray(canvas.buffer_rgba())
    edges = _inked(page)
    if edges is None:
        box = figure.get_tightbbox().padded(MARGIN / DPI)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=DPI, bbox_inches=box)
        return np.asarray(Image.open(buffer).convert("RGB")), box
    top, bottom, left, right = edges
    area = np.empty((bottom - top + 2 * MARGIN, right - left + 2 * MARGIN, 3), np.uint8)
    area[:] = page[0, 0, :3]
    area[MARGIN:-MARGIN, MARGIN:-MARGIN] = page[top:bottom, left:right, :3]
    drawn = Bbox([[left, len(page) - bottom], [right, len(page) - top]]).padded(MARGIN)
    return area, Bbox(drawn.get_points() / DPI)


def _inked(page: Pixels) -> tuple[int, int, int, int] | None:
    """First and last rows and columns that are drawn on; None for those of the page's own edge.

    Measured on the page, as asking all artists for their extents takes as long as laying them out.
    """
    colors = page.view(np.uint32)[..., 0]
    drawn = colors != colors[0, 0]
    out = []
    for axis in (1, 0):
        (where,) = np.nonzero(drawn.any(axis=axis))
        if not where.size or where[0] == 0 or where[-1] == drawn.shape[1 - axis] - 1:
            return None
        out += [int(where[0]), int(where[-1]) + 1]
    top, bottom, left, right = out
    return top, bottom, left, right


def _png(pixels: Pixels) -> bytes:
    image = Image.fromarray(pixels)
    # colours are chosen on every other pixel each way, in a fourth of the time
    some = Image.fromarray(np.ascontiguousarray(pixels[::2, ::2]))
    colors = some.quantize(256, method=Image.Quantize.MEDIANCUT)
    few = image.quantize(palette=colors, dither=Image.Dither.NONE)
    palette = few.getpalette() or []
    page = 3 * int(few.getpixel((0, 0)))  # type: ignore[arg-type]  # one number of such an image
    palette[page : page + 3] = pixels[0, 0].tolist()  # it would be a shade darker
    few.putpalette(palette)
    buffer = io.BytesIO()
    few.save(buffer, format="png", dpi=(DPI, DPI))
    return buffer.getvalue()


def _pdf(figure: Figure, box: Bbox) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="pdf", dpi=DPI, bbox_inches=box, metadata={"CreationDate": None})
    return buffer.getvalue()


def _svg(figure: Figure, box: Bbox) -> str:
    """Figure with letters as outlines: a page on paper has them whatever fonts there are."""
    buffer = io.StringIO()
    with rc_context({"svg.fonttype": "path", "svg.hashsalt": "bayesdist"}):
        figure.savefig(buffer, format="svg", dpi=DPI, bbox_inches=box, metadata={"Date": None})
    return buffer.getvalue()


def _settle(figure: Figure) -> None:
    """Fix all positions; an engine, even 'none', would have each file drawn twice."""
    with rc_context({"figure.autolayout": False, "figure.constrained_layout.use": False}):
        figure.set_layout_engine(None)


def save_figures(figures: Mapping[str, Figure], folder: str | os.PathLike[str]) -> tuple[Path, ...]:
    """Paths of figures, drawn and written as PNG files to a folder, which is made if need be.

    InputError when the folder cannot be made or a file cannot be written.
    """
    images = {name: png_of(figure) for name, figure in figures.items()}
    return _saved(images, "png", made_folder(folder))


def save_drawings(
    drawings: Mapping[str, Drawing], folder: str | os.PathLike[str]
) -> tuple[Path, ...]:
    """Paths of figures, written as PNG files to a folder, which is made if need be.

    Those that were drawn as PDF are written as such, too.

    InputError when the folder cannot be made or a file cannot be written.
    """
    made = made_folder(folder)
    return (
        *_saved({name: one.png for name, one in drawings.items()}, "png", made),
        *_saved({name: one.pdf for name, one in drawings.items() if one.pdf}, "pdf", made),
    )


def _saved(files: Mapping[str, bytes], kind: str, folder: Path) -> tuple[Path, ...]:
    paths = []
    for name, content in files.items():
        path = folder / f"{name}.{kind}"
        with atomic_path(path) as temporary:
            temporary.write_bytes(content)
        paths.append(path)
    return tuple(paths)
