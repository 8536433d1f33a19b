"""Corner plots: contours, bars and lines hold as many of the draws as they stand for."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.report.corners import BINS, Column, corner_figure


def corner(draws):
    """Panels (n, n) of a corner plot of draws (N, n), and the figure."""
    figure = corner_figure([Column(name, "", d) for name, d in zip("abc", draws.T, strict=False)])
    n = draws.shape[1]
    return np.array(figure.axes).reshape(n, n), figure


def test_a_corner_plot_holds_what_its_sigmas_say():
    draws = 10.0 + np.random.default_rng(5).standard_normal((200_000, 2))
    panels, _ = corner(draws)
    (lines,) = [one for one in panels[1, 0].collections if not one.filled]
    # smoothing by one bin of eight standard deviations' range widens the density a little, and the
    # level is that of a cell: eight of them lie at one distance from the middle
    cell = (8 / BINS) ** 2
    for path, sigma in zip(lines.get_paths(), (2.0, 1.0), strict=True):
        expected = 1 - np.exp(-0.5 * sigma**2 * (1 + cell))
        step = 8 * cell * np.exp(-0.5 * sigma**2) / (2 * np.pi)
        assert path.contains_points(draws).mean() == pytest.approx(expected, abs=step)
    for k in (0, 1):
        low, high = (line.get_xdata()[0] for line in panels[k, k].lines)
        inside = (low < draws[:, k]) & (draws[:, k] < high)
        assert inside.mean() == pytest.approx(0.6826, abs=1e-4)
        (bars,) = panels[k, k].patches
        x, y = bars.get_xy().T
        area = 0.5 * np.sum(np.diff(x) * (y[1:] + y[:-1]))
        assert area == pytest.approx(1.0, abs=0.01)


def test_only_panels_at_the_edge_are_labelled():
    panels, figure = corner(10.0 + np.random.default_rng(6).standard_normal((500, 3)))
    figure.canvas.draw()
    assert [[ax.get_xlabel() for ax in row] for row in panels[:2]] == [[""] * 3] * 2
    assert [ax.get_xlabel() for ax in panels[2]] == [f"{name} [no unit]" for name in "abc"]
    assert [ax.get_ylabel() for ax in panels[:, 0]] == ["", "b [no unit]", "c [no unit]"]
    assert not any(panels[row, column].axison for row in range(3) for column in range(row + 1, 3))


def test_few_draws_make_a_corner_plot():
    _, figure = corner(10.0 + np.random.default_rng(7).standard_normal((4, 2)))
    figure.canvas.draw()
