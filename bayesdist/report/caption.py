"""Words of a figure."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Caption"]


@dataclass(frozen=True)
class Caption:
    """Words of a figure.

    Parameters
    ----------
    title : str
    text : str
        What to see.
    alt : str
        What the picture shows, for those who cannot see it.
    """

    title: str
    text: str
    alt: str
