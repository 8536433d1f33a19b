"""Exposures by themselves: their linear terms, in one gauge whatever the roll."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer import fit_linear
from bayesdist.infer.exposures.alone import fit_exposures
from bayesdist.infer.solution.transforms import LINEAR_TERMS, linear_terms, reference_gauge

from ..small_campaign import campaign, seen_by

pytestmark = pytest.mark.usefixtures("one_thread")

FREE = (
    *(f"WFC1.{term}" for term in LINEAR_TERMS),
    *(f"WFC2.{term}" for term in ("A_2", "B_2", "B_3")),
)


def truth_of(model, theta, exposure, epoch, *labels):
    """Linear terms of one exposure, from its true parameters."""
    view = reference_gauge(seen_by(exposure, epoch, model, theta))
    return linear_terms(view).select(*labels).values


def true_series(model, theta, found, *labels):
    return np.array(
        [
            truth_of(model, theta, name, t, *labels)
            for name, t in zip(found.names, found.epoch, strict=True)
        ]
    )


@pytest.fixture(scope="module")
def some():
    model, matches, theta = campaign(1, 40, 300)
    return model, matches, theta, fit_exposures(matches, model)


def test_linear_terms_are_those_of_the_truth_within_their_covariance(some):
    model, _, theta, found = some
    assert len(found) == 40 and found.names == model.exposures and not found.skipped
    _, values, cov = found.series(*FREE)
    d = values - true_series(model, theta, found, *FREE)
    chi2 = np.einsum("ek,ekl,el->e", d, np.linalg.inv(cov), d)
    assert stats.kstest(chi2, stats.chi2(len(FREE)).cdf).pvalue > 1e-3
    # the telescope's roll and pointing are known to the gauge, whatever they are
    names = [f"{name}.rotation" for name in model.exposures[1:]]
    roll = np.array([theta[model.names.index(name)] for name in names])
    gauges = [view.gauge for view in found.views]
    turned = np.array([g.rotation for g in gauges[1:]])
    assert np.cos(roll + turned).min() > 1 - 1e-9
    assert gauges[0].shift[0] == pytest.approx(5000.0, abs=0.05)
    assert gauges[0].rotation == pytest.approx(-0.4, abs=1e-4)


def test_what_the_gauge_fixes_is_zero_without_error(some):
    found = some[3]
    _, values, cov = found.series("WFC2.A_1", "WFC2.B_1", "WFC2.A_3")
    np.testing.assert_allclose(values, 0, atol=1e-8)
    np.testing.assert_allclose(cov, 0, atol=1e-12)
    size = np.sqrt(found.series("WFC2.A_2")[2][0, 0, 0])
    # 150 evenly spread stars on a chip of 4096 px: the derivatives of P_1, P_3 and P_1 P_2 at the
    # centre are 1, -3/2 and -1/2, and their coefficients have variances 3, 7 and 15 (over n)
    expected = 0.02 / np.sqrt(150) / 2048 * np.sqrt(3 + 7 * 2.25 + 15 * 0.25)
    assert size == pytest.approx(expected, rel=0.2)


def test_a_rotated_catalogue_changes_nothing_but_the_gauge():
    """The reference gauge forgets where the catalogue's axes point."""
    model, matches, _ = campaign(2, 3, 400)
    c, s = np.cos(1.1), np.sin(1.1)
    turned = matches.with_columns(
        u=c * matches.u - s * matches.v + 77.0, v=s * matches.u + c * matches.v - 9.0
    )
    first, second = (fit_exposures(m, model) for m in (matches, turned))
    (_, a, cov), (_, b, turned_cov) = (found.series(*FREE) for found in (first, second))
    sigma = np.sqrt(np.einsum("ekk->ek", cov))
    np.testing.assert_allclose((b - a) / sigma, 0, atol=1e-3)
    unit = sigma[:, :, None] * sigma[:, None, :]
    np.testing.assert_allclose(turned_cov / unit, cov / unit, atol=1e-4)
    for a, b in zip(first.views, second.views, strict=True):
        assert np.cos(a.gauge.rotation - b.gauge.rotation - 1.1) == pytest.approx(1, abs=1e-12)


def test_each_is_the_fit_of_its_own_stars(some):
    model, matches, _, found = some
    one = matches.select(matches.exposure == 7)
    alone = replace(
        model, frames="none", time=None, exposures=("1",), gauge="first", held=(0.0, 0.0, 0.0)
    )
    fit = fit_linear(one, alone)
    view = reference_gauge(fit)
    np.testing.assert_allclose(found.views[7].mean, view.mean, atol=1e-12)
    assert found.epoch[7] == one.epoch[0]


# -- what cannot be fitted ------------------------------------------------------------------------


def test_an_exposure_without_stars_on_a_chip_is_left_out(some):
    model, matches, _, _ = some
    first = matches.select(matches.exposure < 3)
    part = first.select(~((first.exposure == 1) & (first.chip == 0)))
    found = fit_exposures(part, model)
    assert found.names == ("j001", "j003") and set(found.skipped) == {"j002"}
    assert "no star" in found.skipped["j002"]
    with pytest.raises(DegenerateError, match=r"none of 1 exposures .* no star lies on this chip"):
        fit_exposures(part.select(part.exposure == 1), model)


def test_an_exposure_with_fewer_stars_than_terms_is_named():
    model, matches, _ = campaign(3, 60, 36, order=5, time=False)  # 18 stars, 21 terms
    message = r"none of 60 exposures .* 1\d stars lie on this chip"
    with pytest.raises(DegenerateError, match=message):
        fit_exposures(matches, model)


def test_an_exposure_with_stars_in_a_corner_is_left_out(some):
    model, matches, _, _ = some
    first = matches.select(matches.exposure < 2)
    keep = (first.exposure == 0) | (first.chip == 0) | ((first.x < 1500) & (first.y < 900))
    found = fit_exposures(first.select(keep), replace(model, order=1))
    assert found.names == ("j001",) and "the stars lie within" in found.skipped["j002"]


def test_epochs_are_needed(some):
    model, matches, _, _ = some
    with pytest.raises(InputError, match="epoch of every exposure"):
        fit_exposures(matches.with_columns(epoch=None), model)
