"""The section on change with time: vectors as drawn, tables as computed."""

from __future__ import annotations

import numpy as np
import pytest
from lxml import html as lxml_html
from matplotlib.colors import to_hex
from matplotlib.quiver import Quiver

from bayesdist.data import Matches
from bayesdist.diagnose.periods import PeriodSettings, time_variation
from bayesdist.infer import fit_linear
from bayesdist.infer.compare.order import select_order
from bayesdist.model import Chip, DistortionModel
from bayesdist.report.figures.commands import order_comparison
from bayesdist.report.figures.style import INK, PALE
from bayesdist.report.run_report import render_report
from bayesdist.report.sections.periods import period_tables

from .plots import plot_of
from .runs import report_run

SIZE = (1000.0, 800.0)
MODEL = DistortionModel(2, (Chip(1, "A", SIZE, (500.5, 400.5)),))
SPANS = {"55212.5": (2010.0, 2010.1), "55262.5": (2010.2, 2010.3), "55312.5": (2010.4, 2010.5)}


@pytest.fixture(scope="module")
def pairs():
    """In the last period pairs move along v: not at the left edge, by 0.04 px at the right one."""
    rng = np.random.default_rng(4)
    n = 6000
    x, y = (rng.uniform(0.5, s + 0.5, n) for s in SIZE)
    period = rng.integers(3, size=n)
    v = y + 0.02 * (1 + (2 * x - 1 - SIZE[0]) / SIZE[0]) * (period == 2)
    noise = 0.05 * rng.standard_normal((2, n))
    epoch = np.array([s[0] for s in SPANS.values()])[period] + 0.05
    sigma = np.full(n, 0.05)
    return Matches(x, y, x + noise[0], v + noise[1], sigma_u=sigma, sigma_v=sigma, epoch=epoch)


@pytest.fixture(scope="module")
def found(pairs):
    fit = fit_linear(pairs, MODEL)
    settings = PeriodSettings(SPANS, bins=8, tolerance=0.5)
    return time_variation(fit, pairs, settings, rng=np.random.default_rng(1))


def designed(x, y):
    X, Y = ((2 * z - 1 - n) / n for z, n in zip((x, y), SIZE, strict=True))
    return np.stack([X**i * Y**j for i, j in MODEL.basis().terms], axis=1)


def test_vectors_are_the_difference_of_the_two_models(found, pairs):
    """Dark where both axes together are beyond 2 sigma, by the covariance of two separate fits."""
    cov = 0
    for start, stop in (SPANS["55212.5"], SPANS["55312.5"]):
        inside = (pairs.epoch >= start) & (pairs.epoch < stop)
        A = designed(pairs.x[inside], pairs.y[inside])
        cov = cov + (0.05 * found.comparison.error_scale) ** 2 * np.linalg.inv(A.T @ A)
    figure = plot_of(report_run(size=SIZE).having(periods=found), "period_differences").figure
    drawn = [one for ax in figure.axes for one in ax.collections if isinstance(one, Quiver)]
    late, early = (found.comparison.means[k] for k in (2, 0))
    colors = set()
    for one in drawn:
        x, y = one.X, one.Y
        expected = MODEL.predict(late, x, y) - MODEL.predict(early, x, y)
        np.testing.assert_allclose(np.column_stack([one.U, one.V]), expected, atol=1e-9)
        colors.add(to_hex(one.get_facecolor()[0]).upper())
        phi = designed(x, y)
        z2 = (expected**2).sum(axis=1) / np.einsum("nk,kl,nl->n", phi, cov, phi)
        dark = to_hex(one.get_facecolor()[0]).upper() == INK.upper()
        # 4.55 % of the noise of one axis, and of two, are beyond
        assert ((z2 > -2 * np.log(0.0455)) == dark).all()
    assert colors == {PALE.upper(), INK.upper()}
    assert sum(one.N for one in drawn) == 17 * 14
    title = figure.axes[0].get_title(loc="left")
    assert title.startswith("MJD 55312.5 − 55212.5")


def test_the_section_has_what_was_found(converged, drawings, found):
    inputs = converged.having(periods=found)
    tables = period_tables(inputs)
    assert [t.caption.split(":")[0] for t in tables] == [
        "Does the distortion change?",
        "Models of the periods against the combined model",
        "Legendre coefficients",
        "Mean residuals of bins about the one model of all data [pix]",
        "Patterns of the residuals",
    ]
    assert [row[0] for row in tables[1].rows] == [*SPANS, "55312.5 against 55212.5"]
    assert tables[0].rows[0][1] == found.verdict and found.significant and not found.is_material
    names = [row[k] for k in (0, 5) for row in tables[2].rows]
    assert names == list(MODEL.names)
    page = lxml_html.fromstring(render_report(inputs, drawings))
    sections = page.xpath("//section/@id")
    assert sections.index("periods") == sections.index("maps") + 1
    assert [h[1:] for h in page.xpath("//nav//a/@href")] == sections[1:]
    caption = plot_of(inputs, "period_differences")
    assert f"({found.ends.at[0]:.0f}, {found.ends.at[1]:.0f})" in caption.text


def test_orders_are_drawn_as_they_were_found(pairs):
    chosen = select_order(pairs, MODEL, orders=(1, 2, 3), bins=12, regions=4, folds=20)
    left, right = order_comparison(chosen).axes
    by = {line.get_label(): line.get_ydata() for line in left.lines}
    np.testing.assert_allclose(by["u"], chosen.surfaces.rms[:, 0])
    np.testing.assert_allclose(by["v"], chosen.surfaces.rms[:, 1])
    stars = right.containers[0].lines[0].get_ydata()
    k = chosen.orders.index(chosen.order)
    each = chosen.stars.log_density.sum(axis=(0, 2))
    np.testing.assert_allclose(stars, each - each[k], atol=1e-9)
