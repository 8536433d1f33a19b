"""Reference positions with errors, proper motions and an epoch."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.covariances import LARGEST_RHO, with_correlations, without_sizes
from bayesdist.data.sky import parallax_factors
from bayesdist.data.tables.checks import COMPLETED, check_columns, columns_of, refuse_half
from bayesdist.data.tables.column import check_unit
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Bool, Float, Int
from bayesdist.utils.quantities import Epoch, year_of

# columns of which both must be present or absent
PAIRS = (("sigma_u", "sigma_v"), ("pm_u", "pm_v"), ("sigma_pm_u", "sigma_pm_v"))
PARALLAX = ("parallax", "sigma_parallax")
_COLUMNS = ("u", "v", "mag", *(name for pair in PAIRS for name in pair), *PARALLAX)
ROUNDING = 1e-9  # of correlations
# errors of the parameters, in the order of `ReferenceCatalog.correlations`
SIGMAS = ("sigma_u", "sigma_v", "sigma_parallax", "sigma_pm_u", "sigma_pm_v")


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
        for pair, quantity in zip(PAIRS, ("errors", "motions", "errors of motions"), strict=True):
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
        n = (len(self), len(SIGMAS), len(SIGMAS))
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
        sigma = np.zeros((len(self), len(SIGMAS)))
        for k, name in enumerate(SIGMAS):
            values = getattr(self, name)
            if values is not None:
                sigma[:, k] = values
        correlations = self.correlations
        if correlations is None:
            correlations = np.broadcast_to(np.eye(len(SIGMAS)), (len(self), 5, 5))
        return with_correlations(sigma, correlations)

    def _with_covariances(self, covariances: Float, **changes: Any) -> ReferenceCatalog:
        """Catalogue with these covariances (N, 5, 5) of its errors, and with other changes."""
        sigma, correlations = without_sizes(covariances)
        sigmas = {
            name: sigma[:, k] for k, name in enumerate(SIGMAS) if getattr(self, name) is not None
        }
        return replace(self, **{**sigmas, "correlations": correlations, **changes})

    def with_errors_of(self, covariances: Float, jacobian: Float) -> ReferenceCatalog:
        """Catalogue with errors that are transformed from other axes.

        `covariances` (N, 5, 5) are the covariances of position, parallax and motion along those
        axes, and `jacobian` (N, 2, 2) the derivatives of u and v with respect to positions along
        them.
        """
        turn = np.tile(np.eye(len(SIGMAS)), (len(self), 1, 1))
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
            carry = np.tile(np.eye(len(SIGMAS)), (len(self), 1, 1))
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
        carry = np.eye(len(SIGMAS))
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
