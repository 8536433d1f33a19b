"""Values that are kept as long as what they were made from is there."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

__all__ = ["Derived"]

T = TypeVar("T")


class Derived:
    """Values by name, each with the objects that it was made from."""

    def __init__(self) -> None:
        self._values: dict[str, tuple[tuple[Any, ...], Any]] = {}

    def get(self, name: str, made_from: tuple[Any, ...], make: Callable[[], T]) -> T:
        """The value that was made from these very objects; it is made where there is none.

        Parameters
        ----------
        name : str
        made_from : tuple
        make : callable
        """
        known = self._values.get(name)
        if known is None or not _same(known[0], made_from):
            self.put(name, made_from, make())
        value: T = self._values[name][1]
        return value

    def put(self, name: str, made_from: tuple[Any, ...], value: object) -> None:
        """Keep a value in place of what was there."""
        self._values[name] = (made_from, value)


def _same(a: tuple[Any, ...], b: tuple[Any, ...]) -> bool:
    return len(a) == len(b) and all(one is other for one, other in zip(a, b, strict=True))
