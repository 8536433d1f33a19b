"""Artefacts of a run: each is made again when its ingredients have changed."""

from __future__ import annotations

from bayesdist.app.store.record import (
    Adjustable,
    Artefact,
    Record,
    as_json,
    differences,
    versions,
    write_json,
)
from bayesdist.app.store.store import ArtefactStore, Made, Stage

__all__ = [
    "Adjustable",
    "Artefact",
    "ArtefactStore",
    "Made",
    "Record",
    "Stage",
    "as_json",
    "differences",
    "versions",
    "write_json",
]
