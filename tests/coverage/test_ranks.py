"""Simulation-based calibration of whole runs: with truths from the priors all ranks are even."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayesdist.diagnose.correlated import DiscrepancyPriors
from tests.adversarial import fields
from tests.adversarial.truth import SIGMA
from tests.infer.oracle import star_terms
from tests.reduced import case_in_full, only_in_full

from .ranks import half_t, log_likelihood, structure
from .runs import EXPOSURES, all_ranks
from .summary import evenness, farthest, simultaneous_band

pytestmark = pytest.mark.slow

SURE = 0.999  # that ranks which are even are not taken for uneven, over all quantities


COEFFICIENTS, POSITIONS, STATISTICS, AMPLITUDES, MIXTURE = 20, 10, 3, 2, 3
QUANTITIES = {
    # and the likelihood; of several exposures the sizes of what each has by itself
    1: COEFFICIENTS + POSITIONS + STATISTICS + AMPLITUDES + MIXTURE + 1,
    EXPOSURES: COEFFICIENTS + POSITIONS + STATISTICS + AMPLITUDES + 3,
}


@pytest.mark.parametrize(
    "exposures", [1, case_in_full(EXPOSURES, instead="one exposure has nearly all quantities")]
)
def test_ranks_are_even(exposures, full, capsys):
    found = all_ranks(full=full, exposures=exposures)
    n, quantities = len(next(iter(found.values()))), len(found)
    most = simultaneous_band(n, 1 - (1 - SURE) / quantities)
    far = {name: farthest(ranks) for name, ranks in found.items()}
    chance = {name: evenness(ranks) for name, ranks in found.items()}
    with capsys.disabled():
        worst, least = max(far, key=far.__getitem__), min(chance, key=chance.__getitem__)
        print(
            f"\n{n} truths, {quantities} quantities: {worst} is farthest from even, "
            f"{far[worst]:.2f}, of {most:.2f}; least chi-square p {chance[least]:.4f}, of {least}"
        )
    assert quantities == QUANTITIES[exposures]
    assert max(far.values()) < most, far
    if full:  # of a few truths bins say nothing
        assert min(chance.values()) > (1 - SURE) / quantities, chance


def test_the_likelihood_is_that_of_the_mixture(rng):
    residual = 0.1 * rng.standard_normal((50, 2))
    variance = np.full(50, SIGMA**2)
    exact = star_terms("gaussian", residual, variance, variance, j=0.01, f=0.2, s_out=0.3)
    assert log_likelihood(residual, 0.2, 0.01, 0.3) == pytest.approx(exact.loglik.sum())
    several = log_likelihood(
        np.stack([residual] * 2), *(np.array([a] * 2) for a in (0.2, 0.01, 0.3))
    )
    assert several == pytest.approx([exact.loglik.sum()] * 2)


def test_the_likelihood_sees_errors_that_ignore_the_data(rng):
    """Draws from the prior have even ranks in the parameter (Modrak et al. 2023)."""
    n, draws, data = 200, 400, 8
    theta = rng.standard_normal(n)
    seen = theta[:, None] + rng.standard_normal((n, data))

    def uneven(drawn: np.ndarray) -> tuple[float, float]:
        """Chi-square probabilities of the ranks of parameter and likelihood; drawn (n, draws)."""

        def fit(theta: np.ndarray) -> np.ndarray:
            return -((seen[:, :, None] - theta[:, None]) ** 2).sum(axis=1)

        return (
            evenness(np.mean(drawn < theta[:, None], axis=1)),
            evenness(np.mean(fit(drawn) < fit(theta[:, None]), axis=1)),
        )

    right = seen.sum(axis=1) / (data + 1)  # normal with the precision of prior and data
    right = right[:, None] + rng.standard_normal((n, draws)) / np.sqrt(data + 1)
    assert min(uneven(right)) > 1e-3
    of_parameter, of_likelihood = uneven(rng.standard_normal((n, draws)))
    assert of_parameter > 1e-3 and of_likelihood < 1e-9


def test_amplitudes_are_those_of_what_is_drawn(rng):
    drawn = structure(rng)
    x, y = fields.even_pixels(12)
    terms, field = (drawn.amplitudes()[name] for name in ("higher orders", "field"))
    T = drawn.functions.n_terms
    bare = replace(
        drawn, coefficients=drawn.coefficients * (np.arange(drawn.coefficients.shape[-1]) < T)
    )
    assert terms == pytest.approx(np.sqrt(np.mean(bare.values(x, y) ** 2)))
    rest = drawn.values(x, y) - bare.values(x, y)
    assert field == pytest.approx(np.sqrt(np.mean(rest**2)))


def test_ranks_that_are_not_even_are_seen(rng):
    """Errors that are stated a fifth too small, with as many truths as the full suite has."""
    from scipy.stats import norm

    ranks = norm.cdf(1.25 * rng.standard_normal((40, 200)))
    seen = [farthest(r) > simultaneous_band(200, 0.95) for r in ranks]
    assert np.mean(seen) > 0.6
    even = [farthest(r) > simultaneous_band(200, 0.95) for r in rng.uniform(size=(400, 200))]
    assert 0.02 < np.mean(even) < 0.09


@only_in_full("ranks have it among their quantities")
def test_structure_has_the_size_of_its_prior(rng):
    """Half of the fields are smaller than the medians of the priors say together, or about so."""
    line = np.linspace(100, 1950, 12)
    x, y = np.meshgrid(line, line)
    rms = [np.sqrt(np.mean(structure(rng).values(x.ravel(), y.ravel()) ** 2)) for _ in range(60)]
    priors = DiscrepancyPriors()
    assert priors.structure < np.median(rms) < 10 * priors.higher_order
    drawn = [half_t(rng, 1.0, 1e9) for _ in range(2000)]
    # half of them are below the median, within 4 sigma
    assert np.mean(np.array(drawn) < 1.0) == pytest.approx(0.5, abs=4 * 0.5 / np.sqrt(2000))
