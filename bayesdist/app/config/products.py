"""Files for pipelines that a run is asked for: a table for each format that can be built."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from pydantic import AfterValidator, Field, PositiveFloat, create_model

from bayesdist.app.config.section import Section
from bayesdist.errors import InputError
from bayesdist.products.formats.common.document import FormatSettings
from bayesdist.products.registry import product_settings
from bayesdist.utils.quantities import year_of

_USEAFTER = ("%b %d %Y %H:%M:%S", "%b %d %Y")  # as reference files of HST have it


def _as_part(name: str) -> str:
    """A part of the name of a file, which leads into no other folder."""
    if not name or not name.isprintable() or {*name} & {*"/\\"}:
        raise ValueError(
            f"{name!r} cannot be part of the name of a file; give letters without slashes"
        )
    return name


FileNamePart = Annotated[str, AfterValidator(_as_part)]


class PeriodBlock(Section):
    """The years that one IDCTAB serves, and the segment of the drift that it holds."""

    name: FileNamePart
    years: tuple[float, float]
    segment: Annotated[int, Field(ge=0)] = 0
    useafter: str | None = None
    pedigree: str | None = None


class ReleaseBlock(Section):
    """IDCTABs, D2IMFILE and NPOLFILE, along V2 and V3 as an existing IDCTAB lies."""

    name: FileNamePart
    reference: str
    period: Annotated[list[PeriodBlock], Field(min_length=1)]
    instrument: str = "ACS"
    detector: str = "WFC"
    scale_arcsec: PositiveFloat = 0.05
    limit_mas: PositiveFloat = 0.1


class Products(Section):
    """Files for pipelines, and the release that they replace."""

    previous: str | None = None  # a calibration of any format, or a run

    if TYPE_CHECKING:

        @property
        def release(self) -> ReleaseBlock | None:
            """What a release is made of, where the kind of run has one."""

    def faults(self) -> Iterator[str]:
        """A date of use that is none."""
        try:
            self.useafter_years()
        except InputError as error:
            yield f"useafter: {error.cause}; give 'Mar 01 2002 00:00:00'"

    def useafter_years(self) -> tuple[float, ...]:
        """Dates from which the files are to be used, decimal years; none where none is given."""
        release = getattr(self, "release", None)
        files = (*self.asked().values(), *(() if release is None else release.period))
        given = (getattr(one, "useafter", None) for one in files)
        return tuple(_year_of_keyword(text) for text in given if text)

    def asked(self) -> dict[str, FormatSettings]:
        """Settings of the files that are asked for, by format."""
        found = {key: getattr(self, key, None) for key in product_settings()}
        return {key: settings for key, settings in found.items() if settings is not None}


def _year_of_keyword(text: str) -> float:
    """Decimal year of a date as USEAFTER has it, 'Mar 01 2002 00:00:00', or of an ISO date."""
    date = " ".join(text.split())
    for pattern in _USEAFTER:
        try:
            date = datetime.strptime(date, pattern).isoformat()
        except ValueError:
            continue
        break
    return year_of(date, where="useafter")


class _Single(Products):
    release: ClassVar[ReleaseBlock | None] = None  # the set of a release is of a campaign


class _Release(Products):
    release: ReleaseBlock | None = None


def _products(name: str, base: type[Products], *without: str) -> Any:
    """The base with a table for each format, but for those that this kind of run does not make."""
    known = product_settings()
    fields: dict[str, Any] = {key: (known[key] | None, None) for key in known if key not in without}
    return create_model(name, __base__=base, **fields)


MatchedProducts = _products("MatchedProducts", _Single)
CampaignProducts = _products("CampaignProducts", _Release)
SelfcalProducts = _products("SelfcalProducts", _Single, "wise_meta")
