"""Time-dependent terms of ACS/WFC in an IDCTAB, and the part of a drift that it can store.

    CX11 += CXB dt,  CY11 += CTB dt,  CY10 += CYB dt

with dt in years since TDD_DATE (scheme of 2015). The rates are in the primary header, as stwcs
reads them.

A calibration that has been rotated to V2 and V3 also drifts in terms for which a file has no
keyword: a change of the y scale causes a change of CX10, multiplied by the sine of 2.2 degrees for
ACS/WFC. Such terms are left out only if their effect over the years of the file is below a limit,
and that effect is reported.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.plane import ARCSEC
from bayesdist.errors import InputError
from bayesdist.infer.solution.solution import Solution, TransformedSolution
from bayesdist.infer.solution.transforms import segment as segment_of
from bayesdist.model import TimeDependence
from bayesdist.utils.arrays import Float

Term = tuple[str, int, int]

NEGLIGIBLE = 1e-3  # mas; a drift this small, fixed by a prior or by the gauge, is not reported

# (axis, power of x, power of y) of a coefficient: keyword of its rate without the chip number
RATES = {("u", 1, 0): "TDD_CXB", ("v", 1, 0): "TDD_CTB", ("v", 0, 1): "TDD_CYB"}


def scheme_of(keywords: Mapping[str, float]) -> str:
    """Scheme that stwcs finds in the TDD keywords of an ACS/WFC table, in the order of its tests.

    '2015' (TDD_CTB1 ...), '2014' (TDD_CYB1 ...), 'order' (TDDORDER with TDD_A, TDD_B), or
    'default': the terms of 2004.5 that are built into stwcs.
    """
    for keyword, scheme in (("TDD_CTB1", "2015"), ("TDD_CYB1", "2014"), ("TDDORDER", "order")):
        if keyword in keywords:
            return scheme
    return "default"


def drift(
    keywords: Mapping[str, float],
    terms: tuple[tuple[int, int], ...],
    chip: int,
    epoch: float,
    where: str,
) -> Float:
    """Change (2, n_terms) of the coefficients of a chip at an epoch (decimal years).

    `keywords` are all header keywords that begin with TDD, `terms` the powers of the coefficients;
    `where` names the file. InputError if the keywords are not of the 2015 scheme.
    """
    scheme = scheme_of(keywords)
    if scheme != "2015" or "TDD_DATE" not in keywords:
        raise InputError(
            f"time-dependent terms of the scheme {scheme!r} are not evaluated here",
            where=where,
            do="leave out the epoch, or use a table with TDD_DATE and TDD_CTB1",
        )
    out = np.zeros((2, len(terms)))
    for (axis, i, j), name in RATES.items():
        rate = keywords.get(f"{name}{chip}", 0.0)
        out["uv".index(axis), terms.index((i, j))] = rate * (epoch - keywords["TDD_DATE"])
    return out


# -- drifts that a file can hold -------------------------------------------------------------------


@dataclass(frozen=True)
class Loss:
    """Drift that a file does not store."""

    chip: str
    term: Term  # axis, power of x, power of y
    mas: float  # largest displacement left out, over the chip and the years
    sigma: float  # its standard deviation, mas
    years: tuple[float, float]  # first and last date

    def __str__(self) -> str:
        axis, i, j = self.term
        return (
            f"Not stored: drift of the {axis} term x^{i} y^{j} of {self.chip}, at most "
            f"{self.mas:.2g} +- {self.sigma:.1g} mas over the chip from {self.years[0]:g} to "
            f"{self.years[1]:g}"
        )


def storable(
    calibration: Calibration,
    *,
    years: tuple[float, float],
    segment: int = 0,
    limit_mas: float = 0.1,
    like: Calibration | None = None,
) -> tuple[Calibration, tuple[Loss, ...]]:
    """Part of a calibration that an IDCTAB can store, and the drifts that are left out.

    Parameters
    ----------
    calibration : Calibration
        Calibration in an angular unit, along the axes of the IDCTAB (see
        `calibration.orientation`).
    years : tuple of float
        First and last date for which the file is meant.
    segment : int
        Segment of the time dependence, counted from 0.
    limit_mas : float
        Largest sum of the effects of all terms of a chip that may be left out.
    like : Calibration, optional
        Calibration with the drift that the file will store. This calibration then provides its
        coefficients at the reference date, and the difference of the two drifts counts as left out.

    Returns
    -------
    calibration : Calibration
        Selected segment with the terms that can be stored.
    lost : tuple of Loss
        Drifts that are left out.

    Raises
    ------
    InputError
        If more than `limit_mas` would be left out, if the unit is pixels, if the years are not
        ascending, if the segment does not exist, or if `like` depends on time and this solution
        does not, or has another reference date.
    """
    solution = calibration.solution
    if solution.model.unit not in ARCSEC:
        raise InputError(
            f"u and v are in {solution.model.unit}, but the axes of an IDCTAB are angles",
            where="model.unit",
            do="orient the solution first",
        )
    first, last = years
    if not first < last:
        raise InputError(
            f"the years {first} to {last} are not ascending",
            where="years",
            do="give first and last date",
        )
    _check_like(solution, like, segment)
    view: Solution = solution
    of_view: Callable[[Float], Float] = np.asarray
    if solution.model.time is not None:
        selected = segment_of(solution, segment)
        view, of_view = selected, selected.transform
    model, time = view.model, view.model.time
    stored_terms: list[Term] = []
    if time is not None and like is None:
        stored_terms = [term for term in time.terms if term in RATES]
    new = replace(
        model,
        time=TimeDependence(tuple(stored_terms), time.epoch0) if time and stored_terms else None,
    )
    columns = list(range(model.n_polynomial))
    for chip in model.chips:
        start = model.tdd_slice(chip.number).start
        columns += [
            start + k for k, t in enumerate(time.terms if time else ()) if t in stored_terms
        ]
    lost = _lost(view, None if like is None else like.solution, stored_terms, (first, last))
    _check_lost(lost, limit_mas)

    def transform(theta: Float) -> Float:
        return of_view(theta)[..., columns]

    cov = np.asarray(view.cov, float)[np.ix_(columns, columns)]
    held = TransformedSolution(new, np.asarray(view.mean, float)[columns], cov, solution, transform)
    shared = calibration.with_plane
    with_plane = None if shared is None else transform(shared.T).T  # the transformation is linear
    return replace(calibration, solution=held, with_plane=with_plane), lost


def _check_like(solution: Solution, like: Calibration | None, segment: int) -> None:
    if like is None or like.model.time is None:
        return
    time = solution.model.time
    wanted = like.model.time.epoch0[0]
    if time is None or not 0 <= segment < time.n_segments or time.epoch0[segment] != wanted:
        stated = "does not depend on time" if time is None else f"counts from {time.epoch0}"
        raise InputError(
            f"the solution {stated}, and the file's drift from {wanted:g}",
            where="model.tdd",
            do="fit it with the same segments and reference dates, its rates held if need be",
        )


def _lost(
    view: Solution, like: Solution | None, kept: list[Term], years: tuple[float, float]
) -> tuple[Loss, ...]:
    """Effects of drift terms beyond the drift that is stored."""
    model = view.model
    if model.time is None:
        return ()
    factor = 1e3 * ARCSEC[model.unit]
    span = max(abs(t - model.time.epoch0[0]) for t in years)
    out = []
    for chip in model.chips:
        rates, sigmas = rates_of(view, chip.number)
        stored = {} if like is None else rates_of(like, chip.number)[0]
        for term in dict.fromkeys([*rates, *stored]):
            if term in kept:
                continue
            _, i, j = term
            reach = 1.0
            for n, ref, power in zip(chip.size, chip.reference_pixel, (i, j), strict=True):
                # in units of half the size of the chip, like the rates of the model
                reach *= (max(n + 0.5 - ref, ref - 0.5) / (n / 2)) ** power
            lever = factor * span * reach
            rate = rates.get(term, 0.0) - stored.get(term, 0.0)
            # a drift copied from `like` equals the stored one in every draw
            sigma = lever * sigmas.get(term, 0.0) if rate or term not in stored else 0.0
            if max(lever * abs(rate), sigma) > NEGLIGIBLE and (rate or term not in stored):
                out.append(Loss(chip.name, term, lever * abs(rate), sigma, years))
    return tuple(out)


def rates_of(solution: Solution, chip: int) -> tuple[dict[Term, float], dict[Term, float]]:
    """Rates of a model with one segment and their standard deviations, by term."""
    model = solution.model
    if model.time is None:
        return {}, {}
    place = model.tdd_slice(chip)
    values = np.asarray(solution.mean, float)[place].tolist()
    sigmas = np.sqrt(np.diag(np.asarray(solution.cov, float))[place]).tolist()
    terms = model.time.terms
    return dict(zip(terms, values, strict=True)), dict(zip(terms, sigmas, strict=True))


def _check_lost(lost: tuple[Loss, ...], limit_mas: float) -> None:
    for chip in dict.fromkeys(entry.chip for entry in lost):
        mine = [entry for entry in lost if entry.chip == chip]
        total = sum(entry.mas for entry in mine)
        if total > limit_mas:
            worst = max(mine, key=lambda entry: entry.mas)
            raise InputError(
                f"an IDCTAB cannot store drifts of {chip} that reach {total:.3g} mas, most of all "
                f"the term ({', '.join(map(str, worst.term))}) with {worst.mas:.3g} mas",
                where="model.tdd.terms",
                do=f"choose a file for fewer years, or a limit above {limit_mas:g} mas",
            )
