"""Polynomial and look-up tables fitted in turn, until both converge.

Each iteration corrects the pixels by the tables of the last one, fits the polynomial, and makes the
tables anew from *all* that the polynomial leaves: residuals, with the last tables' own shifts added
back.  Nothing is smoothed twice, and the iterations end at the joint solution of both.

The detector's tables come from a filter whose own irregularities are the smallest, and are then
fixed; each other filter has its own polynomial, and tables of the residuals of both (ACS ISR
2015-06, section 4.3).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.nodes.binned import binned_table
from bayesdist.infer.nodes.field import field_table
from bayesdist.infer.nodes.grid import STEP
from bayesdist.infer.nodes.hyperparameters import SMOOTHNESS
from bayesdist.infer.nodes.mixture import ResidualMixture, fit_mixture
from bayesdist.infer.nodes.pixels import corrected_matches, on_the_chips, pixel_shifts
from bayesdist.infer.nodes.posterior import TablePosterior
from bayesdist.infer.nodes.table_fit import Iteration, TableFit, shifts_of
from bayesdist.infer.solution.linear import LinearFit, fit_linear
from bayesdist.model import DistortionModel
from bayesdist.model.lookup import LookupTable
from bayesdist.utils.arrays import Bool, Float

LIKELY = 0.5  # stars that are less likely true matches are left out
# of the hyperparameters, as of `field_table`, in the first iterations; in later ones they are held
SEARCHES = ("tiles", "chip")


# all large matrices are factored here, one at a time: see `field_table`
@one_thread
def fit_with_tables(
    matches: Matches,
    model: DistortionModel,
    *,
    filter: str = "",
    beneath: Sequence[LookupTable | TablePosterior] = (),
    method: str = "field",
    max_iterations: int = 8,
    tolerance: float = 2e-4,
    step: tuple[float, float] = STEP,
    smoothness: Sequence[float] = SMOOTHNESS,
    start: TableFit | None = None,
    report: Callable[[Iteration], None] | None = None,
) -> TableFit:
    """Fit the polynomial and the look-up tables of one filter in turn.

    Parameters
    ----------
    matches : Matches
        At raw pixels, with errors, of one filter.
    model : DistortionModel
        It is cut to the exposures of the matches.
    filter : str
        Filter of the new tables; '' makes them the detector's.
    beneath : sequence of LookupTable or TablePosterior
        The detector's tables where they are known: they are fixed, and applied first.  The error
        of a posterior counts as far as the new tables do not absorb it, that of a plain table by
        its upper bound.
    method : str
        'field': a Gaussian random field, with the covariance of its nodes; 'binned': clipped means
        in bins, smoothed, as ACS ISR 2015-06.  Either is made orthogonal to the polynomial.
    max_iterations : int
    tolerance : float
        Change of every node, pixels, below which the iterations end.
    step : tuple of float
        Pixels between nodes.
    smoothness : sequence of float
        Matern smoothness to choose from, for 'field'.
    start : TableFit, optional
        Fit of the same matches, perhaps with other errors, whose iterations are continued: from the
        third on the hyperparameters are held.
    report : callable, optional
        Called with each iteration.

    Returns
    -------
    TableFit
        `converged` is True if the tables converged.

    Raises
    ------
    InputError
        For an unknown method, no iterations, a tolerance that is not positive, matches of several
        filters, matches without the exposure that holds the gauge, a table of a filter among the
        detector's, or a start of other chips or by another method.
    DegenerateError
        When the matches do not determine the model.

    Notes
    -----
    The detector's tables come from one filter, and each other one lies over them::

        base = fit_with_tables(matches.select(matches.filter == 0), model)
        other = matches.select(matches.filter == 1)
        fit_with_tables(other, model, filter="F814W", beneath=base.fitted)
    """
    _check(matches, beneath, method, max_iterations, tolerance)
    matches, model = _with_own_exposures(matches, model)
    chips = [c for k, c in enumerate(matches.chip_numbers) if (matches.chip == k).any()]
    numbers = matches.chip_number
    lower = corrected_matches([shifts_of(one) for one in beneath], matches)
    x, y = lower.x, lower.y
    progress: list[Iteration] = []
    fitted: dict[int, LookupTable | TablePosterior] = {}
    own = np.zeros((len(x), 2))
    if start is not None:
        _check_start(start, chips, method)
        progress += start.progress
        fitted |= zip(chips, start.fitted, strict=True)
        for c, table in fitted.items():
            rows = numbers == c
            own[rows] = shifts_of(table).evaluate(x[rows], y[rows])
    searched = dict(fitted)  # those whose hyperparameters are held

    def solved(moved: Matches, mixture: ResidualMixture, pixel: float) -> LinearFit:
        """Polynomial fit for fixed tables; `pixel` is the size of one in u, v."""
        jitter = np.full(len(x), mixture.jitter)
        for chip, table in fitted.items():
            if isinstance(table, TablePosterior):
                jitter[numbers == chip] = table.jitter
        moved = _with_memberships(moved, mixture, jitter * pixel)
        return fit_linear(on_the_chips(moved, model), model)

    def new_table(
        chip: int, rows: Bool, shift: Float, variance: Float, search: str
    ) -> LookupTable | TablePosterior:
        where = model.chips[model.chip_code(chip)]
        if method == "binned":
            return binned_table(
                x[rows],
                y[rows],
                shift[rows],
                chip=where,
                order=model.order,
                filter=filter,
                step=step,
            )
        earlier = searched.get(chip)
        return field_table(
            x[rows],
            y[rows],
            shift[rows],
            variance[rows],
            chip=where,
            order=model.order,
            weight=weight[rows],
            filter=filter,
            step=step,
            smoothness=smoothness,
            earlier=earlier if isinstance(earlier, TablePosterior) else None,
            search=search,
        )

    def corrected_by_all() -> Matches:
        return matches.with_columns(x=x + own[:, 0], y=y + own[:, 1])

    moved = corrected_by_all()
    solution = fit_linear(on_the_chips(moved, model), model)
    for number in range(len(progress) + 1, len(progress) + 1 + max_iterations):
        search = SEARCHES[number - 1] if number <= len(SEARCHES) else "none"
        pixel = model.pixel_size(solution.mean)
        shifts = pixel_shifts(solution, moved)
        mixture = fit_mixture(shifts.shift, shifts.variance)
        weight = np.where(mixture.probability >= LIKELY, mixture.probability, 0.0)
        rms = float(np.sqrt((weight[:, None] * shifts.shift**2).sum() / (2 * weight.sum())))
        total = shifts.shift + own
        change = 0.0
        for c in chips:
            rows = numbers == c
            before = shifts_of(fitted[c]).values if c in fitted else 0.0
            fitted[c] = new_table(c, rows, total, shifts.variance, search)
            new = shifts_of(fitted[c])
            change = max(change, float(np.abs(new.values - before).max()))
            if search != "none":
                searched[c] = fitted[c]
            own[rows] = new.evaluate(x[rows], y[rows])
        progress.append(
            Iteration(number=number, moved=change, rms=rms, false_fraction=mixture.fraction)
        )
        if report is not None:
            report(progress[-1])
        moved = corrected_by_all()
        solution = solved(moved, mixture, pixel)
        if progress[-1].moved < tolerance:
            break
    return TableFit(
        filter=filter,
        solution=solution,
        beneath=tuple(beneath),
        fitted=tuple(fitted[c] for c in chips),
        mixture=mixture,
        progress=tuple(progress),
        converged=progress[-1].moved < tolerance,
    )


def _check(
    matches: Matches,
    beneath: Sequence[LookupTable | TablePosterior],
    method: str,
    max_iterations: int,
    tolerance: float,
) -> None:
    """Refuse arguments that make no fit, as `fit_with_tables` has them."""
    if method not in ("field", "binned"):
        raise InputError(f"there is no method {method!r} for tables", do="choose field or binned")
    if max_iterations < 1 or not tolerance > 0:
        raise InputError(
            f"{max_iterations} iterations to a tolerance of {tolerance} pixels",
            do="give one iteration or more and a positive tolerance",
        )
    for table in map(shifts_of, beneath):
        if table.filter:
            raise InputError(
                f"the look-up table {table.label} is not the detector's",
                where="beneath",
                do="give tables of no filter",
            )
    present = [matches.filter_names[k] for k in np.unique(matches.filter)]
    if len(present) > 1:
        raise InputError(
            f"the matches are of filters {', '.join(map(repr, present))}",
            do="give those of one: matches.select(matches.filter == k)",
        )


def _check_start(start: TableFit, chips: Sequence[int], method: str) -> None:
    """Refuse a start whose tables are of other chips, or were made by another method."""
    known = [shifts_of(table).chip for table in start.fitted]
    fields = all(isinstance(table, TablePosterior) for table in start.fitted)
    if known != list(chips) or fields != (method == "field"):
        raise InputError(
            f"the start has tables of chips {known}, {'fields' if fields else 'bins'}",
            where="start",
            do=f"give a fit of chips {list(chips)} by the method {method!r}",
        )


def _with_own_exposures(
    matches: Matches, model: DistortionModel
) -> tuple[Matches, DistortionModel]:
    """Matches with the exposures that have stars only, and the model with these."""
    names = matches.exposures
    if model.n_frame and model.gauge != "first" and names[0] != model.exposures[0]:
        raise InputError(
            f"no match is of exposure {model.exposures[0]!r}, which holds the gauge",
            do="give the filter a model of its own",
        )
    return matches.with_exposure_names(names), replace(model, exposures=names)


def _with_memberships(matches: Matches, mixture: ResidualMixture, jitter: Float) -> Matches:
    """Likely true matches, with errors that give the polynomial the weights of the tables.

    A star of probability p counts p times: its variance is divided by p.
    """
    sigma_u, sigma_v = matches.column("sigma_u"), matches.column("sigma_v")
    likely = mixture.probability >= LIKELY
    p = np.maximum(mixture.probability, LIKELY)
    wide = matches.with_errors(
        (
            np.sqrt((sigma_u**2 + jitter**2) / p),
            np.sqrt((sigma_v**2 + jitter**2) / p),
        )
    )
    return wide.select(likely, reason="false match")
