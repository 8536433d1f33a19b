"""Iterations of grouping and solution."""

from __future__ import annotations

import weakref

import numpy as np
import pytest
from astropy import units
from astropy.table import Table

from bayesdist.data import ReferenceCatalog
from bayesdist.data.sky import parallax_factors
from bayesdist.kinds.selfcal.config import SelfcalConfig
from bayesdist.kinds.selfcal.infer import self_calibrate
from bayesdist.kinds.selfcal.infer.prior import ReferenceStars
from bayesdist.kinds.selfcal.inputs import _read_references
from tests.kinds.selfcal.infer.fields import field, problem_of


def test_an_iteration_holds_no_detections_of_the_last():
    """Else the peak of the memory is a third higher."""
    simulated, errors, still_held = field(1, 6, 200, order=1), [], []

    def references(problem, theta):
        still_held.append([k for k, one in enumerate(errors) if one() is not None])
        errors.append(weakref.ref(problem.var))
        return problem.priors

    self_calibrate(
        simulated.model,
        simulated.unlabelled,
        simulated.theta,
        match_radius=1.0,
        start_radius=4.0,
        references=references,
    )
    assert len(still_held) > 2
    assert still_held == [[]] * len(still_held)


@pytest.mark.parametrize("motion", ["none", "proper_motion", "parallax"])
def test_reference_stars_are_where_their_detections_see_them(motion):
    """Positions, motions and parallaxes with their covariances, at the dates of the detections.

    Every third star has no error of its parallax, which is then free if it is fitted.
    """
    epochs, point = np.linspace(2020.0, 2021.3, 6), (150.0, 2.0)
    simulated = field(2, 6, 300, epochs=epochs)
    factors = parallax_factors(epochs, *point)
    problem, _ = problem_of(simulated, motion=motion, parallax_factors=factors)
    n, rng = len(simulated.sky), np.random.default_rng(46)
    root = rng.standard_normal((n, 5, 5))
    C = 1e-4 * (root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(5))
    without = np.arange(n) % 3 == 0
    C[without, 2] = C[without, :, 2] = 0.0
    sigma = np.sqrt(np.einsum("nii->ni", C))
    size = np.where(sigma > 0, sigma, 1.0)
    correlations = C / (size[:, :, None] * size[:, None])
    correlations[without, 2, 2] = 1.0
    names = ("sigma_u", "sigma_v", "sigma_parallax", "sigma_pm_u", "sigma_pm_v")
    p = np.column_stack([simulated.sky, rng.exponential(0.1, n), 0.05 * rng.normal(size=(n, 2))])
    catalog = ReferenceCatalog(
        p[:, 0], p[:, 1], parallax=p[:, 2], pm_u=p[:, 3], pm_v=p[:, 4], epoch=2016.0,
        tangent_point=point, **dict(zip(names, sigma.T, strict=True)),
        correlations=correlations,
    )  # fmt: skip
    priors = ReferenceStars(catalog, 2.0)(problem, simulated.theta)
    star, exposure = (a[problem.rows] for a in (simulated.detections.star,
                                                simulated.detections.exposure))  # fmt: skip
    checked = 0
    for k, whose in enumerate(star[problem.starts[:-1]]):
        if whose < 0 or not priors.informed[k]:
            continue
        seen = exposure[problem.starts[k] : problem.starts[k + 1]]
        years, (east, north) = epochs[seen].mean() - 2016.0, factors[seen].mean(axis=0)
        if motion != "none":
            years = epochs.mean() - 2016.0
        A = np.eye(5)[[0, 1, 3, 4, 2]]
        A[:2, 3:] = years * np.eye(2)
        if motion != "parallax":
            A = A[: 2 if motion == "none" else 4]
            A[:2, 2] = east, north
        elif without[whose]:
            A = A[:4]
        expected = np.linalg.inv(A @ C[whose] @ A.T)
        m = len(A)
        np.testing.assert_allclose(priors.precision[k][:m, :m], expected, rtol=1e-5)
        np.testing.assert_allclose(priors.precision[k][m:], 0.0, atol=1e-11)
        np.testing.assert_allclose(priors.centre[k][:m], A @ p[whose], atol=1e-9)
        checked += 1
    assert checked > 100


def test_reference_stars_without_motions_get_one_with_the_error_that_is_given(tmp_path):
    """gauge.reference.motion_prior, as in tables of matches: 8 years times 10 mas per year."""
    rng, n = np.random.default_rng(3), 50
    table = Table({"ra": 150 + rng.uniform(0, 0.01, n), "dec": 2 + rng.uniform(0, 0.01, n)})
    for name in ("pmra", "pmdec", "ra_error", "dec_error", "pmra_error", "pmdec_error"):
        table[name] = np.full(n, 0.1) * (units.mas if "pm" not in name else units.mas / units.yr)
        if "pm" in name:
            table[name][:20] = np.nan
    table["ra_error"][:] = table["dec_error"][:] = 0.1
    table["pmra"][20:] = rng.normal(0, 3, n - 20)
    table["pmdec"][20:] = rng.normal(0, 3, n - 20)
    for name in ("ra", "dec"):
        table[name].unit = units.deg
    table["ref_epoch"] = 2016.0
    table.write(tmp_path / "stars.ecsv")
    config = {
        "selfcal": {"lists": "x/*", "unit": "mas"},
        "detector": {"name": "A", "size": [1000, 1000], "scale_mas": 40.0},
        "model": {"order": 3},
        "gauge": {"reference": {"catalog": "stars.ecsv", "motion_prior": 10.0}},
    }
    sigma = {}
    for given in (True, False):
        if not given:
            del config["gauge"]["reference"]["motion_prior"]
        catalog = _read_references(SelfcalConfig.model_validate(config), tmp_path)
        assert len(catalog) == n and catalog.assumed_motion.sum() == 20
        sigma[given] = catalog.at(2024.0).sigma_u[catalog.assumed_motion]
    np.testing.assert_allclose(sigma[True], 80.0, rtol=0.01)
    np.testing.assert_allclose(sigma[False], 24.0, rtol=0.35)
