"""Products for pipelines: one section for each format that can be written."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from datetime import datetime
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, TypeVar

from pydantic import AfterValidator, Field, PositiveFloat, create_model

from bayesdist.app.config.section import Section
from bayesdist.errors import InputError
from bayesdist.products.common.document import FormatSettings
from bayesdist.products.registry import product_settings
from bayesdist.utils.quantities import year_of

_USEAFTER = ("%b %d %Y %H:%M:%S", "%b %d %Y")  # as in reference files of HST


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


class Products(Section):
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


P = TypeVar("P", bound=Products)


class SingleProducts(Products):
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
