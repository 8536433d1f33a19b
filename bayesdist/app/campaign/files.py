"""Which files a campaign reads."""

from __future__ import annotations

from pathlib import Path

from bayesdist.app.campaign.reference import FREE, reference_files
from bayesdist.app.config import Config

__all__ = ["campaign_files"]


def campaign_files(config: Config, base: Path) -> list[Path]:
    """Files, patterns and folders that a campaign names, each once."""
    block, release, tdd = config.campaign, config.products.release, config.model.tdd
    assert block is not None
    lists = [block.lists] if isinstance(block.lists, str) else block.lists
    named = [block.catalog, block.exposures, block.initial_distortion, *lists]
    if release is not None:
        named.append(release.reference)
    others = reference_files(config.tables, FREE if tdd is None else tdd.rates, base)
    return [*(base / name for name in dict.fromkeys(named)), *others]
