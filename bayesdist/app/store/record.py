"""run.json: ingredients of a run, and the ingredients and files of each stage."""

from __future__ import annotations

import platform
import sys
from collections.abc import Set
from dataclasses import dataclass, field
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, TypeAdapter
from pydantic_core import to_json

from bayesdist.app.store.keys import as_json, digest_of, digest_of_plain
from bayesdist.app.store.summary import Sections
from bayesdist.errors import InputError
from bayesdist.files.atomic import atomic_path, sha256_of
from bayesdist.files.documents import model_of, read_json
from bayesdist.version import __version__

SCHEMA = 2
PACKAGES = ("arviz-stats", "astropy", "emcee", "h5py", "numba", "numpy", "scipy")


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file, replaced atomically.

    Parameters
    ----------
    path : Path
    value : object
        Value that `as_json` can convert.
    """
    write_text(path, json_text(as_json(value)))


def write_text(path: Path, text: str) -> None:
    """Write a text file, replaced atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def json_text(plain: Any) -> str:
    """Text of a JSON file from plain JSON, as returned by `as_json`."""
    return to_json(plain, indent=1).decode() + "\n"


_version = cache(metadata.version)


def versions() -> dict[str, str]:
    """Versions of Python, the platform, and the packages that affect results, by name."""
    out = {"python": sys.version.split()[0], "platform": platform.platform()}
    out["bayesdist"] = __version__  # also if run from a source tree
    out |= {name: _version(name) for name in PACKAGES}
    return out


class _Part(BaseModel):
    """Part of run.json; strings are not converted to numbers."""

    model_config = ConfigDict(strict=True, extra="forbid")


class _Head(_Part):
    """Entries that every version of the package writes to run.json."""

    model_config = ConfigDict(extra="allow")
    schema_: int = Field(alias="schema")
    versions: dict[str, str] = Field(default_factory=dict)


class FileMark(_Part):
    """Size and SHA-256 of a file when it was written."""

    size: Annotated[int, Field(ge=0)]
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]

    @classmethod
    def of(cls, path: Path) -> FileMark:
        """Mark of a file in its present state."""
        return cls(size=path.stat().st_size, sha256=sha256_of(path))


def _as_sections(raw: dict[str, Any]) -> dict[str, Any]:
    """Validate sections of summary.json and return them unchanged."""
    Sections.model_validate(raw)
    return raw


class _Ingredients(BaseModel):
    """Ingredients of a stage that are read again; settings are only compared."""

    from_: dict[str, str] = Field(default_factory=dict, alias="from")


def _as_ingredients(raw: dict[str, Any]) -> dict[str, Any]:
    """Validate the ingredients of a stage and return them unchanged."""
    _Ingredients.model_validate(raw)
    return raw


class Artefact(_Part):
    """Ingredients of a stage, and the files that it wrote.

    Parameters
    ----------
    key : str
        Hash of `parts`.
    parts : dict
        Revision of the stage, settings, and digests of the preceding artefacts.
    files : dict of str to FileMark
        Marks of the files by their path in the folder.
    sections : dict
        Sections of summary.json.
    """

    key: str
    parts: Annotated[dict[str, Any], AfterValidator(_as_ingredients)]
    files: dict[str, FileMark]
    sections: Annotated[dict[str, Any], AfterValidator(_as_sections)]

    @property
    def digest(self) -> str:
        """Hash of the written files and sections; of the ingredients if nothing was written."""
        written = {name: mark.sha256 for name, mark in self.files.items()}
        return digest_of([written, self.sections] if written or self.sections else self.parts)


class _StageNote(_Part):
    wall_s: float
    ended: str


class _UnderWay(_Part):
    stage: str
    files: list[str]


class _Whole(_Head):
    """Content of run.json."""

    sha256: str
    artefacts: dict[str, Artefact]
    stages: dict[str, _StageNote]
    under_way: _UnderWay | None
    checkpoints: dict[str, str]
    # entries of runs, which a bare store does not have
    config: dict[str, Any] = Field(default_factory=dict)
    base: str = ""
    base_from_run: str = ""
    inputs: dict[str, str] = Field(default_factory=dict)
    seed: int = 0
    command: str = ""
    created: str = ""
    requirements: list[dict[str, Any]] = Field(default_factory=list)


_HEAD, _WHOLE = TypeAdapter(_Head), TypeAdapter(_Whole)


@dataclass
class Record:
    """Content of run.json.

    Parameters
    ----------
    facts : dict
        Ingredients of the run: configuration, inputs, versions.
    artefacts : dict of str to Artefact
        Artefacts of completed stages.
    stages : dict of str to dict
        For each completed stage when it ended, and how long it took.
    under_way : dict or None
        Name of the stage in progress or interrupted, and the files that it may have written.
    checkpoints : dict of str to str
        For each stage with checkpoints the hash of their ingredients.
    """

    facts: dict[str, Any]
    artefacts: dict[str, Artefact] = field(default_factory=dict)
    stages: dict[str, dict[str, Any]] = field(default_factory=dict)
    under_way: dict[str, Any] | None = None
    checkpoints: dict[str, str] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path) -> Record:
        """Read a run.json; raises InputError if it has another schema or was changed."""
        do = "restore it, or choose another folder"
        facts = read_json(path, do=do)
        head = model_of(_HEAD, facts, str(path), do=do)
        if head.schema_ != SCHEMA:
            raise InputError(
                f"is a run of schema {head.schema_}, which the version of bayesdist that made it "
                f"({head.versions.get('bayesdist', 'another version')}) reads; this version reads "
                f"schema {SCHEMA}",
                where=str(path),
                do="use that version, or choose another folder",
            )
        content = model_of(_WHOLE, facts, str(path), do=do)
        if facts.pop("sha256") != digest_of_plain(facts):
            raise InputError(
                "was changed since bayesdist wrote it (its checksum differs)",
                where=str(path),
                do=do,
            )
        del facts["schema"], facts["artefacts"]
        entries = {key: facts.pop(key) for key in ("stages", "under_way", "checkpoints")}
        return cls(facts, content.artefacts, **entries)

    def copied(self) -> Record:
        """Copy in which entries can be added, replaced and removed."""
        under_way = self.under_way and {**self.under_way, "files": [*self.under_way["files"]]}
        return Record(
            dict(self.facts),
            dict(self.artefacts),
            dict(self.stages),
            under_way,
            dict(self.checkpoints),
        )

    @property
    def file_names(self) -> set[str]:
        """Files that stages have written or may have written."""
        names = {name for artefact in self.artefacts.values() for name in artefact.files}
        return names.union((self.under_way or {}).get("files", ()))

    def begins_files(self, names: Set[str]) -> bool:
        """Note that the current stage writes files; False if all of them were noted before."""
        if self.under_way is None or names <= set(self.under_way["files"]):
            return False
        self.under_way["files"] = sorted({*names, *self.under_way["files"]})
        return True

    def write(self, path: Path) -> None:
        """Replace run.json."""
        content = {"schema": SCHEMA, **self.facts, "stages": self.stages}
        content |= {
            "artefacts": self.artefacts,
            "under_way": self.under_way,
            "checkpoints": self.checkpoints,
        }
        plain = as_json(content)
        write_text(path, json_text(plain | {"sha256": digest_of_plain(plain)}))
