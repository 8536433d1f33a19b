"""Reference positions with errors, proper motions and an epoch."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from bayesdist.data.covariances import LARGEST_RHO, with_correlations, without_sizes
from bayesdist.data.reading.columns import is_on_sky, plane_unit, position_unit
from bayesdist.data.reading.motions import prior_in_mas, with_prior_motions
from bayesdist.data.reading.table import as_table, with_sky_columns
from bayesdist.data.sky import (
    CORRELATIONS,
    PARAMETERS,
    correlation_matrices,
    onto_plane,
    parallax_factors,
    sky_columns,
    tangent_jacobian,
)
from bayesdist.data.tables.checks import (
    COMPLETED,
    check_columns,
    columns_of,
    refuse_half,
    row_number,
    without_missing,
)
from bayesdist.data.tables.column import Quantities, SourceColumn, check_unit
from bayesdist.data.tables.names import ALIASES, find_columns
from bayesdist.errors import InputError
from bayesdist.files.fits import MISSING_EXTENSIONS
from bayesdist.files.tables import read_table
from bayesdist.utils.arrays import Bool, Float, Int
from bayesdist.utils.quantities import Direction, Epoch, Number, direction_in, year_of

_PAIRS = (("sigma_u", "sigma_v"), ("pm_u", "pm_v"), ("sigma_pm_u", "sigma_pm_v"))
_PARALLAX = ("parallax", "sigma_parallax")
_COLUMNS = ("u", "v", "mag", *(name for pair in _PAIRS for name in pair), *_PARALLAX)
ROUNDING = 1e-9  # of correlations
# errors of the parameters that `ReferenceCatalog.correlations` are of, in their order
_SIGMAS = ("sigma_u", "sigma_v", "sigma_parallax", "sigma_pm_u", "sigma_pm_v")


@dataclass(frozen=True, eq=False)
class ReferenceCatalog:
    """Reference stars: positions, errors, proper motions and parallaxes; arrays of length N.

    Parameters
    ----------
    u, v : ndarray
        Positions at `epoch`, in `unit`.
    sigma_u, sigma_v : ndarray, optional
        Standard errors of the positions; 0 or more.
    mag : ndarray, optional
        Magnitudes.
    pm_u, pm_v : ndarray, optional
        Proper motions in `unit` per year.
    sigma_pm_u, sigma_pm_v : ndarray, optional
        Standard errors of the proper motions; 0 or more.
    epoch : float or ndarray, optional
        Decimal year of the positions, common to all stars or one per star.
    unit : str
        'pix', 'arcsec', 'mas' or 'deg'.
    tangent_point : tuple of float, optional
        RA and Dec of the tangent point in degrees, if u, v are on a tangent plane; u increases to
        the east and v to the north.
    source : str
        Name of the file.
    star : ndarray of int, optional
        Code of each star, 0 or more, which identifies it in tables of matches. The default is the
        row, counted from 0. It is kept in every selection.
    parallax, sigma_parallax : ndarray, optional
        Parallaxes and their standard errors in `unit`, for a catalogue with a tangent point; 0 if
        unknown.
    notes : tuple of str
        Clauses on how the stars of the file were treated.
    correlations : ndarray, shape (N, 5, 5), optional
        Correlation matrices of the errors of u, v, parallax, pm_u and pm_v. By default all errors
        are independent.
    assumed_motion : ndarray of bool, shape (N,), optional
        True for stars whose motion is not measured but taken from the others, with its error. By
        default all motions are measured.

    Raises
    ------
    InputError
        If there are no stars, if lengths are unequal, if values are not finite, if errors or codes
        are negative, if only one of a pair of columns is given, or if correlations are impossible.

    Examples
    --------
    >>> catalog = bd.ReferenceCatalog(u=[0.0, 30.0], v=[5.0, -10.0], unit="arcsec")
    >>> len(catalog)
    2
    """

    u: Float
    v: Float
    sigma_u: Float | None = None
    sigma_v: Float | None = None
    mag: Float | None = None
    pm_u: Float | None = None
    pm_v: Float | None = None
    sigma_pm_u: Float | None = None
    sigma_pm_v: Float | None = None
    epoch: float | Float | None = None
    unit: str = "pix"
    tangent_point: tuple[float, float] | None = None
    source: str = "catalogue"
    star: Int = COMPLETED
    parallax: Float | None = None
    sigma_parallax: Float | None = None
    notes: tuple[str, ...] = ()
    correlations: Float | None = None
    assumed_motion: Bool | None = None

    def __post_init__(self) -> None:
        check_unit(self.unit, where=self.source)
        n = np.size(self.u)
        if n == 0:
            raise InputError("holds no stars", where=self.source, do="give a catalogue with stars")
        columns = columns_of(self, _COLUMNS)
        for pair, quantity in zip(_PAIRS, ("errors", "motions", "errors of motions"), strict=True):
            refuse_half(pair, columns, where=self.source, what=quantity)
        sigmas = [name for name in _COLUMNS if name.startswith("sigma")]
        check_columns(self, _COLUMNS, where=self.source, not_negative=sigmas)
        star = np.ascontiguousarray(np.arange(n) if self.star is None else self.star, np.int64)
        object.__setattr__(self, "star", star)
        if star.shape != (n,) or star.min() < 0:
            raise InputError(
                f"codes of the stars are not {n} numbers of 0 or more",
                where=f"{self.source}, column 'star'",
                do="number the stars, or leave out the column",
            )
        if self.epoch is not None and np.ndim(self.epoch):
            object.__setattr__(self, "epoch", np.ascontiguousarray(self.epoch, np.float64))
        if self.epoch is not None and not (
            np.shape(self.epoch) in ((), (n,)) and np.all(np.isfinite(self.epoch))
        ):
            raise InputError(
                "epoch is neither one finite year nor one for each star",
                where=self.source,
                do="give decimal years",
            )
        if self.correlations is not None:
            self._check_correlations(np.asarray(self.correlations, float))
        if self.assumed_motion is not None:
            object.__setattr__(self, "assumed_motion", np.asarray(self.assumed_motion, bool))
            if np.shape(self.assumed_motion) != (n,):
                raise InputError(
                    f"assumed_motion does not have {n} values",
                    where=self.source,
                    do="give True or False for each star, or leave it out",
                )

    def _check_correlations(self, correlations: Float) -> None:
        if self.sigma_u is None:
            raise InputError(
                "has correlations of errors but no errors",
                where=self.source,
                do="give sigma_u and sigma_v, or leave the correlations out",
            )
        n = (len(self), len(_SIGMAS), len(_SIGMAS))
        possible = correlations.shape == n and np.isfinite(correlations).all()
        if not possible or (np.abs(correlations) > 1.0 + ROUNDING).any():
            raise InputError(
                f"correlations are not {n[0]} matrices of 5 x 5 numbers from -1 to 1",
                where=self.source,
                do="give a correlation matrix of u, v, parallax, pm_u and pm_v for each star",
            )
        object.__setattr__(self, "correlations", np.ascontiguousarray(correlations))

    def __len__(self) -> int:
        return len(self.u)

    @property
    def covariances(self) -> Float:
        """Covariances (N, 5, 5) of the errors of u, v, parallax, pm_u and pm_v; 0 if unknown."""
        sigma = np.zeros((len(self), len(_SIGMAS)))
        for k, name in enumerate(_SIGMAS):
            values = getattr(self, name)
            if values is not None:
                sigma[:, k] = values
        correlations = self.correlations
        if correlations is None:
            correlations = np.broadcast_to(np.eye(len(_SIGMAS)), (len(self), 5, 5))
        return with_correlations(sigma, correlations)

    def _with_covariances(self, covariances: Float, **changes: Any) -> ReferenceCatalog:
        """Catalogue with these covariances (N, 5, 5) of its errors, and with other changes."""
        sigma, correlations = without_sizes(covariances)
        sigmas = {
            name: sigma[:, k] for k, name in enumerate(_SIGMAS) if getattr(self, name) is not None
        }
        return replace(self, **{**sigmas, "correlations": correlations, **changes})

    def with_errors_of(self, covariances: Float, jacobian: Float) -> ReferenceCatalog:
        """Catalogue with errors that are transformed from other axes.

        `covariances` (N, 5, 5) are the covariances of position, parallax and motion along those
        axes, and `jacobian` (N, 2, 2) the derivatives of u and v with respect to positions along
        them.
        """
        turn = np.tile(np.eye(len(_SIGMAS)), (len(self), 1, 1))
        turn[:, :2, :2] = turn[:, 3:, 3:] = jacobian
        return self._with_covariances(turn @ covariances @ np.swapaxes(turn, 1, 2))

    @property
    def position_errors(self) -> dict[str, Float]:
        """Errors of positions as columns of `Matches`.

        They are sigma_u and sigma_v and, if errors are correlated, rho_uv, each (N,); empty without
        errors.
        """
        if self.sigma_u is None or self.sigma_v is None:
            return {}
        out = {"sigma_u": self.sigma_u, "sigma_v": self.sigma_v}
        if self.correlations is not None:
            out["rho_uv"] = np.clip(self.correlations[:, 0, 1], -LARGEST_RHO, LARGEST_RHO)
        return out

    def select(self, which: NDArray[Any]) -> ReferenceCatalog:
        """Select stars by mask or indices.

        Parameters
        ----------
        which : ndarray
            Boolean mask (N,), or indices.

        Returns
        -------
        ReferenceCatalog
            The selected stars, with their codes.
        """
        arrays = {name: values[which] for name, values in columns_of(self, _COLUMNS).items()}
        if isinstance(self.epoch, np.ndarray):
            arrays["epoch"] = self.epoch[which]
        for name in ("correlations", "assumed_motion"):
            if getattr(self, name) is not None:
                arrays[name] = getattr(self, name)[which]
        return replace(self, **arrays, star=self.star[which])

    @property
    def measured_motion(self) -> Bool:
        """Mask (N,) of stars whose motion is measured; True if the catalogue has no motions."""
        if self.assumed_motion is None:
            return np.ones(len(self), bool)
        return ~self.assumed_motion

    def by_code(self, *names: str) -> Float | None:
        """Columns (codes, n) of the catalogue, with a row per star code; None if any is missing."""
        out = np.zeros((int(self.star.max()) + 1, len(names)))
        for k, name in enumerate(names):
            values = getattr(self, name)
            if values is None:
                return None
            out[self.star, k] = values
        return out

    def rescaled(self, factor: float, unit: str) -> ReferenceCatalog:
        """Convert the catalogue to another unit.

        Parameters
        ----------
        factor : float
            Size of the present unit in the new unit. All positions, motions and their errors are
            multiplied by it.
        unit : str
            Name of the new unit.

        Returns
        -------
        ReferenceCatalog
            Catalogue in the new unit.
        """
        lengths = columns_of(self, [name for name in _COLUMNS if name != "mag"])
        return replace(self, **{k: factor * values for k, values in lengths.items()}, unit=unit)

    def at(self, epoch: Epoch) -> ReferenceCatalog:
        """Catalogue at another epoch.

            u(t) = u + pm (t - t0),   sigma(t)^2 = sigma^2 + sigma_pm^2 (t - t0)^2

        With correlations, all covariances are carried to the new epoch. Without them, errors of
        positions and proper motions are treated as uncorrelated, which holds at the mean epoch of
        the catalogue's observations. Without proper motions, positions do not change. Without
        errors of the motions, or of the positions, the errors do not change.

        Parameters
        ----------
        epoch : float, str, Time, date or Quantity
            New epoch; numbers are decimal years.

        Returns
        -------
        ReferenceCatalog
            Catalogue with positions and errors at the new epoch.

        Raises
        ------
        InputError
            If there are proper motions but no epoch of the positions.
        """
        year = year_of(epoch)
        if self.pm_u is None or self.pm_v is None:
            return replace(self, epoch=year)
        if self.epoch is None:
            raise InputError(
                "has proper motions but no epoch", where=self.source, do="give the epoch"
            )
        dt = year - np.asarray(self.epoch, float)
        u, v = self.u + self.pm_u * dt, self.v + self.pm_v * dt
        if self.correlations is not None:
            carry = np.tile(np.eye(len(_SIGMAS)), (len(self), 1, 1))
            carry[:, 0, 3] = carry[:, 1, 4] = dt
            moved = carry @ self.covariances @ np.swapaxes(carry, 1, 2)
            return self._with_covariances(moved, u=u, v=v, epoch=year)
        sigma_u, sigma_v = self.sigma_u, self.sigma_v
        if sigma_u is not None and self.sigma_pm_u is not None:
            sigma_u = np.hypot(sigma_u, self.sigma_pm_u * dt)
        if sigma_v is not None and self.sigma_pm_v is not None:
            sigma_v = np.hypot(sigma_v, self.sigma_pm_v * dt)
        return replace(
            self,
            u=u,
            v=v,
            sigma_u=sigma_u,
            sigma_v=sigma_v,
            epoch=year,
        )

    def as_seen(self, epoch: Epoch) -> ReferenceCatalog:
        """Catalogue as seen from the Earth: as from `at`, displaced by the parallaxes.

        Parameters
        ----------
        epoch : float, str, Time, date or Quantity
            Epoch of the observation; numbers are decimal years.

        Returns
        -------
        ReferenceCatalog
            Catalogue without parallax columns: parallaxes are included in the positions, and their
            errors in the errors.

        Raises
        ------
        InputError
            As for `at`.
        """
        then = self.at(epoch)
        if self.parallax is None or self.tangent_point is None:
            return then
        # parallax factors at the middle of the field are used for the whole field
        east, north = parallax_factors(year_of(epoch), *self.tangent_point)[0]
        seen = replace(then, u=then.u + east * self.parallax, v=then.v + north * self.parallax)
        without: dict[str, Any] = {"parallax": None, "sigma_parallax": None}
        if self.sigma_parallax is None or self.sigma_u is None or not self.sigma_parallax.any():
            return replace(seen, **without)
        carry = np.eye(len(_SIGMAS))
        carry[:2, 2] = east, north
        carry[2, 2] = 0.0
        return seen._with_covariances(carry @ seen.covariances @ carry.T, **without)

    def mirrored(self) -> ReferenceCatalog:
        """Catalogue with the sign of u reversed; tangent point and parallaxes are removed."""
        correlations = self.correlations
        if correlations is not None:
            sign = np.array([-1.0, 1.0, 0.0, -1.0, 1.0])
            correlations = correlations * np.outer(sign, sign)
            correlations[:, 2, 2] = 1.0
        return replace(
            self,
            u=-self.u,
            pm_u=None if self.pm_u is None else -self.pm_u,
            tangent_point=None,
            parallax=None,
            sigma_parallax=None,
            correlations=correlations,
        )


_ALIASES: dict[str, tuple[str, ...]] = {
    "u": ("u", "x0", "xi"),
    "v": ("v", "y0", "eta"),
    "ra": ALIASES["ra"],
    "dec": ALIASES["dec"],
    "sigma_u": ("sigma_u", "su", "u_error", "x0e", *ALIASES["sigma_ra"], *ALIASES["sigma_u"]),
    "sigma_v": ("sigma_v", "sv", "v_error", "y0e", *ALIASES["sigma_dec"], *ALIASES["sigma_v"]),
    "pm_u": ("pm_u", "vx", *ALIASES["pm_ra"]),
    "pm_v": ("pm_v", "vy", *ALIASES["pm_dec"]),
    "sigma_pm_u": ("sigma_pm_u", "vxe", *ALIASES["sigma_pm_ra"]),
    "sigma_pm_v": ("sigma_pm_v", "vye", *ALIASES["sigma_pm_dec"]),
    "parallax": ALIASES["parallax"],
    "sigma_parallax": ALIASES["sigma_parallax"],
    "epoch": ("epoch", "t0", *ALIASES["catalogue_epoch"]),
    "mag": (*ALIASES["mag"], "g", "m"),
    "star": ALIASES["star"],
    "rho_uv": ALIASES["rho_uv"],
    **{key: ALIASES[key] for key in sorted(CORRELATIONS)},
}
_NAME_PAIRS = (("u", "v"), ("ra", "dec"), *_PAIRS)
# keys under which tables of matches know these quantities
_ALSO = {"sigma_ra": "sigma_u", "sigma_dec": "sigma_v", "pm_ra": "pm_u", "pm_dec": "pm_v"}
_ALSO |= {"sigma_pm_ra": "sigma_pm_u", "sigma_pm_dec": "sigma_pm_v", "catalogue_epoch": "epoch"}
_IN_MATCHES = {key: name for name, key in _ALSO.items() if key != "epoch"}
_MOTIONS = frozenset(("pm_u", "pm_v", "sigma_pm_u", "sigma_pm_v"))
# missing values of these quantities count as 0
_SPARED = frozenset(_PARALLAX) | CORRELATIONS


def read_catalog(
    path: str | Path,
    columns: Mapping[str, str] | None = None,
    *,
    unit: str | None = None,
    epoch: Epoch | None = None,
    tangent_point: Direction | None = None,
    motion_prior: Number | None = None,
) -> ReferenceCatalog:
    r"""Read a reference catalogue from a table file.

    Parameters
    ----------
    path : path-like
        .ecsv, .csv, .fits or .parquet file.
    columns, unit, epoch, tangent_point, motion_prior
        As for `catalog_from_table`.

    Returns
    -------
    ReferenceCatalog
        Reference stars of the file.

    Raises
    ------
    InputError
        As for `catalog_from_table`, and if the file cannot be read.

    Examples
    --------
    >>> from pathlib import Path
    >>> n = Path("catalog.csv").write_text("u,v,mag\n0,5,18.1\n30,-10,19.4\n")
    >>> bd.read_catalog("catalog.csv", unit="arcsec").mag.tolist()
    [18.1, 19.4]
    """
    path = Path(path)
    return catalog_from_table(
        read_table(path),
        columns,
        source=str(path),
        unit=unit,
        epoch=epoch,
        tangent_point=tangent_point,
        motion_prior=motion_prior,
    )


def catalog_from_table(
    table: Any,
    columns: Mapping[str, str] | None = None,
    *,
    source: str = "catalogue",
    unit: str | None = None,
    epoch: Epoch | None = None,
    tangent_point: Direction | None = None,
    motion_prior: Number | None = None,
) -> ReferenceCatalog:
    """Reference catalogue from the columns of a table.

    Parameters
    ----------
    table : table
        Any object that `Matches.from_table` accepts.
    columns : mapping of str to str, optional
        Column of each quantity: u v ra dec sigma_u sigma_v rho_uv pm_u pm_v sigma_pm_u sigma_pm_v
        parallax sigma_parallax epoch mag star, and the correlations corr_ra_dec and others of
        `ReadOptions`; an empty name omits the quantity. With ra and dec, positions are projected to
        the tangent plane in arcsec. pm_u (pm_ra) is then the motion to the east, which includes the
        factor cos(dec); errors, motions and correlations are rotated to the axes of the plane; and
        stars with a missing value are left out. Missing correlations count as 0.
    source : str, optional
        Name of the file, for error messages.
    unit : str, optional
        Unit of u and v if the table states none. Errors and motions without a unit are in that of u
        and v, per year. With ra and dec they must have a unit, in the file or implied by the names
        of the Gaia archive or VizieR.
    epoch : float, str, Time, date or Quantity, optional
        Epoch of the positions, if the table has no such column.
    tangent_point : SkyCoord, or pair of float or Quantity, optional
        Tangent point. The default is the mean direction of the stars.
    motion_prior : float or Quantity, optional
        Standard deviation on each axis of the motions of stars without a measured one, in mas per
        year if it is a number. The default is the scatter of the other stars, if there are at least
        30; with fewer, and without errors of positions and motions, such stars are left out. With
        fewer than 30, the error of the median of the others is added in quadrature.

    Returns
    -------
    ReferenceCatalog
        Reference stars of the table.

    Raises
    ------
    InputError
        If columns are missing, if values are missing or not numbers, if units are missing or
        contradictory, or if `motion_prior` is not positive or given without errors of positions and
        motions.
    """
    if epoch is not None:
        epoch = year_of(epoch, where=source)
    if motion_prior is not None:
        motion_prior = prior_in_mas(motion_prior, source)
    point = None
    if tangent_point is not None:
        point = direction_in(tangent_point, "tangent_point", where=source)
    table = with_sky_columns(as_table(table, source))
    named = {_ALSO.get(key, key): name for key, name in (columns or {}).items()}
    column_names = find_columns(table.colnames, named, _ALIASES, source=source, pairs=_NAME_PAIRS)
    on_sky = is_on_sky(table.colnames, column_names, named, source)
    first, second = ("ra", "dec") if on_sky else ("u", "v")
    if first not in column_names or second not in column_names:
        raise InputError(
            f"no columns for u, v or ra, dec among {', '.join(table.colnames) or 'none'}",
            where=source,
            do="rename the columns, or name them with the option 'columns'",
        )
    refuse_half(_PAIRS[0], column_names, where=source, what="errors")
    unread = _unread(column_names, on_sky=on_sky)
    column_names = {key: name for key, name in column_names.items() if key not in unread}
    if on_sky:
        base = plane_unit(unit, source=source)
    else:
        u, v = (Quantities(table, column_names, source)[key] for key in ("u", "v"))
        base = position_unit((u, v), unit)
    n_rows = len(table)
    stars = _usable(table, column_names, source, base=base, motion_prior=motion_prior)
    cut = table.meta.get(MISSING_EXTENSIONS)
    notes = (*((f"{source}: {cut}",) if cut else ()), *stars.notes)
    table, rows = stars.table, stars.rows
    quantities = Quantities(table, column_names, source, lambda index: row_number(int(rows[index])))
    column = quantities.__getitem__

    def values(key: str, per_year: str = "") -> Float:
        if on_sky and column(key).unit is None:
            # catalogues use degrees for positions and mas for other columns, so no default is safe
            raise InputError(
                "has no unit",
                where=column(key).where,
                do="write mas or mas / yr into the file, or leave out the column by an empty name "
                "in the option 'columns'",
            )
        numbers = column(key).numbers_or(0.0) if key in _SPARED else column(key).numbers()
        return numbers * column(key).factor(base + per_year)

    out: dict[str, Any] = {}
    if not on_sky:
        out |= {key: values(key) for key in ("u", "v")}
    for pair in _PAIRS:
        if pair[0] in column_names:
            out |= {key: values(key, " / yr" if "pm" in key else "") for key in pair}
    out |= {key: values(key) for key in _PARALLAX if key in column_names}
    if "mag" in column_names:
        out["mag"] = column("mag").numbers()
    if "star" in column_names:
        out["star"] = _identities(column("star"))
    elif len(rows) < n_rows:
        out["star"] = rows
    out["epoch"] = column("epoch").years() if "epoch" in column_names else epoch
    out["assumed_motion"] = stars.assumed if stars.assumed.any() else None
    if not on_sky:
        if "rho_uv" in column_names:
            out["correlations"] = _of_positions(column("rho_uv"))
        return ReferenceCatalog(**out, unit=base, source=source, notes=notes)
    out |= {"unit": base, "source": source, "notes": notes}
    return _on_plane(quantities, out, point)


@dataclass(frozen=True, eq=False)
class _Usable:
    """Rows of a table with all values that are needed."""

    table: Table
    rows: Int  # (N,), rows in the whole table
    assumed: Bool  # (N,), True for motions from a prior
    notes: tuple[str, ...]  # clauses on the others


def _usable(
    table: Table,
    found: Mapping[str, str],
    source: str,
    *,
    base: str,
    motion_prior: float | None,
) -> _Usable:
    """Rows with all values that are needed; missing motions come from a prior if it can be made."""
    on_sky = "ra" in found
    filled = with_prior_motions(
        table,
        {_IN_MATCHES.get(key, key): name for key, name in found.items()},
        source=source,
        sigma_mas_yr=motion_prior,
        reject=True,
        unit=None if on_sky else base,
    )
    rows = np.arange(len(table))
    needed = found if on_sky else {key: found[key] for key in _MOTIONS & found.keys()}
    if not needed or not len(table):
        return _Usable(filled.table, rows, filled.assumed, filled.notes)
    stay, counts = without_missing(
        filled.table, needed, source=source, reject=False, spared=_SPARED, motions=_MOTIONS
    )
    left_out = [f"{n} stars are left out: {reason}" for reason, n in counts.items()]
    return _Usable(filled.table[stay], rows[stay], filled.assumed[stay], (*filled.notes, *left_out))


def _unread(found: Collection[str], *, on_sky: bool) -> set[str]:
    """Quantities that are not read although a table has them, because others are missing."""
    unread = {"u", "v", "rho_uv"} if on_sky else {"ra", "dec", *_PARALLAX, *CORRELATIONS}
    unread |= {name for pair in _PAIRS for name in pair if not set(pair) <= set(found)}
    if on_sky and "pm_u" in unread:
        unread |= _MOTIONS
    if "sigma_u" in unread:
        unread |= {"rho_uv", *CORRELATIONS}
    return unread


def _on_plane(
    quantities: Quantities, out: dict[str, Any], point: tuple[float, float] | None
) -> ReferenceCatalog:
    """Catalogue on a tangent plane, from arguments of `ReferenceCatalog` along east and north."""
    sky_errors = {
        name: out[key] for name, key in zip(PARAMETERS, _SIGMAS, strict=True) if key in out
    }
    sigma, motion, sigma_motion = (
        np.stack([out.pop(key) for key in pair]) if pair[0] in out else None for pair in _PAIRS
    )
    ra, dec = sky_columns(quantities)
    source = quantities.source
    out |= onto_plane(
        ra, dec, point, sigma=sigma, motion=motion, sigma_motion=sigma_motion, where=source
    )
    catalog = ReferenceCatalog(**out)
    correlations = correlation_matrices(quantities, sky_errors)
    if correlations is None:
        return catalog
    errors = np.stack([sky_errors.get(name, np.zeros(len(ra))) for name in PARAMETERS], axis=1)
    return catalog.with_errors_of(
        with_correlations(errors, correlations),
        tangent_jacobian(ra, dec, out["tangent_point"], where=source),
    )


def _of_positions(column: SourceColumn) -> Float:
    """Correlation matrices (N, 5, 5) from a column with the correlation of u and v."""
    rho = column.numbers_or(0.0)
    beyond = np.abs(rho) > 1.0
    if beyond.any():
        bad = int(np.argmax(beyond))
        raise column.fail(bad, f"a correlation is {rho[bad]:g}, but must be at most 1")
    out = np.tile(np.eye(len(_SIGMAS)), (len(rho), 1, 1))
    out[:, 0, 1] = out[:, 1, 0] = rho
    return out


def _identities(column: SourceColumn) -> Int:
    """Codes of the stars; InputError if a code is repeated."""
    star = column.integers()
    unique, first = np.unique(star, return_index=True)
    if len(unique) < len(star):
        repeated = int(np.setdiff1d(np.arange(len(star)), first)[0])
        raise column.fail(repeated, f"star {star[repeated]} occurs twice")
    return star
