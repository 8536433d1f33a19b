"""A kind of damage: which files it is for, what it takes, and whether it can be known afterwards."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

__all__ = ["HARMLESS", "KNOWABLE", "MUTATIONS", "OPEN", "Mutation", "changes", "replaces"]

# what the numbers of an accepted file may be afterwards
HARMLESS = "harmless"  # as they were
KNOWABLE = "knowable"  # as they were, unless a warning is given
OPEN = "open"  # others: a file of such numbers is as good as the first

Arguments = dict[str, Any]


@dataclass(frozen=True)
class Mutation:
    """A kind of damage.

    Parameters
    ----------
    name : str
    kind : str
        In words.
    forms : frozenset of str
        Forms of files that it is for; empty for all.
    arguments : callable
        Strategy of its arguments from the content of a file; None where that has no place for it.
    apply : callable
        Damages the file at a path.
    effect : str
        HARMLESS, KNOWABLE or OPEN.
    """

    name: str
    kind: str
    forms: frozenset[str]
    arguments: Callable[[bytes], st.SearchStrategy[Arguments] | None]
    apply: Callable[..., None]
    effect: str

    def suits(self, form: str) -> bool:
        return not self.forms or form in self.forms


MUTATIONS: dict[str, Mutation] = {}


def _nothing(content: bytes) -> st.SearchStrategy[Arguments]:
    return st.just({})


def changes(kind: str, effect: str, *forms: str, arguments=_nothing):
    """Decorator of a function from the content of a file, and arguments, to other content."""

    def register(function):
        def apply(path: Path, **given: Any) -> None:
            content = function(path.read_bytes(), **given)
            path.unlink()  # it may be a link to a file that others read
            path.write_bytes(content)

        name = function.__name__
        assert name not in MUTATIONS
        MUTATIONS[name] = Mutation(name, kind, frozenset(forms), arguments, apply, effect)
        return function

    return register


def replaces(kind: str, effect: str, *forms: str, arguments=_nothing):
    """Decorator of a function of a path, where a file is, that puts something else there."""

    def register(function):
        name = function.__name__
        assert name not in MUTATIONS
        MUTATIONS[name] = Mutation(name, kind, frozenset(forms), arguments, function, effect)
        return function

    return register
