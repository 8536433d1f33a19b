"""Settings of the results: assessment, errors that the data cannot show, requirements, products.

There is one section of products for each format that can be written.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from datetime import datetime
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeVar

from pydantic import AfterValidator, Field, PositiveFloat, create_model, field_validator
from pydantic_core import PydanticCustomError

from bayesdist.app.config.section import Circle, Epoch, Section, Unit
from bayesdist.assess.terms.catalogue import Catalogue
from bayesdist.assess.terms.correlated import (
    DEVIATIONS,
    FIELDS,
    FIELDS_IN_FIT,
    STRUCTURE,
    STRUCTURE_IN_FIT,
)
from bayesdist.assess.terms.forms import GIVEN
from bayesdist.assess.terms.given import (
    TERM_KINDS,
    is_stated,
    names_catalogue,
    names_motions,
)
from bayesdist.assess.terms.parameters import (
    COEFFICIENTS,
    EXPOSURE_FRAME,
    TIME_DEPENDENCE,
    one_size_kinds,
)
from bayesdist.errors import InputError
from bayesdist.products.common.document import FormatSettings
from bayesdist.products.registry import product_settings
from bayesdist.utils.quantities import year_of

Probability = Annotated[float, Field(gt=0, lt=1)]
GridPoints = Annotated[int, Field(ge=2, le=10_000)]  # no more than a detector has pixels

# names of rows that every budget has, including totals
MEASURED_TERMS = (
    *(COEFFICIENTS, TIME_DEPENDENCE, EXPOSURE_FRAME),
    *("total", "model", STRUCTURE, STRUCTURE_IN_FIT, DEVIATIONS, FIELDS, FIELDS_IN_FIT),
    "look-up tables",
)

_USEAFTER = ("%b %d %Y %H:%M:%S", "%b %d %Y")  # as in reference files of HST


class Assess(Section):
    """Positions and dates at which errors are assessed."""

    epoch: Epoch | None = None
    grid: tuple[GridPoints, GridPoints] = (33, 17)
    draws: Annotated[int, Field(ge=100, le=1_000_000)] = 4000
    exposure: Literal["mean", "single"] = "mean"
    years_ahead: Annotated[float, Field(ge=0, le=100)] = 10.0


class BudgetBlock(Section):
    """Error term that the data cannot show."""

    name: str
    kind: str
    sigma_u: Annotated[float, Field(ge=0)] | None = None
    sigma_v: Annotated[float, Field(ge=0)] | None = None
    sigma: Annotated[float, Field(ge=0)] | None = None
    unit: Unit | None = None  # unit of sigma_u and sigma_v; default pixels if u and v are in pixels
    source: str = GIVEN
    included_in_scatter: bool = False

    @field_validator("kind")
    @classmethod
    def _known_kind(cls, kind: str) -> str:
        *first_kinds, last = kinds = (*TERM_KINDS, *one_size_kinds())
        if kind not in kinds:  # worded like the error of a Literal
            listed = ", ".join(map(repr, first_kinds))
            raise PydanticCustomError("literal_error", f"Input should be {listed} or {last!r}")
        return kind

    @property
    def of_catalogue(self) -> bool:
        """True if the row is the error of the positions in the reference catalogue."""
        return names_catalogue(self.name)

    @property
    def of_motions(self) -> bool:
        """True if the row is the error of proper motions."""
        return names_motions(self.name)

    @property
    def stated(self) -> bool:
        """True if the row states an error; a size of 0 counts only with a source."""
        return is_stated((self.sigma_u, self.sigma_v, self.sigma), self.source)

    def faults(self) -> Iterator[str]:
        """Faults of sigmas that do not suit the kind of the term."""
        axes = self.sigma_u is not None and self.sigma_v is not None
        neither = self.sigma_u is None and self.sigma_v is None
        of_kind = f"a budget term of kind {self.kind!r} has"
        if self.kind not in TERM_KINDS:
            if self.sigma is None or not neither:
                yield (
                    f"{of_kind} a single sigma; give sigma, in the unit of its kind, instead of "
                    "sigma_u and sigma_v"
                )
            if self.unit is not None:
                yield f"{of_kind} a fixed unit, but unit is {self.unit!r}; leave out unit"
        elif not axes or self.sigma is not None:
            yield f"{of_kind} one sigma per axis; give sigma_u and sigma_v instead of sigma"
        if self.included_in_scatter and self.kind != "random":
            yield (
                "included_in_scatter applies only to random budget terms, which vary from star to "
                "star; leave it out"
            )


class CatalogueBlock(Section):
    """Systematic errors of the reference catalogue, as published or as stated by the user."""

    name: str
    systematics_mas: PositiveFloat | None = None
    motions_mas_yr: Annotated[float, Field(ge=0)] | None = None
    correlation_deg: PositiveFloat | None = None
    epoch: Epoch | None = None
    bright_fraction: Annotated[float, Field(ge=0, le=1)] | None = None
    source: str = ""

    def faults(self) -> Iterator[str]:
        """Faults of an unknown name, and of numbers that do not go together."""
        try:
            self.catalogue()
        except InputError as error:
            yield f"{error.where}: {error.cause}; {error.do}"

    def catalogue(self) -> Catalogue:
        """Catalogue of this section."""
        return Catalogue(**self.model_dump())


class RequirementBlock(Section):
    """Limit on a statistic of the position error."""

    name: str
    statistic: str
    limit: PositiveFloat
    unit: Unit | None = None  # default pixels if u and v are in pixels
    probability: Probability = 0.95
    epoch: Epoch | None = None
    chip: int | None = None
    region: str | Circle | list[tuple[float, float]] = "whole"
    epochs: tuple[Epoch, Epoch] | None = None
    relative: bool = False
    separation: PositiveFloat | None = None
    magnitude: float | None = None


def _as_part(name: str) -> str:
    """Validate a part of a file name, which must not lead to another folder."""
    if not name or not name.isprintable() or {*name} & {*"/\\"}:
        raise ValueError(f"{name!r} cannot be part of a file name; give letters without slashes")
    return name


FileNamePart = Annotated[str, AfterValidator(_as_part)]


class PeriodBlock(Section):
    """Years of validity of one file, and the segment of the drift that it contains."""

    name: FileNamePart
    years: tuple[float, float]
    segment: Annotated[int, Field(ge=0)] = 0
    useafter: str | None = None
    pedigree: str | None = None


class ReleaseBlock(Section):
    """Files for several filters and periods, oriented as an existing file; see `ReleaseSet`."""

    name: FileNamePart
    reference: str
    period: Annotated[list[PeriodBlock], Field(min_length=1)]
    # None: the values of the mission that releases the files
    instrument: str | None = None
    detector: str | None = None
    scale_arcsec: PositiveFloat | None = None
    limit_mas: PositiveFloat = 0.1


class ProductsBlock(Section):
    """Products for pipelines, and the release that they replace."""

    previous: str | None = None  # calibration of any format, or a run

    if TYPE_CHECKING:

        @property
        def release(self) -> ReleaseBlock | None:
            """Section of the release; None if there is none."""

    def faults(self) -> Iterator[str]:
        """Fault of an invalid date of use."""
        try:
            self.useafter_years()
        except InputError as error:
            yield f"useafter: {error.cause}; give 'Mar 01 2002 00:00:00'"

    def useafter_years(self) -> tuple[float, ...]:
        """Dates of use of the files in decimal years; empty if none are given."""
        release = getattr(self, "release", None)
        files = (*self.asked().values(), *(() if release is None else release.period))
        dates = (getattr(file, "useafter", None) for file in files)
        return tuple(_year_of_keyword(text) for text in dates if text)

    def asked(self) -> dict[str, FormatSettings]:
        """Settings of the requested files, by format."""
        sections = {key: getattr(self, key, None) for key in product_settings()}
        return {key: settings for key, settings in sections.items() if settings is not None}


def _year_of_keyword(text: str) -> float:
    """Decimal year of a USEAFTER date, such as 'Mar 01 2002 00:00:00', or of an ISO date."""
    date = " ".join(text.split())
    for pattern in _USEAFTER:
        try:
            date = datetime.strptime(date, pattern).isoformat()
        except ValueError:
            continue
        break
    return year_of(date, where="useafter")


P = TypeVar("P", bound=ProductsBlock)


class SingleProducts(ProductsBlock):
    """Products of a kind of run that has no releases."""

    release: ClassVar[ReleaseBlock | None] = None  # only campaigns have releases


def with_formats(*without: str) -> Callable[[type[P]], type[P]]:
    """Decorator that gives a class of products a section for each format, but not for `without`."""

    def decorated(base: type[P]) -> type[P]:
        formats = product_settings()
        fields: dict[str, Any] = {
            key: (formats[key] | None, None) for key in formats if key not in without
        }
        return create_model(
            base.__name__, __base__=base, __module__=base.__module__, __doc__=base.__doc__, **fields
        )

    return decorated


@with_formats()
class MatchedProducts(SingleProducts):
    """Products of matched stars."""
