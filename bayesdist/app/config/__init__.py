"""Configuration file: all keys with their types and defaults."""

from __future__ import annotations

from bayesdist.app.config.reading import (
    Config,
    config_of_record,
    installed_kinds,
    load_config,
    load_requirements,
    load_text,
    parse_config,
)
from bayesdist.app.config.run import StarsConfig
from bayesdist.app.config.section import ChipBlock

__all__ = [
    "ChipBlock",
    "Config",
    "StarsConfig",
    "config_of_record",
    "installed_kinds",
    "load_config",
    "load_requirements",
    "load_text",
    "parse_config",
]
