"""Matches of rolled exposures of two chips that drift, brought to one exposure at one date."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.errors import InputError
from bayesdist.infer import fit_linear
from bayesdist.infer.compare.order import in_one_frame
from bayesdist.infer.solution.transforms import without_frames
from bayesdist.model import DistortionModel, TimeDependence
from bayesdist.simulate import simulate_matches

from ..support import TWO_CHIPS, truth_of

NAMES = ("a", "b", "c")


@pytest.fixture(scope="module")
def rolled():
    """A fit of exposures whose frames are rolled and shifted, and its matches."""
    rng = np.random.default_rng(8)
    time = TimeDependence((("u", 1, 0), ("v", 0, 1)), (2010.0,))
    model = DistortionModel(2, TWO_CHIPS, frames="shift_rotation", exposures=NAMES, time=time)
    theta = truth_of(model, rng)
    for code in (1, 2):
        theta[model.frame_slice(code)] = [3.0 * code, -5.0, 0.9 * code]
    epochs = np.array([2009.0, 2011.0, 2014.0])
    matches, _ = simulate_matches(
        model, theta, 3000, rng=rng, fraction=0.0, sigma=0.03, epochs=epochs
    )
    return fit_linear(matches, model), matches


def test_residuals_keep_their_lengths(rolled):
    """A roll turns residuals, and those of one chip are about the polynomials at epoch0."""
    fit, matches = rolled
    bare = without_frames(fit)
    for chip in (1, 2):
        mine = matches.select(matches.chip_number == chip)
        found = in_one_frame(fit, matches, chip)
        assert len(found) == len(mine) and not found.has_epoch and len(found.exposures) == 1
        seen = fit.model.predict(
            fit.mean, mine.x, mine.y, exposure=mine.exposure, chip=chip, epoch=mine.epoch
        )
        alone = bare.model.predict(bare.mean, found.x, found.y, chip=chip, epoch=2010.0)
        before = np.stack([mine.u, mine.v], 1) - seen
        after = np.stack([found.u, found.v], 1) - alone
        np.testing.assert_allclose(np.hypot(*after.T), np.hypot(*before.T), atol=1e-9)
        # equal errors along both axes are so along all
        np.testing.assert_allclose([found.sigma_u, found.sigma_v], 0.03, rtol=1e-12)
        first = mine.exposure == 0
        np.testing.assert_allclose(after[first], before[first], atol=1e-9)


def test_matches_without_errors_are_refused(rolled):
    fit, matches = rolled
    with pytest.raises(InputError, match="no column 'sigma_u'"):
        in_one_frame(fit, matches.with_columns(sigma_u=None, sigma_v=None), 1)


def test_the_order_of_rolled_exposures_is_that_of_the_polynomials(rolled):
    """Positions of the brought matches are fitted by the polynomials as one exposure's."""
    fit, matches = rolled
    found = in_one_frame(fit, matches, 2)
    one = next(chip for chip in TWO_CHIPS if chip.number == 2)
    alone = fit_linear(found, DistortionModel(2, (one,)))
    bare = without_frames(fit)
    x, y = np.array([10.0, 400.0]), np.array([20.0, 300.0])
    expected = bare.model.predict(bare.mean, x, y, chip=2, epoch=2010.0)
    np.testing.assert_allclose(alone.model.predict(alone.mean, x, y), expected, atol=4 * 0.03)
