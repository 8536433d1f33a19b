"""Figures as files: each laid out and drawn once as PNG, and once more as PDF."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox
from PIL import Image

from bayesdist.data.files import atomic_path, made_folder
from bayesdist.report.style import figure_style, plain_ticks

__all__ = [
    "DPI",
    "Drawing",
    "drawing_of",
    "drawn",
    "png_of",
    "save_drawings",
    "save_images",
]

DPI = 150
PAD = 0.05  # inches left around what is drawn


@dataclass(frozen=True)
class Drawing:
    """A figure as files.

    Parameters
    ----------
    png, pdf : bytes
    """

    png: bytes
    pdf: bytes


def drawn(figures: Mapping[str, Figure]) -> dict[str, bytes]:
    """Figures as PNG files, by name: drawn once, for the folder and for the report.

    Their layout is settled by that, and serves other files of them: it takes as long as drawing.
    """
    return {name: png_of(figure) for name, figure in figures.items()}


def drawing_of(figure: Figure) -> Drawing:
    """A figure as PNG and as PDF, whose letters are letters; the same figure gives the same."""
    canvas, box = _laid_out(figure)
    return Drawing(_png(figure, canvas, box), _pdf(figure, box))


def png_of(figure: Figure) -> bytes:
    """A figure as PNG file of 256 colours: a third of the size, and no eye sees the difference."""
    return _png(figure, *_laid_out(figure))


def _laid_out(figure: Figure) -> tuple[FigureCanvasAgg, Bbox]:
    """Draw a figure, once for all, and say what is drawn on: in inches, with room around it."""
    with figure_style():  # mathematical text and ticks read the settings only when drawn
        plain_ticks(figure)
        figure.set_dpi(DPI)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        _settle(figure)
        return canvas, figure.get_tightbbox().padded(PAD)


def _png(figure: Figure, canvas: FigureCanvasAgg, box: Bbox) -> bytes:
    page = Bbox.from_bounds(0, 0, *figure.get_size_inches())
    if not (page.contains(*box.min) and page.contains(*box.max)):  # what is outside as well
        buffer = io.BytesIO()
        with figure_style():
            figure.savefig(buffer, format="png", dpi=DPI, bbox_inches=box)
        image = Image.open(buffer).convert("RGB")
    else:
        image = Image.fromarray(_cut(np.asarray(canvas.buffer_rgba()), box))
    few = image.quantize(256, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    buffer = io.BytesIO()
    few.save(buffer, format="png", dpi=(DPI, DPI))
    return buffer.getvalue()


def _pdf(figure: Figure, box: Bbox) -> bytes:
    buffer = io.BytesIO()
    with figure_style():
        figure.savefig(
            buffer, format="pdf", dpi=DPI, bbox_inches=box, metadata={"CreationDate": None}
        )
    return buffer.getvalue()


def _settle(figure: Figure) -> None:
    """Leave all where it lies; an engine, even 'none', would have each file drawn twice."""
    with rc_context({"figure.autolayout": False, "figure.constrained_layout.use": False}):
        figure.set_layout_engine(None)


def _cut(pixels: np.ndarray, box: Bbox) -> np.ndarray:
    """The part (rows, columns, 3) of a canvas; rows run from the top."""
    height, width = pixels.shape[:2]
    left, right = np.clip(np.rint(DPI * box.intervalx).astype(int), 0, width)
    top, bottom = np.clip(height - np.rint(DPI * box.intervaly[::-1]).astype(int), 0, height)
    return np.ascontiguousarray(pixels[top:bottom, left:right, :3])


def save_images(images: Mapping[str, bytes], folder: str | os.PathLike[str]) -> tuple[Path, ...]:
    """Write the PNG files of a report.

    Parameters
    ----------
    images : mapping of str to bytes
        As of `drawn`.
    folder : path-like
        Made where it does not exist.

    Returns
    -------
    tuple of pathlib.Path

    Raises
    ------
    InputError
        When the folder cannot be made or a file cannot be written.
    """
    return _saved(images, "png", made_folder(folder))


def save_drawings(
    drawings: Mapping[str, Drawing], folder: str | os.PathLike[str]
) -> tuple[Path, ...]:
    """Write figures as PNG and as PDF files.

    Parameters
    ----------
    drawings : mapping of str to Drawing
    folder : path-like
        Made where it does not exist.

    Returns
    -------
    tuple of pathlib.Path

    Raises
    ------
    InputError
        When the folder cannot be made or a file cannot be written.
    """
    made = made_folder(folder)
    return (
        *_saved({name: one.png for name, one in drawings.items()}, "png", made),
        *_saved({name: one.pdf for name, one in drawings.items()}, "pdf", made),
    )


def _saved(files: Mapping[str, bytes], kind: str, folder: Path) -> tuple[Path, ...]:
    paths = []
    for name, content in files.items():
        path = folder / f"{name}.{kind}"
        with atomic_path(path) as temporary:
            temporary.write_bytes(content)
        paths.append(path)
    return tuple(paths)
