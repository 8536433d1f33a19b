"""Type checks for the arguments of public functions."""

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
    """Decorator that checks the types of arguments at each call.

    Parameters
    ----------
    **kinds : type or tuple of type
        Allowed types of the argument of that name.  Its default, such as None, is always allowed.

    Raises
    ------
    InputError
        Raised by the decorated function if an argument has another type.
    """

    def decorated(function: Callable[P, R]) -> Callable[P, R]:
        parameters = signature(function)

        @wraps(function)
        def checked(*args: P.args, **kwargs: P.kwargs) -> R:
            arguments = parameters.bind(*args, **kwargs).arguments
            for name, kind in kinds.items():
                value = arguments.get(name, parameters.parameters[name].default)
                if value is parameters.parameters[name].default or isinstance(value, kind):
                    continue
                allowed = kind if isinstance(kind, tuple) else (kind,)
                raise InputError(
                    f"{name} is a {type(value).__name__}",
                    where=function.__name__,
                    do=f"give a {' or '.join(map(_name_of, allowed))}"
                    + (_OF_A_TABLE if allowed[0].__name__ == "Matches" else ""),
                )
            return function(*args, **kwargs)

        return checked

    return decorated


def _name_of(kind: type) -> str:
    """Name of a type in messages."""
    return _OF_A_SOLUTION if kind.__name__ == "Solution" else kind.__name__
