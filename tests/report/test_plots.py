"""Plots of single results: into the axes that are given, in the user's style, with true numbers."""

from __future__ import annotations

import doctest
import re
from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver
from scipy.stats import chi2

import bayesdist as bd
from bayesdist.assess import Requirement, distortion_vectors
from bayesdist.assess.evaluation import EvaluationSettings
from bayesdist.assess.requirements.margins import ValidityPeriod
from bayesdist.assess.vectors import diagram_vectors
from bayesdist.errors import InputError
from bayesdist.report import html, plots
from bayesdist.report.drawing import numbers_of
from bayesdist.report.figures.arrows import Arrows
from bayesdist.report.figures.style import INK, PAPER, Tones
from bayesdist.report.plots import errors, maps
from bayesdist.report.plots.posterior import Column, contour_heights, draw_corner
from bayesdist.report.run import shown_maps, shown_residuals
from bayesdist.report.run_plots import RunPlots

from .plots import figures_of
from .runs import report_run

STYLES = ("default", "dark_background", "seaborn-v0_8", "ggplot")
SCALE = 2757.0  # mas
WFC = {"size": (4096.0, 2048.0), "names": ("WFC2", "WFC1")}


def run_plots(run, **parts) -> RunPlots:
    """Plots of a run with these parts of its evaluation."""
    return RunPlots(run.having(**parts))


@pytest.fixture(scope="module")
def plot(converged):
    return run_plots(converged)


PLOTS = {
    "map": lambda plot, ax: plot.map(ax),
    "map in mas": lambda plot, ax: plot.map(ax, mas=True),
    "crosses": lambda plot, ax: plot.map(ax, kind="crosses"),
    "distortion": lambda plot, ax: plot.distortion(ax),
    "residuals": lambda plot, ax: plot.residuals(ax),
    "histogram": lambda plot, ax: plot.residuals(ax, kind="histogram"),
    "tails": lambda plot, ax: plot.residuals(ax, kind="histogram", axis="v", tails=True),
    "magnitude": lambda plot, ax: plot.residuals(ax, kind="magnitude"),
    "x": lambda plot, ax: plot.residuals(ax, kind="x"),
    "epoch": lambda plot, ax: plot.residuals(ax, kind="epoch", axis="v"),
    "exposures": lambda plot, ax: plot.exposures(ax),
    "budget": lambda plot, ax: plot.budget(ax),
    "margins": lambda plot, ax: plot.margins(ax),
    "correlations": lambda plot, ax: plot.correlations(ax),
    "ranks": lambda plot, ax: plot.ranks(ax),
}
COUNTS = re.compile(r"stars per (bin|hexagon)")


def drawn_on(ax) -> int:
    """Number of artists on axes, without those that axes have from the start."""
    return len(ax.lines) + len(ax.collections) + len(ax.patches) + len(ax.images) + len(ax.texts)


@pytest.mark.parametrize("name", PLOTS)
def test_a_plot_is_drawn_into_the_axes_that_are_given_and_nowhere_else(plot, name):
    figure = Figure()
    left, right = figure.subplots(1, 2)
    state, settings = pyplot.get_fignums(), dict(matplotlib.rcParams)
    assert PLOTS[name](plot, right) is right
    assert drawn_on(right) > 0
    assert drawn_on(left) == 0 and not left.get_title() and not left.get_xlabel()
    assert pyplot.get_fignums() == state and dict(matplotlib.rcParams) == settings
    # but for the colour bar of the correlations, which takes its place from the axes
    assert len(figure.axes) == (3 if name == "correlations" else 2)


@pytest.mark.parametrize("name", PLOTS)
def test_axes_have_labels_with_units(plot, name):
    ax = PLOTS[name](plot, Figure().subplots())
    labels = [ax.get_xlabel()]
    if name not in ("budget", "margins"):  # names along y
        labels.append(ax.get_ylabel())
    labels += [bar.get_ylabel() for bar in ax.child_axes]
    for label in labels:
        assert re.search(r"\[[^\]]+\]", label) or COUNTS.search(label), label


