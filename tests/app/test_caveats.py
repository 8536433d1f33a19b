"""What keeps a verdict from being given."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.app.config import parse_config
from bayesdist.assess.checks import visits_of

from .support import config_text

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
