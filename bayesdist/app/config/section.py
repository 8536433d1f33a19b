"""A table of the configuration file."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

__all__ = ["Epoch", "RightAscensionDeclination", "Section", "Unit"]

Unit = Literal["pix", "arcsec", "mas", "deg"]
Epoch = Annotated[float, Field(ge=1800, le=2200)]  # decimal years; others are days, or slips
RightAscensionDeclination = tuple[  # degrees
    Annotated[float, Field(ge=-180, le=360)], Annotated[float, Field(ge=-90, le=90)]
]


class Section(BaseModel):
    """A table of the file; keys that it does not know are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
