"""Real pairs with false matches untruncated: MegaCam detections and every Gaia DR1 star near them.

More than half of the pairs are false, as in RvB files of WISE.  No truth is known; what the
posterior says is held against geometry, which counts false pairs by their density, and against a
twin of the set whose false pairs are made.
"""

from __future__ import annotations

import json

import numpy as np
import pytest
from astropy.table import Table
from scipy import stats

import bayesdist as bd
from bayesdist.errors import InputError
from tests.reduced import only_in_full

from ..app.support import good
from .megacam import RADIUS, SIGMA, SIZE, Fitted, Pairs, fitted, twin

CIRCLE = np.pi * RADIUS**2
OUTER, INNER = (4.0, 6.5), (1.5, 3.0)  # annuli about the fitted position, inside every circle
CERTAIN = 0.6  # arcsec
TURNS = 19  # catalogues that give the density of the real false pairs


def area(inner: float, outer: float) -> float:
    return np.pi * (outer**2 - inner**2)


def within(radius: np.ndarray, limits: tuple[float, float]) -> np.ndarray:
    return (radius > limits[0]) & (radius < limits[1])


def false_by_density(radius: np.ndarray) -> tuple[float, float]:
    """False pairs of the whole circle and their Poisson error, by those of the outer annulus."""
    count = within(radius, OUTER).sum()
    scale = CIRCLE / area(*OUTER)
    return count * scale, np.sqrt(count) * scale


@pytest.fixture(scope="module")
def real(megacam: Pairs) -> Fitted:
    return fitted(megacam)


@pytest.fixture(scope="module")
def known(megacam: Pairs, real: Fitted) -> tuple[np.ndarray, Fitted]:
    """The twin: which pairs are true, and what the fits make of them."""
    pairs, true = twin(megacam, real.radius("mixture") < CERTAIN, TURNS, seed=1)
    return true, fitted(pairs, true)


# -- the real set ---------------------------------------------------------------------------------


def test_stars_that_the_catalogue_repeats_are_named(data_dir) -> None:
    path = data_dir / "megacam_gaia" / "megacam744331p_gaiadr1_pairs_8arcsec.csv"
    names = {"x": "x_hdrwcs_arcsec", "y": "y_hdrwcs_arcsec", "u": "x_gaia_arcsec"}
    columns = {**names, "v": "y_gaia_arcsec"}
    with pytest.raises(InputError, match=r"row \d+: repeats .* row \d+"):
        bd.read_matches(path, columns=columns, unit="arcsec", sigma=SIGMA)


def test_the_posterior_s_false_pairs_are_as_many_as_geometry_implies(real) -> None:
    count, error = false_by_density(real.radius("mixture"))
    assert real.n_false > 0.5 * len(real.outlier)
    assert abs(real.n_false - count) < 3 * np.hypot(error, real.false_sd)


def test_bright_stars_keep_other_detections_away(every_pair) -> None:
    """Why geometry counts too many: their density is the outer one only some arcsec off."""
    radius = np.hypot(*every_pair.offset.T)[every_pair.mag < 18]
    near, far = (within(radius, limits).sum() for limits in ((2.5, 4.0), (5.5, RADIUS)))
    share = area(2.5, 4.0) / (area(2.5, 4.0) + area(5.5, RADIUS))
    assert stats.binomtest(int(near), int(near + far), share, "less").pvalue < 1e-4


def test_some_true_pairs_are_far_off(real) -> None:
    """Why the posterior does as well: moving and saturated stars, more than false ones there."""
    radius = real.radius("mixture")
    lost = int(((real.outlier > 0.5) & (radius < INNER[0])).sum())
    near = int(within(radius, INNER).sum())
    share = INNER[0] ** 2 / INNER[1] ** 2
    assert stats.binomtest(lost, lost + near, share, "greater").pvalue < 1e-3


def test_false_pairs_fill_the_circle_about_the_header_s_position(megacam, real) -> None:
    """The likelihood's 1 / (pi R^2) holds whatever the distortion: the circle does not move.

    Pairs are taken beyond 3.5 arcsec, and of faint stars, which keep nobody away there.
    """
    hole = 3.5
    offset = megacam.offset
    squared = (offset**2).sum(axis=1)
    which = (real.outlier > 0.5) & (megacam.mag >= 19) & (squared > hole**2)
    share = (squared[which] - hole**2) / (RADIUS**2 - hole**2)
    assert squared.max() <= RADIUS**2
    assert stats.kstest(share, "uniform").pvalue > 1e-3
    azimuth = np.arctan2(*offset[which].T) / (2 * np.pi) + 0.5
    assert stats.kstest(azimuth, "uniform").pvalue > 1e-3
    # along the fitted distortion d its mean is 0; it were d for a circle about the model's position
    d = (offset - real.residuals["mixture"])[which]
    weight = (d**2).sum()
    error = np.sqrt((RADIUS**2 + hole**2) / 4 / weight)
    assert abs((offset[which] * d).sum() / weight) < 3 * error


