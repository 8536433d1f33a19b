"""Rules that the checks of several formats share: when they report, and when they are silent."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.errors import FormatError
from bayesdist.products.common.document import Finding
from bayesdist.products.common.rules import (
    IDENTITY,
    Inverse,
    LinearPart,
    copies,
    is_skewed,
    missing,
    no_grid,
    no_sigmas,
    record,
    stated_closure,
)

INVERSE = Inverse("AP", 0.01, 0.5, "misses the inverse", "is off by {closure:.2g} px")
CAUSE = Finding("error", "AP_1_1", "is wrong")


@pytest.mark.parametrize(
    ("closure", "after_exchange", "levels", "where"),
    [
        (0.01, 0.0, [], []),  # good: the exchange is not tried
        (0.4, 0.3, ["warning"], ["AP"]),
        (0.6, 0.3, ["error"], ["AP"]),
        (0.6, 0.01, ["error"], ["A"]),
        (float("nan"), float("nan"), ["error"], ["AP"]),
    ],
)
def test_an_inverse_is_judged_by_its_closure(closure, after_exchange, levels, where) -> None:
    found = list(INVERSE.findings(closure, [("AP", closure), ("A", after_exchange)]))
    assert [f.level for f in found] == levels
    assert [f.where for f in found] == where


@pytest.mark.parametrize(
    ("closure", "conclusive", "n"), [(0.4, False, 1), (0.6, False, 2), (0.6, True, 1)]
)
def test_a_cause_of_the_closure_comes_first(closure, conclusive, n) -> None:
    found = list(
        INVERSE.findings(closure, [("A", closure)], lambda: [CAUSE], conclusive=conclusive)
    )
    assert found[0] == CAUSE and len(found) == n


def test_an_exchange_is_blamed_before_any_other_cause() -> None:
    def explain():
        raise AssertionError("is not asked")

    assert [f.where for f in INVERSE.findings(1.0, [("A", 0.0)], explain)] == ["A"]


def test_parity_and_singular_matrices() -> None:
    linear = LinearPart("CD", "mirrored")
    assert [f.level for f in linear.findings(0.0)] == ["error"]
    assert [f.message for f in linear.findings(2.0)] == ["mirrored"]
    assert linear.findings(-2.0) == linear.findings(2.0, mirror=0) == []
    assert linear.findings(1e-9, smallest=1e-8)[0].level == "error"


def test_keywords_that_are_there_are_not_missing() -> None:
    absent = missing({"PEDIGREE", "DESCRIP"}, IDENTITY)
    assert [f.where for f in absent] == ["USEAFTER", "FILETYPE"]
    assert all(f.message.startswith("is missing") for f in absent)


def test_copies_have_one_magnitude_and_are_not_zero() -> None:
    found = copies({"A": 0.0, "B": 0.0, "C": 2.0, "D": -2.0, "E": 3.0})
    assert [(f.where, "2" in f.message) for f in found] == [("C, D", True)]


@pytest.mark.parametrize(("shape", "n"), [((2, 2), 0), ((1, 5), 1), ((4,), 1), ((2, 2, 2), 1)])
def test_a_grid_has_two_nodes_along_two_axes(shape, n) -> None:
    assert len(no_grid(np.zeros(shape), "D2IMARR")) == n


@pytest.mark.parametrize(
    ("sigma", "messages"),
    [
        (np.ones((2, 3)), []),
        (-np.ones((2, 3)), ["value"]),
        (np.full((2, 3), np.nan), ["value"]),
        (np.ones((3, 2)), ["shape"]),
    ],
)
def test_standard_errors_are_positive_and_of_the_shape_of_the_table(sigma, messages) -> None:
    found = no_sigmas(sigma, (2, 3), "SIGMA", "value", "shape")
    assert [f.message for f in found] == messages


def test_axes_are_skewed_if_they_are_nearly_parallel_or_very_unequal() -> None:
    assert not is_skewed(np.array([[0.6, 0.8], [-0.8, 0.6]]))
    assert is_skewed(np.array([[1.0, 0.9], [0.9, 1.0]]))
    assert is_skewed(np.diag([1.0, 0.4])) and is_skewed(np.zeros((2, 2)))


def test_a_stated_closure_may_be_rounded_but_not_too_small() -> None:
    assert stated_closure(None, 1.0, "BDCLOS", "it leaves") == []
    assert stated_closure(0.5, 0.504, "BDCLOS", "it leaves") == []
    assert len(stated_closure(0.5, 0.51, "BDCLOS", "it leaves")) == 1


def test_a_record_is_read_and_compared() -> None:
    def broken() -> float:
        raise FormatError("is cut off", where="a file", do="fetch it again")

    assert record("record", lambda: 1e-5, 1e-4, "differ by {far}") == []
    [unread] = record("record", broken, 1e-4, "differ by {far}")
    assert "is cut off" in unread.message
    for far in (1.0, float("nan")):
        [other] = record("record", lambda far=far: far, 1e-4, "{far}", differs_at="parameters")
        assert (other.where, other.message) == ("parameters", str(far))
