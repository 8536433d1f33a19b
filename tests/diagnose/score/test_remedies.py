"""What the tests of shape and match radius advise is done, and the run after it is right."""

from __future__ import annotations

import re

import numpy as np
import pytest

import bayesdist as bd
from bayesdist.assess.statistics import field_statistic
from bayesdist.model.grid import grid_pixels, mesh
from tests.reduced import only_in_full

from .shaped import CHIP, SIDE, SIGMA, direction, matches_of, nominal_within, scene, tail, true_map

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]

GRID = (9, 9)
WRONG = ("raise model.order", "scale_mas", "too small", "depend on position")


class Carried:
    """A posterior with its diagnostics, and its actual errors in an exposure."""

    def __init__(self, matches, outliers=None, frames="none", exposure=None):
        model = bd.build_model(matches, order=3, size=(SIDE, SIDE), name=CHIP.name, frames=frames)
        fit = bd.fit_linear(matches, model)
        self.posterior = bd.sample(fit, matches, outliers=outliers, seed=1, target_ess=400)
        self.diagnostics = bd.diagnose(self.posterior, matches, fit=fit, rng=1)
        x, y = mesh(*grid_pixels(CHIP.size, GRID))
        code = None
        if exposure is not None:
            code = np.full(x.size, model.exposures.index(exposure))
        predicted = model.predict(self.posterior.mean, x, y, exposure=code)
        self.error = np.asarray(predicted) - true_map(x, y)

    @property
    def p95(self) -> float:
        return float(field_statistic("p95", self.error))

    def verdict(self, limit: float) -> str:
        requirement = bd.Requirement("limit", "p95", limit)
        [margin] = bd.check_requirements(
            self.posterior,
            [requirement],
            diagnostics=self.diagnostics,
            catalogue=bd.Catalogue("simulated", 0.0, "pix", "it is the truth"),
            rng=1,
        )
        return margin.verdict

    def advice(self) -> str:
        """What the findings that keep verdicts open say."""
        return "; ".join(check.sentence for check in self.diagnostics.checks if check.doubt)

    def assert_doubted(self, *words: str) -> None:
        assert self.p95 > 3 * ideal(len(self.diagnostics.sample.table))
        assert self.verdict(0.9 * self.p95) != "met"
        advice = self.advice()
        assert all(word in advice for word in words), advice
        assert not any(word in advice for word in WRONG), advice

    def assert_right(self, n: int) -> None:
        assert not self.advice()
        self.assert_covers(n)
        assert self.verdict(8 * ideal(n)) == "met"

    def assert_covers(self, n: int) -> None:
        budget = bd.error_budget(self.posterior, diagnostics=self.diagnostics, grid=GRID, rng=1)
        z = self.error / np.column_stack([budget.total.u, budget.total.v])
        # of some ten independent parameters on each axis
        assert np.mean(z**2) < 3
        assert np.mean(np.abs(z) < 2) > 0.8
        assert self.p95 < 5 * ideal(n)


def ideal(n: int) -> float:
    """Rms error of both axes together, of ten parameters on each, by n stars."""
    return SIGMA * np.sqrt(2 * 10 / n)


def test_visits_that_are_labelled_have_frames():
    rng = np.random.default_rng(1)
    x, y = rng.uniform(0.5, SIDE + 0.5, (2, 2500))
    second = rng.uniform(size=2500) < np.where(x > 1100, 0.6, 0.05)
    uv = true_map(x, y) + SIGMA * rng.standard_normal((2500, 2))
    uv += second[:, None] * 0.12 * direction(rng)
    Carried(matches_of(x, y, uv)).assert_doubted("without a label", "give the exposure")
    labelled = matches_of(
        x, y, uv, exposure=second.astype(np.int64), exposure_names=("first", "second")
    )
    Carried(labelled, frames="shift_rotation", exposure="first").assert_right(2500)


def test_blends_that_are_cut():
    """Displaced to one side, more of them towards one edge, and known by their shape."""
    rng = np.random.default_rng(2)
    state = rng.bit_generator.state
    matches = scene(rng, 4000, tail(0.08, 0.6), false=0.02)
    Carried(matches).assert_doubted("blends", "cut the stars that are displaced")
    rng.bit_generator.state = state
    alone = scene(rng, 4000, None, false=0.0)
    blended = np.abs(matches.u - alone.u) + np.abs(matches.v - alone.v) > 1e-9
    Carried(matches.select(~blended)).assert_right(int((~blended).sum()))


@only_in_full("the other remedies are followed in the same way")
def test_a_match_radius_that_is_corrected():
    """Errors cover; structure in the mean residuals, which the circle cuts, is still doubted."""
    matches, _ = nominal_within(np.random.default_rng(3), 5000, 0.06, off=0.03, false=0.05)
    before = Carried(matches, bd.OutlierMixture("uniform", match_radius=0.25))
    before.assert_doubted("state outliers.match_radius = 0.06")
    radius = float(re.search(r"match_radius = ([\d.]+\d)", before.advice()).group(1))
    after = Carried(matches, bd.OutlierMixture("uniform", match_radius=radius))
    after.assert_covers(4000)
    assert "match radius" not in after.advice() and "lopsided" not in after.advice()
