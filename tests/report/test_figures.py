"""Figures say what they show: labels with units, finite data, a key that is true to scale."""

from __future__ import annotations

import re
from dataclasses import replace

import matplotlib
import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.collections import LineCollection, QuadMesh
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver

from bayesdist.assess import VectorMap
from bayesdist.assess.vectors import diagram_vectors
from bayesdist.errors import InputError
from bayesdist.report.drawing import save_figures
from bayesdist.report.figures.arrows import Arrows, cross_map, sparse_step, square_cells
from bayesdist.report.figures.fields import (
    Grid,
    contour_levels,
    draw_grid,
    error_levels,
    scalar_map,
)
from bayesdist.report.figures.panels import ChipPanels, FocalPlane, overlap
from bayesdist.report.figures.style import figure_style, nice_below
from bayesdist.report.plots.posterior import (
    correlation_matrix,
    rank_counts,
    slowest_parameters,
)
from bayesdist.report.plots.residuals import MixtureCurve
from bayesdist.report.run import Mosaic, shown_maps
from bayesdist.report.sections.fit import _density
from bayesdist.report.sections.residuals import _histograms
from tests.reduced import case_in_full

from .plots import figures_of
from .runs import SIZE, report_run

WITHOUT_UNIT = {"stars per bin", "stars per hexagon"}  # counts
CATEGORIES = {"budget_terms", "margins"}  # names, not numbers, along y

WFC = {"size": (4096.0, 2048.0), "names": ("WFC2", "WFC1")}
ARCSEC = {"unit": "arcsec", "scale": 0.05}
# each shape, unit and model of outliers once
RUNS = {
    "square": {},
    "least squares": {"sampler": False},
    "wide in arcsec, no outliers": {"size": (4096.0, 2048.0), "outliers": "none"} | ARCSEC,
    "two wide chips": WFC,
    "two square chips in arcsec, uniform": {"names": ("A", "B"), "outliers": "uniform"} | ARCSEC,
    "two wide chips in arcsec, uniform": WFC | {"outliers": "uniform"} | ARCSEC,
}
# reduced, the shapes, units and models of outliers that are the least usual, together
REDUCED = ("two wide chips in arcsec, uniform",)


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(name, id=name)
        if name in REDUCED
        else case_in_full(name, instead="others are run", id=name)
        for name in RUNS
    ],
)
def every_figure(request):
    options = RUNS[request.param]
    figures = figures_of(report_run(**options)) if options else request.getfixturevalue("figures")
    for figure in figures.values():
        figure.canvas.draw()
    return figures


@pytest.fixture(scope="module")
def wfc():
    return report_run(**WFC)


def test_every_axis_names_its_unit(every_figure):
    for name, fig in every_figure.items():
        for which in ("xlabel", "ylabel"):
            labels = {getattr(ax, f"get_{which}")() for ax in fig.axes} - {""}
            assert labels or (which == "ylabel" and name in CATEGORIES), f"{name} has no {which}"
            for label in labels - WITHOUT_UNIT:
                assert re.search(r"\[[^\]]+\]", label), f"{name}: no unit in {label!r}"


def test_what_is_drawn_is_finite(every_figure):
    for name, fig in every_figure.items():
        for ax in fig.axes:
            for line in ax.lines:
                assert np.isfinite(line.get_xydata()).all(), name
            for c in ax.collections:
                if isinstance(c, Quiver):
                    assert c.U.size == c.V.size == len(c.XY)
                    assert np.isfinite([*c.U, *c.V]).all() and np.isfinite(c.XY).all(), name
                elif isinstance(c, LineCollection):
                    assert np.isfinite(c.get_segments()).all(), name
                elif isinstance(c, QuadMesh):
                    assert np.isfinite(c.get_array()).all(), name
            assert np.isfinite([*ax.get_xlim(), *ax.get_ylim()]).all(), name


def test_titles_and_keys_do_not_overlap(every_figure):
    for name, fig in every_figure.items():
        renderer = fig.canvas.get_renderer()
        for ax in fig.axes:
            above = [t for t in (ax.title, ax._left_title, *ax.texts) if t.get_text()]
            boxes = [
                t.get_window_extent(renderer)
                for t in above
                if t.get_window_extent(renderer).y0 >= ax.bbox.y1
            ]
            for k, a in enumerate(boxes):
                assert not any(a.overlaps(b) for b in boxes[k + 1 :]), name