@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("name", PLOTS)
def test_text_sizes_and_backgrounds_are_those_of_the_style(plot, name, style):
    with pyplot.style.context(style), matplotlib.rc_context({"legend.fontsize": 11.5}):
        figure = Figure()
        plain, ax = figure.subplots(1, 2)
        PLOTS[name](plot, ax)
        plain.set(title="title", xlabel="x")
        assert ax.get_facecolor() == plain.get_facecolor()
        assert figure.get_facecolor() == to_rgba(matplotlib.rcParams["figure.facecolor"])
        for part in ("title", "xaxis.label", "yaxis.label"):
            ours, theirs = ax, plain
            for step in part.split("."):
                ours, theirs = getattr(ours, step), getattr(theirs, step)
            assert ours.get_fontsize() == theirs.get_fontsize(), part
            assert ours.get_color() == theirs.get_color(), part
        sizes = {text.get_fontsize() for text in ax.texts if text.get_text()}
        assert sizes <= {11.5, matplotlib.font_manager.FontProperties().get_size_in_points()}
        tick, other = ax.xaxis.get_major_ticks()[0], plain.xaxis.get_major_ticks()[0]
        assert tick.label1.get_fontsize() == other.label1.get_fontsize()


@pytest.mark.parametrize("style", STYLES[:2])
@pytest.mark.parametrize("name", PLOTS)
def test_words_stand_out_from_every_background_and_do_not_overlap(plot, name, style):
    with pyplot.style.context(style):
        ax = PLOTS[name](plot, None)
        try:
            ax.figure.canvas.draw()
            renderer = ax.figure.canvas.get_renderer()
            paper = np.array(to_rgba(ax.figure.get_facecolor())[:3])
            words = [t for t in (ax.title, ax._left_title, *ax.texts) if t.get_text()]
            outside = []
            for text in words:
                box = text.get_window_extent(renderer)
                if not ax.bbox.fully_overlaps(box):
                    assert np.abs(np.array(to_rgba(text.get_color())[:3]) - paper).max() > 0.3
                    outside.append(box)
            for k, box in enumerate(outside):
                assert not any(box.overlaps(other) for other in outside[k + 1 :])
            everything = ax.get_tightbbox(renderer)
            page = ax.figure.bbox
            assert everything.x0 > page.x0 - 1 and everything.x1 < page.x1 + 1
            assert everything.y0 > page.y0 - 1 and everything.y1 < page.y1 + 1
        finally:
            pyplot.close(ax.figure)


def test_without_axes_a_new_figure_of_pyplot_is_made(plot):
    first, second = plot.map(), plot.budget()
    try:
        assert first.figure is not second.figure
        assert second is pyplot.gca() and len(pyplot.get_fignums()) == 2
        np.testing.assert_allclose(
            first.figure.get_size_inches(), matplotlib.rcParams["figure.figsize"]
        )
    finally:
        pyplot.close("all")


def test_neutral_colours_are_the_reports_on_its_paper_and_shades_of_others():
    with matplotlib.rc_context({"axes.labelcolor": INK, "axes.facecolor": PAPER}):
        assert Tones.of(Figure().subplots()) == Tones()
    with pyplot.style.context("dark_background"):
        tones = Tones.of(Figure().subplots())
    bright = [np.mean(to_rgba(c)[:3]) for c in (tones.ink, tones.outline, tones.pale, tones.bars)]
    assert bright == sorted(bright, reverse=True) and bright[0] == 1.0
    assert np.mean(to_rgba(tones.paper)[:3]) == 0.0 < bright[-1]
    transparent = Figure(facecolor="black").subplots()
    transparent.set_facecolor("none")
    assert Tones.of(transparent).paper == "#000000"


# -- the report draws with the same functions ----------------------------------------------------


