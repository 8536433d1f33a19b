"""One family of errors: what is wrong, where, and what to do next.

Everything that a user can put right is raised as a `BayesdistError`; the command line prints its
one sentence and exits with its code.  Any other exception is a defect of the program, and the
command line says so (`bayesdist.app.commands.failures`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

__all__ = [
    "BayesdistError",
    "BayesdistWarning",
    "ConfigError",
    "DegenerateError",
    "FormatError",
    "InputError",
    "MemoryLimitError",
    "NotConvergedError",
    "NotSettledError",
    "RenamedError",
    "require_known",
    "required",
]

T = TypeVar("T")


class BayesdistError(Exception):
    """Base of all errors meant for the user.

    Parameters
    ----------
    cause : str
        What is wrong, as a clause without a full stop.
    where : str, optional
        File, row, column or keyword, as in ``"stars.ecsv, row 12, column 'su'"``.
    do : str, optional
        The next action, as an imperative clause.

    Attributes
    ----------
    exit_code : int
        Exit status of the command line for this kind of error.

    Examples
    --------
    >>> error = bd.BayesdistError("is empty", where="stars.csv", do="give a table with stars")
    >>> str(error)
    'stars.csv: is empty; give a table with stars.'
    """

    exit_code = 1

    def __init__(self, cause: str, *, where: str = "", do: str = "") -> None:
        self.cause = cause.rstrip(".")
        self.where = where
        self.do = do.rstrip(".")
        super().__init__(self.sentence)

    @property
    def sentence(self) -> str:
        """The whole message as one sentence."""
        head = f"{self.where}: {self.cause}" if self.where else self.cause
        return f"{head}; {self.do}." if self.do else f"{head}."


class BayesdistWarning(UserWarning):
    """Warning about what other programs will make of a file, or what the file does not hold.

    It is issued by functions that write files, once for each sentence.
    """


class InputError(BayesdistError):
    """Input data, files or arguments that cannot be used.

    Parameters
    ----------
    cause, where, do : str
        As of `BayesdistError`.

    Examples
    --------
    >>> from bayesdist.model import PolynomialBasis
    >>> try:
    ...     PolynomialBasis(0, (1016, 1016), (508.5, 508.5))
    ... except bd.InputError as error:
    ...     print(error.exit_code)
    1
    """


class ConfigError(InputError):
    """A configuration that cannot be used."""


class FormatError(InputError):
    """A file that is not what its format demands (truncated, corrupt, other columns)."""


class DegenerateError(InputError):
    """The data do not determine the parameters that are asked for."""


class MemoryLimitError(InputError):
    """A computation that needs more memory than there is."""


class NotSettledError(InputError):
    """An iteration over the data that does not come to rest."""


class NotConvergedError(BayesdistError):
    """The sampler did not reach its targets and ``--strict`` was given."""

    exit_code = 3


class RenamedError(BayesdistError):
    """A command under a name that it no longer has."""

    exit_code = 2


def required(value: T | None, cause: str) -> T:
    """The value, if there is one; InputError, with this cause, if there is none."""
    if value is None:
        raise InputError(cause)
    return value


def require_known(name: str, known: Sequence[str], what: str, *, where: str = "") -> None:
    """Pass a known name.

    Parameters
    ----------
    name : str
    known : sequence of str
    what : str
        What the name stands for, as in ``"statistic"``.
    where : str, optional
        Where it was given.

    Raises
    ------
    InputError
        For an unknown name; it names the nearest known one, or all of them where none is near.
    """
    if name in known:
        return
    from difflib import get_close_matches  # which takes longer to load than all else here

    near = get_close_matches(str(name).lower(), known, n=1, cutoff=0.5)
    do = f"use {near[0]!r} if that is meant" if near else f"choose one of {', '.join(known)}"
    raise InputError(f"unknown {what} {name!r}", where=where, do=do)
