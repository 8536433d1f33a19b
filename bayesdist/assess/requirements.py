"""Requirements on the position error, and by what margin a solution meets them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.field_terms import FieldTerm
from bayesdist.assess.fields import MODEL, ErrorFields, draw_errors
from bayesdist.assess.grid import DEFAULT_GRID, grid_pixels, mesh
from bayesdist.assess.names import require_known
from bayesdist.assess.solution import Solution, place_of
from bayesdist.assess.statistics import STATISTICS, field_statistic
from bayesdist.assess.terms import LocalTerm, UserTerm, combined_sigma
from bayesdist.assess.units import UNITS, convert, pixel_scale_of
from bayesdist.assess.verdict import counting_error, effective_draws, verdict_of
from bayesdist.errors import InputError
from bayesdist.model import Chip

__all__ = ["Margin", "Requirement", "check_requirements"]

Float = NDArray[np.float64]
Case = tuple[float | None, tuple[Chip, ...]]

# Grid points times draws whose errors are held at once: two axes of them are 8 MB.
BLOCK = 500_000


@dataclass(frozen=True)
class Requirement:
    """A limit on a statistic of the position error over the detector, which is all of its chips.

    Parameters
    ----------
    name : str
    statistic : str
        One of `STATISTICS`.
    limit : float
        Positive, in `unit`.
    unit : str
        'pix', 'arcsec', 'mas' or 'deg'.
    probability : float
        With which the statistic must be at or under the limit, between 0 and 1.
    epoch : float, optional
        Decimal years.
    chip : int, optional
        Number of the one chip that is judged; all chips together by default.

    Raises
    ------
    InputError
        For an unknown statistic or unit, or a limit or probability out of range.
    """

    name: str
    statistic: str
    limit: float
    unit: str = "pix"
    probability: float = 0.95
    epoch: float | None = None
    chip: int | None = None

    def __post_init__(self) -> None:
        require_known(self.statistic, STATISTICS, "statistic", where=self.where)
        require_known(self.unit, UNITS, "unit", where=self.where)
        if not (math.isfinite(self.limit) and self.limit > 0):
            raise InputError(
                f"the limit is {self.limit}", where=self.where, do="give a positive number"
            )
        if not 0 < self.probability < 1:
            raise InputError(
                f"the probability is {self.probability}",
                where=self.where,
                do="give a number between 0 and 1, without the ends",
            )

    @property
    def where(self) -> str:
        """How messages name it."""
        return f"requirement {self.name!r}"


@dataclass(frozen=True, eq=False)
class Margin:
    """How a solution stands against a requirement.  All lengths are in `unit`.

    Parameters
    ----------
    requirement : Requirement
    value : float
        Median of the statistic over the draws.
    interval : tuple of float
        Central 95 % of the statistic over the draws.
    margin : float
        The limit minus the value that the statistic stays at or under with the probability asked
        for: not negative exactly where `probability_met` is at least that probability.
    probability_met : float
        Fraction of draws at or under the limit.
    mc_error : float
        Monte-Carlo standard error of `probability_met`.
    verdict : str
        'met', 'missed' or 'undecided'.
    reason : str
        Why, in words.
    unit : str
        The requirement's.
    epoch : float or None
        At which it was judged.
    n_effective : float
        Independent draws that the draws are worth.
    draws : ndarray, shape (n,)
        The statistic of every draw.
    """

    requirement: Requirement
    value: float
    interval: tuple[float, float]
    margin: float
    probability_met: float
    mc_error: float
    verdict: str
    reason: str
    unit: str
    epoch: float | None
    n_effective: float
    draws: Float


def check_requirements(
    solution: Solution,
    requirements: Sequence[Requirement],
    *,
    terms: Sequence[UserTerm] = (),
    fields: Sequence[FieldTerm] = (),
    aligned: bool = False,
    local: Sequence[LocalTerm] = (),
    grid: tuple[int, int] = DEFAULT_GRID,
    epoch: float | None = None,
    chip: int | None = None,
    n_draws: int = 2000,
    rng: np.random.Generator,
    pixel_scale: float | None = None,
    converged: bool | None = None,
    doubt: str = "",
) -> tuple[Margin, ...]:
    """Judge requirements on draws of the position error.

    Each draw is an error field over the grid: a draw of the solution minus its mean (all parts of
    the model jointly, so with the correlation between positions), plus a draw of every field term
    that is not among the solution's errors, plus for the systematic terms one Gaussian offset of
    each axis for the whole field, plus for the random and the local terms an independent Gaussian
    error at every grid point.  The statistic of each field gives a
    distribution, and the fraction of draws at or under the limit is compared with the probability
    asked for.

    The field is that of all chips: the same grid on each of them, so that each has the same weight.
    A draw of the solution and an offset are common to all chips.

    Parameters
    ----------
    solution : LinearFit or Posterior
    requirements : sequence of Requirement
    terms : sequence of UserTerm
    fields : sequence of FieldTerm
    aligned : bool
        Whether shift and rotation of the exposure are the observer's to fit, as in `error_fields`:
        over all chips, also where one is judged.  The user's terms stay as they are given.
    local : sequence of LocalTerm
        Measured beside the solution, on this grid.
    grid : tuple of int
        Points on x and y.
    epoch : float, optional
        For requirements that name none; decimal years.
    chip : int, optional
        Chip number, for requirements that name none; all chips by default.
    n_draws : int
    rng : numpy.random.Generator
    pixel_scale : float, optional
        Size of one pixel in mas; `pixel_scale_of` the solution by default.
    converged : bool, optional
        Whether the posterior may be trusted; by default what its convergence says.  If not, every
        verdict is 'undecided'.
    doubt : str
        Any other reason why no verdict can be given: every one is then 'undecided'.

    Returns
    -------
    tuple of Margin
        In the order of the requirements.

    Raises
    ------
    InputError
        For a requirement without an epoch where the model depends on time, units that need a pixel
        scale that is not known, an unknown chip, a bad grid, or fewer than two draws.
    """
    unit = solution.model.unit
    if pixel_scale is None:
        pixel_scale = pixel_scale_of(solution, chip)
    epochs = [r.epoch if r.epoch is not None else epoch for r in requirements]
    for r, t in zip(requirements, epochs, strict=True):
        convert(r.limit, r.unit, unit, pixel_scale, where=r.where)
        if t is None and solution.model.time is not None:
            raise InputError(
                "the model depends on time and no epoch is given",
                where=r.where,
                do="give the requirement an epoch, or set assess.epoch",
            )
    systematic = combined_sigma(terms, "systematic", unit, pixel_scale)
    random = combined_sigma(terms, "random", unit, pixel_scale)
    if not requirements:
        return ()

    # a field of the error is that of some chips at an epoch
    cases = [
        (t, _chips_of(r, solution, chip, t)) for r, t in zip(requirements, epochs, strict=True)
    ]
    added = [term for term in fields if term.without is None]
    drawn = draw_errors(solution, n_draws, rng, fields=added, aligned=aligned)
    offsets = rng.normal(size=(n_draws, 2)) * systematic
    statistics: dict[tuple[Case, str], Float] = {}
    for case in dict.fromkeys(cases):
        names = {r.statistic for r, c in zip(requirements, cases, strict=True) if c == case}
        epoch, chips = case
        points = {one.number: mesh(*grid_pixels(one.size, grid)) for one in chips}
        errors = drawn.at(points, epoch=epoch)
        everywhere = np.concatenate([_at_points(f, random, local, grid) for f in errors])
        for name, values in _statistics(errors, sorted(names), offsets, everywhere, rng).items():
            statistics[case, name] = values

    doubt = _doubt(solution, converged) or doubt
    n_effective = effective_draws(solution, n_draws)
    margins = []
    for r, case in zip(requirements, cases, strict=True):
        draws = statistics[case, r.statistic] * convert(1.0, unit, r.unit, pixel_scale)
        margins.append(_margin(r, case[0], draws, n_effective, doubt))
    return tuple(margins)


def _chips_of(
    requirement: Requirement, solution: Solution, chip: int | None, epoch: float | None
) -> tuple[Chip, ...]:
    """The chips whose field is judged."""
    model = solution.model
    number = chip if requirement.chip is None else requirement.chip
    if requirement.chip is not None and number not in [c.number for c in model.chips]:
        raise InputError(
            f"there is no chip {number}",
            where=requirement.where,
            do=f"name one of {', '.join(str(c.number) for c in model.chips)}, or leave chip out "
            "for all of them",
        )
    if number is None:
        return model.chips
    return (place_of(model, epoch=epoch, chip=number).chip,)


def _at_points(
    fields: ErrorFields,
    random: tuple[float, float],
    local: Sequence[LocalTerm],
    grid: tuple[int, int],
) -> Float:
    """Standard deviations (N, 2) of what is independent at the points of a chip's grid."""
    variance = np.tile(np.square(random), (fields.x.size, 1))
    for term in local:
        found = term.on(fields.chip, (grid[1], grid[0]))
        variance += np.column_stack([sigma.ravel() ** 2 for sigma in found])
    return np.sqrt(variance)


