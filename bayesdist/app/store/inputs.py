"""Inputs of a run: by which names its record knows them, and where they are now."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from bayesdist.app.config import Config
from bayesdist.data import input_files
from bayesdist.files import sha256_of

__all__ = ["base_of", "hashes_of", "input_name", "places_of"]


def input_name(path: Path, *bases: Path) -> str:
    """Name of an input: relative to the first of some folders that it is below, else its path.

    As a name it is that of the configuration: '../data/x' stays so.
    """
    for base in bases:
        with suppress(ValueError):
            return path.relative_to(base).as_posix()
    return str(path)


def hashes_of(config: Config, base: Path, *before: Path) -> dict[str, str]:
    """SHA-256 of every file that a configuration names, by its name.

    `base` is the folder that names are relative to, `before` are those that it was.
    """
    base = base.resolve()
    others = [*config.files_of_products(base), *config.files_of_priors(base)]
    named = [*input_files(config.named_files(base)), *others]
    return {input_name(path, base, *before): sha256_of(path) for path in named}


def places_of(base: Path, run: Path) -> dict[str, str]:
    """Facts of a record on where inputs are: by themselves, and as seen from the run."""
    base = base.resolve()
    places = {"base": str(base)}
    with suppress(ValueError):  # another drive
        places["base_from_run"] = Path(os.path.relpath(base, run.resolve())).as_posix()
    return places


def base_of(facts: Mapping[str, Any], run: Path) -> Path:
    """Folder that inputs are relative to, by the facts of a record."""
    recorded = Path(facts["base"])
    names = [name for name in facts["inputs"] if not Path(name).is_absolute()]
    beside = (run / facts.get("base_from_run", recorded)).resolve()
    return beside if names and all((beside / name).exists() for name in names) else recorded
