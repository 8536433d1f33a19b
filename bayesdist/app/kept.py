"""Results that a session keeps, so that its stages share them."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

__all__ = ["kept"]

T = TypeVar("T")


def kept(session: object, name: str, make: Callable[[], T], *, anew: bool = False) -> T:
    """What was made before under a name, or is made now.

    Parameters
    ----------
    session : object
        Holds it, beside its cached properties.
    name : str
    make : callable
    anew : bool
        Also where it is there.

    Returns
    -------
    object
        Of `make`.
    """
    if anew or name not in session.__dict__:
        session.__dict__[name] = make()
    return session.__dict__[name]  # type: ignore[no-any-return]
