"""How the values of stages get into the run's folder and out of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

__all__ = ["Codec", "WrittenByStage"]


class Codec(Protocol):
    """Save and load of one kind of artefact.

    Attributes
    ----------
    revision : int
        Raised when the numbers of the stage change.
    checkpoints : tuple of str
        Patterns of the files by which an interrupted stage goes on.
    """

    @property
    def revision(self) -> int: ...

    @property
    def checkpoints(self) -> tuple[str, ...]: ...

    def save(self, value: Any, folder: Path) -> Mapping[str, Any]:
        """Write a value; what is returned are its sections of summary.json."""

    def load(self, folder: Path) -> Any:
        """The value that was saved."""


@dataclass(frozen=True)
class WrittenByStage:
    """Of stages that write their files themselves, and are read by whoever needs them."""

    revision: int = 1
    checkpoints: tuple[str, ...] = ()

    def save(self, value: None, folder: Path) -> Mapping[str, Any]:
        """Nothing: all has been written."""
        return {}

    def load(self, folder: Path) -> None:
        """Nothing: files are read when they are needed."""