def test_the_words_of_the_legend_fit_into_the_figure(every_figure):
    for name, fig in every_figure.items():
        for legend in fig.legends:
            box = legend.get_window_extent()
            assert box.x0 >= -1 and box.x1 <= fig.bbox.x1 + 1, name


def _key(ax):
    """What the key says, as (stated length, unit), and how long its arrow is on the paper."""
    (words,) = [t.get_text() for t in ax.texts if "drawn" in t.get_text()]
    number, unit = re.match(r"\s*([\d.]+)\s*(\S+),", words).groups()
    (arrow,) = [t for t in ax.texts if getattr(t, "arrow_patch", None) is not None]
    ends = arrow.xycoords.transform([arrow.xy, arrow.xyann])
    return float(number), unit, float(np.hypot(*(ends[1] - ends[0]))), words


def _drawn_lengths(quiver):
    """Length on the paper of each arrow of a quiver, from the polygons that are painted."""
    transform = quiver.get_transform()
    origin = transform.transform([[0.0, 0.0]])[0]
    out = []
    for path in quiver.get_paths():
        out.append(np.hypot(*(transform.transform(path.vertices) - origin).T).max())
    return np.array(out)


@pytest.mark.parametrize(
    ("unit", "size"), [("pix", (1016.0, 1016.0)), ("arcsec", (4096.0, 2048.0))]
)
def test_key_has_the_length_that_arrows_of_that_value_are_drawn_with(unit, size):
    run = report_run(size=size, unit=unit, scale=1.0 if unit == "pix" else 0.05)
    mas = {"mas": 1e-3, "arcsec": 1.0, "pix": 1.0}
    for fig in figures_of(run, "distortion", "distortion_non_linear", "residual_vectors").values():
        fig.canvas.draw()
        ax = fig.axes[0]
        stated, key_unit, paper, _ = _key(ax)
        for quiver in [c for c in ax.collections if isinstance(c, Quiver)]:
            value = np.hypot(quiver.U, quiver.V)
            long = value > 0.3 * value.max()  # the head of a short arrow is a dot of its own size
            drawn = _drawn_lengths(quiver)[long]
            expected = paper * value[long] / (stated * mas[key_unit])
            np.testing.assert_allclose(drawn, expected, rtol=0.01)


def crosses(maps):
    """Crosses of the maps of one chip, 2000 times larger than the chip."""
    panels = ChipPanels(Mosaic((SIZE,)), len(maps))
    panels.frame(100.0)
    cross_map(panels, maps, [m.kind for m in maps], magnification=2000.0, key=0.01)
    return panels.figure


def test_key_of_the_crosses_is_to_their_scale(converged):
    fig = crosses(shown_maps(converged)[0])
    fig.canvas.draw()
    for ax, m in zip(fig.axes, shown_maps(converged)[0], strict=True):
        stated, _, paper, words = _key(ax)
        assert "×2\u202f000" in words
        (lines,) = [c for c in ax.collections if isinstance(c, LineCollection)]
        ends = np.array([ax.transData.transform(s) for s in lines.get_segments()])
        drawn = np.hypot(*(ends[:, 1] - ends[:, 0]).T).max()
        assert drawn == pytest.approx(paper * m.radius_max / stated, rel=1e-9)


MAPS = ("formal_uncertainty", "uncertainty_radius",
        "pixel_area", "residual_vectors", "budget_dominating")  # fmt: skip


def test_each_chip_has_a_panel_where_it_lies(wfc):
    """WFC1, the second chip, lies above WFC2; one scale of pixels, vectors and colours for both."""
    figs = figures_of(wfc, *MAPS)
    assert sorted(figs) == sorted(MAPS)
    for name, fig in figs.items():
        fig.canvas.draw()
        panels = [ax for ax in fig.axes if ax.get_title(loc="left")]
        titles = [ax.get_title(loc="left") for ax in panels]
        kinds = 2 if name in ("formal_uncertainty", "uncertainty_radius") else 1
        assert len(panels) == 2 * kinds, name
        high, low = ([ax for ax, t in zip(panels, titles, strict=True) if n in t]
                     for n in ("WFC1", "WFC2"))  # fmt: skip
        assert len(high) == len(low) == kinds
        assert min(ax.bbox.y0 for ax in high) > max(ax.bbox.y1 for ax in low), name
        # as many pixels of the paper to the detector's pixel, along both axes and on both chips
        scales = [np.diff(ax.transData.transform([[0, 0], [1, 1]]), axis=0)[0] for ax in panels]
        np.testing.assert_allclose(scales, scales[0][0], rtol=1e-6)
        keys = [_key(ax) for ax in panels if any("drawn" in t.get_text() for t in ax.texts)]
        if name in (
            "residual_vectors",
            "formal_uncertainty",
        ):
            assert len(keys) == len(panels)
            assert len({(length, unit, text) for length, unit, _, text in keys}) == 1
            np.testing.assert_allclose([paper for _, _, paper, _ in keys], keys[0][2], rtol=1e-6)
        fills = {
            c.get_clim()
            for ax in panels
            for c in ax.collections
            if c.get_cmap().name == "cividis" and c.get_array() is not None
        }
        assert len(fills) == (name in ("uncertainty_radius", "pixel_area"))


