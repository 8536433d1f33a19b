"""Names of the coefficients of an IDCTAB."""

import pytest

from bayesdist.formats.idctab.table import idctab_column, idctab_powers
from bayesdist.model import polynomial_terms


@pytest.mark.parametrize(("i", "j"), polynomial_terms(9))
def test_names_and_powers_are_inverse_to_one_another(i: int, j: int) -> None:
    assert idctab_powers(idctab_column("CX", i, j)) == ("CX", i, j)


def test_first_order_is_as_stwcs_has_it() -> None:
    # stwcs makes its CD matrix of [[CX11, CX10], [CY11, CY10]]: x first
    assert [idctab_column("CX", 1, 0), idctab_column("CX", 0, 1)] == ["CX11", "CX10"]


@pytest.mark.parametrize("name", ["CX12", "CX1", "CZ11", "A_1", "XREF", "AP_ORDER", "A_10_0"])
def test_other_names_are_no_coefficients(name: str) -> None:
    assert idctab_powers(name) is None
