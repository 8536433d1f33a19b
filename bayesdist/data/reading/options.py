"""Options for the columns of a table, checked once."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from bayesdist.data.magnitude_errors import no_magnitudes
from bayesdist.data.repeated_stars import check_same_position
from bayesdist.data.tables.checks import check_not_finite
from bayesdist.data.tables.units import length_in_mm
from bayesdist.errors import BayesdistError, InputError
from bayesdist.utils.quantities import Number, direction_in, year_of


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
    sigma : {'columns', 'by_magnitude'}, float or Quantity, optional
        Source of errors: columns; left to be estimated from residuals by magnitude (they
        are then None); or one number, in the unit of u and v or with a unit of its own.
    pixel_origin : {0, 1}, optional
        Coordinate of the centre of the first pixel; by default 1, or 0 where names or header are
        those of a program that counts from 0.
    tangent_point : SkyCoord, or pair of float or Quantity, optional
        Point where the plane for sky positions touches the sky (numbers: ICRS degrees); by default
        the mean direction of all stars.
    epoch : float, str, Time, date or Quantity, optional
        Decimal year, ISO date or time of all exposures, where the table has no column of it.
        Reference positions with proper motions are brought to it.
    catalogue_epoch : float, str, Time, date or Quantity, optional
        The same of the reference positions, where the table has no column of it.
    chips : mapping of str to int, optional
        Numbers of the chips, where the table has their names; by default from 1 in the order of the
        names.
    not_finite : {'refuse', 'reject'}, optional
        Rows with NaN or infinity are an error, or left out and counted.  Rows with missing (masked)
        values are always left out and counted, in `rejected`.
    same_position : {'one_star', 'separate_stars'}, optional
        Meaning of rows with the same reference position, where the table has no column `star`: they
        are measurements of one star, which share the error of its position, or of separate stars
        with independent errors.  Catalogue positions are compared before proper motions.
    plate_scale : float, optional
        Arcsec in a millimetre, for u and v in a length (of a focal plane, a mask or a metrology),
        which is their unit in the file or `unit`.  They become arcsec, and so do their errors.

    Raises
    ------
    InputError
        For `sigma`, `not_finite` or `same_position` that are none of these.
    """

    columns: Mapping[str, str] | None = None
    unit: str | None = None
    sigma: str | Number = "columns"
    pixel_origin: int | None = None
    tangent_point: Any = None  # (ra, dec) in degrees once it is made
    epoch: Any = None  # decimal year once it is made
    catalogue_epoch: Any = None  # the same
    chips: Mapping[str, int] | None = None
    not_finite: str = "refuse"
    same_position: str = "one_star"
    plate_scale: float | None = None

    def __post_init__(self) -> None:
        check_sigma(self.sigma)
        check_not_finite(self.not_finite)
        check_same_position(self.same_position)
        if self.plate_scale is not None and not 0 < self.plate_scale < np.inf:
            raise InputError(
                f"plate_scale is {self.plate_scale}",
                where="data.plate_scale",
                do="give a positive number of arcsec per mm",
            )
        if self.tangent_point is not None:
            point = direction_in(self.tangent_point, "tangent_point", where="data.tangent_point")
            object.__setattr__(self, "tangent_point", point)
        for key in ("epoch", "catalogue_epoch"):
            if getattr(self, key) is not None:
                year = year_of(getattr(self, key), where=f"data.{key}")
                object.__setattr__(self, key, year)

    @property
    def read_sigma(self) -> bool:
        """True where errors come from columns."""
        return self.sigma == "columns"

    @property
    def plane_sigma(self) -> str | Number:
        """Option `sigma` in the unit to which u and v come: lengths become arcsec.

        Raises
        ------
        InputError
            For a number without unit beside u and v whose unit the file states.
        """
        if self.plate_scale is None or isinstance(self.sigma, str):
            return self.sigma
        quantity: Any = self.sigma
        if hasattr(quantity, "unit"):
            factor = length_in_mm(quantity.unit)
            return quantity if factor is None else quantity.value * factor * self.plate_scale
        factor = length_in_mm(self.unit)
        if factor is None:
            raise InputError(
                f"sigma is {self.sigma}, and u and v are in a length that only the file states",
                where="data.sigma",
                do="set the unit, as in unit = 'mm', in which sigma then is",
            )
        return self.sigma * factor * self.plate_scale

    def refuse(self, source: str, why: str, *names: str, do: str = "leave {} out") -> None:
        """Refuse options that are set and would not be used.

        Parameters
        ----------
        source : str
            File or table, for the error.
        why : str
            Reason why they are not used.
        *names : str
            The options.
        do : str, optional
            What to do, in which {} stands for the option.

        Raises
        ------
        InputError
            If one of the options differs from its default.
        """
        for name in names:
            if getattr(self, name) != getattr(ReadOptions, name):
                raise InputError(
                    f"option {name!r} is given, but {why}", where=source, do=do.format(repr(name))
                )

    def refuse_fixed(self, source: str, kind: str, *names: str) -> None:
        """Refuse options that the format `kind` leaves no room for."""
        why = f"the format {kind} fixes it"
        self.refuse(source, why, *names, do="leave {} out or set the format to 'table'")


@contextmanager
def option_names() -> Iterator[None]:
    """Context in which errors name options without the section [data] of a configuration."""
    key = re.compile(rf"\bdata\.({'|'.join(field.name for field in fields(ReadOptions))})\b")
    try:
        yield
    except BayesdistError as error:
        error.where, error.cause, error.do = (
            key.sub(r"\1", text) for text in (error.where, error.cause, error.do)
        )
        error.args = (error.sentence,)
        raise


def check_sigma(sigma: str | Number) -> None:
    """Refuse an invalid option `sigma`."""
    if isinstance(sigma, str):
        good = sigma in ("columns", "by_magnitude")
    elif hasattr(sigma, "value"):  # its unit is compared with that of u and v later
        good = np.ndim(sigma) == 0 and bool(np.isfinite(sigma.value)) and sigma.value > 0
    else:
        good = not isinstance(sigma, bool) and bool(np.isfinite(sigma)) and sigma > 0
    if not good:
        raise InputError(
            f"sigma is {sigma!r}",
            where="data.sigma",
            do="set it to 'columns', 'by_magnitude', a positive number or a Quantity",
        )


def refuse_missing_errors(
    sigma: str | Number, has_sigma: bool, has_mag: bool, *, where: str
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
