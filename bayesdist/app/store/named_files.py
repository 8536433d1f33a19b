"""Files that a configuration names: those that the solution is made from, and those of products."""

from __future__ import annotations

from pathlib import Path

from bayesdist.app.campaign.reference import FREE, reference_files
from bayesdist.app.config import CampaignConfig, Config, SelfcalConfig

__all__ = ["files_of_products", "named_files"]


def named_files(config: Config, base: Path) -> Path | list[Path]:
    """Files, patterns and folders that the solution is made from, each once.

    Parameters
    ----------
    config : Config
    base : Path
        Folder that relative names are relative to.

    Returns
    -------
    Path or list of Path
        One of matches where one name is given.
    """
    if isinstance(config, CampaignConfig):
        return _of_campaign(config, base)
    if isinstance(config, SelfcalConfig):
        return _of_selfcal(config, base)
    names = config.data.matches
    return base / names if isinstance(names, str) else [base / name for name in names]


def files_of_products(config: Config, base: Path) -> list[Path]:
    """Files that only the products of a run are made from."""
    release = config.products.release
    found = [] if release is None else [base / release.reference]
    named = named_files(config, base)
    return [path for path in found if path not in (named if isinstance(named, list) else [named])]


def _of_campaign(config: CampaignConfig, base: Path) -> list[Path]:
    """Lists, catalogue and log, and what is taken over from other runs."""
    block, tdd = config.campaign, config.model.tdd
    lists = [block.lists] if isinstance(block.lists, str) else block.lists
    named = [block.catalog, block.exposures, block.initial_distortion, *lists]
    others = reference_files(config.tables, FREE if tdd is None else tdd.rates, base)
    return [*(base / name for name in dict.fromkeys(named)), *others]


def _of_selfcal(config: SelfcalConfig, base: Path) -> list[Path]:
    """Lists, and what is known beside the detections."""
    block, gauge = config.selfcal, config.gauge
    lists = [block.lists] if isinstance(block.lists, str) else block.lists
    named = [*lists, block.exposures, _first_solution(block.initial_distortion, base)]
    named += [gauge.offsets, None if gauge.reference is None else gauge.reference.catalog]
    return [base / name for name in dict.fromkeys(named) if name is not None]


def _first_solution(name: str | None, base: Path) -> str | None:
    """A file as it is named, and the posterior of a run."""
    if name is not None and (base / name).is_dir():
        return f"{name}/posterior.nc"
    return name
