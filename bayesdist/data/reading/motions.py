"""Proper motions of stars without a measured one: a prior from the other stars of the field.

A star that does not move in its table still moves on the sky.  Its motion is taken as normally
distributed with the median and the scatter of the measured motions of stars of similar magnitude,
so that the error of its position grows with the time from the epoch of the catalogue.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

import numpy as np
from astropy.table import Column, Table

from bayesdist.data.sky import CORRELATIONS, MOTIONS
from bayesdist.data.tables.checks import absent, row_number, zero_motions
from bayesdist.data.tables.column import Quantities
from bayesdist.utils.arrays import Bool, Float

log = logging.getLogger("bayesdist")

MIN_STARS = 30  # with a measured motion, from which a prior is made
PER_BIN = 60  # stars of a bin of magnitudes
MOST_BINS = 5
TWO_PARAMETERS = 3  # astrometric_params_solved of Gaia's solutions of the position alone
DOUBTFUL_RUWE = 1.4  # above it Gaia's documentation doubts that a star is single
ARCSEC_PER_MAS = 1e-3


def with_prior_motions(
    table: Table,
    found: Mapping[str, str],
    *,
    source: str,
    sigma_mas_yr: float | None,
    reject: bool,
) -> tuple[Table, tuple[str, ...]]:
    """Table in which stars without a motion have one from a prior, and notes on them.

    Parameters
    ----------
    table : Table
        Table with sky positions.
    found : mapping of str to str
        Column of each quantity.
    source : str
        Name of the table, for error messages.
    sigma_mas_yr : float or None
        Standard deviation of the prior on each axis; by default that of the other stars.
    reject : bool
        True if rows with errors that are not finite are left out later, False to refuse them.

    Returns
    -------
    Table
        The table itself if it has no errors of positions and motions, no such stars, or too few
        stars with a motion to make a prior.
    tuple of str

    Raises
    ------
    InputError
        If a star with a motion has no error of it.
    """
    if not {"sigma_ra", "sigma_dec", *MOTIONS} <= found.keys():
        return table, ()
    zero = zero_motions(table[found["pm_ra"]], table[found["pm_dec"]])
    missing = zero | _without_solution(table)
    for key in MOTIONS[:2]:
        missing |= absent(table[found[key]], not_finite=True)
    quantities = Quantities(table, found, source, row_number)
    if any(quantities[key].unit is None for key in MOTIONS):
        return table, ()  # refused in reading
    if not reject:
        _refuse_missing_errors(quantities, ~missing)
    notes = _doubtful(table)
    enough = np.count_nonzero(~missing) >= MIN_STARS
    if not missing.any() or not (enough or sigma_mas_yr is not None):
        return table, notes
    if zero.any():
        log.warning(
            "%s: WARNING: %d of %d stars have %s and %s of exactly 0: taken as missing values",
            *(source, np.count_nonzero(zero), len(table), found["pm_ra"], found["pm_dec"]),
        )
    pairs = [("pm_ra", "sigma_pm_ra", "arcsec / yr"), ("pm_dec", "sigma_pm_dec", "arcsec / yr")]
    if {"parallax", "sigma_parallax"} <= found.keys():
        pairs.append(("parallax", "sigma_parallax", "arcsec"))
    out, magnitude, sizes = table.copy(copy_data=False), _magnitudes(table, found), []
    for key, sigma_key, unit in pairs:
        columns = [quantities[name] for name in (key, sigma_key)]
        if any(column.unit is None for column in columns):
            continue
        factors = [column.factor(unit) for column in columns]
        values, errors = (f * c.numbers_or(0.0) for f, c in zip(factors, columns, strict=True))
        measured = ~missing & ~absent(columns[0].values, not_finite=True)
        mean, sigma = _prior(values, magnitude, measured, missing)
        if key in MOTIONS:
            if sigma_mas_yr is not None:
                sigma = np.full(len(sigma), sigma_mas_yr * ARCSEC_PER_MAS)
            sizes.append(sigma)
        values[missing], errors[missing] = mean, sigma
        for column, factor, filled in zip(columns, factors, (values, errors), strict=True):
            out[column.name] = Column(filled / factor, unit=column.unit)
    for key in CORRELATIONS - {"corr_ra_dec"}:
        if key in found:
            rho = quantities[key].numbers_or(0.0)
            rho[missing] = 0.0
            out[found[key]] = Column(rho)
    size = np.median(np.hypot(*sizes)) / np.sqrt(2.0) / ARCSEC_PER_MAS
    note = (
        f"{np.count_nonzero(missing)} of {len(table)} rows have no motion; they were given that of "
        f"the others of similar magnitude, with an error of {size:.3g} mas/yr on an axis (median)"
    )
    return out, (*notes, note)


def _named(table: Table, wanted: str) -> str | None:
    """Name of a column in any case; None if the table has no such column."""
    return next((name for name in table.colnames if name.lower() == wanted), None)


def _without_solution(table: Table) -> Bool:
    """Mask (N,) of stars for which Gaia has solved the position alone."""
    name = _named(table, "astrometric_params_solved")
    if name is None:
        return np.zeros(len(table), bool)
    return np.asarray(np.ma.filled(np.ma.asarray(table[name]), 0) == TWO_PARAMETERS)


def _refuse_missing_errors(quantities: Quantities, measured: Bool) -> None:
    """Raise InputError for a measured motion without an error."""
    for key in MOTIONS[2:]:
        column = quantities[key]
        bad = measured & absent(column.values, not_finite=True)
        if bad.any():
            raise column.fail(int(np.argmax(bad)), "a measured proper motion has no error")


def _doubtful(table: Table) -> tuple[str, ...]:
    """Note on stars whose solution Gaia's documentation doubts; empty if there are none."""
    name = _named(table, "ruwe")
    if name is None:
        return ()
    values = np.ma.filled(np.ma.asarray(table[name]), 0.0)
    n = np.count_nonzero(values > DOUBTFUL_RUWE) if values.dtype.kind in "iuf" else 0
    if not n:
        return ()
    return (
        f"{n} of {len(table)} rows have a ruwe above {DOUBTFUL_RUWE}: they may be double stars, "
        "whose motions Gaia's documentation doubts",
    )


