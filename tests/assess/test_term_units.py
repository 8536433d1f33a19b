"""Units of errors that the user gives without one."""

from __future__ import annotations

import numpy as np
import pytest
from astropy import units as u

import bayesdist as bd
from bayesdist.errors import InputError
from bayesdist.infer.stars.stars import errors_of
from bayesdist.kinds.matches.calibrate import _budget
from bayesdist.kinds.matches.config import MatchesConfig


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


@pytest.mark.parametrize("unit", ["arcsec", "mas", "deg"])
def test_a_limit_without_unit_is_refused_where_u_v_are_angles(unit):
    """It was in pixels: 0.02 pixels are not 0.02 arcsec."""
    need = bd.Requirement("field", "p95", 0.02)
    assert need.in_unit_of("pix").unit == "pix"
    with pytest.raises(InputError, match=f"'field': no unit is given, and u and v are in {unit}"):
        need.in_unit_of(unit)
    assert bd.Requirement("field", "p95", 0.02 * u.arcsec).in_unit_of(unit).unit == "arcsec"
    assert bd.Requirement("field", "p95", 0.02, "pix").in_unit_of(unit).unit == "pix"


def test_blocks_of_a_configuration_without_unit_are_refused_where_u_v_are_angles():
    row = {"name": "thermal", "kind": "random", "sigma_u": 0.004, "sigma_v": 0.003}
    settings = {"data": {"matches": "a.csv"}, "detector": {"size": [9.0, 9.0]}}
    settings |= {"model": {"order": 1}, "budget": [row], "requirement": [
        {"name": "field", "statistic": "max", "limit": 0.1}]}  # fmt: skip
    config = MatchesConfig(**settings)
    assert [term.unit for term in config.user_terms("pix")] == ["pix"]
    with pytest.raises(InputError, match="'thermal': no unit is given, and u and v are in mas"):
        config.user_terms("mas")
    assert [need.unit for need in config.requirements()] == [""]
    stated = MatchesConfig(**settings | {"budget": [row | {"unit": "mas"}]})
    assert [term.unit for term in stated.user_terms("arcsec")] == ["mas"]


def test_margins_without_unit_are_refused_before_they_are_judged(from_monomials):
    plane = {"order": 1, "size": (9.0, 9.0), "reference_pixel": (5.0, 5.0), "unit": "arcsec"}
    solution = from_monomials({(1, 0): 0.1}, {(0, 1): 0.1}, **plane)
    with pytest.raises(InputError, match='state it, as unit = "arcsec"'):
        bd.check_requirements(solution, [bd.Requirement("field", "p95", 0.02)])


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
