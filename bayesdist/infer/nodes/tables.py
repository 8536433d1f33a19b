"""Detector and filter tables of a whole calibration.

ACS ISR 2015-06, section 4.3: the detector's table comes from a base filter whose own irregularities
are the smallest, and is then fixed; each other filter has its own polynomial, and a table of the
residuals of both.  Detector's tables that are known from elsewhere are fixed in the same way.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.infer.linear import fit_linear
from bayesdist.infer.nodes.alternation import Alternated, Fit, Round, alternate
from bayesdist.infer.nodes.filters import matches_of_filter
from bayesdist.infer.nodes.grid import STEP
from bayesdist.infer.nodes.matern import SMOOTHNESS
from bayesdist.infer.nodes.table_fit import TableFit
from bayesdist.model import DistortionModel
from bayesdist.model.lookup import LookupTable

__all__ = ["TableFit", "fit_with_tables"]


def fit_with_tables(
    matches: Matches,
    model: DistortionModel | Mapping[str, DistortionModel],
    *,
    base: str | None = None,
    filters: Sequence[str] | None = None,
    detector: Sequence[LookupTable] = (),
    method: str = "field",
    rounds: int = 8,
    tolerance: float = 2e-4,
    step: tuple[float, float] = STEP,
    smoothness: Sequence[float] = SMOOTHNESS,
    fit: Fit = fit_linear,
    report: Callable[[Round], None] | None = None,
) -> TableFit:
    """Fit polynomials and look-up tables in turn: the detector's, then each filter's.

    Parameters
    ----------
    matches : Matches
        At raw pixels, with errors, of one filter or several.
    model : DistortionModel or dict of str to DistortionModel
        One for all filters, or one for each by name.  A model for all is cut to the exposures of
        each filter.
    base : str, optional
        Filter of the detector's tables; by default the one with the most matches.
    filters : sequence of str, optional
        Other filters that get a polynomial and tables of their own; all by default.
    detector : sequence of LookupTable, optional
        The detector's tables, where they are known: they are fixed, and the base filter gets tables
        of its own as the others do.
    method : str
        'field': a Gaussian random field, with the covariance of its nodes; 'binned': clipped means
        in bins, smoothed, as ACS ISR 2015-06.  Either is made orthogonal to the polynomial.
    rounds : int
        Largest number, for each filter.
    tolerance : float
        Change of every node, pixels, below which the rounds end.
    step : tuple of float
        Pixels between nodes.
    smoothness : sequence of float
        Matern smoothness to choose from, for 'field'.
    fit : callable
        Takes matches and a model, returns a solution with `model`, `mean` and `cov`.
    report : callable, optional
        Called with each round.

    Returns
    -------
    TableFit
        `converged` is True if the tables converged.

    Raises
    ------
    InputError
        For an unknown filter or method, a gauge whose exposure a filter lacks, or a
        table of a filter among the detector's.
    DegenerateError
        When the matches of a filter do not determine its model.
    """
    present = [name for k, name in enumerate(matches.filter_names) if (matches.filter == k).any()]
    if base is None:
        counts = np.bincount(matches.filter, minlength=len(matches.filter_names))
        base = matches.filter_names[int(np.argmax(counts))]
    others = [f for f in present if f != base] if filters is None else list(filters)
    for name in (base, *others):
        if name not in present:
            raise InputError(
                f"there are no matches in filter {name!r}",
                do=f"the matches are in {', '.join(map(repr, present))}",
            )
    held = tuple(detector)
    for table in held:
        if table.filter:
            raise InputError(
                f"the look-up table {table.label} is not the detector's",
                where="detector",
                do="give tables of no filter",
            )
    parts: dict[str, Alternated] = {}
    beneath = held
    for name in (base, *[f for f in others if f != base]):
        some, own_model = matches_of_filter(matches, model, name)
        parts[name] = alternate(
            some,
            own_model,
            beneath=beneath,
            filter=name if beneath else "",
            method=method,
            rounds=rounds,
            tolerance=tolerance,
            step=step,
            smoothness=smoothness,
            fit=fit,
            report=report,
        )
        beneath = beneath or parts[name].tables
    return TableFit(base, parts, held)
