"""run.json and other files of results: ingredients of a run, keys of artefacts, atomic writing.

run.json holds the ingredients of a run, and the ingredients and files of each stage.  Keys are
hashes of ingredients, which are converted to plain JSON.  Output files and folders appear whole and
never overwrite other files.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Iterator, Mapping, Set
from contextlib import contextmanager
from dataclasses import dataclass, field, is_dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from astropy.table import Table
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, TypeAdapter
from pydantic_core import to_json, to_jsonable_python

from bayesdist.app.store.summary import Sections
from bayesdist.errors import InputError
from bayesdist.files.atomic import atomic_path, sha256_of
from bayesdist.files.documents import model_of, read_json
from bayesdist.infer import Posterior
from bayesdist.version import __version__

SCHEMA = 2
TABLE_SCHEMA = 1  # of records of commands
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


class _RecordPart(BaseModel):
    """Part of run.json; strings are not converted to numbers."""

    model_config = ConfigDict(strict=True, extra="forbid")


class _Head(_RecordPart):
    """Entries that every version of the package writes to run.json."""

    model_config = ConfigDict(extra="allow")
    schema_: int = Field(alias="schema")
    versions: dict[str, str] = Field(default_factory=dict)


class FileMark(_RecordPart):
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


class Artefact(_RecordPart):
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


class _StageNote(_RecordPart):
    wall_s: float
    ended: str


class _UnderWay(_RecordPart):
    stage: str
    files: list[str]


class _RecordFile(_Head):
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


_HEAD, _WHOLE = TypeAdapter(_Head), TypeAdapter(_RecordFile)


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


@dataclass(frozen=True)
class Adjustable:
    """Settings that may change when a stage is resumed.

    They are part of the key of the stage, but not of that of its checkpoints.

    Parameters
    ----------
    value : object
        Settings that `as_json` can convert.
    """

    value: Any


def as_json(value: Any) -> Any:
    """Convert a value to plain JSON.

    Parameters
    ----------
    value : object
        Settings, dataclasses, arrays, paths, or mappings and sequences of these.

    Returns
    -------
    object
        Mappings, lists, text, numbers and None.  Numbers that are not finite become None.

    Raises
    ------
    TypeError
        If the value contains anything else, or a set, which has no order.
    """
    _refuse_sets(value)
    return to_jsonable_python(value, inf_nan_mode="null", fallback=_plain)


def attributes(one: Any, names: str) -> dict[str, Any]:
    """Attributes of an object by name, as a row; all None if the object is None."""
    return {name: None if one is None else getattr(one, name) for name in names.split()}


def _refuse_sets(value: Any) -> None:
    """Raise TypeError for a set anywhere in a value: pydantic would list it in hash order."""
    if value is None or isinstance(value, str | int | float | np.ndarray):
        return  # first, because tests for models and mappings are slow
    if isinstance(value, set | frozenset):
        raise TypeError(f"{type(value).__name__} is no JSON and cannot be in a record or a key")
    if isinstance(value, dict):
        value = value.values()
    elif not isinstance(value, list | tuple):
        if (is_dataclass(value) and not isinstance(value, type)) or isinstance(value, BaseModel):
            value = vars(value)
        if not isinstance(value, Mapping):
            return
        value = value.values()
    for element in value:
        _refuse_sets(element)


def _plain(value: Any) -> Any:
    """Convert values that pydantic cannot serialise to lists, numbers and dictionaries."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return dict(value)
    raise TypeError(f"{type(value).__name__} is no JSON and cannot be in a record or a key")


def digest_of(value: Any) -> str:
    """SHA-256 of a value as plain JSON: 64 hexadecimal digits."""
    return digest_of_plain(as_json(value))


def digest_of_plain(plain: Any) -> str:
    """SHA-256 of a value that is already plain JSON, as returned by `as_json`."""
    text = json.dumps(plain, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def differences(known: Any, now: Any, path: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Compare two values of plain JSON.

    Mappings are compared key by key, and lists of mappings of equal length row by row.

    Parameters
    ----------
    known, now : object
        Old and new value.
    path : str
        Dotted path that the values are found at.

    Yields
    ------
    tuple of str, object, object
        Dotted path, old value and new value of each difference.
    """
    if isinstance(known, Mapping) and isinstance(now, Mapping):
        for key in dict.fromkeys([*known, *now]):
            at = f"{path}.{key}" if path else str(key)
            yield from differences(known.get(key), now.get(key), at)
    elif _rows(known) and _rows(now) and len(known) == len(now):
        for k, (old_row, new_row) in enumerate(zip(known, now, strict=True)):
            yield from differences(old_row, new_row, f"{path}[{k + 1}]" if path else "")
    elif known != now:
        yield path, known, now


def difference(known: Any, now: Any) -> str:
    """Sentence on the first difference between two values; empty if they are equal."""
    for path, old, new in differences(known, now):
        if path.startswith("from."):
            return f"{path.removeprefix('from.')} has other results"
        return f"{path} {shown(old)} is now {shown(new)}"
    return ""


def _rows(value: Any) -> bool:
    """True for a list of mappings."""
    return isinstance(value, list) and all(isinstance(row, Mapping) for row in value)


def shown(value: Any) -> str:
    """Text of a value, shortened to fit on a line."""
    text = "none" if value is None else json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else f"{text[:57]}..."


def refuse_existing(path: Path, force: bool) -> None:
    """Refuse a file that exists, unless it may be replaced."""
    if path.exists() and not force:
        raise InputError("this file exists", where=str(path), do="replace it with --force")


def write_table(table: Table, path: Path) -> None:
    """Write a table as ECSV, atomically."""
    with atomic_path(path) as temporary:
        table.write(temporary, format="ascii.ecsv")


def provenance_notes(posterior: Posterior, gauge: str) -> dict[str, bool | str]:
    """Metadata on the convergence and the gauge, for the header of a file."""
    return {
        "converged": posterior.convergence.converged,
        **({"gauge": gauge} if gauge else {}),
    }


@contextmanager
def record_folder(path: Path, name: str, command: str) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Create a folder and a record to be filled, which is written when the block succeeds."""
    with atomic_directory(path) as folder:
        record: dict[str, Any] = {
            "schema": TABLE_SCHEMA,
            "command": command,
            "versions": versions(),
        }
        yield folder, record
        write_json(folder / name, record)


@contextmanager
def atomic_directory(path: Path) -> Iterator[Path]:
    """Create a folder that appears under its name if the block succeeds, and is removed otherwise.

    `path` must not exist or be empty.  Yields the temporary folder to write to.
    """
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise InputError(
            "the folder holds other files" if path.is_dir() else "is a file, not a folder",
            where=str(path),
            do="choose a new folder: existing files are never overwritten",
        )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}-", dir=path.parent))
    except OSError as error:
        raise InputError(
            f"the folder cannot be made ({error.strerror})",
            where=str(path),
            do="choose one that you may write to",
        ) from error
    try:
        yield temporary
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o777 & ~mask)  # temporary folders are readable only by their owner
        temporary.replace(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