def test_vectors_of_all_chips_are_in_one_focal_plane(wfc):
    """WFC1 is 30 pixels above WFC2, and the longest arrow is as long as a cell of the grid."""
    for name, fig in figures_of(wfc, "distortion", "distortion_non_linear").items():
        part = {"distortion": "no_constant", "distortion_non_linear": "non_linear"}[name]
        vectors = [
            diagram_vectors(wfc.solution, chip, part=part, epoch=2010.3) for chip in wfc.model.chips
        ]
        ax, bar = fig.axes
        low, high = (patch.get_xy()[:4] for patch in ax.patches[:2])
        assert np.ptp(low, axis=0) == pytest.approx((4096, 2048), rel=1e-6)
        assert np.ptp(high, axis=0) == pytest.approx((4096, 2048), rel=1e-3)
        assert high[:, 1].min() - low[:, 1].max() == pytest.approx(30, abs=3)
        quivers = [c for c in ax.collections if isinstance(c, Quiver)]
        assert len(quivers) == 2
        M = 1.0 / quivers[0].scale
        longest = max(float(np.hypot(*v.on_detector).max()) for v in vectors)
        step = min(np.diff(np.unique(q.X)).max() for q in quivers[:1])
        assert 0.9 * step < M * longest <= step * (1 + 1e-9)
        for quiver in quivers:
            np.testing.assert_allclose(quiver.get_array(), np.hypot(quiver.U, quiver.V))
            assert quiver.get_clim() == pytest.approx((0.0, longest), rel=1e-3)
        assert bar.get_ylabel() == "length [pix]"


def test_maps_of_many_chips_are_in_one_focal_plane(wfc):
    """Each cell of a turned chip is where the chip's frame puts its corners."""
    grid = Grid(np.arange(3.0), np.arange(2.0), np.arange(6.0).reshape(2, 3))
    square = np.array([[0, 0], [3, 0], [3, 2], [0, 2.0]])
    outlines = [square + np.array([10.0 * k, 0]) for k in range(5)]

    def turned(x, y):
        return np.stack([40.0 - np.asarray(y), np.asarray(x)])

    frames = [*[lambda x, y, k=k: np.stack([x + 10 * k, y]) for k in range(4)], turned]
    panels = FocalPlane(outlines, list("ABCDE"), frames=frames, colorbar=True)
    scalar_map(panels, [grid] * 5, [""], norm=Normalize(0, 5), label="n")
    ax, _ = panels.figure.axes
    meshes = [c for c in ax.collections if isinstance(c, QuadMesh)]
    corners = [m.get_coordinates() for m in meshes]
    np.testing.assert_allclose(corners[1][0, 0], (9.5, -0.5))
    np.testing.assert_allclose(corners[4][0, 0], (40.5, -0.5))
    np.testing.assert_allclose(corners[4][0, -1], (40.5, 2.5))
    assert [text.get_text() for text in ax.texts] == list("ABCDE")


def test_chips_on_each_other_have_panels_of_their_own():
    def square(x: float, y: float):
        return np.array([[x, y], [x + 100, y], [x + 100, y + 100], [x, y + 100]])

    assert overlap([square(0, 0), square(50, 10)])
    assert not overlap([square(0, 0), square(95, 0)])
    assert not overlap([square(0, 0), square(0, 130), square(130, 0)])


def test_chips_of_several_sizes_share_one_scale():
    sizes = ((4096.0, 2048.0), (1014.0, 1014.0))
    panels = ChipPanels(Mosaic(sizes, ("A", "B"), ((0, 0), (1, 0))))
    panels.frame()
    fig = panels.figure
    fig.canvas.draw()
    scales = [np.diff(ax.transData.transform([[0, 0], [1, 1]]), axis=0)[0] for ax in fig.axes]
    np.testing.assert_allclose(scales, scales[0][0], rtol=1e-6)


