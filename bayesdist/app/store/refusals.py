"""Refusal of unsuitable folders, inputs and settings of a run before anything is written."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

from bayesdist.app.config import Config, load_config, load_text, parse_config
from bayesdist.app.store.keys import shown
from bayesdist.app.store.lock import LOCK
from bayesdist.app.store.made_from import changes, input_name, is_adjustable, with_seed
from bayesdist.errors import InputError
from bayesdist.files.atomic import is_leftover


def refuse_inside_input(folder: Path, config: Config, base: Path) -> None:
    """Refuse a run inside a folder of its input, because its files would become inputs."""
    named = config.named_files(base)
    for path in named if isinstance(named, list) else [named]:
        if path.is_dir() and folder.resolve().is_relative_to(path.resolve()):
            raise InputError(
                "the run would lie inside the folder of its input",
                where=str(folder),
                do="choose a folder outside of it",
            )


def refuse_foreign_files(folder: Path, text: str, inputs: Iterable[Path] = ()) -> None:
    """Raise InputError if a run would begin in a folder that contains other files.

    Allowed are inputs of the run, and a config.toml with the text of the configuration, because
    stages can be run on such a folder.
    """
    if not folder.is_dir():
        return
    names = {path.name for path in folder.iterdir() if not is_leftover(path.name)} - {LOCK}
    names -= {path.name for path in inputs if path.parent.resolve() == folder.resolve()}
    if "config.toml" in names and load_text(folder / "config.toml") == text:
        names.remove("config.toml")
    if names:
        raise InputError(
            f"the folder holds other files ({min(names)})",
            where=str(folder),
            do="choose an empty folder",
        )


def refuse_another_solution(
    folder: Path,
    known: Config,
    record: Mapping[str, Any],
    config: Config,
    base: Path,
    inputs: Mapping[str, str],
    seed: int | None,
) -> None:
    """Refuse to resume a run with inputs or settings that differ from those of its solution.

    Parameters
    ----------
    folder : Path
        Folder of the run.
    known : Config
        Configuration that the run began with.
    record : mapping
        Entries of the record of the run.
    config : Config
        Configuration to resume with.
    base : Path
        Folder that inputs are relative to.
    inputs : mapping of str to str
        SHA-256 of the inputs by name.
    seed : int or None
        Seed given on the command line.

    Raises
    ------
    InputError
        If the seed, an input, or a setting that may not change differs.
    """
    path = folder / "config.toml"
    if seed is not None and seed != known.sampler.seed:
        raise InputError(
            f"the run was started with seed {known.sampler.seed}",
            where=str(folder),
            do="leave out --seed, or start again with --force",
        )
    if path.exists():  # the seed of the file may have been replaced on the command line
        known = with_seed(known, parse_config(load_text(path), str(path)).sampler.seed)
    for key, old, new in changes(known, config):
        if not is_adjustable(key, known):
            raise InputError(
                f"the configuration has {key} = {shown(new)}, but this run was started with "
                f"{shown(old)}",
                where=str(path),
                do="resume with the old value, or start again with --force",
            )
    base, before = base.resolve(), Path(record["base"])
    of_products = {input_name(file, base) for file in config.files_of_products(base)}
    of_products |= {input_name(file, before) for file in known.files_of_products(before)}
    refuse_other_inputs(record["inputs"], inputs, base, but=of_products)


def refuse_edited(folder: Path, known: Config) -> None:
    """Refuse a run if its config.toml was edited in place after the run began."""
    path = folder / "config.toml"
    if not path.exists():
        return
    # the seed may have been replaced on the command line
    now = with_seed(load_config(path)[0], known.sampler.seed)
    keys = [key for key, *_ in changes(known, now)]
    if keys:
        resumed = f"take it over by 'bayesdist run {path} -o {folder} --resume'"
        adjustable = all(is_adjustable(key, known) for key in keys)
        raise InputError(
            f"was edited since the run began ({keys[0]}), which uses the old one",
            where=str(path),
            do=f"restore it, or {resumed if adjustable else 'start again with --force'}",
        )


def refuse_other_inputs(
    known: Mapping[str, str], now: Mapping[str, str], base: Path, but: Collection[str] = ()
) -> None:
    """Refuse inputs that differ from those of the record, except for the names in `but`.

    `base` is the folder of the inputs.
    """
    for name in sorted((known.keys() | now.keys()) - set(but)):
        if known.get(name) != now.get(name):
            raise InputError(
                "this input changed since the run began",
                where=str(base / name),
                do="restore it, or start again with --force",
            )