def marks(ax) -> str:
    """Numbers of the marks of one panel."""
    lines = numbers_of(SimpleNamespace(axes=[ax])).splitlines()
    return "\n".join(line for line in lines if not line.startswith("#"))


@pytest.mark.parametrize(
    ("figure", "panel", "name"),
    [
        ("distortion", 0, "distortion"),
        ("residual_vectors", 0, "residuals"),
        ("residual_histogram", 0, "histogram"),
        ("residual_histogram", 3, "tails"),
        ("residuals_by_magnitude", 0, "magnitude"),
        ("residuals_by_position", 0, "x"),
        ("chi_square_by_exposure", 0, "exposures"),
        ("budget_terms", 0, "budget"),
        ("margins", 0, "margins"),
        ("correlations", 0, "correlations"),
        ("ranks", 0, "ranks"),
    ],
)
def test_a_plot_has_the_marks_of_the_figure_in_the_report(plot, figures, figure, panel, name):
    ax = PLOTS[name](plot, Figure().subplots())
    expected = marks(figures[figure].axes[panel])
    assert marks(ax) == expected and len(expected.splitlines()) > 2


def test_maps_have_the_marks_of_the_figures_in_the_report(converged, figures):
    maps = shown_maps(converged)[0]
    every = np.concatenate([m.per_axis.ravel() for m in maps])
    for k, (m, which) in enumerate(zip(maps, ("formal", "posterior"), strict=True)):
        shared = figures["uncertainty_radius"].axes[k]
        (filled,) = [c for c in shared.collections if getattr(c, "filled", False)]
        assert filled.levels[0] <= every.min() and filled.levels[-1] >= every.max()
        ax = run_plots(converged).map(Figure().subplots(), which=which, levels=filled.levels)
        assert marks(ax) == marks(shared)
        crosses = plots.plot_map(m, Figure().subplots(), kind="crosses", magnification=500.0)
        (drawn,) = [c for c in crosses.collections if isinstance(c, LineCollection)]
        steps = np.diff(drawn.get_segments(), axis=1)[:, 0] / 500.0
        assert np.abs(steps[:, 0]).max() == pytest.approx(m.sigma_u_max, rel=1e-9)
        assert np.abs(steps[:, 1]).max() == pytest.approx(m.sigma_v_max, rel=1e-9)


# -- numbers -------------------------------------------------------------------------------------


def test_a_map_in_mas_has_the_errors_times_the_pixel_scale(plot, converged):
    m = converged.evaluation.maps[0]
    levels = [0.005, 0.01, 0.02]  # pixels
    ax = plots.plot_map(m, Figure().subplots(), scale_mas=SCALE, levels=levels)
    (filled,) = [c for c in ax.collections if getattr(c, "filled", False)]
    np.testing.assert_allclose(filled.levels, np.array(levels) * SCALE)
    (bar,) = ax.child_axes
    assert bar.get_ylabel() == "per axis (1 σ) [mas]"
    low, high = (float(v) for v in re.findall(r"[\d.]+", ax.get_title()))
    assert low == pytest.approx(m.per_axis.min() * SCALE, rel=6e-3)
    assert high == pytest.approx(m.per_axis.max() * SCALE, rel=6e-3)
    (ring, _) = ax.lines
    np.testing.assert_allclose(ring.get_xydata()[0], m.position_of_max)


