"""Exceptions and warnings of the package.

Every error that a user can correct is raised as a `BayesdistError`: one sentence that gives the
cause, the location and the next action.  The command line prints this sentence and exits with the
`exit_code` of the exception.  Any other exception is a defect of the program, which the command
line reports as such (`bayesdist.app.cli`).
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
    """Base class of all errors that a user can correct.

    Parameters
    ----------
    cause : str
        Cause of the error, as a clause without a full stop.
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
        """Location, cause and next action as one sentence."""
        head = f"{self.where}: {self.cause}" if self.where else self.cause
        return f"{head}; {self.do}." if self.do else f"{head}."


class BayesdistWarning(UserWarning):
    """Warning that a written file may be misread, or that a plugin cannot be loaded.

    Functions that write files issue it once for each message. The command line prints it as one
    sentence.
    """


class InputError(BayesdistError):
    """Input data, files or arguments that cannot be used.

    Parameters
    ----------
    cause, where, do : str
        See `BayesdistError`.

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
    """Invalid configuration."""


class FormatError(InputError):
    """File that violates its format: truncated, corrupt, or with unexpected columns."""


class DegenerateError(InputError):
    """Data that do not determine all parameters of the model."""


class MemoryLimitError(InputError):
    """Computation that needs more memory than is available."""


class NotSettledError(InputError):
    """Iteration over the data that does not converge."""


class NotConvergedError(BayesdistError):
    """The sampler did not reach its targets and ``--strict`` was given."""

    exit_code = 3


class RenamedError(BayesdistError):
    """Command called by a former name."""

    exit_code = 2


def required(value: T | None, cause: str) -> T:
    """Return the value; raise InputError with this cause if it is None."""
    if value is None:
        raise InputError(cause)
    return value


def require_known(name: str, known: Sequence[str], what: str, *, where: str = "") -> None:
    """Raise an error unless a name is one of the allowed names.

    Parameters
    ----------
    name : str
        Name to check.
    known : sequence of str
        Allowed names.
    what : str
        Noun for the message, such as ``"statistic"``.
    where : str, optional
        File or key in which the name was given.

    Raises
    ------
    InputError
        If the name is not allowed.  The message suggests the most similar allowed name, or lists
        all of them if none is similar.
    """
    if name in known:
        return
    from difflib import get_close_matches  # slow to import, and needed only for the message

    near = get_close_matches(str(name).lower(), known, n=1, cutoff=0.5)
    do = f"use {near[0]!r} if that is meant" if near else f"choose one of {', '.join(known)}"
    raise InputError(f"unknown {what} {name!r}", where=where, do=do)
