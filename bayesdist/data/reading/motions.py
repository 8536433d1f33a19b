"""Proper motions of stars without a measured one: a prior from the other stars of the field.

A star that does not move in its table still moves on the sky.  Its motion is taken as normally
distributed with the median and the scatter of the measured motions of stars of similar magnitude,
so that the error of its position grows with the time from the epoch of the catalogue.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from astropy.table import Column, Table

from bayesdist.data.sky import CORRELATIONS, MOTIONS
from bayesdist.data.tables.checks import absent, row_number, zero_motions
from bayesdist.data.tables.column import EncodedColumn, Quantities, TableColumns
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Bool, Float
from bayesdist.utils.quantities import Number, value_in

log = logging.getLogger("bayesdist")

MIN_STARS = 30  # with a measured motion, from which a prior is made
PER_BIN = 60  # stars of a bin of magnitudes
MOST_BINS = 5
MEDIAN_TO_MEAN = (np.pi / 2.0) ** 0.5  # error of the median of normal values, in errors of the mean
TWO_PARAMETERS = 3  # astrometric_params_solved of Gaia's solutions of the position alone
DOUBTFUL_RUWE = 1.4  # above it Gaia's documentation doubts that a star is single
SOLVED, G_MAGNITUDE, RUWE = "astrometric_params_solved", "phot_g_mean_mag", "ruwe"
ON_SKY = "arcsec"  # unit in which motions of positions on the sky are compared
MAS = {"arcsec": 1e3, "mas": 1.0, "deg": 3.6e6}
# quantities that a prior fills, and what their unit has after that of positions
FILLED = {"pm_ra": " / yr", "pm_dec": " / yr", "parallax": ""}
NEEDED = {"sigma_ra", "sigma_dec", *MOTIONS}  # quantities without which there is no prior


@dataclass(frozen=True, eq=False)
class Filled:
    """Table in which stars without a motion have one from a prior.

    Parameters
    ----------
    table : Table
        The table itself if it has no such stars, or no prior can be made.
    assumed : ndarray of bool, shape (N,)
        True for stars whose motion is from the prior.
    notes : tuple of str
        Clauses about them, and about stars with a doubtful solution.
    """

    table: Table
    assumed: Bool
    notes: tuple[str, ...] = ()


def with_prior_motions(
    table: Table,
    found: Mapping[str, str],
    *,
    source: str,
    sigma_mas_yr: float | None,
    reject: bool,
    unit: str | None = None,
) -> Filled:
    """Give stars without a measured motion one from a prior.

    Parameters
    ----------
    table : Table
        Table with catalogue positions.
    found : mapping of str to str
        Column of each quantity.
    source : str
        Name of the table, for error messages.
    sigma_mas_yr : float or None
        Standard deviation of the prior on each axis; by default that of the other stars.
    reject : bool
        True if rows with errors that are not finite are left out later, False to refuse them.
    unit : str or None
        Unit of positions on a plane, which that of columns without a unit is; None for positions on
        the sky, where columns must have a unit.

    Returns
    -------
    Filled
        With the unchanged table if it has no errors of positions and motions, no such stars, or too
        few stars with a motion to make a prior.

    Raises
    ------
    InputError
        If a star with a motion has no error of it, if a prior is given and the unit of positions is
        no angle, or as for `refuse_unused_prior`.
    """
    refuse_unused_prior(sigma_mas_yr, found, where=source, on_plane=unit is not None)
    unchanged = Filled(table, np.zeros(len(table), bool))
    if not found.keys() >= NEEDED:
        return unchanged
    stars = MovingStars.of(Quantities(table, found, source, row_number), unit)
    if stars is None:
        return unchanged
    if not reject:
        stars.refuse_missing_errors()
    notes = doubtful_solutions(stars.n_doubtful, len(table))
    prior = MotionPrior.of([stars.measured()], sigma_mas_yr, unit=unit, source=source)
    if prior is None or not stars.missing.any():
        return replace(unchanged, notes=notes)
    warn_of_zeros([found[key] for key in MOTIONS[:2]], stars.n_zero, len(table), source)
    out = table.copy(copy_data=False)
    for name, column in prior.columns(stars).items():
        out[name] = column
    magnitude = stars.magnitude[stars.missing]
    note = prior.note(magnitude, len(magnitude), len(table))
    return Filled(out, stars.missing, (*notes, note))


def prior_in_mas(motion_prior: Number, where: str) -> float:
    """Standard deviation of a prior of motions in mas per year; InputError unless it is positive.

    Plain numbers are in mas per year.
    """
    sigma = value_in(motion_prior, "mas / yr", "motion_prior", where=where)
    if not 0 < sigma < np.inf:
        raise InputError(
            f"motion_prior is {sigma}", where=where, do="give a positive number of mas per year"
        )
    return sigma


def refuse_unused_prior(
    sigma_mas_yr: float | None, found: Mapping[str, str], *, where: str, on_plane: bool = False
) -> None:
    """Raise InputError if a prior of motions is given that has no effect.

    `found` are the columns by quantity.  `on_plane` is True for positions u, v.
    """
    if sigma_mas_yr is None:
        return
    lacking = [key for key in (*MOTIONS, "sigma_ra", "sigma_dec") if key not in found]
    if lacking:
        if on_plane:
            lacking = [key.replace("_ra", "_u").replace("_dec", "_v") for key in lacking]
        raise InputError(
            "motion_prior is given, and errors of positions do not grow with it: no column is "
            f"read for {lacking[0]!r}",
            where=where,
            do="leave it out, or read the errors of positions and motions from columns",
        )


@dataclass(frozen=True, eq=False)
class MovingStars:
    """Motions and parallaxes of stars of a table, or of a block of its rows."""

    quantities: Quantities
    missing: Bool  # (N,), True for stars without a measured motion
    n_zero: int  # stars with a motion of exactly 0 on both axes
    n_doubtful: int  # stars whose solution Gaia's documentation doubts
    magnitude: Float  # (N,), NaN if unknown
    # quantities with an error, and the factors from the columns to the unit of positions
    factors: Mapping[str, tuple[float, float]]

    @classmethod
    def of(cls, quantities: Quantities, unit: str | None) -> MovingStars | None:
        """Stars of a table; None if a motion has no unit and needs one, which reading refuses.

        `unit` is as for `with_prior_motions`.
        """
        table, found = quantities.table, quantities.found
        columns = {key: quantities[key] for key in MOTIONS}
        if unit is None and any(column.unit is None for column in columns.values()):
            return None
        zero = zero_motions(*(_plain(columns[key].values) for key in MOTIONS[:2]))
        missing = zero | _without_solution(table)
        for key in MOTIONS[:2]:
            values = _plain(columns[key].values)
            # an infinite motion is not a missing one: reading refuses it, or leaves its row out
            missing |= absent(values, not_finite=True) & ~_infinite(values)
        factors = {}
        for key, per_year in FILLED.items():
            names = (key, f"sigma_{key}")
            if not found.keys() >= set(names):
                continue
            pair = [quantities[name] for name in names]
            if unit is not None or all(column.unit is not None for column in pair):
                first, second = (column.factor((unit or ON_SKY) + per_year) for column in pair)
                factors[key] = first, second
        return cls(
            quantities,
            missing,
            int(np.count_nonzero(zero)),
            _n_doubtful(table),
            _magnitudes(table, found),
            factors,
        )

    def refuse_missing_errors(self) -> None:
        """Raise InputError for a measured motion without an error."""
        for key in MOTIONS[2:]:
            column = self.quantities[key]
            bad = ~self.missing & absent(_plain(column.values), not_finite=True)
            if bad.any():
                raise column.fail(int(np.argmax(bad)), "a measured proper motion has no error")

    def measured(self, rows: slice = slice(None)) -> dict[str, Float]:
        """Measured values and magnitudes (2, n) of each quantity, in the unit of positions.

        `rows` selects a part of the stars.
        """
        out = {}
        for key, (factor, _) in self.factors.items():
            column = self.quantities[key]
            values = factor * column.numbers_or(0.0)
            lacks = self.missing | absent(_plain(column.values), not_finite=True)
            out[key] = np.stack([values, self.magnitude])[:, rows][:, ~lacks[rows]]
        return out


@dataclass(frozen=True, eq=False)
class MotionPrior:
    """Normal distributions of motions and parallaxes by magnitude.

    Parameters
    ----------
    distributions : mapping of str to Distribution
        Distribution of each quantity in the unit of positions (per year).
    unit : str or None
        As for `with_prior_motions`.
    """

    distributions: Mapping[str, Distribution]
    unit: str | None

    @property
    def mas(self) -> float | None:
        """Milliarcseconds in the unit of positions; None if that is no angle."""
        return MAS.get(self.unit or ON_SKY)

    @classmethod
    def of(
        cls,
        parts: Sequence[Mapping[str, Float]],
        sigma_mas_yr: float | None,
        *,
        unit: str | None,
        source: str,
    ) -> MotionPrior | None:
        """Prior from measured values; None if they are too few and no prior is given.

        `parts` are those of `MovingStars.measured` for parts of a table.
        """
        mas = MAS.get(unit or ON_SKY)
        if sigma_mas_yr is not None and mas is None:
            raise InputError(
                f"a prior of motions is given in mas/yr, and positions are in {unit}",
                where=source,
                do="give positions in an angle, or leave motion_prior out",
            )
        sigma = None if sigma_mas_yr is None or mas is None else sigma_mas_yr / mas
        distributions = {}
        for key in FILLED:
            if all(key in part for part in parts):
                values, magnitude = np.concatenate([part[key] for part in parts], axis=1)
                if key not in MOTIONS:
                    distributions[key] = Distribution.of(values, magnitude)
                elif len(values) >= MIN_STARS or sigma is not None:
                    distributions[key] = Distribution.of(values, magnitude, sigma)
                else:
                    return None
        return cls(distributions, unit)

    def columns(self, stars: MovingStars) -> dict[str, Column]:
        """Columns by name in which stars without a motion have that of the prior."""
        quantities, missing, out = stars.quantities, stars.missing, dict[str, Column]()
        for key, distribution in self.distributions.items():
            mean, sigma = distribution.at(stars.magnitude[missing])
            pairs = zip((key, f"sigma_{key}"), stars.factors[key], (mean, sigma), strict=True)
            for name, factor, filling in pairs:
                column = quantities[name]
                values = column.numbers_or(0.0)
                values[absent(_plain(column.values), not_finite=True)] = np.nan
                values[missing] = filling / factor
                out[column.name] = Column(values, unit=column.unit)
        for key in CORRELATIONS - {"corr_ra_dec"}:
            if key in quantities:
                rho = quantities[key].numbers_or(0.0)
                rho[missing] = 0.0
                out[quantities.found[key]] = Column(rho)
        return out

    def filled(self, quantities: Quantities) -> tuple[Quantities, Bool]:
        """Quantities of a block of rows in which stars without a motion have that of the prior.

        The mask (N,) is True for these stars.
        """
        stars = MovingStars.of(quantities, self.unit)
        if stars is None or not stars.missing.any():
            return quantities, np.zeros(len(quantities), bool)
        table = _Replaced(quantities.table, self.columns(stars))
        return replace(quantities, table=table), stars.missing

    def note(self, magnitude: Float, n_missing: int, n: int) -> str:
        """Clause about the `n_missing` of `n` stars that have a motion from the prior.

        `magnitude` are the magnitudes of these stars, or of a part of them.
        """
        axes = [self.distributions[key] for key in MOTIONS[:2]]
        factor, unit = (1.0, self.unit) if self.mas is None else (self.mas, "mas")
        size = (
            factor * float(np.median(np.hypot(*(axis.at(magnitude)[1] for axis in axes)))) / 2**0.5
        )
        motion = "that of the others of similar magnitude"
        n_measured = min(axis.n for axis in axes)
        if n_measured < MIN_STARS:
            first, second = (factor * axis.mean for axis in axes)
            motion = f"{first:.3g} and {second:.3g} {unit}/yr to the east and north"
            if self.unit is not None:
                motion = f"{first:.3g} and {second:.3g} {unit}/yr along u and v"
            motion += f", the median of the {n_measured} measured motions"
            motion += " (0 without any)" if not n_measured else ""
        return (
            f"{n_missing} of {n} rows have no motion; they were given {motion}, with a median "
            f"error of {size:.3g} {unit}/yr on an axis"
        )


@dataclass(frozen=True, eq=False)
class _Replaced:
    """Table with other values in some columns."""

    table: TableColumns
    columns: Mapping[str, Column]

    @property
    def colnames(self) -> Sequence[str]:
        """Names of the columns."""
        return self.table.colnames

    def __len__(self) -> int:
        return len(self.table)

    def __getitem__(self, name: str) -> Any:
        return self.columns[name] if name in self.columns else self.table[name]


@dataclass(frozen=True, eq=False)
class Distribution:
    """Normal distribution of a quantity, in bins of magnitude."""

    mean: float  # of stars without a magnitude
    sigma: float
    magnitude: Float  # (B,), median of each bin
    means: Float  # (B,)
    sigmas: Float  # (B,)
    n: int  # number of measured values

    @classmethod
    def of(cls, values: Float, magnitude: Float, sigma: float | None = None) -> Distribution:
        """Distribution of measured values (M,) with magnitudes (M,), NaN if unknown.

        `sigma` replaces the standard deviations.  With fewer than `MIN_STARS` values, the error of
        their median is added to it.  Without it, the mean is then 0 and the standard deviation
        covers the root mean square of the values, because so few do not determine their scatter.
        """
        none, n = np.zeros(0), len(values)
        if not n:
            return cls(0.0, sigma or 0.0, none, none, none, n)
        if n < MIN_STARS and sigma is None:
            size = float(np.sqrt(np.mean(values**2) * (1.0 + 1.0 / n)))
            return cls(0.0, size, none, none, none, n)
        if n < MIN_STARS and sigma is not None:
            scatter = max(sigma, float(np.std(values, ddof=1)) if n > 1 else 0.0)
            size = float(np.hypot(sigma, MEDIAN_TO_MEAN * scatter / np.sqrt(n)))
            return cls(float(np.median(values)), size, none, none, none, n)
        spread = _normal(values)
        overall = (spread[0], spread[1] if sigma is None else sigma)
        known = np.flatnonzero(np.isfinite(magnitude))
        n_bins = min(MOST_BINS, len(known) // PER_BIN)
        if n_bins < 2:
            return cls(*overall, none, none, none, n)
        order = known[np.argsort(magnitude[known], kind="stable")]
        bins = np.array_split(order, n_bins)
        centres = np.array([np.median(magnitude[rows]) for rows in bins])
        means, sigmas = np.array([_normal(values[rows]) for rows in bins]).T
        if sigma is not None:
            sigmas = np.full(n_bins, sigma)
        return cls(*overall, centres, means, sigmas, n)

    def at(self, magnitude: Float) -> tuple[Float, Float]:
        """Means and standard deviations (n,) for stars of these magnitudes (n,)."""
        n = len(magnitude)
        mean, sigma = np.full(n, self.mean), np.full(n, self.sigma)
        has = np.isfinite(magnitude)
        if len(self.magnitude) and has.any():
            nearest = np.argmin(np.abs(magnitude[has, None] - self.magnitude), axis=1)
            mean[has], sigma[has] = self.means[nearest], self.sigmas[nearest]
        return mean, sigma


def warn_of_zeros(names: Sequence[str], n_zero: int, n: int, source: str) -> None:
    """Log a warning about motions of exactly 0 in the columns `names`, if there are any."""
    if n_zero:
        log.warning(
            "%s: WARNING: %d of %d stars have %s and %s of exactly 0: taken as missing values",
            *(source, n_zero, n, *names),
        )


def _plain(column: Any) -> Any:
    """Values of a column that is encoded, or the column itself."""
    return column.plain if isinstance(column, EncodedColumn) else column


def _infinite(column: Any) -> Bool:
    """Mask (N,) of infinite values of a column; False for masked ones."""
    values = np.ma.filled(np.ma.asarray(getattr(column, "value", column)), 0)
    return np.isinf(values) if values.dtype.kind == "f" else np.zeros(len(values), bool)


def unnamed_columns(names: Iterable[str]) -> list[str]:
    """Columns of Gaia's tables that are used beside those of quantities, as far as they exist."""
    return [name for name in names if name.lower() in (SOLVED, G_MAGNITUDE, RUWE)]


