"""Error terms stated by the user, and errors of the centroid of a star."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.terms.forms import (
    GIVEN,
    LOCAL,
    PUBLISHED,
    ErrorDraws,
    ErrorTerm,
    Independent,
    Pool,
    Row,
    SizedTerm,
)
from bayesdist.assess.terms.functions import Functions
from bayesdist.assess.units import convert
from bayesdist.data.magnitude_errors import MagnitudeErrors
from bayesdist.data.tables.column import UNITS
from bayesdist.errors import InputError, require_known
from bayesdist.model import DistortionModel, PolynomialBasis
from bayesdist.model.grid import DEFAULT_GRID, grid_pixels, mesh
from bayesdist.utils.arrays import Float
from bayesdist.utils.quantities import Number, unit_name, value_in

if TYPE_CHECKING:
    from bayesdist.diagnose.diagnostics import Diagnostics

TERM_KINDS = ("random", "systematic")
CENTROID = "centroid"

# words in the name of a row that identify it as the error of the reference catalogue
CATALOGUE_WORDS = (
    *("catalog", "reference", "gaia", "2mass", "hipparcos", "tycho", "ucac", "urat", "usno"),
    *("pan-starrs", "panstarrs", "ps1", "sdss", "skymapper", "hsc", "des dr"),
)

SMOOTH_ORDER = 3  # polynomial order of smooth fields that represent errors varying over a detector
SMOOTH_DRAWS = 1000
BEYOND = 0.5  # magnitudes by which the range of the outermost bins may be exceeded


def said_by_user(source: str) -> str:
    """Source of a row of the budget, from the text of the user.

    The result begins with one of the three kinds of source; text that already begins with 'given by
    the user' or 'published' keeps its kind.
    """
    text = source.strip()
    if text.lower().startswith((GIVEN, PUBLISHED)):
        return text[0].lower() + text[1:]
    return f"{GIVEN}: {text}" if text else GIVEN


def names_motions(name: str) -> bool:
    """True if the name of a row indicates the error of proper motions."""
    return "motion" in name.lower()


def names_catalogue(name: str) -> bool:
    """True if the name of a row indicates the error of the reference catalogue's positions."""
    return any(word in name.lower() for word in CATALOGUE_WORDS) and not names_motions(name)


def is_stated(sizes: Sequence[float | None], source: str) -> bool:
    """True if a row states an error; a size of 0 counts only if `source` is not the default."""
    return any(sizes) or said_by_user(source) != GIVEN


def stated_names(terms: Sequence[ErrorTerm]) -> tuple[str, ...]:
    """Names of the terms that state an error, in order."""
    names = []
    for term in terms:
        sizes: list[float | None] = [1.0]  # of terms that compute their size
        if isinstance(term, UserTerm):
            sizes = [term.sigma_u, term.sigma_v]
        elif isinstance(term, SizedTerm):
            sizes = [term.sigma]
        if is_stated(sizes, term.rows[0].source):
            # parts of an error that vary over the field are implied by its other rows
            wide = [row.name for row in term.rows if row.kind != LOCAL]
            names += wide or [term.rows[0].name]
    return tuple(names)


def sizes_of(
    sizes: Sequence[Number], unit: str, what: str, where: str
) -> tuple[tuple[float, ...], str]:
    """Standard deviations and their unit: `unit` for plain numbers, else that of the Quantities.

    `what` and `where` are for error messages.
    """
    units = [unit_name(size, what, where=where) for size in sizes]
    if None in units and any(units):
        raise InputError(
            f"one {what} has a unit and the other has none",
            where=where,
            do="give Quantities for both, or numbers in `unit`",
        )
    named = unit if units[0] is None else units[0]
    # the unit has no effect on a plain number
    return tuple(value_in(size, named or "pix", what, where=where) for size in sizes), named