def _statistics(
    fields: Sequence[ErrorFields],
    names: Sequence[str],
    offsets: Float,
    random: Float,
    rng: np.random.Generator,
) -> dict[str, Float]:
    """Each statistic of each draw's field over all chips, by blocks of draws."""
    n_draws = fields[0].n_draws
    out = {name: np.empty(n_draws) for name in names}
    step = max(1, BLOCK // sum(f.x.size for f in fields))
    for start in range(0, n_draws, step):
        rows = slice(start, start + step)
        error = np.concatenate([f.field(MODEL, rows) for f in fields], axis=1)
        error += offsets[rows, None, :]
        if random.any():
            error += rng.normal(size=error.shape) * random
        for name in names:
            out[name][rows] = field_statistic(name, error)
    return out


def _doubt(solution: Solution, converged: bool | None) -> str:
    """Why no verdict can be given; '' where the draws can be trusted."""
    convergence = getattr(solution, "convergence", None)
    if converged is None:
        converged = convergence is None or bool(convergence.converged)
    if converged:
        return ""
    reasons = "; ".join(getattr(convergence, "reasons", ()))
    return "the posterior is not converged" + (f": {reasons}" if reasons else "")


def _margin(
    requirement: Requirement, epoch: float | None, draws: Float, n_effective: float, doubt: str
) -> Margin:
    asked = requirement.probability
    met = float(np.mean(draws <= requirement.limit))
    low, median, high = np.quantile(draws, [0.025, 0.5, 0.975])
    # the empirical quantile without interpolation, so that its side of the limit agrees with `met`
    reached = np.quantile(draws, asked, method="inverted_cdf")
    verdict, reason = verdict_of(met, n_effective, asked)
    return Margin(
        requirement=requirement,
        value=float(median),
        interval=(float(low), float(high)),
        margin=float(requirement.limit - reached),
        probability_met=met,
        mc_error=counting_error(met, n_effective),
        verdict="undecided" if doubt else verdict,
        reason=doubt or reason,
        unit=requirement.unit,
        epoch=epoch,
        n_effective=n_effective,
        draws=draws,
    )
