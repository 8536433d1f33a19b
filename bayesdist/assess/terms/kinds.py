"""Kinds of error terms that have one size: those of the package, and those that missions add."""

from __future__ import annotations

from collections.abc import Callable

from bayesdist.assess.solution import Solution
from bayesdist.assess.terms.forms import ErrorTerm
from bayesdist.assess.terms.parameters import LINEAR_KINDS, ScaleError
from bayesdist.mission import load_object, missions

__all__ = ["one_size_kinds", "one_size_term"]


def one_size_kinds() -> tuple[str, ...]:
    """Names of all kinds."""
    return (*LINEAR_KINDS, *(kind for one in missions().values() for kind in one.error_terms))


def one_size_term(name: str, kind: str, sigma: float, solution: Solution, source: str) -> ErrorTerm:
    """Error term of a kind; parameters as of `ScaleError`."""
    make: Callable[..., ErrorTerm] = ScaleError
    for mission in missions().values():
        if kind in mission.error_terms:
            make = load_object(mission.error_terms[kind])
    return make(name, kind, sigma, solution, source)
