"""Are most pairs false?  Then neither rejection nor mixture is sure of what it fits.

Both take the true matches to be those that lie together.  Where false ones are the rule, a chance
alignment, or their own mean, may be what was fitted; the posterior is then that of a wrong mode and
says nothing of the others.  A mixture whose outliers have another shape than the false matches may
settle where all pairs are true and their errors large: that shows in the jitter.
"""

from __future__ import annotations

from bayesdist.infer.linear import LinearFit
from bayesdist.infer.posterior import Posterior
from bayesdist.limits import FALSE_MAJORITY, WIDENED_ERRORS

__all__ = ["majority_sentence"]


def majority_sentence(
    fit: LinearFit,
    posterior: Posterior | None = None,
    *,
    quoted: float | None = None,
    things: str = "pairs",
) -> str:
    """Warning that most pairs are false, as a clause; empty where they are not.

    `quoted` is the usual quoted error of one axis, in the unit of u, v; `things` is the word for
    the matches.
    """
    if posterior is not None and "f" in posterior.hyper:
        fraction = float(posterior.hyper["f"].mean())
        if not FALSE_MAJORITY.met_by(fraction):
            return (
                f"the mixture takes {100 * fraction:.0f} % of the {things} for false ones: with "
                "more false than true ones the solution may rest on chance alignments"
            )
    if posterior is not None and quoted and "j" in posterior.hyper:
        jitter = float(posterior.hyper["j"].mean())
        if jitter > WIDENED_ERRORS.value * quoted:
            return (
                f"the mixture adds {jitter:.3g} {posterior.unit} to the errors of all {things}, "
                f"{jitter / quoted:.2g} times the quoted one: either that is far too small, or "
                f"most {things} are false ones that were taken for true"
            )
    share = fit.n_rejected / fit.n_rows
    if not FALSE_MAJORITY.met_by(share):
        return (
            f"the fit left out {100 * share:.0f} % of the {things}: most of them are "
            "false, or the quoted errors are far too small, and the solution may rest on "
            "chance alignments"
        )
    return ""