@pytest.mark.parametrize("kind", ["distortion", "crosses"])
@pytest.mark.parametrize("mas", [False, True])
def test_the_key_is_to_the_scale_of_the_vectors(plot, converged, kind, mas):
    figure = Figure()
    ax = figure.subplots()
    if kind == "crosses":
        plot.map(ax, kind="crosses", mas=mas)
    else:
        plot.distortion(ax, mas=mas)
    figure.draw_without_rendering()
    (words,) = [t.get_text() for t in ax.texts if "drawn" in t.get_text()]
    stated, unit, M = re.match(r"([\d.]+)\u202f(\S+), drawn ×([\d\u202f]+)", words).groups()
    in_pixels = float(stated) / ({"mas": SCALE, "arcsec": SCALE / 1e3}[unit] if mas else 1.0)
    assert (unit == "pix") == (not mas)
    (key,) = [t for t in ax.texts if getattr(t, "arrow_patch", None) is not None]
    ends = key.xycoords.transform([key.xy, key.xyann])
    per_pixel = np.diff(ax.transData.transform([[0, 0], [1, 0]]), axis=0)[0, 0]
    length = np.hypot(*(ends[1] - ends[0])) / per_pixel
    magnification = float(M.replace("\u202f", ""))
    assert length == pytest.approx(magnification * in_pixels, rel=5e-3)
    for c in ax.collections:
        if isinstance(c, Quiver):
            assert 1.0 / c.scale == pytest.approx(magnification)
            vectors = diagram_vectors(converged.solution, converged.model.chips[0], epoch=2010.3)
            assert np.hypot(c.U, c.V).max() == pytest.approx(vectors.length_max)


def test_vectors_of_residuals_are_those_of_the_cells(plot, converged):
    binned = shown_residuals(converged)[0]
    ax = plot.residuals(Figure().subplots())
    quivers = [c for c in ax.collections if isinstance(c, Quiver)]
    drawn = np.concatenate([np.column_stack([c.XY, c.U, c.V]) for c in quivers])
    gx, gy = np.meshgrid(binned.x, binned.y)
    cells = np.column_stack([a.ravel() for a in (gx, gy, binned.mean_u, binned.mean_v)])
    order = [np.lexsort(rows.T[:2]) for rows in (drawn, cells)]
    np.testing.assert_allclose(drawn[order[0]], cells[order[1]])
    n = Arrows.of_cells(binned).n_clear
    assert ax.get_title() == f"{n} of 256 significant, 12 by chance"
    assert ax.get_xlim()[1] == pytest.approx(1016.5 + 0.03 * 1016)


def test_means_against_x_are_weighted_means_of_the_stars(plot, converged):
    ax = plot.residuals(Figure().subplots(), kind="x", axis="v")
    (bars,) = [c for c in ax.containers if isinstance(c, ErrorbarContainer)]
    at, mean = bars.lines[0].get_data()
    stars = converged.diagnostics.sample
    shown = stars.probably_true
    x, residual = stars.table.x[shown], stars.residual[shown, 1]
    weight = 1.0 / stars.expected_square[shown].mean(axis=1)
    edges = np.linspace(0.5, 1016.5, 21)
    for k in (0, 7, 19):
        cell = (x >= edges[k]) & (x < edges[k + 1])
        assert at[k] == pytest.approx(x[cell].mean())
        assert mean[k] == pytest.approx(np.average(residual[cell], weights=weight[cell]))


def test_bars_of_a_budget_are_its_rows_with_the_total_last(converged):
    ax = plots.plot_budget(converged.evaluation.budget, Figure().subplots(), scale_mas=SCALE)
    rows = converged.evaluation.budget.rows()
    widths = [bar.get_width() for bar in ax.patches]
    np.testing.assert_allclose(widths, [SCALE * r["radial"] / np.sqrt(2) for r in rows], rtol=1e-12)
    assert "[mas]" in ax.get_xlabel()
    assert [t.get_text().replace("\n", " ") for t in ax.get_yticklabels()] == [
        r["name"] for r in rows
    ]
    places = [bar.get_y() for bar in ax.patches]
    transform = ax.transData.transform
    assert transform((0, places[-1]))[1] < transform((0, places[0]))[1]  # the total at the bottom


