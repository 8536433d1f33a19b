"""Models of several periods from one pass over the data (WSDC D-T033, Appendix C).

The normal equations of the periods add up to those of all data, so that the model of each period,
the combined one and all that is to be known of their differences come from these sums.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from bayesdist.data.matches import MatchTable
from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.compare.period_changes import PeriodComparison
from bayesdist.infer.compare.period_dates import Periods, check_periods
from bayesdist.infer.equations.normal import NormalEquations, least_squares
from bayesdist.infer.equations.rank import require_full_rank
from bayesdist.infer.linear import LinearFit
from bayesdist.infer.stars.shards import Matches
from bayesdist.infer.stars.stars import Stars, prepare
from bayesdist.model import DistortionModel

__all__ = [
    "PeriodSums",
    "compare_periods",
    "period_sums",
    "sum_by_period",
    "sums_of_stars",
]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PeriodSums:
    """All that the pairs of one period say: sums, which add over pieces of the data.

    Parameters
    ----------
    equations : NormalEquations
        About the mean of the fit of all data, with the pairs that it uses.
    squares : NormalEquations or None
        The same with squared weights, where extra weights make the sandwich necessary.
    n : int
        Pairs used.
    """

    equations: NormalEquations
    squares: NormalEquations | None
    n: int

    def __add__(self, other: PeriodSums) -> PeriodSums:
        squares = None
        if self.squares is not None and other.squares is not None:
            squares = self.squares + other.squares
        return PeriodSums(self.equations + other.equations, squares, self.n + other.n)


def sum_by_period(matches: Matches, periods: Periods, task: Callable[[MatchTable], Any]) -> Any:
    """Sum over the pairs of each period of a task: one pass over the data, piece by piece.

    Parameters
    ----------
    matches : MatchTable or PartitionedMatches
        With epochs.
    periods : mapping of str to tuple of float
        First epoch of each period, and the epoch at which it is over, in decimal years.  Pairs
        outside all of them are not used.
    task : callable
        Of the pairs of a period that one piece of the data holds; what it returns adds.

    Returns
    -------
    dict of str to what the task returns

    Raises
    ------
    InputError
        Without epochs, for periods that overlap, and for a period without pairs.
    """
    where = ", ".join(matches.sources)
    if not matches.has_epoch:
        raise InputError(
            "periods need an epoch for every pair", where=where, do="map column 'epoch'"
        )
    check_periods(periods)
    sums: dict[str, Any] = {}
    for piece in matches.pieces():
        table = piece.read()
        assert table.epoch is not None
        for name, (start, stop) in periods.items():
            inside = (table.epoch >= start) & (table.epoch < stop)
            if inside.any():
                part = task(table.select(inside))
                sums[name] = sums[name] + part if name in sums else part
    for name, (start, stop) in periods.items():
        if name not in sums:
            raise InputError(
                f"period {name} ({start:.8g} to {stop:.8g}) has no pairs",
                where=where,
                do="correct the period or leave it out",
            )
    return {name: sums[name] for name in periods}


def period_sums(
    fit: LinearFit, matches: Matches, periods: Periods, *, radial_weight: float = 1.0
) -> dict[str, PeriodSums]:
    """Sums over the pairs of each period.

    Parameters
    ----------
    fit : LinearFit
        Of all data: its model, and its rule for leaving pairs out, which is then one for all.
    matches : MatchTable or PartitionedMatches
        With errors and epochs.
    periods : mapping of str to tuple of float
        As `sum_by_period`.
    radial_weight : float
        As the fit's.

    Returns
    -------
    dict of str to PeriodSums

    Raises
    ------
    InputError
        As `sum_by_period`, and for a model with frames or time dependence.
    """
    _check_model(fit.model)
    task = partial(_sums_of, fit=fit, radial_weight=radial_weight)
    out: dict[str, PeriodSums] = sum_by_period(matches, periods, task)
    return out


def _sums_of(matches: MatchTable, *, fit: LinearFit, radial_weight: float) -> PeriodSums:
    return sums_of_stars(prepare(fit.model, matches)[0], fit, radial_weight)


def sums_of_stars(stars: Stars, fit: LinearFit, radial_weight: float = 1.0) -> PeriodSums:
    """What some pairs of one period say.

    Parameters
    ----------
    stars : Stars
    fit, radial_weight
        As `period_sums`.

    Returns
    -------
    PeriodSums
    """
    rule = (fit.clip.theta, fit.clip.chi2_limit, fit.clip.abs_limit, radial_weight)
    equations = least_squares(stars, fit.mean, *rule)
    squares = least_squares(stars, fit.mean, *rule, 2) if radial_weight != 1.0 else None
    return PeriodSums(equations, squares, int(equations.scalars[0]))


def _check_model(model: DistortionModel) -> None:
    if model.n_frame or model.time is not None:
        raise InputError(
            "periods are compared by polynomials alone, and the model has "
            + ("frames of exposures" if model.n_frame else "time-dependent terms"),
            where="model",
            do="set model.frames = 'none' (refer the pairs to common solutions first) and drop the "
            "time-dependent terms",
        )


def compare_periods(
    fit: LinearFit, sums: Mapping[str, PeriodSums], *, rescale: bool = True
) -> PeriodComparison:
    """The model of each period, and how they differ from the combined one.

    Parameters
    ----------
    fit : LinearFit
        That `period_sums` was given.
    sums : mapping of str to PeriodSums
        Two or more periods.  Together they are the combined data set, of which `fit` need not be
        the fit: where pairs lie outside all periods it is not.
    rescale : bool
        Whether all errors are multiplied by one factor, the root of chi-square per degree of
        freedom about the models of the periods.  Without it, quoted errors that are too small make
        a change of noise.

    Returns
    -------
    PeriodComparison
        Residual structure that is the same in all periods cancels in the differences as far as
        the periods cover the array alike.

    Raises
    ------
    InputError
        For less than two periods, and for a model with frames or time dependence.
    DegenerateError
        When a period does not determine the model, naming the parameters.
    """
    if len(sums) < 2:
        raise InputError(f"{len(sums)} periods are given", do="give two or more")
    model = fit.model
    _check_model(model)
    rights: list[Float] = []
    steps: list[Float] = []
    covs: list[Float] = []
    normals: list[Float] = []
    for name, one in sums.items():
        arrow, right = one.equations.assemble(model, fit.mean)
        try:
            require_full_rank(arrow, model, one.equations.groups)
        except DegenerateError as error:
            raise DegenerateError(
                f"the {one.n} pairs of period {name} do not determine the model: {error.cause}",
                where="periods",
                do="give longer periods or lower model.order",
            ) from error
        normal = arrow.dense()
        inverse = _inverse(normal)
        rights.append(right)
        steps.append(inverse @ right)
        if one.squares is not None:
            meat, _ = one.squares.assemble(model, fit.mean)
            covs.append(inverse @ meat.dense() @ inverse)
        else:
            covs.append(inverse)
        normals.append(normal)
    all_inverse = _inverse(np.sum(normals, axis=0))
    shares = np.array([all_inverse @ normal for normal in normals])
    scale = _error_scale(sums.values(), rights, steps) if rescale else 1.0
    return PeriodComparison(
        model=model,
        names=tuple(sums),
        means=fit.mean + np.array(steps),
        covs=np.array(covs) * scale**2,
        shares=shares,
        counts=tuple(one.n for one in sums.values()),
        error_scale=scale,
    )


def _inverse(normal: Float) -> Float:
    """Inverse of a normal matrix, scaled to unit diagonal on the way."""
    scale = np.sqrt(np.diag(normal))
    unit = cho_solve(cho_factor(normal / np.outer(scale, scale)), np.eye(len(normal)))
    return np.asarray(unit / np.outer(scale, scale))


def _error_scale(
    sums: Collection[PeriodSums], rights: Sequence[Float], steps: Sequence[Float]
) -> float:
    """Root of chi-square per degree of freedom, of all periods about their own models."""
    chi2, dof = 0.0, 0
    for one, right, step in zip(sums, rights, steps, strict=True):
        chi2 += float(one.equations.scalars[2])
        dof += 2 * one.n
        if one.squares is None:
            # with extra weights chi-square stays that about the fit of all data
            chi2 -= float(right @ step)
            dof -= len(step)
    return float(np.sqrt(chi2 / dof))
