"""Which files a campaign reads."""

from __future__ import annotations

from pathlib import Path

from bayesdist.app.campaign.config import CampaignBlock, ReleaseBlock

__all__ = ["campaign_files"]


def campaign_files(block: CampaignBlock, release: ReleaseBlock | None, base: Path) -> list[Path]:
    """Files, patterns and folders that a campaign names, each once."""
    lists = [block.lists] if isinstance(block.lists, str) else block.lists
    named = [block.catalog, block.exposures, block.start, *lists]
    if release is not None:
        named.append(release.reference)
    return [base / name for name in dict.fromkeys(named)]
