import numpy as np
import pytest

from bayesdist.assess.terms.given import centroid_errors
from bayesdist.data import Matches
from bayesdist.diagnose.residuals.stars import StarSample, centroid_scatter
from bayesdist.errors import InputError


def sample(n=20_000, *, seed=1, catalogue=0.015, false=0.03, with_mag=True):
    """Centroid errors 0.01 px at magnitude 14, doubling every two; a catalogue error beside."""
    rng = np.random.default_rng(seed)
    mag = rng.uniform(14, 20, n)
    centroid = 0.01 * 2 ** ((mag - 14) / 2)
    residual = rng.standard_normal((n, 2)) * np.hypot(centroid, catalogue)[:, None]
    wrong = rng.uniform(size=n) < false
    residual[wrong] = rng.uniform(-1, 1, (wrong.sum(), 2))
    table = Matches(
        x=np.arange(1.0, n + 1), y=np.ones(n), u=np.zeros(n), v=np.zeros(n), unit="pix",
        mag=mag if with_mag else None,
    )  # fmt: skip
    variance = np.repeat(centroid[:, None] ** 2, 2, axis=1)
    doubted = np.where(wrong, 0.99, 0.01)
    return StarSample(table, residual, ~wrong, n, variance, residual, doubted)


def test_what_is_known_to_be_in_the_residuals_is_taken_off():
    found = centroid_errors(centroid_scatter(sample()), [("catalogue", 0.015, 0.015)])
    at = np.array([15.0, 17.0, 19.0])
    # 800 stars in a bin: scatter to 4 %, of which the catalogue is half at first
    for sigma in found.at(at):
        assert sigma == pytest.approx(0.01 * 2 ** ((at - 14) / 2), rel=0.15)
    assert (centroid_scatter(sample()).at(at)[0] > 1.1 * found.at(at)[0])[:2].all()


def test_without_magnitudes_nothing_is_said():
    assert centroid_scatter(sample(with_mag=False)) is None
    assert centroid_scatter(sample(n=30)) is None


def test_errors_that_are_larger_than_the_residuals_cannot_be_in_them():
    with pytest.raises(InputError, match="declared part of residuals that scatter by"):
        centroid_errors(centroid_scatter(sample()), [("catalogue", 0.3, 0.3)])
