"""Figures and tables of several bands, on numbers made here."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.quiver import Quiver

from bayesdist.assess import UncertaintyMap, VectorMap
from bayesdist.missions.wise.assess.distortion_field import histogram
from bayesdist.missions.wise.assess.residual_tables import printed_rows
from bayesdist.missions.wise.bands.figures import (
    CASES,
    alignment,
    formal_uncertainty,
    histograms,
    residuals,
    vectors,
)
from bayesdist.missions.wise.bands.findings import as_printed, verdict


def page_of(*bands, **more) -> SimpleNamespace:
    """As much of a page's input as one figure looks at."""
    return SimpleNamespace(bands=bands, n_bins=9, optical="", **{"wise": False} | more)


def flow(n: float, length: float) -> VectorMap:
    x = np.linspace(1, n, 33)
    X, Y = np.meshgrid(x, x)
    du = length * (2 * X - n - 1) / (n - 1)  # as long at the edge in whatever pixels
    return VectorMap(x, x, du, 0.5 * du * np.sign(Y), "pix", "no_constant")


def arrows(ax) -> Quiver:
    [one] = [c for c in ax.collections if isinstance(c, Quiver)]
    return one


def test_all_bands_are_drawn_to_one_scale_in_arcsec():
    """Bands of one field in pixels of different size: equal vectors look equal."""
    bands = {"A": flow(1000, 4.0), "B": flow(500, 2.0)}
    one, two = (
        SimpleNamespace(name=name, vectors=v, arcsec=size)
        for (name, v), size in zip(bands.items(), (2.75, 5.5), strict=True)
    )
    fig = vectors(page_of(one, two, wise=True)).figure
    drawn = []
    for ax, (name, n) in zip(fig.axes, (("A", 1000), ("B", 500)), strict=True):
        q = arrows(ax)
        step = np.diff(np.unique(q.X))[0]
        longest = np.hypot(q.U, q.V).max() / q.scale
        assert 0.5 * step < longest <= 1.5 * step  # seen, and hardly beyond its neighbour
        reach = np.ptp(ax.get_xlim())
        drawn.append(np.max(np.abs(q.U)) / q.scale / reach)
        title = ax.get_title(loc="left")
        largest = bands[name].length_max
        assert f"Max = {largest:.4g} pix" in title and title.startswith(name)
        assert reach / n == pytest.approx(np.ptp(fig.axes[0].get_xlim()) / 1000)
    assert drawn[0] == pytest.approx(drawn[1], rel=1e-9)


def test_every_second_vector_is_drawn_with_its_corners():
    band = SimpleNamespace(name="A", vectors=flow(1000, 4.0), arcsec=2.75)
    fig = vectors(page_of(band)).figure
    q = arrows(fig.axes[0])
    assert len(q.X) == 17**2 and set(q.X) >= {1.0, 1000.0}


@pytest.mark.parametrize(("sigma", "factor"), [(0.0093 / np.sqrt(2), 2000), (2.5e-4, None)])
def test_crosses_have_the_magnification_they_state(sigma, factor):
    x = np.linspace(1, 1016, 33)
    s = np.full((33, 33), sigma)
    m = UncertaintyMap(x, x, s, 2 * s, 0 * s, "pix", 1, None, "least squares")
    fig = formal_uncertainty(page_of(SimpleNamespace(name="A", formal_map=m))).figure
    ax = fig.axes[0]
    [stated] = [t.get_text() for t in ax.texts if "drawn" in t.get_text()]
    M = float(stated.split("×")[-1].replace("\u202f", "").strip())
    if factor is not None:
        assert factor == M  # as section 6 of WSDC D-T033
    [crosses] = [c for c in ax.collections if hasattr(c, "get_segments")]
    ends = np.array([np.diff(s, axis=0)[0] for s in crosses.get_segments()])
    np.testing.assert_allclose(np.abs(ends), M * np.array([[sigma, 2 * sigma]] * len(ends)))
    assert {tuple(np.sign(e)) for e in ends} == {(1, 1), (-1, 1), (-1, -1), (1, -1)}
    radius = np.hypot(sigma, 2 * sigma)
    assert ax.get_title(loc="left").endswith(f"max radius {radius:.3g}\u202fpix")


