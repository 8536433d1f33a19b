"""Configuration of the assessment, of errors that the data cannot show, and of requirements."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field, PositiveFloat, field_validator
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

Probability = Annotated[float, Field(gt=0, lt=1)]
GridPoints = Annotated[int, Field(ge=2, le=10_000)]  # no more than a detector has pixels

# names of rows that every budget has, including totals
MEASURED_TERMS = (
    *(COEFFICIENTS, TIME_DEPENDENCE, EXPOSURE_FRAME),
    *("total", "model", STRUCTURE, STRUCTURE_IN_FIT, DEVIATIONS, FIELDS, FIELDS_IN_FIT),
    "look-up tables",
)


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
