"""Figures as files: nothing cut, numbers as matplotlib sets them, the same whoever draws."""

import io
import re
import sys
import time

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from bayesdist.report import drawing, two_hands
from bayesdist.report.drawing import DPI, PAD, drawing_of, png_of
from bayesdist.report.figures import plan_of_figures
from bayesdist.report.style import figure_style, new_figure, plain_ticks


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
    side = DPI * (1.0 + 2 * PAD)
    assert np.abs(np.array(image.shape[:2]) - side).max() <= 2
    dark = (image < 50).all(axis=2)
    assert dark.sum() == pytest.approx(DPI**2, rel=0.03)


def test_the_same_figure_gives_the_same_files():
    first, second = (square(0.1, 0.1, 0.5) for _ in range(2))
    assert drawing_of(first) == drawing_of(second)
    assert drawing_of(first).png == png_of(second)


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


# -- two processes ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def alone(converged):
    return two_hands.drawn_report(converged)


def test_two_processes_draw_what_one_draws(converged, alone, monkeypatch):
    monkeypatch.setattr(two_hands.os, "cpu_count", lambda: 2)
    made = []
    real = two_hands.drawing_of
    monkeypatch.setattr(two_hands, "drawing_of", lambda f: made.append(f) or real(f))
    with two_hands.second_hand(True) as hand:
        hand.give(plan_of_figures, converged)
        end = time.monotonic() + 60
        while not (hand.folder / list(alone)[-1]).exists() and time.monotonic() < end:
            time.sleep(0.01)
        both = two_hands.drawn_report(converged, hand)
    assert hand.process.poll() is not None and not hand.folder.exists()
    assert list(both) == list(alone) and both == alone
    assert 0 < len(made) < len(alone)  # the others were not drawn here


def test_a_process_that_is_not_wanted_is_none(monkeypatch):
    for wanted, processors in ((False, 2), (True, 1)):
        monkeypatch.setattr(two_hands.os, "cpu_count", lambda n=processors: n)
        with two_hands.second_hand(wanted) as hand:
            assert hand is None


def test_a_process_that_fails_is_made_up_for(converged, alone, monkeypatch, tmp_path, caplog):
    monkeypatch.setattr(two_hands.os, "cpu_count", lambda: 2)
    broken = tmp_path / "python"
    broken.write_text(f"#!{sys.executable}\nraise SystemExit(3)\n")
    broken.chmod(0o755)
    monkeypatch.setattr(two_hands.sys, "executable", str(broken))
    with two_hands.second_hand(True) as hand:
        (hand.folder / next(iter(alone))).touch()  # it has claimed a figure, and ends
        assert two_hands.drawn_report(converged, hand) == alone
    assert "the other failed: it ended with exit code 3" in caplog.text


def test_a_process_that_cannot_be_started_is_made_up_for(converged, monkeypatch, tmp_path, caplog):
    monkeypatch.setattr(two_hands.os, "cpu_count", lambda: 2)
    monkeypatch.setattr(two_hands.sys, "executable", str(tmp_path / "nowhere"))
    with two_hands.second_hand(True) as hand:
        assert hand is None
    assert "the other failed" in caplog.text


def test_both_kinds_are_saved(tmp_path):
    fig = square(0.1, 0.1, 0.5)
    one = drawing_of(fig)
    paths = drawing.save_drawings({"a": one}, tmp_path / "figures")
    assert [p.name for p in paths] == ["a.png", "a.pdf"]
    assert paths[0].read_bytes() == one.png and paths[1].read_bytes().startswith(b"%PDF")