def test_margins_are_relative_to_their_limits(converged):
    ax = plots.plot_margins(converged.evaluation.margins, Figure().subplots())
    medians = [line for line in ax.lines if line.get_marker() not in ("None", None, "")]
    for line, m in zip(medians, converged.evaluation.margins, strict=True):
        assert line.get_xdata()[0] == pytest.approx(m.value / m.requirement.limit)
    words = [t.get_text() for t in ax.texts]
    assert [w.partition(":")[0] for w in words] == [m.verdict for m in converged.evaluation.margins]


# -- chips ---------------------------------------------------------------------------------------


def test_a_chip_is_chosen_by_its_number_and_named():
    r = report_run(**WFC)
    plot = run_plots(r)
    assert plot.map(Figure().subplots(), chip=2).get_title().startswith("WFC1: posterior: ")
    assert plot.distortion(Figure().subplots()).get_title().startswith("WFC2: largest")
    ax = plot.budget(Figure().subplots(), chip=2)
    assert "WFC1" in ax.get_xlabel()
    widths = [bar.get_width() for bar in ax.patches]
    alone = r.evaluation.budget.chips[1].rows()
    np.testing.assert_allclose(widths, [row["radial"] / np.sqrt(2) for row in alone])
    names = [t.get_text() for t in plot.residuals(Figure().subplots(), kind="y").legend_.texts]
    assert names == ["WFC2", "WFC1"]
    shared = Figure()
    axes = shared.subplots(1, 2)
    levels = [0.0, 0.01, 0.02, 0.05]
    plot.map(axes[0], chip=1, levels=levels, colorbar=False)
    plot.map(axes[1], chip=2, levels=levels, colorbar=axes)
    assert len(shared.axes) == 3 and not axes[0].child_axes
    for call in (plot.map, plot.distortion, plot.residuals, plot.budget):
        with pytest.raises(InputError, match="chip 3"):
            call(Figure().subplots(), chip=3)
    with pytest.raises(InputError, match="no chip 7; give one of 1, 2"):
        plots.plot_budget(r.evaluation.budget, Figure().subplots(), chip=7)


# -- the corner plot -----------------------------------------------------------------------------


def test_a_corner_plot_has_a_panel_for_each_pair(converged):
    names = ["u_1_0", "v_0_1", "j"]
    figure = Figure()
    panels = plots.plot_corner(converged.posterior, names, fig=figure)
    assert panels.shape == (3, 3) and len(figure.axes) == 6
    assert all(panels[i, j] is None for i in range(3) for j in range(i + 1, 3))
    assert [panels[2, j].get_xlabel().split()[0] for j in range(3)] == names
    figure.draw_without_rendering()
    assert figure.get_tightbbox().x0 >= 0 and figure.get_tightbbox().y0 >= 0
    with pytest.raises(InputError, match="has axes; give an empty figure"):
        plots.plot_corner(converged.posterior, names, fig=figure)


def test_by_default_a_corner_plot_is_that_of_the_report(converged, figures):
    panels = plots.plot_corner(converged.posterior, fig=Figure())
    reported = figures["outliers_corner"].axes
    ours = [panels[i, j] for i in range(3) for j in range(i + 1)]
    assert sorted(map(marks, ours)) == sorted(map(marks, reported))
    report = report_run(outliers="none")
    assert plots.plot_corner(report.posterior, fig=Figure()).shape == (1, 1)


def test_contours_hold_what_one_and_two_sigma_of_a_gaussian_hold():
    t = np.linspace(-6, 6, 401)
    density = np.exp(-0.5 * (t**2 + t[:, None] ** 2))
    two, one = contour_heights(density)
    # the density at 1 sigma and at 2 sigma from the middle
    np.testing.assert_allclose([one, two], np.exp([-0.5, -2.0]), rtol=0.01)
    for height, sigma in ((one, 1.0), (two, 2.0)):
        held = density[density >= height].sum() / density.sum()
        assert held == pytest.approx(chi2.cdf(sigma**2, 2), abs=1e-3)


