"""Proper motions from two sets of epochs, and the choice of those that are well measured.

As Kozhurina-Platais et al. 2015, ACS ISR 2015-06, Section 2.2: mean positions before and after a
gap, their difference divided by the time between them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesdist.data.catalog import ReferenceCatalog
from bayesdist.data.magnitude_errors import MAD_TO_SIGMA
from bayesdist.data.matching.voting import mean_spacing
from bayesdist.errors import InputError

__all__ = ["MotionErrorLine", "derive_motions", "motion_error_line", "select_motions"]

Float = NDArray[np.float64]
Line: TypeAlias = "float | Callable[[Float], ArrayLike]"

_STARS_IN_BIN = 200  # stars of a bin in magnitude
_MAX_BINS = 40
# above the median, in the logarithm: 0.6 % of a log-normal distribution
_MAX_SCATTERS_ABOVE = 2.5
_MIN_SCATTER = 0.05  # of ln(sigma): among errors all alike a slightly larger one stays


def derive_motions(
    early: ReferenceCatalog, late: ReferenceCatalog, *, source: str = ""
) -> ReferenceCatalog:
    """Catalogue with proper motions from mean positions at two epochs.

        pm = (u2 - u1) / (t2 - t1),      sigma_pm^2 = (s1^2 + s2^2) / (t2 - t1)^2
        t0 = (t1 / s1^2 + t2 / s2^2) / (1 / s1^2 + 1 / s2^2)

    At t0, the error-weighted mean epoch of each star, the errors of position and motion are
    uncorrelated, so that the error grows as sigma^2 + sigma_pm^2 (t - t0)^2 on both sides.  A star
    has one t0 for both axes, with s^2 = s_u^2 + s_v^2: exact where the ratio of early to late
    errors is the same on both axes.

    Parameters
    ----------
    early, late : ReferenceCatalog
        Positions in one system, with errors and epoch (one, or one for each star).  The stars of
        both are paired by their codes `star`; those of one catalogue only are left out.
    source : str, optional
        Name of the catalogue that is made.

    Returns
    -------
    ReferenceCatalog
        In the order of `early`, with its codes and magnitudes.

    Raises
    ------
    InputError
        When epochs or errors are missing or the units differ, when there are no common stars, when
        one has the same or a later epoch in `early`, or when the codes do not name the same stars
        (positions differ by more than a quarter of the distance between neighbours).
    """
    where = f"{early.source} and {late.source}"
    for one in (early, late):
        if one.epoch is None or one.sigma_u is None or one.sigma_v is None:
            lacks = "epoch" if one.epoch is None else "errors of the positions"
            raise InputError(
                f"has no {lacks}", where=one.source, do="give the mean epoch and sigma_u, sigma_v"
            )
        if not ((one.sigma_u > 0).all() and (one.sigma_v > 0).all()):
            raise InputError("has errors of 0", where=one.source, do="give positive errors")
        unique = np.unique(one.star)
        if len(unique) < len(one.star):
            raise InputError(
                "has one star code twice", where=one.source, do="number the stars differently"
            )
    if early.unit != late.unit or early.tangent_point != late.tangent_point:
        raise InputError(
            "have different units or tangent points", where=where, do="bring both to one"
        )
    _, a, b = np.intersect1d(early.star, late.star, assume_unique=True, return_indices=True)
    if not len(a):
        raise InputError("have no star in common", where=where, do="give both the same star codes")
    order = np.argsort(a)
    one, two = early.select(a[order]), late.select(b[order])
    first, second = (np.broadcast_to(np.asarray(c.epoch, float), len(c)) for c in (one, two))
    dt = second - first
    if not (dt > 0).all():
        bad = int(np.argmax(~(dt > 0)))
        raise InputError(
            f"star {one.star[bad]} has epochs {first[bad]:g} and then {second[bad]:g}",
            where=where,
            do="give the earlier catalogue first",
        )
    step = np.stack([two.u - one.u, two.v - one.v])
    apart, spacing = float(np.median(np.hypot(*step))), mean_spacing(np.stack([one.u, one.v], -1))
    if len(one) > 1 and apart > 0.25 * spacing:
        raise InputError(
            f"stars of one code lie {apart:.3g} {one.unit} apart, where neighbours have "
            f"{spacing:.3g}",
            where=where,
            do="give the same star the same code in both, and positions in one system",
        )
    s1, s2 = (np.stack([c.sigma_u, c.sigma_v]) for c in (one, two))  # type: ignore[list-item]
    w1, w2 = 1.0 / (s1**2).sum(axis=0), 1.0 / (s2**2).sum(axis=0)
    late_part = w2 / (w1 + w2)
    pm = step / dt
    sigma_pm = np.hypot(s1, s2) / dt
    sigma = np.hypot(s1 * (1.0 - late_part), s2 * late_part)
    return ReferenceCatalog(
        u=one.u + step[0] * late_part,
        v=one.v + step[1] * late_part,
        sigma_u=sigma[0],
        sigma_v=sigma[1],
        mag=one.mag if one.mag is not None else two.mag,
        pm_u=pm[0],
        pm_v=pm[1],
        sigma_pm_u=sigma_pm[0],
        sigma_pm_v=sigma_pm[1],
        epoch=first + dt * late_part,
        unit=one.unit,
        tangent_point=one.tangent_point,
        source=source or where,
        star=one.star,
    )


@dataclass(frozen=True, eq=False)
class MotionErrorLine:
    """Largest error of a proper motion that counts as well measured, by magnitude.

    Parameters
    ----------
    mag, sigma : ndarray, shape (B,)
        Knots in rising magnitude; linear in the logarithm between, constant beyond.
    """

    mag: Float
    sigma: Float

    def __call__(self, mag: ArrayLike) -> Float:
        """The line at magnitudes, in the catalogue's unit per year."""
        return np.exp(np.interp(np.asarray(mag, float), self.mag, np.log(self.sigma)))


