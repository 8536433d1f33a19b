"""Systematic errors of a reference catalogue: published or stated by the user, over the field."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bayesdist.assess.terms.forms import LOCAL, PUBLISHED, ErrorTerm, Row
from bayesdist.assess.terms.functions import Functions
from bayesdist.assess.terms.given import (
    UserTerm,
    is_stated,
    names_catalogue,
    names_motions,
    said_by_user,
    sizes_of,
)
from bayesdist.assess.terms.sky_field import AngularCovariance, SkyTerm, SplitField
from bayesdist.assess.units import convert
from bayesdist.data import Matches
from bayesdist.data.tables.column import UNITS
from bayesdist.errors import InputError, require_known
from bayesdist.infer.solution.solution import Solution
from bayesdist.utils.arrays import Float
from bayesdist.utils.quantities import Number

EVERYWHERE = math.inf  # degrees; the scale of an error that is common to the whole sky
BRIGHT = 13.0  # mag; brighter stars of Gaia are in a reference frame that rotates
OVER_THE_FIELD = "over the field"
MOTIONS_OF = "proper motions"
NO_ERRORS = AngularCovariance()


@dataclass(frozen=True)
class Systematics:
    """Published systematic errors of a catalogue; docs/method.md lists the sources."""

    source: str  # of the motions, or of the positions if `of_positions` is empty
    positions: AngularCovariance  # at `epoch`
    motions: AngularCovariance = NO_ERRORS
    # common error of the motions of stars brighter than BRIGHT: rotation of their frame
    bright_motions: AngularCovariance = NO_ERRORS
    epoch: float | None = None  # of the positions, decimal years; None if motions have no errors
    of_positions: str = ""  # source of the positions if they have another one


def _gaia(motions: AngularCovariance, parallaxes: AngularCovariance) -> AngularCovariance:
    """Covariance of Gaia's positions at its epoch, for which none is published.

    Positions are assumed to err as the motions do in one year.  Half of the variance of parallaxes
    is added, which is the mean over the directions and dates of the squared parallax factor.
    """
    return motions + parallaxes.times(0.5)


_ASSUMED = (
    f"{PUBLISHED} errors of motions and parallaxes, and the assumption that positions err as "
    "motions do in one year"
)

# mas^2 and degrees
_MOTIONS_3 = AngularCovariance(((292e-6, 12.0), (333e-6, 0.25)))
_MOTIONS_2 = AngularCovariance(((800e-6, 20.0), (3600e-6, 0.25)))
_PARALLAXES_3 = AngularCovariance(((142e-6, 16.0), (400e-6, EVERYWHERE)))
_PARALLAXES_2 = AngularCovariance(((285e-6, 14.0), (1564e-6, 0.25), (841e-6, EVERYWHERE)))
# a rotation by w displaces positions by w^2 / 3 on each axis, in the mean over the sky
_SPIN_3 = AngularCovariance(((0.080**2 / 3.0, EVERYWHERE),))
_SPIN_2 = AngularCovariance(((0.150**2 / 3.0, EVERYWHERE),))

_GAIA_3 = Systematics(
    f"{PUBLISHED}: Lindegren et al. 2021 (A&A 649, A2), Vasiliev & Baumgardt 2021, Cantat-Gaudin & "
    "Brandt 2021",
    _gaia(_MOTIONS_3, _PARALLAXES_3),
    _MOTIONS_3,
    _SPIN_3,
    2016.0,
    f"{_ASSUMED} (Lindegren et al. 2021, A&A 649, A2)",
)
PUBLISHED_SYSTEMATICS: Mapping[str, Systematics] = {
    "Gaia DR3": _GAIA_3,
    "Gaia EDR3": _GAIA_3,
    "Gaia DR2": Systematics(
        f"{PUBLISHED}: Lindegren et al. 2018 (A&A 616, A2), Vasiliev 2019",
        _gaia(_MOTIONS_2, _PARALLAXES_2),
        _MOTIONS_2,
        _SPIN_2,
        2015.5,
        f"{_ASSUMED} (Lindegren et al. 2018, A&A 616, A2)",
    ),
    "Pan-STARRS": Systematics(
        f"{PUBLISHED}: Magnier et al. 2020 (ApJS 251, 6), Lubow et al. 2021",
        AngularCovariance(((5.0**2, EVERYWHERE), (11.5**2, 1 / 60))),
    ),
    "2MASS": Systematics(
        f"{PUBLISHED}: CASU, astrometric properties of VST (residuals of a detector against 2MASS)",
        AngularCovariance(((25.0**2, 0.15),)),
    ),
}
_ALSO_NAMED = {"ps1": "Pan-STARRS", "panstarrs1": "Pan-STARRS", "panstarrsps1": "Pan-STARRS"}


def fraction_of_bright(stars: Matches) -> float:
    """Fraction of stars brighter than `BRIGHT`; 1, the worst case, if they have no magnitudes."""
    return float(np.mean(stars.mag < BRIGHT)) if stars.mag is not None else 1.0


def _key(name: str) -> str:
    """Name of a catalogue without case, spaces and hyphens."""
    return "".join(c for c in name.lower() if c.isalnum())


_BY_KEY = {_key(name): name for name in PUBLISHED_SYSTEMATICS} | _ALSO_NAMED


def published_systematics(name: str, where: str) -> Systematics:
    """Published systematic errors of a catalogue by its name.

    Raises InputError with the names that are known if there are none; `where` is for the message.
    """
    known = _BY_KEY.get(_key(name))
    if known is None:
        listed = ", ".join(PUBLISHED_SYSTEMATICS)
        raise InputError(
            f"no published errors are known of a catalogue with this name, but of {listed}",
            where=where,
            do="give systematics_mas, correlation_deg and source",
        )
    return PUBLISHED_SYSTEMATICS[known]


def require_catalogue(catalogue: object) -> None:
    """Raise InputError if an argument is neither a Catalogue nor None."""
    if not isinstance(catalogue, Catalogue | None):
        raise InputError(
            f"the catalogue is {catalogue!r}",
            where="catalogue",
            do="give an object, as in bd.Catalogue('Gaia DR3')",
        )


@dataclass(frozen=True, init=False)
class Catalogue:
    """The systematic error of the reference catalogue.

    A verdict needs it, because matched stars cannot reveal an error that is common to all stars of
    the catalogue.  There are three ways to state it:

    - by the name of a catalogue with published errors, 'Gaia DR3', 'Gaia EDR3', 'Gaia DR2',
      'Pan-STARRS' or '2MASS'; it corresponds to the section ``[catalogue]`` of a configuration;
    - by `systematics_mas` and `correlation_deg`, in the same section;
    - by one `sigma`, whose correlation over the field is unknown.  It corresponds to a
      ``[[budget]]`` row with the same name, sizes and source.

    Parameters
    ----------
    name : str
        Name of the catalogue, such as 'Gaia DR3'.
    sigma : float or Quantity, or a pair of them, optional
        Standard deviation of the positions, for both axes or along u and v; stored as a pair.
    unit : str
        'pix', 'arcsec', 'mas' or 'deg' of `sigma`; ignored for Quantities.
    source : str
        Origin of the number. A `sigma` of 0 needs a source.
    sigma_mas : float, optional
        Size in milliarcseconds, instead of `sigma`.
    systematics_mas : float, optional
        Standard deviation on each axis of position errors that are correlated over the sky, in mas;
        replaces published numbers.
    motions_mas_yr : float, optional
        The same of the proper motions, in mas per year.  By default 0 if `systematics_mas` is
        given.
    correlation_deg : float, optional
        Separation in degrees at which the correlation of these errors is 1/e.
    epoch : float, optional
        Epoch of the positions, decimal years, from which errors of the motions grow.
    bright_fraction : float, optional
        Fraction of the stars brighter than G = 13, whose motions in Gaia are in a rotating frame.
        By default it is counted from the magnitudes of the matches, and 1 if they have none.

    Raises
    ------
    InputError
        If the name is empty or that of proper motions, nothing is published of the catalogue and no
        size is given, a size is given twice, is negative or not finite, a size of 0 has no source,
        or the unit is unknown.

    Examples
    --------
    >>> bd.Catalogue("Gaia DR3").row_name
    'Gaia DR3'
    >>> catalogue = bd.Catalogue("Gaia DR3", sigma_mas=0.3, source="Lindegren et al. 2021")
    >>> catalogue.sigma, catalogue.unit
    ((0.3, 0.3), 'mas')
    >>> catalogue.term().source
    'given by the user: Lindegren et al. 2021'
    """

    name: str
    sigma: tuple[float, float] | None
    unit: str
    source: str
    systematics_mas: float | None
    motions_mas_yr: float | None
    correlation_deg: float | None
    epoch: float | None
    bright_fraction: float | None

    def __init__(
        self,
        name: str,
        sigma: Number | tuple[Number, Number] | None = None,
        unit: str = "mas",
        source: str = "",
        *,
        sigma_mas: float | None = None,
        systematics_mas: float | None = None,
        motions_mas_yr: float | None = None,
        correlation_deg: float | None = None,
        epoch: float | None = None,
        bright_fraction: float | None = None,
    ) -> None:
        if not (isinstance(name, str) and name.strip()):
            raise InputError(
                f"the reference catalogue has the name {name!r}",
                where="catalogue",
                do="give its name, as in bd.Catalogue('Gaia DR3')",
            )
        location = f"catalogue {name!r}"
        if names_motions(name):
            raise InputError(
                "the name is that of proper motions, and the error is that of positions",
                where=location,
                do="name the catalogue, and give errors of its motions as a UserTerm",
            )
        require_known(unit, UNITS, "unit", where=location)
        if sigma is not None and sigma_mas is not None:
            raise InputError(
                "the size of its error is given twice",
                where=location,
                do="give sigma_mas, or sigma with its unit",
            )
        numbers = {
            "systematics_mas": systematics_mas,
            "motions_mas_yr": motions_mas_yr,
            "correlation_deg": correlation_deg,
            "epoch": epoch,
            "bright_fraction": bright_fraction,
        }
        sizes = None
        if sigma is not None or sigma_mas is not None:
            sizes, unit = _pair(sigma, unit, sigma_mas, source, location)
            given = next((key for key, number in numbers.items() if number is not None), None)
            if given is not None:
                raise InputError(
                    f"sigma and {given} are given",
                    where=location,
                    do="give one number whose correlation is unknown as sigma, or systematics_mas "
                    "and correlation_deg",
                )
        else:
            _check_numbers(name, numbers, location)
        arguments = {"name": name, "sigma": sizes, "unit": unit, "source": source, **numbers}
        for key, value in arguments.items():
            object.__setattr__(self, key, value)

    @property
    def row_name(self) -> str:
        """Name of its row of the budget, which always identifies it as a catalogue."""
        return self.name if names_catalogue(self.name) else f"reference catalogue {self.name}"

    def term(
        self, dates: Sequence[float] | Float = (), bright_fraction: float = 1.0
    ) -> UserTerm | CatalogueSystematics:
        """Term of the error budget, equal to the one of a run with this catalogue.

        Parameters
        ----------
        dates : sequence of float, optional
            Dates of the exposures in decimal years.
        bright_fraction : float, optional
            Fraction of the stars that are brighter than G = 13, unless the catalogue states it.

        Returns
        -------
        UserTerm or CatalogueSystematics
            The first if one sigma is stated.
        """
        if self.sigma is not None:
            source = said_by_user(self.source)
            return UserTerm(
                self.row_name, "systematic", *self.sigma, self.unit, source, varies=True
            )
        systematics, source = self._systematics()
        if self.bright_fraction is not None:
            bright_fraction = self.bright_fraction
        motions = systematics.motions + systematics.bright_motions.times(bright_fraction**2)
        years = float(np.mean(dates)) if len(dates) else None
        return CatalogueSystematics(
            self.row_name,
            systematics.positions,
            motions,
            systematics.epoch,
            source,
            years,
            systematics.of_positions,
        )

    def doubt_on_pointings(self, apart: float) -> str:
        """Warning if exposures point farther apart than errors are correlated; else empty.

        `apart` is the largest distance of a pointing from the mean of all, in degrees.
        """
        if self.sigma is not None:
            return ""
        systematics, _ = self._systematics()
        parts = (*systematics.positions.parts, *systematics.motions.parts)
        shortest = min((s for _, s in parts if math.isfinite(s)), default=math.inf)
        if not apart > shortest:
            return ""
        return (
            "[catalogue] states the errors of one pointing, and exposures are up to "
            f"{apart:.2g} degrees from their mean: errors that are correlated over "
            f"{shortest:.2g} degrees are smaller in the mean of the exposures than is stated"
        )

    def _systematics(self) -> tuple[Systematics, str]:
        """Systematic errors, and the source for the budget."""
        if self.systematics_mas is None:
            systematics = published_systematics(self.name, f"catalogue {self.name!r}")
            if self.epoch is not None:
                systematics = replace(systematics, epoch=self.epoch)
            return systematics, systematics.source
        scale = self.correlation_deg or EVERYWHERE
        positions, motions = (
            AngularCovariance(((size**2, scale),)) if size else NO_ERRORS
            for size in (self.systematics_mas, self.motions_mas_yr)
        )
        source = said_by_user(self.source)
        return Systematics(source, positions, motions, epoch=self.epoch), source

    def budget_row(self) -> dict[str, str | float]:
        """Keys and values of the ``[[budget]]`` row in a configuration; only with `sigma`."""
        assert self.sigma is not None
        sigma_u, sigma_v = self.sigma
        row: dict[str, str | float] = {"name": self.row_name, "kind": "systematic"}
        row |= {"sigma_u": sigma_u, "sigma_v": sigma_v, "unit": self.unit}
        return row | ({"source": self.source} if self.source.strip() else {})

    def section(self) -> dict[str, str | float]:
        """Keys and values of the section ``[catalogue]`` in a configuration; without `sigma`."""
        names = "name systematics_mas motions_mas_yr correlation_deg epoch bright_fraction".split()
        out = {key: getattr(self, key) for key in names if getattr(self, key) is not None}
        return out | ({"source": self.source} if self.source.strip() else {})


def _pair(
    sigma: Any, unit: str, sigma_mas: float | None, source: str, location: str
) -> tuple[tuple[float, float], str]:
    """Standard deviations of both axes and their unit."""
    size_argument: Any = sigma if sigma_mas is None else sigma_mas
    several = isinstance(size_argument, tuple | list) or getattr(size_argument, "ndim", 0) > 0
    pair = tuple(size_argument) if several else (size_argument, size_argument)
    if len(pair) != 2:
        raise InputError(
            f"its error has {len(pair)} sizes",
            where=location,
            do="give one, or those of u and v",
        )
    sizes, unit = sizes_of(pair, unit if sigma_mas is None else "mas", "sigma", location)
    for size in sizes:
        if not (math.isfinite(size) and size >= 0):
            raise InputError(
                f"its error is {size} {unit}", where=location, do="give a number of 0 or more"
            )
    if not is_stated(sizes, source):
        raise InputError(
            "its error is 0, and no source is given for that",
            where=location,
            do="give the source, or the size of its error",
        )
    return (sizes[0], sizes[1]), unit


def _check_numbers(name: str, numbers: Mapping[str, float | None], location: str) -> None:
    """Raise InputError for numbers out of range, or for those that do not go together."""
    for key, number in numbers.items():
        low, high = (0.0, 1.0) if key == "bright_fraction" else (0.0, math.inf)
        positive = key in ("systematics_mas", "correlation_deg")
        if number is None:
            continue
        if not (low <= number <= high and math.isfinite(number)) or (positive and number == 0):
            raise InputError(
                f"{key} is {number}",
                where=location,
                do=f"give a number {'above 0' if positive else f'of {low:g} or more'}"
                + (f", at most {high:g}" if math.isfinite(high) else ""),
            )
    own = numbers["systematics_mas"] is not None
    for key in ("motions_mas_yr", "correlation_deg"):
        if not own and numbers[key] is not None:
            raise InputError(
                f"{key} is given without systematics_mas", where=location, do="give both"
            )
    if not own:
        published_systematics(name, location)
        return
    if numbers["correlation_deg"] is None:
        raise InputError(
            "systematics_mas is given without correlation_deg",
            where=location,
            do="give the separation in degrees at which the correlation of its errors is 1/e",
        )
    if numbers["motions_mas_yr"] and numbers["epoch"] is None:
        raise InputError(
            "motions_mas_yr is given without epoch",
            where=location,
            do="give the epoch of the positions, from which errors of motions grow",
        )


@dataclass(frozen=True)
class CatalogueSystematics:
    """Systematic errors of a catalogue before a solution tells where on the sky the pixels are.

    `in_field` makes the terms of the budget.  The covariance of motions is multiplied by the square
    of the time between the epoch of the catalogue and that of the exposures.
    """

    name: str  # of the rows
    positions: AngularCovariance
    motions: AngularCovariance
    epoch: float | None  # of the positions in the catalogue, decimal years
    source: str
    date: float | None = None  # mean date of the exposures, decimal years
    of_positions: str = ""  # source of the positions if it is not `source`

    @property
    def rows(self) -> tuple[Row, ...]:
        """Rows of the budget: constant and tilt, and the rest; of positions and of motions."""
        names = [(self.name, self.of_positions or self.source)] if self.positions.parts else []
        names += [(f"{self.name} {MOTIONS_OF}", self.source)] if self.motions.parts else []
        return tuple(
            row
            for name, source in names
            for row in (
                Row(name, source=source),
                Row(f"{name} ({OVER_THE_FIELD})", LOCAL, source),
            )
        )

    def in_field(self, solution: Solution, pixel_scale: float | None) -> tuple[ErrorTerm, ...]:
        """Terms over the field of a solution, in its unit.

        Parameters
        ----------
        solution : Solution
            Solution that places the pixels on the sky.
        pixel_scale : float or None
            Size of a pixel in mas; needed if u and v are in pixels.

        Returns
        -------
        tuple of ErrorTerm
            Errors that are a constant and a tilt of the field, and those that vary over it; of the
            positions, and of the motions if these have any.

        Raises
        ------
        InputError
            If the pixel scale is needed and unknown, or the date of the exposures is.
        """
        model, where = solution.model, f"catalogue {self.name!r}"
        mas = convert(1.0, "mas", model.unit, pixel_scale, where=where)
        out: list[ErrorTerm] = []
        rows = iter(self.rows)
        if self.positions.parts:
            split = SplitField(self.positions, model, np.asarray(solution.mean, float), mas)
            out += [SkyTerm(next(rows), split, tilt) for tilt in (True, False)]
        if self.motions.parts:
            if self.epoch is None or (model.time is None and self.date is None):
                raise InputError(
                    "the errors of its motions grow with time, and the date of the exposures is "
                    "not known",
                    where=where,
                    do="date the matches by a column epoch or by data.epoch, or give assess.epoch",
                )
            # errors of a drift are those of the catalogue at the date of the evaluation
            date = self.date if model.time is None else None
            split = SplitField(self.motions, model, np.asarray(solution.mean, float), mas)
            out += [SkyTerm(next(rows), split, tilt, self.epoch, date) for tilt in (True, False)]
        return tuple(out)

    def draw(self, n: int, rng: np.random.Generator) -> Functions:
        """Not possible before the field is known; see `in_field`."""
        raise InputError(
            "its errors depend on the field",
            where=f"catalogue {self.name!r}",
            do="use it in the argument 'catalogue'",
        )