def _magnitudes(table: Table, found: Mapping[str, str]) -> Float:
    """Magnitudes (N,) of the catalogue if it is Gaia, else of the table; NaN if unknown."""
    name = _named(table, "phot_g_mean_mag") or found.get("mag")
    out = np.full(len(table), np.nan)
    if name is None:
        return out
    column: Any = table[name]
    plain = getattr(column, "unmasked", column)
    values = np.asarray(getattr(plain, "value", plain))
    if values.dtype.kind in "iuf":
        known = ~absent(column, not_finite=True)
        out[known] = values[known]
    return out


def _prior(values: Float, magnitude: Float, measured: Bool, at: Bool) -> tuple[Float, Float]:
    """Means and standard deviations (n,) of the prior for the n stars `at`.

    They are those of the bin of measured stars that is next in magnitude.  Zero without measured
    stars.
    """
    n = int(at.sum())
    if not measured.any():
        return np.zeros(n), np.zeros(n)
    known = measured & np.isfinite(magnitude)
    n_bins = min(MOST_BINS, int(known.sum()) // PER_BIN)
    mean, sigma = (np.full(n, number) for number in _normal(values[measured]))
    if n_bins < 2:
        return mean, sigma
    order = np.flatnonzero(known)[np.argsort(magnitude[known], kind="stable")]
    bins = np.array_split(order, n_bins)
    centres = np.array([np.median(magnitude[rows]) for rows in bins])
    numbers = np.array([_normal(values[rows]) for rows in bins])
    wanted = magnitude[at]
    nearest = np.argmin(np.abs(np.nan_to_num(wanted)[:, None] - centres), axis=1)
    has = np.isfinite(wanted)
    mean[has], sigma[has] = numbers[nearest[has]].T
    return mean, sigma


def _normal(values: Float) -> tuple[float, float]:
    """Median, and the standard deviation that contains 68 % and 95 % of the values.

    The larger of both is used, since motions of a field have wide tails.
    """
    low, first, middle, third, high = np.percentile(values, (2.5, 15.87, 50.0, 84.13, 97.5))
    sigma = max((third - first) / 2.0, (high - low) / (2.0 * 1.96))
    return float(middle), float(sigma * np.sqrt(1.0 + 1.0 / len(values)))
