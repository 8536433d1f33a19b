"""The configuration of a run: one of three kinds, each with the sections that mean something in it.

What a kind does not have is a constant of its class, so that nobody has to ask for the kind.
"""

from __future__ import annotations

from typing import Annotated, Any, TypeAlias

from pydantic import Discriminator, Tag, TypeAdapter

from bayesdist.app.config.campaign import CampaignConfig
from bayesdist.app.config.data import MatchesConfig
from bayesdist.app.config.run import RunConfig
from bayesdist.app.config.selfcal import SelfcalConfig

__all__ = ["CONFIG", "KINDS", "Config"]

# by the section that says of which kind a configuration is
KINDS: dict[str, type[RunConfig]] = {
    "data": MatchesConfig,
    "campaign": CampaignConfig,
    "selfcal": SelfcalConfig,
}


def _kind_of(raw: Any) -> str | None:
    """The section that says of which kind a configuration is; None where not just one does."""
    found = [kind for kind in KINDS if isinstance(raw, dict) and raw.get(kind) is not None]
    return found[0] if len(found) == 1 else None


Config: TypeAlias = MatchesConfig | CampaignConfig | SelfcalConfig

CONFIG: TypeAdapter[Config] = TypeAdapter(
    Annotated[
        Annotated[MatchesConfig, Tag("data")]
        | Annotated[CampaignConfig, Tag("campaign")]
        | Annotated[SelfcalConfig, Tag("selfcal")],
        Discriminator(
            _kind_of,
            custom_error_type="no_kind",
            custom_error_message=(
                "a run begins with [data], matched stars, with [campaign], star lists and a "
                "catalogue, or with [selfcal], star lists alone; give one"
            ),
        ),
    ]
)
