"""Which files a self-calibration reads."""

from __future__ import annotations

from pathlib import Path

from bayesdist.app.config import Config

__all__ = ["selfcal_files"]


def selfcal_files(config: Config, base: Path) -> list[Path]:
    """Files, patterns and folders that a self-calibration names, each once."""
    block, gauge = config.selfcal, config.gauge
    assert block is not None
    lists = [block.lists] if isinstance(block.lists, str) else block.lists
    named = [*lists, block.exposures, _file_of(block.initial_distortion, base), gauge.offsets]
    if gauge.reference is not None:
        named.append(gauge.reference.catalog)
    return [base / name for name in dict.fromkeys(named) if name is not None]


def _file_of(start: str | None, base: Path) -> str | None:
    """A start, and of a run its posterior."""
    if start is not None and (base / start).is_dir():
        return f"{start}/posterior.nc"
    return start
