"""Published lines of linear terms against time, as missions know them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

__all__ = ["Published", "PublishedLine", "published_terms", "publishes"]


@dataclass(frozen=True)
class PublishedLine:
    """Line alpha + beta (TIME - RDATE), with formal errors; for a constant term beta is 0."""

    chip: str
    rdate: float
    alpha: float
    sigma_alpha: float
    beta: float = 0.0
    sigma_beta: float = 0.0


@dataclass(frozen=True)
class Published:
    """Lines of one term."""

    source: str  # the publication
    where: str  # in it
    lines: tuple[PublishedLine, ...]


Source = Callable[[Mapping[str, Any], str, tuple[str, ...]], Mapping[str, Published]]
_SOURCES: list[Source] = []


def publishes(source: Source) -> Source:
    """Decorator of a function that gives published terms, of the arguments of `published_terms`."""
    _SOURCES.append(source)
    return source


def published_terms(
    config: Mapping[str, Any], filter: str, chips: tuple[str, ...]
) -> dict[str, Published]:
    """Published lines of the detector and filter of a run, by term.

    `config`: the resolved configuration: the release names instrument and detector. `chips`: their
    names.
    """
    return {k: v for source in _SOURCES for k, v in source(config, filter, chips).items()}
