"""The configuration file: every key, its type and its default."""

from __future__ import annotations

from bayesdist.app.config.assess import CATALOGUE_WORDS, require_own_names
from bayesdist.app.config.data import Data
from bayesdist.app.config.detector import (
    ChipBlock,
    Detector,
    chips_of,
    reference_first,
    require_detector,
)
from bayesdist.app.config.kinds import (
    KINDS,
    CampaignConfig,
    Config,
    MatchesConfig,
    SelfcalConfig,
)
from bayesdist.app.config.reading import (
    config_of_record,
    load_config,
    load_requirements,
    load_text,
    parse_config,
    validated,
)

__all__ = [
    "CATALOGUE_WORDS",
    "KINDS",
    "CampaignConfig",
    "ChipBlock",
    "Config",
    "Data",
    "Detector",
    "MatchesConfig",
    "SelfcalConfig",
    "chips_of",
    "config_of_record",
    "load_config",
    "load_requirements",
    "load_text",
    "parse_config",
    "reference_first",
    "require_detector",
    "require_own_names",
    "validated",
]
