"""Figures as files: nothing cut, numbers as matplotlib sets them, the same whoever draws."""

import base64
import io
import os
import pickle
import re
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing import get_context
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from bayesdist.report import drawing
from bayesdist.report.contents import Item, Plot
from bayesdist.report.drawing import DPI, MARGIN, png_of, render
from bayesdist.report.figures.style import (
    OneTickAxes,
    OneTickFigure,
    figure_style,
    new_figure,
    plain_ticks,
)
from bayesdist.report.page import picture_of
from bayesdist.report.sections import REPORT


def pixels(png: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))


def square(x: float, y: float, side: float) -> Figure:
    """A black square, in fractions of a figure of 2 x 2 inches."""
    with figure_style():
        fig = Figure(figsize=(2.0, 2.0))
        ax = fig.add_axes((x, y, side, side))
        ax.set_xticks([])
        ax.set_yticks([])
        ax.patch.set_color("black")
        for spine in ax.spines.values():
            spine.set_visible(False)
    fig.patch.set_visible(False)
    return fig


@pytest.mark.parametrize("at", [(0.2, 0.3), (0.8, 0.7), (-0.2, -0.1)])
def test_a_picture_is_cut_to_what_is_drawn_and_no_more(at):
    """Inside the page or beyond its edge: the square of one inch and its margin."""
    image = pixels(png_of(square(*at, 0.5)))
    side = DPI + 2 * MARGIN
    assert np.abs(np.array(image.shape[:2]) - side).max() <= 2
    dark = (image < 50).all(axis=2)
    assert dark.sum() == pytest.approx(DPI**2, rel=0.03)


def test_the_same_figure_gives_the_same_files():
    first, second = (square(0.1, 0.1, 0.5) for _ in range(2))
    one, other = (render(Plot(figure, "", "", ""), pdf=True) for figure in (first, second))
    assert one == other
    assert one.file == png_of(second)


def test_vectors_have_the_area_of_the_picture():
    first, second = (
        render(Plot(square(0.1, 0.1, 0.5), "A square", "", ""), "svg") for _ in range(2)
    )
    assert first == second
    tree = ElementTree.fromstring(first.file)
    # in points: the square and its margin
    assert float(tree.get("width").removesuffix("pt")) == pytest.approx(
        72 * (1 + 2 * MARGIN / DPI), abs=1
    )
    picture = render(Plot(square(0.1, 0.1, 0.5), "A square", "", ""))
    shown, plain = (picture_of("square", one) for one in (first, picture))
    assert (shown.kind, plain.kind) == ("svg+xml", "png") and shown.width == plain.width
    assert base64.b64decode(shown.data) == first.file
    assert pixels(picture.file).shape[1] == pytest.approx(DPI * plain.width, abs=1)


# -- numbers at ticks ------------------------------------------------------------------------------


