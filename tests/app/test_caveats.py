"""What keeps a verdict from being given."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.app.config import parse_config
from bayesdist.assess.requirements.verdict import time_checks, visits_of
from bayesdist.model.timedep import TimeDependence

from .support import config_text

DRIFT = TimeDependence((("u", 0, 1),), (2004.5,), breaks=(2009.4,))
ROW = {"name": "Gaia catalogue", "kind": "systematic", "sigma_u": 0.0, "sigma_v": 0.0}


@pytest.mark.parametrize(
    ("row", "stated"),
    [
        (ROW, False),
        (ROW | {"source": "exact in the simulation"}, True),
        (ROW | {"sigma_v": 0.002}, True),
        (ROW | {"name": "Gaia DR1", "sigma_v": 0.002}, True),
        (ROW | {"name": "Gaia proper motions", "sigma_v": 0.002}, False),
        (ROW | {"name": "camera", "sigma_v": 0.002, "source": "see reference [3]"}, False),
    ],
)
def test_an_error_of_the_catalogue_is_stated_by_its_row(row, stated):
    config = parse_config(config_text(budget=[row]), "config.toml")
    assert config.states_catalogue == stated


def test_exposures_of_a_visit_are_one_date():
    minutes = np.array([0.0, 1e-5, 2e-5])
    dates = np.concatenate([2004.1 + minutes, 2008.3 + minutes])
    assert visits_of(dates) == pytest.approx([2004.1, 2008.3])
    every_year = np.arange(2002.0, 2014.0)
    assert visits_of(every_year[::-1]) == pytest.approx(every_year)
    assert visits_of(np.zeros(0)).size == 0


def test_dates_that_follow_closely_are_not_one_visit():
    rng = np.random.default_rng(4)
    dates = rng.permutation(2002.0 + 12 * (np.arange(110) + rng.uniform(size=110)) / 110)
    visits = visits_of(dates)
    assert np.diff(visits).min() > 12 / 51
    assert 40 <= visits.size <= 50
    assert not list(time_checks(DRIFT, dates, None))


@pytest.mark.parametrize(
    ("after", "said"), [([2009.5, 2009.501], "one date"), ([2009.5, 2012.0], "two dates")]
)
def test_a_drift_of_few_dates_on_one_side_of_its_break_is_doubted(after, said):
    dates = np.concatenate([np.arange(2002.0, 2009.39, 0.1), after])
    (check,) = time_checks(DRIFT, dates, None)
    assert f"a drift is fitted to {said}, " in check.sentence
