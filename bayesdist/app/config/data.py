"""What is said of matched stars: the files, and how they are read."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from pydantic import PositiveFloat, field_validator, model_validator

from bayesdist.app.config.rvb import RvbBlock
from bayesdist.app.config.section import Section
from bayesdist.data.tables.units import length_advice

__all__ = ["Data", "Unit", "names_nominal"]

Unit = Literal["pix", "arcsec", "mas", "deg"]


class Data(Section):
    """Matched stars, and how their files are read."""

    matches: str | list[str]
    format: Literal["auto", "table", "hst1pass", "matchup", "astrometry.net", "rvb"] = "auto"
    band: str | None = None
    columns: dict[str, str] | None = None
    unit: Unit | None = None
    sigma: Literal["columns", "by_magnitude"] | PositiveFloat = "columns"
    pixel_origin: Literal[0, 1] | None = None
    tangent_point: tuple[float, float] | None = None
    epoch: float | str | None = None
    catalogue_epoch: float | None = None
    not_finite: Literal["refuse", "reject"] = "refuse"
    rvb: RvbBlock | None = None
    simulated: bool = False

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
    def _only_of_rvb(self) -> Data:
        for key in ("band", "rvb"):
            if self.format != "rvb" and getattr(self, key) is not None:
                raise ValueError(
                    f"data.{key} is given, but data.format is {self.format!r}; set the format to "
                    f"'rvb', or leave {key} out"
                )
        if self.format == "rvb" and self.tangent_point is not None:
            raise ValueError(
                "data.tangent_point is given, but RvB pairs lie in pixels of the band frame; "
                "leave it out"
            )
        for key in ("epoch", "catalogue_epoch"):
            if self.format == "rvb" and getattr(self, key) is not None:
                raise ValueError(
                    f"data.{key} is given, and RvB pairs have no proper motions; leave it out"
                )
        return self

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