def motion_error_line(catalog: ReferenceCatalog) -> MotionErrorLine:
    """Line in magnitude and proper-motion error above which stars are badly measured.

    In bins of about 200 stars by magnitude (40 bins at most) the line is the median of the error
    times exp(2.5 s), s being the robust scatter (1.4826 median absolute deviation) of its
    logarithm. The median follows how errors grow towards faint stars; what lies above is far from
    the stars of its own magnitude.  The error is the larger one of the two axes.

    Parameters
    ----------
    catalog : ReferenceCatalog

    Returns
    -------
    MotionErrorLine

    Raises
    ------
    InputError
        Without magnitudes or errors of the motions.
    """
    sigma = _motion_errors(catalog)
    if catalog.mag is None:
        raise InputError(
            "has no magnitudes to tell badly measured motions by",
            where=catalog.source,
            do="give them, or one largest error for all, or keep all stars "
            "(campaign.pm_selection = 'all')",
        )
    count = int(np.clip(len(catalog) // _STARS_IN_BIN, 1, _MAX_BINS))
    parts = np.array_split(np.argsort(catalog.mag, kind="stable"), count)
    knots = []
    for part in parts:
        log = np.log(np.maximum(sigma[part], np.finfo(float).tiny))
        middle = float(np.median(log))
        scatter = max(MAD_TO_SIGMA * float(np.median(np.abs(log - middle))), _MIN_SCATTER)
        knots.append(
            (float(np.median(catalog.mag[part])), np.exp(middle + _MAX_SCATTERS_ABOVE * scatter))
        )
    mag, line = np.array(knots).T
    return MotionErrorLine(mag, line)


def select_motions(catalog: ReferenceCatalog, max_sigma: Line | None = None) -> ReferenceCatalog:
    """Stars with well measured proper motions (the red line of the report's Figure 3).

    Parameters
    ----------
    catalog : ReferenceCatalog
    max_sigma : float or callable, optional
        Largest error in the catalogue's unit per year, of the worse axis: a number, or a function
        of an array of magnitudes; by default `motion_error_line`.

    Returns
    -------
    ReferenceCatalog
        The stars at or below the line; they keep their codes.

    Raises
    ------
    InputError
        Without errors of the motions, without magnitudes where the line needs them, or when no star
        is left.
    """
    sigma = _motion_errors(catalog)
    if max_sigma is None:
        max_sigma = motion_error_line(catalog)
    if callable(max_sigma):
        if catalog.mag is None:
            raise InputError(
                "has no magnitudes, and the largest error depends on them",
                where=catalog.source,
                do="give them, or one largest error for all",
            )
        limit = np.asarray(max_sigma(catalog.mag), float)
    else:
        limit = np.full(len(catalog), float(max_sigma))
    good = sigma <= limit
    if not good.any():
        raise InputError(
            "no star has a proper motion measured so well",
            where=catalog.source,
            do="allow larger errors",
        )
    return catalog.select(good)


def _motion_errors(catalog: ReferenceCatalog) -> Float:
    if catalog.sigma_pm_u is None or catalog.sigma_pm_v is None:
        raise InputError(
            "has no errors of the proper motions",
            where=catalog.source,
            do="give sigma_pm_u and sigma_pm_v, or derive them from two sets of epochs",
        )
    return np.maximum(catalog.sigma_pm_u, catalog.sigma_pm_v)