@dataclass(frozen=True)
class UserTerm:
    """A Gaussian error stated by the user, equally large at every position of the detector.

    Parameters
    ----------
    name : str
        Name of the row of the budget.
    kind : str
        'random': independent at every position; 'systematic': one offset shared by the whole field.
    sigma_u, sigma_v : float or Quantity
        Standard deviation of each axis; stored as numbers.
    unit : str, optional
        'pix', 'arcsec', 'mas' or 'deg'; by default the unit of the Quantities, or that of the
        model.
    source : str
        Origin of the number: 'given by the user', or a publication.
    varies : bool, optional
        For a systematic term: True if the error may vary over the field in an unknown way, as the
        errors of a catalogue do. Requirements are then judged for one offset of the whole field,
        for a smooth field, and for independent errors at every position. The default is True if
        the name is that of a reference catalogue, such as 'Gaia DR3'.
    included_in_scatter : bool
        For a random term: True if the residuals contain it in addition to the errors of centroids.

    Raises
    ------
    InputError
        If the kind or unit is unknown, a sigma is negative or not finite, or a systematic term is
        declared as included in the scatter.

    Examples
    --------
    >>> term = bd.UserTerm("reference catalogue", "systematic", 0.005, 0.005)
    >>> [row.name for row in term.rows]
    ['reference catalogue']
    """

    name: str
    kind: str
    sigma_u: float
    sigma_v: float
    unit: str | None = None
    source: str = GIVEN
    varies: bool | None = None
    included_in_scatter: bool = False

    def __post_init__(self) -> None:
        location = f"budget term {self.name!r}"
        require_known(self.kind, TERM_KINDS, "kind", where=location)
        if self.unit is not None:
            require_known(self.unit, UNITS, "unit", where=location)
        (sigma_u, sigma_v), unit = sizes_of(
            (self.sigma_u, self.sigma_v), self.unit or "", "sigma", location
        )
        varies = names_catalogue(self.name) if self.varies is None else self.varies
        for name, value in (
            ("sigma_u", sigma_u),
            ("sigma_v", sigma_v),
            ("unit", unit or None),
            ("varies", varies),
        ):
            object.__setattr__(self, name, value)
        if self.included_in_scatter and self.kind != "random":
            raise InputError(
                "included_in_scatter applies only to random budget terms, which vary from star to "
                "star",
                where=location,
                do="leave it out",
            )
        for axis, sigma in (("u", self.sigma_u), ("v", self.sigma_v)):
            if not (math.isfinite(sigma) and sigma >= 0):
                raise InputError(
                    f"sigma_{axis} is {sigma}",
                    where=location,
                    do="give a number that is not negative",
                )

    def sigma(self, unit: str, pixel_scale: float | None = None) -> tuple[float, float]:
        """Standard deviations (sigma_u, sigma_v), converted to the unit of a model.

        Parameters
        ----------
        unit : str
            'pix', 'arcsec', 'mas' or 'deg'.
        pixel_scale : float, optional
            Size of a pixel in mas, needed for conversions from or to pixels.

        Returns
        -------
        sigma_u, sigma_v : float
            In `unit`.

        Raises
        ------
        InputError
            If a unit is unknown, or a conversion needs the pixel scale.
        """
        location = f"budget term {self.name!r}"
        su, sv = (
            convert(s, self.unit or unit, unit, pixel_scale, where=location)
            for s in (self.sigma_u, self.sigma_v)
        )
        return float(su), float(sv)

    def in_unit(self, unit: str, pixel_scale: float | None = None) -> UserTerm:
        """Term with its standard deviations converted to the unit of a model.

        Parameters
        ----------
        unit : str
            'pix', 'arcsec', 'mas' or 'deg'.
        pixel_scale : float, optional
            Size of a pixel in mas, needed for conversions from or to pixels.

        Returns
        -------
        UserTerm

        Raises
        ------
        InputError
            See `sigma`.
        """
        su, sv = self.sigma(unit, pixel_scale)
        return replace(self, sigma_u=su, sigma_v=sv, unit=unit)

    @property
    def rows(self) -> tuple[Row, ...]:
        """Row of the budget, with the name, kind and source of the term."""
        return (Row(self.name, self.kind, self.source),)

    def draw(self, n: int, rng: np.random.Generator) -> ErrorDraws:
        """Draw one offset for the whole field, or independent errors, in the unit of the term.

        `n` is the number of draws; for random errors it has no effect.
        """
        size = np.array([self.sigma_u, self.sigma_v])
        if self.kind == "random":
            return Independent(self.rows[0], partial(_everywhere, size))
        offset = size * rng.standard_normal((n, 2))
        everywhere: dict[int | None, Float] = {None: offset[..., None]}
        covariance: dict[int | None, Float] = {None: (size**2)[:, None, None]}
        return Functions(self.rows[0], everywhere, _one, n, uniform=True, covariance=covariance)

    def treatments(
        self, model: DistortionModel, grid: tuple[int, int] | None
    ) -> tuple[ErrorTerm, ...]:
        """The error as a smooth field and as independent errors; empty if it cannot vary.

        Parameters
        ----------
        model : DistortionModel
        grid : tuple of int or None
            Number of points along x and y of each chip, over which the smooth field has its stated
            rms; None for the default grid.

        Returns
        -------
        tuple of ErrorTerm
        """
        if not (self.varies and self.kind == "systematic" and (self.sigma_u or self.sigma_v)):
            return ()
        return SmoothTerm(self, model, grid or DEFAULT_GRID), replace(self, kind="random")


def _everywhere(size: Float, domain: EvaluationDomain) -> Float:
    """Standard deviation (N, 2), equal at all positions; a view, since there may be many terms."""
    return np.broadcast_to(size, (domain.size, 2))


def _one(chip: int, x: Float, y: Float) -> Float:
    """Constant function 1, shape (N, 1)."""
    return np.ones((len(x), 1))


