"""Polynomial and look-up tables fitted in turn, until both converge.

Each round corrects the pixels by the tables of the last one, fits the polynomial, and makes the
tables anew from *all* that the polynomial leaves: residuals, with the last tables' own shifts added
back.  Nothing is smoothed twice, and the rounds end at the joint solution of both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.infer.linear import LinearFit, fit_linear
from bayesdist.infer.nodes.binning import binned_table
from bayesdist.infer.nodes.field import field_table
from bayesdist.infer.nodes.grid import STEP
from bayesdist.infer.nodes.matern import SMOOTHNESS
from bayesdist.infer.nodes.pixels import pixel_shifts
from bayesdist.infer.nodes.posterior import TablePosterior
from bayesdist.infer.nodes.trust import Trust, fitted_trust
from bayesdist.model import DistortionModel
from bayesdist.model.lookup import LookupTable, corrected

__all__ = [
    "Alternated",
    "Fit",
    "Round",
    "alternate",
    "inside_chips",
    "on_the_chips",
]

Float = NDArray[np.float64]

Fit = Callable[[Matches, DistortionModel], LinearFit]

LIKELY = 0.5  # stars that are less likely true matches are left out
SEARCHED = 2  # rounds that optimise hyperparameters; later ones fix them, so that rounds converge


@dataclass(frozen=True)
class Round:
    """Statistics of one round.

    Parameters
    ----------
    filter : str
        Of the tables; '' for the detector's.
    number : int
        From 1.
    moved, moved_rms : float
        Largest and rms change of a node, pixels.
    rms : float
        Rms residual of an axis before the new tables, stars weighted by their probability of being
        true matches, pixels.
    false_fraction : float
        Of the matches.
    """

    filter: str
    number: int
    moved: float
    moved_rms: float
    rms: float
    false_fraction: float


@dataclass(frozen=True, eq=False)
class Alternated:
    """Polynomial and tables of the matches of one filter."""

    filter: str  # of the tables; '' for the detector's
    fit: LinearFit  # the polynomial, fitted last, with these tables fixed
    tables: tuple[LookupTable, ...]  # one for each chip
    posteriors: tuple[TablePosterior, ...]  # of the tables; empty for binned ones
    trust: Trust  # of the matches, in their order
    progress: tuple[Round, ...]
    converged: bool  # the tables moved less than the tolerance in the last round


# all large matrices are factored here, one at a time: see `field_table`
@threadpool_limits.wrap(limits=1, user_api="blas")
def alternate(
    matches: Matches,
    model: DistortionModel,
    *,
    beneath: Sequence[LookupTable] = (),
    filter: str = "",
    method: str = "field",
    rounds: int = 8,
    tolerance: float = 2e-4,
    step: tuple[float, float] = STEP,
    smoothness: Sequence[float] = SMOOTHNESS,
    fit: Fit = fit_linear,
    report: Callable[[Round], None] | None = None,
) -> Alternated:
    """Polynomial and tables of one set of matches, at raw pixels and with errors.

    Tables `beneath` are applied first and fixed; `filter` is that of the new tables, '' for the
    detector's; other arguments as in `fit_with_tables`.  InputError for an unknown method, no
    rounds, or a tolerance that is not positive; DegenerateError when the data do not determine the
    polynomial.
    """
    if method not in ("field", "binned"):
        raise InputError(f"there is no method {method!r} for tables", do="choose field or binned")
    if rounds < 1 or not tolerance > 0:
        raise InputError(
            f"{rounds} rounds to a tolerance of {tolerance} pixels",
            do="give one round or more and a positive tolerance",
        )
    chips = [c for k, c in enumerate(matches.chip_numbers) if (matches.chip == k).any()]
    numbers = matches.chip_number
    x, y = corrected(beneath, matches.x, matches.y, chip=numbers)
    tables: dict[int, LookupTable] = {}
    posteriors: dict[int, TablePosterior] = {}
    trust: Trust | None = None
    progress: list[Round] = []

    def solved(pixel: float) -> LinearFit:
        """Polynomial fit for fixed tables; `pixel` is the size of one in u, v."""
        if trust is None:
            return fit(on_the_chips(moved, model), model)
        jitter = np.full(len(x), trust.jitter)
        for number, posterior in posteriors.items():
            jitter[numbers == number] = posterior.jitter
        return fit(on_the_chips(_trusted(moved, trust, jitter * pixel), model), model)

    def shifts_of_tables() -> Float:
        out = np.zeros((len(x), 2))
        for number, table in tables.items():
            rows = numbers == number
            out[rows] = table.evaluate(x[rows], y[rows])
        return out

    moved, pixel = matches.with_columns(x=x, y=y), 1.0
    for number in range(1, rounds + 1):
        solution = solved(pixel)
        pixel = model.pixel_size(solution.mean)
        shifts, own = pixel_shifts(solution, moved), shifts_of_tables()
        trust = fitted_trust(shifts.shift, shifts.variance)
        w = np.where(trust.probability >= LIKELY, trust.probability, 0.0)
        rms = float(np.sqrt((w[:, None] * shifts.shift**2).sum() / (2 * w.sum())))
        total = shifts.shift + own
        change = []
        for c in chips:
            rows = numbers == c
            chip = model.chips[model.chip_code(c)]
            if method == "field":
                posteriors[c] = field_table(
                    x[rows],
                    y[rows],
                    total[rows],
                    shifts.variance[rows],
                    chip=chip,
                    order=model.order,
                    weight=w[rows],
                    filter=filter,
                    step=step,
                    smoothness=smoothness,
                    earlier=posteriors.get(c),
                    hold=number > SEARCHED,
                )
                new = posteriors[c].table
            else:
                new = binned_table(
                    x[rows],
                    y[rows],
                    total[rows],
                    chip=chip,
                    order=model.order,
                    filter=filter,
                    step=step,
                )
            old = tables[c].values if c in tables else np.zeros_like(new.values)
            change.append((new.values - old).ravel())
            tables[c] = new
        difference = np.concatenate(change)
        progress.append(
            Round(
                filter=filter,
                number=number,
                moved=float(np.abs(difference).max()),
                moved_rms=float(np.sqrt((difference**2).mean())),
                rms=rms,
                false_fraction=trust.fraction,
            )
        )
        if report is not None:
            report(progress[-1])
        own = shifts_of_tables()
        moved = matches.with_columns(x=x + own[:, 0], y=y + own[:, 1])
        if progress[-1].moved < tolerance:
            break
    assert trust is not None
    return Alternated(
        filter=filter,
        fit=solved(pixel),
        tables=tuple(tables[c] for c in chips),
        posteriors=tuple(posteriors[c] for c in chips if c in posteriors),
        trust=trust,
        progress=tuple(progress),
        converged=progress[-1].moved < tolerance,
    )


def on_the_chips(matches: Matches, model: DistortionModel) -> Matches:
    """Matches without the few at the edge that a table has moved off the chip.

    There the polynomial is not defined.  They count in the tables all the same.
    """
    inside = inside_chips(matches, model)
    return matches if inside.all() else matches.select(inside, reason="moved off the chip")


def inside_chips(matches: Matches, model: DistortionModel) -> NDArray[np.bool_]:
    """Boolean mask (N,) of the matches whose pixels lie on their chip."""
    size = np.array([model.chips[model.chip_code(c)].size for c in matches.chip_numbers])
    nx, ny = size[matches.chip].T
    x, y = matches.x, matches.y
    return np.asarray((x >= 0.5) & (x <= nx + 0.5) & (y >= 0.5) & (y <= ny + 0.5))


def _trusted(matches: Matches, trust: Trust, jitter: Float) -> Matches:
    """Likely true matches, with errors that give the polynomial the weights of the tables.

    A star of probability p counts p times: its variance is divided by p.
    """
    assert matches.sigma_u is not None and matches.sigma_v is not None
    likely = trust.probability >= LIKELY
    p = np.maximum(trust.probability, LIKELY)
    wide = matches.with_errors(
        (
            np.sqrt((matches.sigma_u**2 + jitter**2) / p),
            np.sqrt((matches.sigma_v**2 + jitter**2) / p),
        )
    )
    return wide.select(likely, reason="false match")
