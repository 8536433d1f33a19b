"""Options for the columns of a table, checked once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bayesdist.data.magnitude_errors import no_magnitudes
from bayesdist.data.tables.checks import check_not_finite
from bayesdist.errors import InputError


@dataclass(frozen=True)
class ReadOptions:
    """Options of reading matches.

    Parameters
    ----------
    columns : mapping of str to str, optional
        Column of each quantity: x y u v ra dec sigma_u sigma_v epoch exposure chip filter mag flux
        colour star u_nominal v_nominal, and with ra and dec sigma_ra sigma_dec pm_ra pm_dec
        sigma_pm_ra sigma_pm_dec corr_ra corr_dec parallax sigma_parallax catalogue_epoch.  What is
        not named is looked for under its usual names (`ALIASES`), in any case of letters; an empty
        name leaves a quantity out.  With ra and dec, u and v are the tangent plane in arcsec.
    unit : {'pix', 'arcsec', 'mas', 'deg'}, optional
        Unit of u and v, where the file states none.
    sigma : {'columns', 'by_magnitude'} or float, optional
        Source of errors: columns; left to be estimated from residuals by magnitude (they
        are then None); or one number, in the unit of u and v.
    pixel_origin : {0, 1}, optional
        Coordinate of the centre of the first pixel; by default 1, or 0 where names or header are
        those of a program that counts from 0.
    tangent_point : tuple of float, optional
        RA and Dec in degrees of the plane for sky positions; by default the mean direction of all
        stars.
    epoch : float or str, optional
        Decimal year or ISO date of all exposures, where the table has no column of it.  Reference
        positions with proper motions are brought to it.
    catalogue_epoch : float, optional
        Decimal year of the reference positions, where the table has no column of it.
    chips : mapping of str to int, optional
        Numbers of the chips, where the table has their names; by default from 1 in the order of the
        names.
    not_finite : {'refuse', 'reject'}, optional
        Rows with NaN or infinity are an error, or left out and counted.  Rows with missing (masked)
        values are always left out and counted, in `rejected`.

    Raises
    ------
    InputError
        For `sigma` or `not_finite` that are none of these.
    """

    columns: Mapping[str, str] | None = None
    unit: str | None = None
    sigma: str | float = "columns"
    pixel_origin: int | None = None
    tangent_point: tuple[float, float] | None = None
    epoch: float | str | None = None
    catalogue_epoch: float | None = None
    chips: Mapping[str, int] | None = None
    not_finite: str = "refuse"

    def __post_init__(self) -> None:
        check_sigma(self.sigma)
        check_not_finite(self.not_finite)

    @property
    def read_sigma(self) -> bool:
        """True where errors come from columns."""
        return self.sigma == "columns"

    def refuse(self, source: str, kind: str, *names: str) -> None:
        """Refuse options that a format leaves no room for."""
        for name in names:
            if getattr(self, name) is not None:
                raise InputError(
                    f"option {name!r} is given, but the format {kind} fixes it",
                    where=source,
                    do=f"leave {name!r} out or set the format to 'table'",
                )


def check_sigma(sigma: str | float) -> None:
    """Refuse an invalid option `sigma`."""
    if isinstance(sigma, str):
        good = sigma in ("columns", "by_magnitude")
    else:
        good = not isinstance(sigma, bool) and bool(np.isfinite(sigma)) and sigma > 0
    if not good:
        raise InputError(
            f"sigma is {sigma!r}",
            where="data.sigma",
            do="set it to 'columns', 'by_magnitude' or a positive number",
        )


def refuse_missing_errors(
    sigma: str | float, has_sigma: bool, has_mag: bool, *, where: str
) -> None:
    """Refuse matches that lack the columns which the option `sigma` asks for."""
    if sigma == "columns" and not has_sigma:
        raise InputError(
            "holds no errors of the positions",
            where=where,
            do="name sigma_u and sigma_v, or set sigma to 'by_magnitude' or a number",
        )
    if sigma == "by_magnitude" and not has_mag:
        raise no_magnitudes(where)