def test_a_wide_detector_is_drawn_row_by_row_in_panels_that_can_be_read():
    names = tuple("ABCDEFGH")
    places = tuple((1 - k // 4, k % 4) for k in range(8))  # A to D below E to H
    mosaic = Mosaic(8 * ((100.0, 100.0),), names, places)
    panels = ChipPanels(mosaic)
    panels.frame()
    fig = panels.figure
    for k, (ax,) in enumerate(panels.axes):
        ax.set_title(panels.title(k, "", ""))
    fig.canvas.draw()
    assert len(fig.axes) == 8
    labelled = [names[k] for k, (ax,) in enumerate(panels.axes) if ax.get_xlabel()]
    assert labelled == ["B", "C", "D"]  # rows EFG, HAB, CD: under B there is no panel
    boxes = [ax.bbox for ax in fig.axes]
    assert min(b.width for b in boxes) > 1.5 * fig.dpi
    assert not any(a.overlaps(b) for k, a in enumerate(boxes) for b in boxes[k + 1 :])
    shown = sorted(fig.axes, key=lambda ax: (-round(ax.bbox.y0), ax.bbox.x0))
    assert "".join(ax.get_title() for ax in shown) == "EFGHABCD"


def test_bars_of_each_chip_stand_beside_those_of_all(wfc):
    fig = figures_of(wfc, "budget_terms")["budget_terms"]
    assert [ax.get_xlabel().split(" [")[0] for ax in fig.axes] == [
        "rms over all chips",
        "rms over WFC2",
        "rms over WFC1",
    ]
    parts = [b.rows() for b in (wfc.evaluation.budget, *wfc.evaluation.budget.chips)]
    for ax, rows in zip(fig.axes, parts, strict=True):
        widths = [bar.get_width() for bar in ax.patches]
        np.testing.assert_allclose(widths, [r["radial"] / np.sqrt(2) for r in rows], rtol=1e-12)
    assert len({ax.get_xlim() for ax in fig.axes}) == 1


def test_crosses_reach_all_four_combinations_of_one_sigma(converged):
    m = converged.evaluation.formal[0]
    fig = crosses((m,))
    (lines,) = [c for c in fig.axes[0].collections if isinstance(c, LineCollection)]
    steps = np.array([s[1] - s[0] for s in lines.get_segments()]) / 2000.0
    rows, columns = square_cells(m.x, m.y)
    su, sv = (s[rows, columns].ravel() for s in (m.sigma_u, m.sigma_v))
    wanted = [(a * u, b * v) for a in (-1, 1) for b in (-1, 1) for u, v in zip(su, sv, strict=True)]
    np.testing.assert_allclose(sorted(map(tuple, steps)), sorted(wanted), atol=1e-12)


def test_the_largest_error_is_printed(converged, figures):
    fig = figures["formal_uncertainty"]
    for ax, m in zip(fig.axes, shown_maps(converged)[0], strict=True):
        printed = float(re.search(r"largest ([\d.]+)", ax.get_title(loc="left")).group(1))
        assert printed == pytest.approx(m.radius_max / np.sqrt(2), rel=6e-3)
        assert m.kind in ax.get_title(loc="left")


def test_maps_of_one_figure_share_their_colours(figures):
    fig = figures["uncertainty_radius"]
    limits = [
        {c.get_clim() for c in ax.collections if c.get_cmap().name == "cividis"}
        for ax in fig.axes[:2]
    ]
    assert len(limits[0]) == 1 and limits[0] == limits[1]


def test_detector_is_shown_x_right_y_up_with_square_pixels(figures):
    for name in ("distortion", "formal_uncertainty", "uncertainty_radius", "pixel_area",
                 "residual_vectors", "budget_dominating"):  # fmt: skip
        ax = figures[name].axes[0]
        assert ax.get_aspect() == 1.0, name
        assert ax.get_xlim()[0] < ax.get_xlim()[1] and ax.get_ylim()[0] < ax.get_ylim()[1], name


def test_vectors_of_a_rotated_frame_are_drawn_along_the_detector():
    # u, v turned by 90 degrees and 0.1 units to the pixel: a shift of one pixel along x is (0, 0.1)
    x = y = np.linspace(1.0, 100.0, 5)
    turn = 0.1 * np.array([[0.0, -1.0], [1.0, 0.0]])
    du, dv = np.zeros((5, 5)), np.full((5, 5), 0.1)
    arrows = Arrows.of_map(VectorMap(x, y, du, dv, "arcsec", "no_constant", similarity=turn))
    np.testing.assert_allclose(arrows.du, 1.0)
    np.testing.assert_allclose(arrows.dv, 0.0, atol=1e-12)


def test_a_map_without_variation_or_vectors_is_drawn(converged):
    m = converged.evaluation.formal[0]
    flat = replace(m, sigma_u=np.full_like(m.sigma_u, 0.01), sigma_v=np.full_like(m.sigma_v, 0.01))
    model, theta = converged.model, np.zeros(converged.model.n_params)
    basis = model.basis()
    for axis, term in enumerate([(1, 0), (0, 1)]):
        monomials = [float(other == term) for other in basis.terms]
        theta[model.coefficient_slice(None, axis)] = basis.from_monomials(monomials)
    draws = np.broadcast_to(theta, converged.posterior.theta.shape)
    still = replace(converged.posterior, theta=draws)
    assert diagram_vectors(still, model.chips[0], epoch=2010.3).length_max < 1e-9
    run = converged.having(formal=(flat,), maps=(flat,), posterior=still)
    drawn = figures_of(run, "uncertainty_radius", "distortion")
    for fig in drawn.values():
        fig.canvas.draw()
    (contours,) = drawn["uncertainty_radius"].axes[0].collections
    low, high = contours.get_clim()
    assert low < 0.01 < high
    (arrows,) = drawn["distortion"].axes[0].collections
    assert not arrows.U.any() and not arrows.V.any()


def test_the_callers_matplotlib_is_left_alone(converged, tmp_path):
    with matplotlib.rc_context({"font.size": 23.0, "axes.linewidth": 3.0}):
        before = dict(matplotlib.rcParams)
        save_figures(figures_of(converged, "margins", "ranks", "outliers_corner"), tmp_path)
        assert dict(matplotlib.rcParams) == before
    assert pyplot.get_fignums() == []


def test_a_million_stars_are_drawn_as_counts():
    rng = np.random.default_rng(1)
    n = 1_000_000
    sigma = rng.uniform(0.01, 0.1, n)
    residual = rng.normal(size=(n, 2)) * sigma[:, None]
    curve = MixtureCurve(sigma)
    mag = rng.uniform(10, 20, n)
    with figure_style():
        bars = _histograms(residual, (curve, curve), unit="pix", sampled=False, rows="stars")
        hexagons = _density(mag, residual, unit="pix", errors=None, shown="stars")
    for ax in bars.axes[2:]:  # all stars of u, and of v
        (counts,) = [patch.get_data().values for patch in ax.patches]
        assert counts.sum() == n and counts.size < 200
    for ax in hexagons.axes[:2]:
        (cells,) = ax.collections
        title = ax.get_title(loc="left").replace("\u202f", "")
        outside = int(re.match(r"[uv]: (\d+) of 1000000 ", title)[1])
        assert cells.get_array().sum() == n - outside and outside < 1e-3 * n
        assert len(cells.get_array()) < 10_000


def test_every_star_of_a_histogram_is_counted(converged, figures):
    fig = figures["residual_histogram"]
    bars = fig.axes[2].patches[0]  # all stars of u
    assert bars.get_data().values.sum() == converged.diagnostics.sample.n_total == 6000


def test_residuals_are_the_data_minus_the_model(converged):
    """By the model's own prediction, which takes another way than the passes over the data."""
    t = converged.diagnostics.sample.table
    where = {"exposure": t.exposure, "epoch": t.epoch}
    for solution, found in (
        (converged.fit, converged.diagnostics.sample.fit_residual),
        (converged.posterior, converged.diagnostics.sample.residual),
    ):
        model = solution.model.predict(solution.mean, t.x, t.y, **where)
        np.testing.assert_allclose(found, np.column_stack([t.u, t.v]) - model, atol=1e-9)


def test_figures_of_some_stars_say_so_and_show_no_others():
    run = report_run(shown=1500)
    assert run.diagnostics.sample.partial and len(run.diagnostics.sample) == 1500
    figs = figures_of(run, "residual_histogram", "residuals_by_magnitude")
    histogram = figs["residual_histogram"]
    bars, curve = histogram.axes[2].patches[0].get_data(), histogram.axes[2].lines[0]
    assert bars.values.sum() == 1500
    # bars and curve count the same stars
    assert curve.get_ydata().sum() == pytest.approx(1500, rel=0.01)
    for name, figure in figs.items():
        labels = [ax.get_ylabel() + ax.get_title() for ax in figure.axes]
        assert any("sample" in label for label in labels), name


def test_correlations_are_those_of_the_draws(converged):
    post = converged.posterior
    a, b = post.model.names.index("u_2_0"), post.model.names.index("v_1_3")
    theta = post.theta.copy()
    theta[..., b] = -3.0 * theta[..., a]
    names, matrix = correlation_matrix(replace(post, theta=theta))
    k = [names.index("u_2_0"), names.index("v_1_3")]
    np.testing.assert_allclose(matrix[np.ix_(k, k)], [[1, -1], [-1, 1]], atol=1e-9)
    assert not any(p.kind == "frame" and p.name in names for p in post.model.parameters)


def test_an_ensemble_that_is_off_has_the_high_ranks():
    draws = np.array([[0.1, 0.3, 0.2, 0.0], [9.0, 8.0, 7.0, 6.0]])
    np.testing.assert_array_equal(rank_counts(draws, 2), [[4, 0], [0, 4]])
    np.testing.assert_array_equal(rank_counts(draws, 4), [[2, 2, 0, 0], [0, 0, 2, 2]])


def test_ranks_are_of_the_parameters_with_fewest_effective_draws(converged):
    post = converged.posterior
    ess = np.array([*post.convergence.ess_bulk])
    ess[post.model.names.index("v_0_3")] = 1.0
    changed = replace(post, convergence=replace(post.convergence, ess_bulk=ess))
    assert slowest_parameters(changed)[0] == "v_0_3"


@pytest.mark.parametrize(("value", "expected"), [
    (1.0, 1.0), (0.0499, 0.02), (5.0, 5.0), (999.0, 500.0), (2e-7, 2e-7), (0.0, 1.0), (np.inf, 1.0),
])  # fmt: skip
def test_round_numbers_below(value, expected):
    assert nice_below(value) == expected


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    with pytest.raises(InputError, match="file"):
        save_figures({}, blocked / "figures")


@pytest.mark.parametrize(("low", "high"), [(0.0077, 1.65), (0.00041, 0.0297), (3.0, 100.0)])
def test_levels_of_values_that_differ_by_far_are_1_2_5_10(low, high):
    levels = contour_levels([low, high])
    assert levels[0] <= low < levels[1] and levels[-2] < high <= levels[-1]
    leading = levels / 10 ** np.floor(np.log10(levels) + 1e-9)
    assert set(np.round(leading, 6)) <= {1.0, 2.0, 5.0}
    even = np.diff(contour_levels([low, 10 * low]))
    np.testing.assert_allclose(even, even[0])


@pytest.mark.parametrize(("low", "high"), [(2e-3, 1.1e-2), (1e-4, 3e-4), (3e-6, 0.4), (1.0, 1.6)])
def test_levels_of_errors_are_logarithmic_and_many(low, high):
    levels = error_levels([low, high])
    assert levels[0] <= low and levels[-1] >= high
    assert ((levels > low) & (levels < high)).sum() >= 7
    steps = np.log(levels[1:] / levels[:-1])
    assert steps.min() > 0 and steps.max() < 2.5 * steps.min()


@pytest.mark.parametrize("n", [5, 13, 17, 33, 65])
def test_at_most_thirteen_crosses_stand_on_an_axis(converged, n):
    x = np.linspace(1.0, 1016.0, n)
    values = np.ones((n, n))
    m = replace(converged.evaluation.formal[0], x=x, y=x, sigma_u=values, sigma_v=values)
    rows, columns = square_cells(m.x, m.y, sparse_step([m]))
    shown = x[columns]
    assert len(x[rows]) == len(shown) <= 13
    assert shown[0] == 1.0 and shown[-1] == 1016.0  # corners, where errors are largest


def test_contours_end_where_a_field_ends():
    """A map of a round field: contours within half a step of it, and over nearly all of it."""
    x = np.linspace(1.0, 1000.0, 33)
    X, Y = np.meshgrid(x, x)
    far = np.hypot(X - 500, Y - 500)
    values = np.where(far <= 400, 1.0 + (far / 400) ** 2, np.nan)
    ax = Figure().subplots()
    drawn = draw_grid(ax, Grid(x, x, values), levels=error_levels(values))
    corners = np.concatenate([path.vertices for path in drawn.get_paths() if len(path.vertices)])
    reach = np.hypot(*(corners - 500).T)
    assert 370 < reach.max() < 400 + 999 / 32
