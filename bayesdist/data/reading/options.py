"""Options for reading the columns of a table, validated once."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from typing import Any, TypedDict

import numpy as np

from bayesdist.data.magnitude_errors import no_magnitudes
from bayesdist.data.reading.motions import prior_in_mas
from bayesdist.data.repeated import check_same_position
from bayesdist.data.tables.checks import check_not_finite
from bayesdist.data.tables.column import length_in_mm
from bayesdist.errors import BayesdistError, InputError
from bayesdist.utils.quantities import Direction, Epoch, Number, direction_in, value_in, year_of


class ReadArguments(TypedDict, total=False):
    """Arguments of functions that read matches: the fields of `ReadOptions`, all optional."""

    columns: Mapping[str, str] | None
    unit: str | None
    sigma: str | Number
    pixel_origin: int | None
    tangent_point: Direction | None
    epoch: Epoch | None
    catalogue_epoch: Epoch | None
    chips: Mapping[str, int] | None
    not_finite: str
    same_position: str
    plate_scale: Number | None
    motion_prior: Number | None


@dataclass(frozen=True)
class ReadOptions:
    """Options for reading matches.

    Parameters
    ----------
    columns : mapping of str to str, optional
        Column of each quantity: x y u v ra dec sigma_u sigma_v epoch exposure chip filter mag flux
        colour star assumed_motion u_nominal v_nominal, and with ra and dec sigma_ra sigma_dec
        pm_ra pm_dec sigma_pm_ra sigma_pm_dec parallax sigma_parallax catalogue_epoch and the
        correlations of these (corr_ra_dec, corr_ra_pm_ra, ...). Other
        quantities are searched for under their usual names (`ALIASES`), ignoring case; an empty
        name omits a quantity. With ra and dec, u and v are on the tangent plane in arcsec.
    unit : {'pix', 'arcsec', 'mas', 'deg'}, optional
        Unit of u and v if the file states none.
    sigma : {'columns', 'by_magnitude'}, float or Quantity, optional
        Source of the errors: columns; estimates from residuals by magnitude, which are made later
        (errors are then None); or one number, in the unit of u and v or as a Quantity.
    pixel_origin : {0, 1}, optional
        Coordinate of the centre of the first pixel. The default is 1, or 0 if column names or the
        header are those of a program that counts from 0.
    tangent_point : SkyCoord, or pair of float or Quantity, optional
        Tangent point for sky positions (numbers: ICRS degrees). The default is the mean direction
        of all stars.
    epoch : float, str, Time, date or Quantity, optional
        Decimal year, ISO date or time of all exposures, if the table has no such column. Reference
        positions with proper motions are moved to it.
    catalogue_epoch : float, str, Time, date or Quantity, optional
        Epoch of the reference positions, if the table has no such column.
    chips : mapping of str to int, optional
        Numbers of the chips, if the table has chip names. The default is from 1 in the order of the
        names.
    not_finite : {'refuse', 'reject'}, optional
        Rows with NaN or infinity are an error, or are left out and counted. Rows with missing
        (masked) values are always left out and counted in `rejected`.
    same_position : {'one_star', 'separate_stars'}, optional
        Meaning of rows with the same reference position, if the table has no column `star`:
        measurements of one star, which share the error of its position, or of separate stars with
        independent errors. Catalogue positions are compared before proper motions are applied.
    plate_scale : float or Quantity, optional
        Arcsec per millimetre, for u and v in a length unit (of a focal plane, a mask or a
        metrology), which is stated in the file or by `unit`. Positions and errors are converted to
        arcsec.
    motion_prior : float or Quantity, optional
        Standard deviation on each axis, in mas per year, of the motions of stars without a measured
        one; only with sigma = 'columns'. The default is the scatter of the other stars, if there
        are at least 30; with fewer, in tables without errors of positions and motions, and with any
        other `sigma`, such stars are left out.

    Raises
    ------
    InputError
        If `sigma`, `not_finite` or `same_position` is none of these values, or if `plate_scale`,
        `motion_prior`, the tangent point or an epoch is invalid.
    """

    columns: Mapping[str, str] | None = None
    unit: str | None = None
    sigma: str | Number = "columns"
    pixel_origin: int | None = None
    tangent_point: Any = None  # converted to (ra, dec) in degrees
    epoch: Any = None  # converted to a decimal year
    catalogue_epoch: Any = None  # converted to a decimal year
    chips: Mapping[str, int] | None = None
    not_finite: str = "refuse"
    same_position: str = "one_star"
    plate_scale: Any = None  # converted to arcsec per mm
    motion_prior: Any = None  # converted to mas per year

    def __post_init__(self) -> None:
        check_sigma(self.sigma)
        check_not_finite(self.not_finite)
        check_same_position(self.same_position)
        if self.plate_scale is not None:
            where = "data.plate_scale"
            plate_scale = value_in(self.plate_scale, "arcsec / mm", "plate_scale", where=where)
            if not 0 < plate_scale < np.inf:
                raise InputError(
                    f"plate_scale is {plate_scale}",
                    where=where,
                    do="give a positive number of arcsec per mm",
                )
            object.__setattr__(self, "plate_scale", plate_scale)
        if self.motion_prior is not None:
            motion_prior = prior_in_mas(self.motion_prior, "data.motion_prior")
            object.__setattr__(self, "motion_prior", motion_prior)
        if self.motion_prior is not None and not self.read_sigma:
            raise InputError(
                f"motion_prior is given, and sigma is {self.sigma!r}, which does not grow with the "
                "error of a motion",
                where="data.motion_prior",
                do="leave it out: stars without a motion are then left out; or set sigma to "
                "'columns'",
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
        """True if errors are read from columns."""
        return self.sigma == "columns"

    @property
    def plane_sigma(self) -> str | Number:
        """Option `sigma` in the unit of u and v after reading: lengths are converted to arcsec.

        Raises
        ------
        InputError
            If `sigma` is a plain number but the unit of u and v is stated only in the file.
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
                f"sigma is {self.sigma}, but u and v are in a length that only the file states",
                where="data.sigma",
                do="set the unit of u, v and sigma, as in unit = 'mm'",
            )
        return self.sigma * factor * self.plate_scale

    def refuse(self, source: str, why: str, *names: str, do: str = "leave {} out") -> None:
        """Raise InputError for options that are set but would not be used.

        Parameters
        ----------
        source : str
            File or table, for the error message.
        why : str
            Reason why the options are not used.
        *names : str
            Names of the options.
        do : str, optional
            Advice, in which {} stands for the name of the option.

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
        """Raise InputError for options that are set although the format `kind` fixes them.

        `source` is the file, for the error message; `names` are the names of the options.
        """
        why = f"the format {kind} fixes it"
        self.refuse(source, why, *names, do="leave {} out or set the format to 'table'")


@contextmanager
def option_names() -> Iterator[None]:
    """Remove the configuration section [data] from option names in error messages."""
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
    """Raise InputError if the option `sigma` is invalid."""
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
    """Raise InputError if matches lack the columns that the option `sigma` requires.

    `has_sigma` and `has_mag` state whether there are columns of errors and of magnitudes.
    """
    if sigma == "columns" and not has_sigma:
        raise InputError(
            "holds no errors of the positions",
            where=where,
            do="name sigma_u and sigma_v, or set sigma to 'by_magnitude' or a number",
        )
    if sigma == "by_magnitude" and not has_mag:
        raise no_magnitudes(where)