@pytest.mark.parametrize(
    ("converged", "significant", "longer", "level", "words"),
    [
        (True, False, 1.001, "pass", "no structure is found"),
        (True, True, 1.001, "warn", "structure is left in the residuals of W2"),
        (True, False, 1.03, "warn", "differs from the published one in W2"),
        (False, True, 1.03, "fail", "not converged: W2"),
    ],
)
def test_the_worst_band_decides_the_verdict(converged, significant, longer, level, words):
    one, two = (
        SimpleNamespace(
            name=name,
            partition=SimpleNamespace(significant=found),
            correlation=SimpleNamespace(p_value=0.5),
            printed=SimpleNamespace(longest_vector=3.0, longest_vector_here=3.0 * factor),
            posterior_map=SimpleNamespace(radius_max=0.01),
        )
        for name, found, factor in (("W1", False, 1.0), ("W2", significant, longer))
    )
    failed = () if converged else (two,)
    found = verdict(page_of(one, two, provisional=not converged, not_converged=failed))
    assert found.level == level and words.casefold() in found.headline.casefold()
    assert "W1" not in found.headline


class Bins(SimpleNamespace):
    """Means of bins, which another band's can be taken from."""

    def values(self, axis):
        return self

    def scaled(self, factor):
        return self

    def minus(self, other):
        return Bins(mean=self.mean - other.mean)


def test_images_have_one_symmetric_scale_unless_they_are_differences():
    rng = np.random.default_rng(1)
    images = [scale * rng.normal(size=(9, 9)) for scale in (1.0, 3.0, 30.0)]
    one, two, three = (
        SimpleNamespace(name=n, size=(s, s), arcsec=1.0, sums=SimpleNamespace(bins=Bins(mean=i)))
        for n, i, s in zip("ABC", images, (90.0, 45.0, 45.0), strict=True)
    )
    bands = page_of(one, two, three)
    differences = [images[1] - images[0], images[2] - images[0], images[2] - images[1]]
    for figure, shown, sizes, bars in (
        (residuals, images, (90, 45, 45), 1),
        (alignment, differences, (90, 90, 45), 3),
    ):
        fig = figure(bands, "x").figure
        maps = [ax.images[0] for ax in fig.axes if ax.images]
        limits = [m.get_clim() for m in maps]
        assert all(low == -high for low, high in limits)
        assert len(set(limits)) == bars
        for m, image, n in zip(maps, shown, sizes, strict=True):
            np.testing.assert_array_equal(m.get_array(), image)
            assert m.origin == "lower"
            np.testing.assert_allclose(m.get_extent(), [0.5, n + 0.5, 0.5, n + 0.5])
        assert sum("mean residual" in ax.get_ylabel() for ax in fig.axes) == bars


def test_histograms_show_the_counts_of_every_case():
    rng = np.random.default_rng(2)
    cases = {
        c: histogram(w * rng.normal(size=(2, 500)), 4.0, 41)
        for c, w in zip(CASES, (2, 1, 0.3), strict=True)
    }
    bands = [SimpleNamespace(name=n, sums=SimpleNamespace(histograms=cases)) for n in "AB"]
    fig = histograms(page_of(*bands)).figure
    assert len(fig.axes) == 4
    for k, ax in enumerate(fig.axes):
        assert ax.get_yscale() == "log"
        steps = {p.get_label(): p.get_data() for p in ax.patches}
        for case, one in cases.items():
            np.testing.assert_array_equal(steps[case].values, one.counts[k % 2])
            np.testing.assert_allclose(steps[case].edges, one.edges)
        assert len({to_rgb(p.get_edgecolor()) for p in ax.patches}) == 3
    assert fig.axes[-1].get_xlabel() == "residual [pix]"


def test_printed_values_keep_their_digits():
    row = printed_rows("W2/X 0.002548 0.01679 -0.05003 0.0 0.1 -0.1020 12")["W2/X"]
    shown = [as_printed(row, s) for s in ("mean", "sigma", "min", "max", "p01", "p99")]
    assert shown == ["0.002548", "0.01679", "−0.05003", "0.0", "−0.1020", "12"]