def _named(table: TableColumns, wanted: str) -> str | None:
    """Name of a column in any case; None if the table has no such column."""
    return next((name for name in table.colnames if name.lower() == wanted), None)


def _without_solution(table: TableColumns) -> Bool:
    """Mask (N,) of stars for which Gaia has solved the position alone."""
    name = _named(table, SOLVED)
    if name is None:
        return np.zeros(len(table), bool)
    return np.asarray(np.ma.filled(np.ma.asarray(_plain(table[name])), 0) == TWO_PARAMETERS)


def _n_doubtful(table: TableColumns) -> int:
    """Number of stars whose solution Gaia's documentation doubts."""
    name = _named(table, RUWE)
    if name is None:
        return 0
    values = np.ma.filled(np.ma.asarray(_plain(table[name])), 0.0)
    return int(np.count_nonzero(values > DOUBTFUL_RUWE)) if values.dtype.kind in "iuf" else 0


def doubtful_solutions(n_doubtful: int, n: int) -> tuple[str, ...]:
    """Note on stars with a doubtful solution; empty if there are none."""
    if not n_doubtful:
        return ()
    return (
        f"{n_doubtful} of {n} rows have a ruwe above {DOUBTFUL_RUWE}: they may be double stars, "
        "whose motions Gaia's documentation doubts",
    )


def _magnitudes(table: TableColumns, found: Mapping[str, str]) -> Float:
    """Magnitudes (N,) of the catalogue if it is Gaia, else of the table; NaN if unknown."""
    name = _named(table, G_MAGNITUDE) or found.get("mag")
    out = np.full(len(table), np.nan)
    if name is None:
        return out
    column: Any = _plain(table[name])
    plain = getattr(column, "unmasked", column)
    values = np.asarray(getattr(plain, "value", plain))
    if values.dtype.kind in "iuf":
        known = ~absent(column, not_finite=True)
        out[known] = values[known]
    return out


def _normal(values: Float) -> tuple[float, float]:
    """Median, and the standard deviation that contains 68 % and 95 % of the values.

    The larger of both is used, since motions of a field have wide tails.
    """
    low, first, middle, third, high = np.percentile(values, (2.5, 15.87, 50.0, 84.13, 97.5))
    sigma = max((third - first) / 2.0, (high - low) / (2.0 * 1.96))
    return float(middle), float(sigma * np.sqrt(1.0 + 1.0 / len(values)))
