"""Units of errors that the user gives without one."""

from __future__ import annotations

import numpy as np
import pytest

import bayesdist as bd
from bayesdist.app.calibrate import _budget
from bayesdist.errors import InputError
from bayesdist.infer.stars.stars import errors_of


@pytest.mark.parametrize("unit", ["pix", "arcsec", "mas"])
def test_a_term_without_unit_is_in_that_of_the_model(unit):
    """A plain number is never scaled by the size of a pixel; a stated unit is."""
    term = bd.UserTerm("thermal", "random", 0.004, 0.003)
    assert term.sigma(unit, 150.0) == (0.004, 0.003)
    assert term.in_unit(unit, 150.0).unit == unit
    stated = bd.UserTerm("thermal", "random", 2.0, 1.0, "pix")
    assert stated.sigma("mas", 150.0) == pytest.approx((300.0, 150.0), rel=1e-15)


def test_a_configuration_states_the_unit_of_a_term():
    term = bd.UserTerm("thermal", "random", 0.004, 0.003)
    assert _budget(None, [term], "arcsec")[0]["unit"] == "arcsec"
    with pytest.raises(InputError, match='unit="arcsec"'):
        _budget(None, [term], None)


def test_advice_of_matches_without_errors_does_not_repeat_what_was_done():
    """After sigma="by_magnitude" the errors come from a fit, which the advice names."""
    rng = np.random.default_rng(1)
    x, y = rng.uniform(1, 100, (2, 20))
    matches = bd.Matches(x=x, y=y, u=x, v=y, unit="pix", mag=np.linspace(10, 15, 20))
    with pytest.raises(InputError, match="fit_by_magnitude") as caught:
        errors_of(matches)
    assert "sigma = 'by_magnitude'" not in str(caught.value)
    with pytest.raises(InputError, match="sigma = 'by_magnitude'"):
        errors_of(bd.Matches(x=x, y=y, u=x, v=y, unit="pix"))