@dataclass(frozen=True)
class SmoothTerm:
    """A user's error as a smooth random field over each chip, larger at the edges than inside.

    It resembles the distortion of a catalogue or of another camera.
    """

    term: UserTerm  # in the unit of the model
    model: DistortionModel
    grid: tuple[int, int]  # points of each chip over which the rms equals that of the term

    @property
    def rows(self) -> tuple[Row, ...]:
        """Row of the budget, which is that of the original term."""
        return self.term.rows

    def draw(self, n: int, rng: np.random.Generator) -> Functions:
        """Draw coefficients of polynomials, independently for each chip."""
        n_own, coefficients = min(n, SMOOTH_DRAWS), dict[int | None, Float]()
        covariance: dict[int | None, Float] = {}
        size = np.array([self.term.sigma_u, self.term.sigma_v])[:, None]
        for chip in self.model.chips:
            phi = self(chip.number, *mesh(*grid_pixels(chip.size, self.grid)))
            unit = np.sqrt(len(phi) / np.square(phi).sum())
            m = phi.shape[1]
            coefficients[chip.number] = size * unit * rng.standard_normal((n_own, 2, m))
            covariance[chip.number] = np.square(size * unit)[:, :, None] * np.eye(m)
        pool = Pool(np.arange(n) % n_own, n_own, renewed=True)
        return Functions(self.rows[0], coefficients, self, n, covariance=covariance, pools=(pool,))

    def __call__(self, chip: int, x: Float, y: Float) -> Float:
        """Values (N, m) of the polynomials on a chip."""
        chip_of_model = self.model.chips[self.model.chip_code(chip)]
        return PolynomialBasis(
            SMOOTH_ORDER, chip_of_model.size, chip_of_model.reference_pixel
        ).evaluate(x, y)


@dataclass(frozen=True, eq=False)
class Centroids:
    """Errors of the centroids of stars with a given magnitude."""

    errors: MagnitudeErrors | None  # in the unit of the solution; None if they are unknown

    @property
    def rows(self) -> tuple[Row, ...]:
        """Row of the centroid errors."""
        return (Row(CENTROID, "random"),)

    def draw(self, n: int, rng: np.random.Generator) -> Independent:
        """Independent errors for stars with the magnitude of a domain."""
        return Independent(self.rows[0], self.sigma)

    def sigma(self, domain: EvaluationDomain) -> Float | None:
        """Standard deviations (N, 2) in the unit of u and v; None without a magnitude."""
        if domain.magnitude is None:
            return None
        return np.tile(self.at(domain.magnitude), (domain.size, 1))

    def at(self, magnitude: float) -> Float:
        """Standard deviations (2,) of the centroid of a star, in the unit of u and v.

        Raises InputError if errors by magnitude are unknown, or were not measured near this one.
        """
        if self.errors is None:
            raise InputError(
                f"the error of a star of magnitude {magnitude:g} is not known",
                where="magnitude",
                do="give the matches magnitudes, or leave it out",
            )
        low, high = self.errors.mag[0] - BEYOND, self.errors.mag[-1] + BEYOND
        if not low <= magnitude <= high:
            raise InputError(
                f"centroids of magnitude {magnitude:g} were not measured, but those of "
                f"{low:.1f} to {high:.1f}",
                where="magnitude",
                do="name one of these",
            )
        return np.ravel(self.errors.at([magnitude]))


def centroid_errors(
    scatter: MagnitudeErrors, contained: Sequence[tuple[str, float, float]]
) -> MagnitudeErrors:
    """Scatter of residuals by magnitude, after subtracting other errors that it contains.

    A budget that lists both the reference catalogue and the residual scatter would count the
    catalogue twice. Errors that the residuals are known to contain are therefore subtracted in
    quadrature.

    `contained`: errors that the residuals contain in addition to those of the centroids, in the
    same unit. Raises InputError if such an error is larger than the residuals.
    """
    squares = np.sum([(u**2, v**2) for _, u, v in contained] or [(0.0, 0.0)], axis=0)
    subtracted = np.sqrt(squares)
    for sigma, contained_sigma in zip((scatter.sigma_u, scatter.sigma_v), subtracted, strict=True):
        # the relative standard error of the median of n absolute residuals is 1.17 / sqrt(n)
        too_small = sigma * (1.0 + 3.0 * 1.17 / np.sqrt(scatter.n)) < contained_sigma
        if too_small.any():
            k = int(np.argmax(too_small))
            raise InputError(
                f"errors of {contained_sigma:.3g} are declared part of residuals that scatter by "
                f"{sigma[k]:.3g} at magnitude {scatter.mag[k]:.2f}",
                where=f"budget term {contained[0][0]!r}",
                do="correct them, or set included_in_scatter = false",
            )
    return scatter.less(*subtracted)


def centroids_of(
    diagnostics: Diagnostics, contained: Sequence[tuple[str, float, float]]
) -> MagnitudeErrors | None:
    """Errors of centroids by magnitude: the scatter of residuals without errors of other terms.

    For structure that the residuals contain, the median of its size is subtracted, because the
    residuals contain nothing of the tail of its prior.

    `contained`: see `centroid_errors`. Returns None if the stars have no magnitudes. Raises
    InputError like `centroid_errors`.
    """
    if diagnostics.centroid is None:
        return None
    errors = centroid_errors(diagnostics.centroid, contained) if contained else diagnostics.centroid
    correlated = diagnostics.correlated
    median = None if correlated is None else correlated.structure_median
    return errors if median is None else errors.less(*median)
