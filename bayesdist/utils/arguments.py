"""Types of arguments of public functions, checked where the user calls them."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from inspect import signature
from typing import ParamSpec, TypeVar

from bayesdist.errors import InputError

_OF_A_SOLUTION = "Posterior or LinearFit"  # what users have of the abstract class
_OF_A_TABLE = "; bayesdist.Matches.from_table makes it of a table"

P = ParamSpec("P")
R = TypeVar("R")


def takes(**kinds: type | tuple[type, ...]) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorator that refuses arguments of another type.

    Parameters
    ----------
    **kinds : type or tuple of type
        Types of an argument.  The default of the function, such as None, is always admitted.

    Raises
    ------
    InputError
        By the decorated function, if an argument has another type.
    """

    def decorated(function: Callable[P, R]) -> Callable[P, R]:
        known = signature(function)

        @wraps(function)
        def checked(*args: P.args, **kwargs: P.kwargs) -> R:
            given = known.bind(*args, **kwargs).arguments
            for name, kind in kinds.items():
                value = given.get(name, known.parameters[name].default)
                if value is known.parameters[name].default or isinstance(value, kind):
                    continue
                several = kind if isinstance(kind, tuple) else (kind,)
                raise InputError(
                    f"{name} is a {type(value).__name__}",
                    where=function.__name__,
                    do=f"give a {' or '.join(map(_name_of, several))}"
                    + (_OF_A_TABLE if several[0].__name__ == "Matches" else ""),
                )
            return function(*args, **kwargs)

        return checked

    return decorated


def _name_of(kind: type) -> str:
    """Name of a type in messages."""
    return _OF_A_SOLUTION if kind.__name__ == "Solution" else kind.__name__