# -- the twin, whose truth is known ---------------------------------------------------------------


@pytest.mark.slow
@only_in_full("its false pairs are as many")
def test_the_twin_is_as_dense_as_the_real_set(megacam, known) -> None:
    """As dense as at the circle's edge, where stars keep fewest detections away."""
    true, _ = known
    edge = (6.5, RADIUS)
    count = within(np.hypot(*megacam.offset.T), edge).sum()
    scale = CIRCLE / area(*edge)
    error = np.hypot(np.sqrt(count) * scale, np.sqrt((~true).sum()))
    assert abs((~true).sum() - count * scale) < 3 * error


def test_the_twin_s_fraction_is_found(known) -> None:
    true, found = known
    assert abs(found.n_false - (~true).sum()) < 3 * found.false_sd


def kept(score: np.ndarray, true: np.ndarray, n_true: int) -> np.ndarray:
    """Pairs up to the score at which so many true ones are in."""
    return score <= np.sort(score[true])[n_true - 1]


def test_memberships_beat_two_pass_clipping_at_equal_completeness(known) -> None:
    true, found = known
    accepted = found.outlier < 0.5
    n_true = int((accepted & true).sum())
    assert n_true > 0.95 * true.sum()
    ours = int((accepted & ~true).sum())
    theirs = int((kept(found.radius("first pass"), true, n_true) & ~true).sum())
    # were both as pure, each false pair would be in either with a probability of one half
    assert stats.binomtest(ours, ours + theirs, 0.5, "less").pvalue < 1e-4
    # and at the completeness of the fit as it clips
    n_true = int((found.used & true).sum())
    ours = int((kept(found.outlier, true, n_true) & ~true).sum())
    theirs = int((found.used & ~true).sum())
    assert stats.binomtest(ours, ours + theirs, 0.5, "less").pvalue < 1e-4


def test_repeated_clipping_with_good_limits_is_as_pure(known) -> None:
    """All errors are equal here: probability and distance put the pairs in one order."""
    true, found = known
    accepted = found.outlier < 0.5
    n_true = int((accepted & true).sum())
    ours = int((accepted & ~true).sum())
    theirs = int((kept(found.radius("repeated"), true, n_true) & ~true).sum())
    assert stats.binomtest(ours, ours + theirs, 0.5).pvalue > 1e-3


def test_false_pairs_move_the_clipped_solution_and_not_the_posterior(known) -> None:
    """Against least squares of the true pairs alone, on the same grid."""
    _, found = known

    def off(name: str) -> float:
        return float(np.sqrt(np.mean((found.maps[name] - found.maps["truth"]) ** 2)))

    sd = float(np.sqrt(np.mean(found.maps["sd"] ** 2)))
    assert off("mixture") < sd
    assert off("clipped") > 3 * sd


# -- the command ----------------------------------------------------------------------------------

CONFIG = f"""
[data]
matches = "pairs.ecsv"
unit = "arcsec"
sigma = {SIGMA}
[detector]
name = "CCD"
size = [{SIZE[0]}, {SIZE[1]}]
scale_mas = 1000.0
[model]
order = 2
[outliers]
model = "uniform"
match_radius = {RADIUS}
fraction_prior = [1.0, 1.0]
[sampler]
target_ess = 100
[assess]
grid = [5, 9]
"""


@pytest.mark.slow
@only_in_full("test_new_instrument runs two of them")
def test_a_run_of_one_ccd_agrees_with_its_geometry(megacam, real, tmp_path) -> None:
    one = megacam.ccd == 1
    Table(megacam.select(one).table()).write(tmp_path / "pairs.ecsv")
    (tmp_path / "job.toml").write_text(CONFIG)
    good("run", tmp_path / "job.toml", "-o", tmp_path / "run")
    found = json.loads((tmp_path / "run" / "summary.json").read_text())
    fraction = found["outliers"]["fraction"]
    count, error = false_by_density(real.radius("mixture")[one])
    n = int(one.sum())
    assert abs(fraction["mean"] - count / n) < 3 * np.hypot(error / n, fraction["sd"])
    # the same posterior as through the library
    assert abs(fraction["mean"] * n - real.outlier[one].sum()) < fraction["sd"] * n
    assert found["sampler"]["converged"]