def as_plain(text: str) -> str:
    """What matplotlib writes as mathematical text, in letters."""
    raised = str.maketrans("0123456789-−", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻⁻")
    body = re.sub(r"\$|\\mathdefault|\s", "", text).replace(r"\times", "×").replace("-", "−")
    body = re.sub(r"\^\{(.*?)\}", lambda m: m[1].translate(raised), body)
    return body.replace("{", "").replace("}", "")


@pytest.mark.parametrize(
    ("limits", "scale"),
    [
        ((-0.15, 0.15), "linear"),
        ((0.0, 3e-7), "linear"),
        ((-4e8, 2e8), "linear"),
        ((1e-6, 1e3), "log"),
        ((0.02, 0.07), "log"),
        ((-100.0, 100.0), "symlog"),
    ],
)
def test_numbers_are_those_of_matplotlib(limits, scale):
    found = []
    for mathematical in (True, False):
        with figure_style():
            import matplotlib

            matplotlib.rcParams["axes.formatter.use_mathtext"] = mathematical
            fig = new_figure(4.0, 2.0)
            ax = fig.subplots()
            ax.set_xscale(scale)
            ax.set_xlim(*limits)
            if not mathematical:
                plain_ticks(fig)
            fig.canvas.draw()
            texts = [t.get_text() for t in ax.get_xticklabels(which="both")]
            found.append([*texts, ax.xaxis.get_offset_text().get_text()])
    assert [as_plain(t) for t in found[0]] == found[1]
    assert any(found[1]) and not any("$" in t for t in found[1])


def many_kinds_of_axes(figure: Figure) -> None:
    """Scales, grids, marks between numbers, turned and hidden labels, colour bars, shared axes."""
    axes = figure.subplots(2, 3, sharex="col")
    left, log, symlog = axes[0]
    left.grid(True)
    left.set(xlim=(-0.1, 0.3), ylim=(0, 4e7), xlabel="x [pix]", ylabel="y [pix]")
    log.set(xscale="log", xlim=(1e-6, 1e3), yscale="log", ylim=(0.02, 0.07))
    log.grid(True, which="both")
    symlog.set(yscale="symlog", ylim=(-100, 100), ylabel="v")
    symlog.yaxis.set_label_position("right")
    symlog.yaxis.tick_right()
    names, _, cells = axes[1]
    names.tick_params(axis="x", labelrotation=90)
    names.tick_params(axis="y", length=0)
    names.set_yticks([0, 1, 2], ["one", "two\nlines", ""])
    names.invert_yaxis()
    for one in axes.ravel():
        one.label_outer()
    image = cells.imshow([[1, 2], [3, 1000]], norm="log", origin="lower")
    figure.colorbar(image, ax=cells, label="count [stars]")
    figure.colorbar(image, ax=names, location="top", ticks=[1, 30])


def test_axes_of_one_tick_look_like_those_of_matplotlib():
    """To the last pixel."""
    files = []
    with figure_style():
        for figure in (
            Figure(figsize=(7.0, 4.0), layout="constrained"),
            OneTickFigure(figsize=(7.0, 4.0), layout="constrained"),
        ):
            many_kinds_of_axes(figure)
            files.append(png_of(figure))
            assert isinstance(figure.axes[0], OneTickAxes) == isinstance(figure, OneTickFigure)
    expected, drawn = (pixels(file) for file in files)
    np.testing.assert_array_equal(drawn, expected)


@pytest.mark.parametrize("layout", ["constrained", "compressed", "none"])
def test_panels_with_long_words_are_cut_to_what_is_drawn(layout):
    with figure_style():
        figure = new_figure(7.0, 4.0, layout=layout)
        many_kinds_of_axes(figure)
        figure.axes[2].set_title(12 * "beyond the panel ")
        figure.axes[3].set_ylabel(4 * "higher than the panel ")
        figure.align_ylabels()
        image = pixels(png_of(figure))
    inked = (image != image[0, 0]).any(axis=2)
    for axis in (0, 1):
        (where,) = np.nonzero(inked.any(axis=axis))
        room = where[0], inked.shape[1 - axis] - 1 - where[-1]
        assert min(room) > 0 and max(room) < 2.5 * MARGIN


# -- several processes ----------------------------------------------------------------------------


SOME = ("margins", "pixel_area", "residual_vectors")


class Few:
    """Some of the figures of the report."""

    @staticmethod
    def items(results, kind):
        return tuple(item for item in REPORT.items(results, kind) if item.name in SOME)


@pytest.fixture(scope="module")
def alone(converged):
    return drawing.draw_all(Few, converged)


@pytest.mark.filterwarnings("ignore:.*fork")
def test_several_processes_draw_what_one_draws(converged, alone, monkeypatch, full):
    """Reduced, they are forks of this one, and need not import anew what draws."""
    here, render = os.getpid(), drawing.render

    def elsewhere(plot, *options, **more):
        assert os.getpid() != here, "it was drawn here"
        return render(plot, *options, **more)

    monkeypatch.setattr(drawing, "MIN_FIGURES_SHARED", 1)
    monkeypatch.setattr(drawing, "render", elsewhere)
    if not full:
        monkeypatch.setattr(drawing, "get_context", lambda _: get_context("fork"))
    sent = pickle.loads(pickle.dumps(converged))  # as it reaches processes that are no forks
    both = drawing.draw_all(Few, sent, processes=2)
    assert list(both) == list(alone) and both == alone


def test_processes_that_fail_are_made_up_for(converged, alone, monkeypatch, caplog):
    monkeypatch.setattr(drawing, "MIN_FIGURES_SHARED", 1)
    monkeypatch.setattr(drawing, "ProcessPoolExecutor", _ended)
    assert drawing.draw_all(Few, converged, processes=2) == alone
    assert "drawn by one process" in caplog.text


def _ended(*_, **__):
    """What a pool says whose processes have ended as they began."""
    raise BrokenProcessPool("they have ended")


def test_words_come_with_the_files(plots, alone):
    assert sorted(alone) == sorted(SOME)
    for name, one in alone.items():
        words = plots[name].title, plots[name].text, plots[name].alt
        assert (one.title, one.text, one.alt) == words and all(words)


def cloud(_, n: int) -> Plot:
    figure = new_figure(3.0, 2.0)
    figure.subplots().scatter(*np.random.default_rng(5).normal(size=(2, n)))
    return Plot(figure, "", "", "")


def marked(_, n: int, **style) -> Plot:
    """Points by `plot`, as one line of markers."""
    figure = new_figure(3.0, 2.0)
    figure.subplots().plot(*np.random.default_rng(5).normal(size=(2, n)), **style)
    return Plot(figure, "", "", "")


def test_dense_figures_are_pixels_on_the_screen_and_vectors_on_paper():
    many = drawing.MOST_VECTORS + 1
    items = (
        Item("few", "", cloud, (9,)),
        Item("many", "", cloud, (many,)),
        Item("marked", "", partial(marked, marker=".", ls=""), (many,)),
        Item("line", "", marked, (many,)),
        Item("drawn", "", partial(marked, marker=".", ls="", rasterized=True), (many,)),
        Item("paper", "", cloud, (many,), printed=True),
    )
    drawn = drawing.draw_all(SimpleNamespace(items=lambda *_: items), None)
    assert {name: one.kind for name, one in drawn.items()} == {
        "few": "svg",
        "many": "png",
        "marked": "png",
        "line": "svg",
        "drawn": "svg",
        "paper": "svg",
    }


def test_the_files_that_were_drawn_are_saved(tmp_path):
    plot = Plot(square(0.1, 0.1, 0.5), "", "", "")
    one, other = render(plot, pdf=True), render(plot, "svg")
    paths = drawing.save_drawings({"a": one, "b": other}, tmp_path / "figures")
    assert [p.name for p in paths] == ["a.png", "b.svg", "a.pdf"]
    assert [p.read_bytes() for p in paths] == [one.file, other.file, one.pdf]
    assert one.pdf.startswith(b"%PDF")
