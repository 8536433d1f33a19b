"""Configuration file: all keys with their types and defaults."""

from __future__ import annotations

from bayesdist.app.config.campaign import CampaignConfig
from bayesdist.app.config.data import Data, MatchesConfig, StarsConfig
from bayesdist.app.config.reading import (
    KINDS,
    Config,
    config_of_record,
    load_config,
    load_requirements,
    load_text,
    parse_config,
)
from bayesdist.app.config.section import ChipBlock
from bayesdist.app.config.selfcal import SelfcalConfig

__all__ = [
    "KINDS",
    "CampaignConfig",
    "ChipBlock",
    "Config",
    "Data",
    "MatchesConfig",
    "SelfcalConfig",
    "StarsConfig",
    "config_of_record",
    "load_config",
    "load_requirements",
    "load_text",
    "parse_config",
]