def test_contours_follow_the_correlation_of_the_draws():
    rng = np.random.default_rng(2)
    x, z = rng.standard_normal((2, 20_000))
    columns = [Column("a", "", x), Column("b", "", 0.9 * x + np.sqrt(0.19) * z)]
    panels = draw_corner(Figure(), columns)
    lines = [c for c in panels[1, 0].collections if not c.filled]
    two = max((path.vertices for path in lines[0].get_paths()), key=len)
    # a Gaussian smoothed by one of the 26 bins that 8 sigma have, along both axes
    covariance = np.array([[1.0, 0.9], [0.9, 1.0]]) + (8.0 / 26.0) ** 2 * np.eye(2)
    distance = np.sqrt(np.einsum("ni,ij,nj->n", two, np.linalg.inv(covariance), two))
    assert distance.mean() == pytest.approx(2.0, rel=0.03) and distance.std() < 0.15


# -- wrong input ---------------------------------------------------------------------------------


def test_wrong_input_is_named(plot, converged):
    with pytest.raises(InputError, match=r"ax is a ndarray of shape \(2,\).*give one"):
        plot.map(Figure().subplots(1, 2))
    for call, words in (
        (lambda ax: plot.map(ax, kind="heat"), "heat"),
        (lambda ax: plot.map(ax, which="relative"), "self-calibration"),
        (lambda ax: plot.residuals(ax, kind="heat"), "heat"),
        (lambda ax: plot.residuals(ax, kind="x", axis="x"), "axis"),
        (lambda ax: plot.residuals(ax, kind="colour"), "no colour"),
        (lambda ax: plot.ranks(ax, parameter="u_9_9"), "u_9_9"),
        (lambda ax: plot.validity(ax), "no validity period"),
        (lambda ax: run_plots(converged, margins=()).margins(ax), "no margin"),
    ):
        with pytest.raises(InputError, match=words):
            call(Figure().subplots())
    with pytest.raises(InputError, match="u_9_9"):
        plot.corner(["u_9_9"], fig=Figure())
    with pytest.raises(InputError, match="give a list of names"):
        plot.corner("u_1_0", fig=Figure())
    unscaled = run_plots(converged, settings=EvaluationSettings(epoch=2010.3))
    with pytest.raises(InputError, match="the size of a pixel is unknown"):
        unscaled.map(Figure().subplots(), mas=True)


def test_the_plots_of_a_run_are_listed(plot, converged):
    listed = re.findall(r"^  \.(\w+)\(\)", repr(plot), re.MULTILINE)
    assert {"map", "distortion", "residuals", "budget", "margins", "corner"} <= set(listed)
    assert "validity" not in listed and all(hasattr(plot, name) for name in listed)
    assert "margins" not in repr(run_plots(converged, margins=()))


def test_probabilities_over_time_are_those_of_the_report(converged):
    years = np.linspace(2010.0, 2020.0, 41)
    p = np.clip(1.0 - 0.02 * (years - 2010.0), 0.0, 1.0)
    asked = Requirement("field-wide", "p95", 0.1, "pix", 0.95)
    period = ValidityPeriod(asked, years, p, p - 0.01, p + 0.01, np.ones_like(p))
    ax = run_plots(converged, validity=(period,)).validity(Figure().subplots())
    r = converged.having(validity=(period,))
    assert marks(ax) == marks(figures_of(r, "validity_period")["validity_period"].axes[0])
    dates = [line.get_xdata()[0] for line in ax.lines if np.ptp(line.get_xdata()) == 0]
    assert dates == pytest.approx([2012.5])  # 0.95 = 1 - 0.02 (t - 2010)


@pytest.mark.parametrize("module", [errors, maps, html], ids=lambda m: m.__name__)
def test_examples_of_the_functions_run(module):
    names = {"bd": bd, "np": np, "Figure": Figure, "distortion_vectors": distortion_vectors}
    found = doctest.testmod(module, extraglobs=names)
    assert found.attempted > 1 and found.failed == 0
