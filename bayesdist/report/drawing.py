"""Figures as files: each laid out and drawn once as PNG, and once more as PDF."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox
from PIL import Image

from bayesdist.data.files import atomic_path, made_folder
from bayesdist.report.style import figure_style
from bayesdist.report.ticks import plain_ticks

__all__ = [
    "DPI",
    "Drawing",
    "drawn",
    "pdf_of",
    "png_of",
    "save_drawings",
    "save_images",
    "save_pdfs",
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


def png_of(figure: Figure) -> bytes:
    """A figure as PNG file of 256 colours: a third of the size, and no eye sees the difference."""
    with figure_style():  # mathematical text and ticks read the settings only when drawn
        plain_ticks(figure)
        figure.set_dpi(DPI)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        figure.set_layout_engine("none")
        box = _extent(figure)
        page = Bbox.from_bounds(0, 0, *figure.get_size_inches())
        if not (page.contains(*box.min) and page.contains(*box.max)):  # what is outside as well
            buffer = io.BytesIO()
            figure.savefig(buffer, format="png", dpi=DPI, bbox_inches=box)
            image = Image.open(buffer).convert("RGB")
        else:
            image = Image.fromarray(_cut(np.asarray(canvas.buffer_rgba()), box))
    few = image.quantize(256, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    buffer = io.BytesIO()
    few.save(buffer, format="png", dpi=(DPI, DPI))
    return buffer.getvalue()


def pdf_of(figure: Figure) -> bytes:
    """A figure as PDF file whose letters are letters; the same figure gives the same bytes."""
    buffer = io.BytesIO()
    with figure_style():
        plain_ticks(figure)
        figure.set_dpi(DPI)
        if figure.get_layout_engine() is not None:
            figure.draw_without_rendering()
            figure.set_layout_engine("none")
        figure.savefig(
            buffer,
            format="pdf",
            dpi=DPI,
            bbox_inches=_extent(figure),
            metadata={"CreationDate": None},
        )
    return buffer.getvalue()


def _extent(figure: Figure) -> Bbox:
    """What is drawn, in inches, with some room around it."""
    return figure.get_tightbbox().padded(PAD)


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


def save_pdfs(figures: Mapping[str, Figure], folder: str | os.PathLike[str]) -> tuple[Path, ...]:
    """Write figures as PDF files whose letters are letters.

    Parameters
    ----------
    figures : mapping of str to matplotlib.figure.Figure
    folder : path-like
        One that is there.

    Returns
    -------
    tuple of pathlib.Path

    Raises
    ------
    InputError
        When a file cannot be written.
    """
    return _saved({name: pdf_of(figure) for name, figure in figures.items()}, "pdf", Path(folder))


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
