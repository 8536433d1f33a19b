"""What is assessed: a solution, and what is known of its errors beside its own draws."""

from __future__ import annotations

from dataclasses import dataclass

from bayesdist.assess.terms.forms import ErrorTerm
from bayesdist.infer import Posterior

__all__ = ["Systematics"]


@dataclass(frozen=True, eq=False)
class Systematics:
    """The solution of a run with all that is known of its errors.

    Parameters
    ----------
    solution : Posterior
        Its draws hold every error that bears on the parameters.
    terms : tuple of ErrorTerm
        Other errors, and what of the solution's is shown by itself.
    aligned : bool
        Whether errors are those in a new exposure after its shift and rotation have been fitted.
    """

    solution: Posterior
    terms: tuple[ErrorTerm, ...] = ()
    aligned: bool = False
