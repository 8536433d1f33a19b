"""The section [data]: files of matched stars, and how they are read.

A format that a mission adds may have keys of its own: its section is a subclass of `Data`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import (
    PositiveFloat,
    SerializeAsAny,
    ValidationInfo,
    WrapValidator,
    field_validator,
    model_validator,
)

from bayesdist.app.config.section import Section
from bayesdist.data import FORMATS
from bayesdist.data.reading.formats import mission_formats
from bayesdist.data.tables.units import length_advice
from bayesdist.mission import load_object, missions

__all__ = ["Data", "DataOfFormat", "Unit", "data_sections", "names_nominal"]

Unit = Literal["pix", "arcsec", "mas", "deg"]


class Data(Section):
    """Matched stars, and how their files are read."""

    matches: str | list[str]
    format: str = "auto"
    columns: dict[str, str] | None = None
    unit: Unit | None = None
    sigma: Literal["columns", "by_magnitude"] | PositiveFloat = "columns"
    pixel_origin: Literal[0, 1] | None = None
    tangent_point: tuple[float, float] | None = None
    epoch: float | str | None = None
    catalogue_epoch: float | None = None
    not_finite: Literal["refuse", "reject"] = "refuse"
    simulated: bool = False

    one_array: ClassVar[bool] = False  # matches of this format are of one chip

    @property
    def has_nominal(self) -> bool:
        """Boolean: columns of nominal positions are named."""
        return names_nominal(self.columns)

    @field_validator("unit", mode="before")
    @classmethod
    def _no_length(cls, unit: Any) -> Any:
        advice = length_advice(unit) if isinstance(unit, str) else ""
        if advice:
            raise ValueError(
                f"data.unit is {unit!r}, and positions are in pixels or angles; {advice}"
            )
        return unit

    @model_validator(mode="after")
    def _nominal_positions_of_tables(self) -> Data:
        if self.has_nominal and self.format not in ("auto", "table"):
            raise ValueError(
                f"nominal positions are columns of tables, and data.format is {self.format!r}; "
                "leave u_nominal and v_nominal out"
            )
        return self


def names_nominal(columns: Mapping[str, str] | None) -> bool:
    """Boolean: columns of nominal positions are named."""
    return any((columns or {}).get(key) for key in ("u_nominal", "v_nominal"))


def data_sections() -> dict[str, type[Data]]:
    """Sections of the formats that have keys of their own, by the name of the format."""
    return {
        name: load_object(where)
        for mission in missions().values()
        for name, where in mission.data_sections.items()
    }


def _of_its_format(raw: Any, handler: Any, info: ValidationInfo) -> Data:
    """Section [data] as the class that its format asks for."""
    if isinstance(raw, Data):
        return raw
    if not isinstance(raw, Mapping) or not isinstance(raw.get("format", ""), str):
        return handler(raw)  # type: ignore[no-any-return]
    format = raw.get("format", "auto")
    kind = Data
    if format not in FORMATS or raw.keys() - Data.model_fields.keys():
        sections = data_sections()
        _require_known(format, (*FORMATS, *mission_formats(), *sections))
        kind = sections.get(format, Data)
        for name, other in sections.items():
            for key in raw.keys() & other.model_fields.keys() - kind.model_fields.keys():
                raise ValueError(
                    f"data.{key} is given, but data.format is {format!r}; set the format to "
                    f"{name!r}, or leave {key} out"
                )
    if info.mode == "json":  # there arrays may become tuples
        return kind.model_validate_json(json.dumps(raw), strict=True)
    return kind.model_validate(raw)


def _require_known(format: str, known: tuple[str, ...]) -> None:
    if format not in known:
        raise ValueError(
            f"data.format is {format!r}, which is no format; give one of "
            f"{', '.join(map(repr, known))}"
        )


DataOfFormat = Annotated[SerializeAsAny[Data], WrapValidator(_of_its_format)]
