"""Names of a package that are loaded when they are first used (PEP 562)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any

__all__ = ["lazy_name"]


def lazy_name(package: str, homes: Mapping[str, Sequence[str]], name: str) -> Any:
    """Object that a package gives under a name, from the module where it is at home.

    `package`: dotted name of the package, whose `__getattr__` this is. `homes`: dotted name of each
    module, and the names that are taken from it. AttributeError when the package has no such name.
    """
    for home, names in homes.items():
        if name in names:
            return getattr(import_module(home), name)
    raise AttributeError(f"module {package!r} has no attribute {name!r}")
