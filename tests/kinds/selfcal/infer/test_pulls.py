"""From detections to coefficients and stars, over many simulated fields: are the errors right?"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from bayesdist.kinds.selfcal.infer import self_calibrate, star_catalogue
from tests.kinds.selfcal.infer.fields import aligned, field, with_ellipses

pytestmark = pytest.mark.slow


def _one(seed, n_exposures, n_stars, rolls, *, tilted=False):
    """Chi-square of the coefficients and frames, and normalised errors of the stars."""
    if tilted:
        simulated = with_ellipses(
            field(seed, n_exposures, n_stars, rolls=rolls, sigma=1e-9), seed, rho=0.9
        )
    else:
        simulated = field(seed, n_exposures, n_stars, rolls=rolls, disturbed=0.025, spurious=0.025)
    K, truth = simulated.model.n_terms, simulated.theta
    start = truth.copy()
    start[3:K] *= 0.9
    start[K + 3 : 2 * K] *= 0.9
    found = self_calibrate(
        simulated.model,
        simulated.unlabelled,
        start,
        match_radius=1.0,
        start_radius=2.0,
        min_detections=3,
    )
    solution, gauge = found.mode, found.gauge
    shift = aligned(solution.theta, truth, gauge) - truth
    chi2 = shift[solution.free] @ solution.precision @ shift[solution.free]
    pulls = shift[solution.free] / np.sqrt(np.diag(np.linalg.inv(solution.precision)))
    return chi2, pulls, _stars(simulated, found)


def _stars(simulated, found):
    """Distances of two stars each from the true ones over their errors, in the own gauge."""
    solution, p = found.mode, found.mode.problem
    catalogue = star_catalogue(solution)
    true = simulated.detections.star[p.rows]
    whose = np.array([np.bincount(t[t >= 0]).argmax() if (t >= 0).any() else -1
                      for t in np.split(true, p.starts[1:-1])])  # fmt: skip
    known = whose >= 0
    off = catalogue.values[known] - simulated.sky[whose[known]]
    # the sky is free by a linear map that the gauge holds: what the stars themselves say of it
    x, y = simulated.sky[whose[known]].T / 1000
    A = np.stack([np.ones_like(x), x, y], axis=1)
    sigma = np.sqrt(np.einsum("nqq->nq", catalogue.own[known]))
    for axis in range(2):
        w = 1 / sigma[:, axis]
        off[:, axis] -= A @ np.linalg.lstsq(A * w[:, None], off[:, axis] * w, rcond=None)[0]
    return (off / sigma).ravel()


@pytest.mark.parametrize(
    ("rolls", "tilted"),
    [((0, 60, 130), False), ((0, 0, 0), False), ((0, 60, 130), True)],
    ids=["three rolls", "one roll", "ellipses"],
)
def test_pulls(rolls, tilted, full, capsys):
    seeds, size = (range(20), (40, 20_000)) if full else (range(6), (12, 1200))
    chi2, dof, pulls, star_pulls = [], [], [], []
    for seed in seeds:
        one, p, of_stars = _one(100 + seed, *size, rolls, tilted=tilted)
        chi2.append(one)
        dof.append(len(p))
        pulls.append(p)
        star_pulls.append(of_stars)
    with capsys.disabled():
        z = np.concatenate(pulls)
        w = np.concatenate(star_pulls)
        print(
            f"\nself-calibration, {len(chi2)} fields, rolls {rolls}"
            f"{', ellipses' * tilted}: coefficients and frames rms "
            f"{np.sqrt((z**2).mean()):.3f}, chi-square {sum(chi2):.0f} of {sum(dof)}; stars "
            f"{np.mean(np.abs(w) < 1):.3f} within one sigma, {np.mean(np.abs(w) < 2):.3f} in two"
        )
    low, high = stats.chi2.ppf([0.005, 0.995], sum(dof))
    assert low < sum(chi2) < high
    n = sum(len(w) for w in star_pulls)
    for k, share in ((1.0, 0.6827), (2.0, 0.9545)):
        inside = np.mean(np.abs(np.concatenate(star_pulls)) < k)
        # errors of the distortion are shared by stars, and a few groups hold a false detection
        assert abs(inside - share) < 0.015 + 2.6 * np.sqrt(share * (1 - share) / n)
