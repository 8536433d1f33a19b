"""The part of the configuration that sets stars aside."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, PositiveInt, model_validator

from bayesdist.app.config.section import Section

__all__ = ["HoldoutBlock"]


class HoldoutBlock(Section):
    """Stars and exposures that are set aside before anything is fitted."""

    fraction: Annotated[float, Field(ge=0, le=0.9)] = 0.0
    exposures: list[str] | PositiveInt = Field(default_factory=list)

    @model_validator(mode="after")
    def _something(self) -> HoldoutBlock:
        if not self.fraction and not self.exposures:
            raise ValueError(
                "[holdout] sets nothing aside; give a fraction of the stars, or exposures"
            )
        return self
