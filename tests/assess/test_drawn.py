"""Several epochs at once, blocks and threads: all give the statistics of one draw after another."""

from dataclasses import replace

import numpy as np
import pytest

from bayesdist.assess import UserTerm
from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.model import error_model
from bayesdist.model import Chip, DistortionModel, TimeDependence

CHIPS = tuple(Chip(k, f"C{k}", (101.0, 81.0), (51.0, 41.0)) for k in (1, 2))
MODEL = DistortionModel(2, CHIPS, time=TimeDependence((("u", 1, 0),), (2010.0, 2015.0), (2014.0,)))
TERMS = (
    UserTerm("noise", "random", 0.02, 0.03, "pix"),
    UserTerm("offset", "systematic", 0.01, 0.0, "pix"),
)
EPOCHS = (2008.0, 2013.9, 2019.0)
NAMES = ("max", "p90", "u_rms")


@pytest.fixture
def errors(solution_of):
    rng = np.random.default_rng(3)
    root = 0.01 * rng.normal(size=(MODEL.n_params, MODEL.n_params))
    solution = solution_of(MODEL, cov=root @ root.T)
    return error_model(solution, terms=TERMS).drawn(150, np.random.default_rng(4))


def cases(**more):
    return [EvaluationDomain.of_chips(MODEL, (6, 5), epoch=epoch, **more) for epoch in EPOCHS]


@pytest.mark.parametrize("more", [{}, {"relative": True}, {"relative": True, "separation": 30.0}])
def test_epochs_together_are_epochs_one_by_one(errors, more):
    together = errors.over_epochs(cases(**more)[0], EPOCHS, NAMES, at_once=2)
    for case, found in zip(cases(**more), together, strict=True):
        alone = errors.statistics(case, NAMES)
        for name in NAMES:
            np.testing.assert_array_equal(found[name], alone[name])
    assert np.mean(together[0]["max"] != together[2]["max"]) > 0.5


def test_fewer_draws_are_the_first_ones(errors):
    every = errors.statistics(cases()[0], NAMES)
    errors = replace(errors, block=1)
    for n in (150, 37, 16, 1):
        some = errors.statistics(cases()[0], NAMES, n_draws=n)
        for name in NAMES:
            np.testing.assert_allclose(some[name], every[name][:n], rtol=1e-12)


def test_noise_has_its_size_and_belongs_to_a_place(solution_of):
    """Without any other error the square of the rms is a mean of squares: chi-square of 2 N."""
    still = solution_of(MODEL)
    noise = (UserTerm("noise", "random", 0.02, 0.02, "pix"),)
    n, places = 4000, 60
    errors = error_model(still, terms=noise).drawn(n, np.random.default_rng(5))
    square = errors.statistics(cases()[0], ["rms"])["rms"] ** 2 / 0.02**2 * places
    dof = 2 * places
    assert np.mean(square) == pytest.approx(dof, abs=5 * np.sqrt(2 * dof / n))
    # variance of chi-square 2 dof, of its estimate from n draws (2 + 12 / dof) / n relative
    assert np.var(square) == pytest.approx(2 * dof, rel=5 * np.sqrt((2 + 12 / dof) / n))


def test_domains_of_the_same_positions_are_equal():
    """So that requirements on the same part of the detector share what is evaluated."""
    one, same = (EvaluationDomain.of_chips(MODEL, (6, 5), epoch=2010.0) for _ in range(2))
    pixels = EvaluationDomain.at_pixels(MODEL, 1, [1.0, 50.0], [2.0, 80.0], epoch=2010.0)
    others = [
        one.at(2011.0),
        one.on(2),
        pixels,
        EvaluationDomain.of_chips(MODEL, (6, 5), epoch=2010.0, relative=True),
        EvaluationDomain.of_chips(MODEL, (6, 5), epoch=2010.0, magnitude=15.0),
        EvaluationDomain.of_chips(MODEL, (6, 5), epoch=2010.0, region="inner 60 %"),
    ]
    assert one == same and len({one, same}) == 1
    assert len({one, *others}) == 1 + len(others)
    assert one.at(2011.0).at(2010.0) == one
    assert [(chip, rows.stop - rows.start) for chip, rows in one.by_chip()] == [(1, 30), (2, 30)]
    assert one.pairs() is None and others[3].pairs().shape == (2, 60 * 59 // 2)
