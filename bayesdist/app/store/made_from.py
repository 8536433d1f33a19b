"""Ingredients of the stages of a run: inputs by name, settings, and the preceding stages.

Unsuitable folders, inputs and settings are refused before anything is written.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from bayesdist.app.config import Config, load_config, load_text, parse_config
from bayesdist.app.store import Adjustable, Made, Stage, as_json, differences
from bayesdist.app.store.record import shown
from bayesdist.app.store.store import LOCK
from bayesdist.data import input_files
from bayesdist.errors import InputError
from bayesdist.files.atomic import is_leftover, sha256_of
from bayesdist.version import __version__


def input_name(path: Path, *bases: Path) -> str:
    """Name of an input relative to the first of some folders that contains it, otherwise its path.

    Names are compared as written in the configuration: '../data/x' stays unchanged.
    """
    for base in bases:
        with suppress(ValueError):
            return path.relative_to(base).as_posix()
    return str(path)


def hashes_of(config: Config, base: Path, *before: Path) -> dict[str, str]:
    """SHA-256 of every file that a configuration names, by file name.

    `base` is the folder that names are relative to; `before` are folders that it was in earlier.
    """
    base = base.resolve()
    further = [*config.files_of_products(base), *config.files_of_priors(base)]
    named = [*input_files(config.named_files(base)), *further]
    return {input_name(path, base, *before): sha256_of(path) for path in named}


def places_of(base: Path, run: Path) -> dict[str, str]:
    """Entries of a record that locate the inputs: their folder, also relative to the run."""
    base = base.resolve()
    places = {"base": str(base)}
    with suppress(ValueError):  # another drive
        places["base_from_run"] = Path(os.path.relpath(base, run.resolve())).as_posix()
    return places


def base_of(facts: Mapping[str, Any], run: Path) -> Path:
    """Folder that inputs are relative to, from the entries of a record."""
    recorded = Path(facts["base"])
    names = [name for name in facts["inputs"] if not Path(name).is_absolute()]
    relocated = (run / facts.get("base_from_run", recorded)).resolve()
    return relocated if names and all((relocated / name).exists() for name in names) else recorded


# stages in order; `revision` is raised when the results or files of a stage change
STAGES = {
    "match": Stage(revision=2),
    "fit": Stage(revision=5),
    "sample": Stage(revision=3, checkpoints=("chain-*.h5",)),
    "diagnose": Stage(revision=7),
    "evaluate": Stage(revision=4),
    "export": Stage(),
    "report": Stage(),
}

# stages that a stage requires
NEEDS = {
    "match": (),
    "fit": (),
    "sample": ("fit",),
    "diagnose": ("fit", "sample"),
    "evaluate": ("fit", "sample", "diagnose"),
    "export": ("fit", "sample"),
    "report": ("fit", "sample", "diagnose", "evaluate"),
}

# stopping criteria: if they change the sampler continues its chains
LIMITS = ("max_steps", "target_ess", "target_rhat")

# sections that are not used before the posterior
LATER = ("assess", "budget", "requirement", "discrepancy", "periods", "products")

# sections that do not affect results
NOWHERE = ("compute",)


def settings_of(config: Config) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    """Settings of a run, divided by what they affect.

    Returns
    -------
    tuple of dict
        Settings that affect the solution, those that limit the length of the chains, and those that
        affect only later stages.
    """
    settings = as_json(config.model_dump())
    later = {key: settings.pop(key) for key in LATER if key in settings}
    limits = {"sampler": {key: settings["sampler"].pop(key) for key in LIMITS}}
    for key in NOWHERE:
        settings.pop(key, None)
    if config.fits_on_grid:
        settings["assess"] = {"grid": later["assess"]["grid"]}
    return settings, limits, later


def made_from_of(
    stage: str, before: Mapping[str, Made[object]], config: Config, facts: Mapping[str, Any]
) -> tuple[object, ...] | None:
    """Ingredients of a stage; None if a stage that it needs is missing.

    Parameters
    ----------
    stage : str
    before : mapping of str to Made
        Preceding stages that are up to date.
    config : Config
    facts : mapping
        Entries of the record: inputs with their hashes, and requirements that replace the
        configured ones.
    """
    first = {config.begins_with} - {stage, "fit"}
    if not before.keys() >= {*first, *NEEDS[stage]}:
        return None
    solution, limits, later = settings_of(config)
    configured = [as_json(vars(item)) for item in config.requirements()]
    later["requirement"] = facts.get("requirements", configured)
    base = Path(facts["base"])
    of_products = {input_name(item, base) for item in config.files_of_products(base)}
    inputs = {k: v for k, v in facts["inputs"].items() if k not in of_products}
    if stage in ("match", "fit"):
        return solution, {"inputs": inputs}, *before.values()
    if stage == "sample":
        return solution, *before.values(), Adjustable(limits)
    if stage == "diagnose":
        return before["fit"], before["sample"], Adjustable(_of_diagnoses(later, configured, config))
    if stage == "evaluate":
        return before["fit"], before["sample"], before["diagnose"], Adjustable(later)
    later["files"] = {k: v for k, v in facts["inputs"].items() if k in of_products}
    return *before.values(), Adjustable(later), {"bayesdist": __version__}


def _of_diagnoses(later: Mapping[str, Any], own: list[Any], config: Config) -> dict[str, Any]:
    """Settings that affect the diagnostics."""
    settings = {key: later[key] for key in ("discrepancy", "periods") if key in later}
    if later.get("periods"):
        settings["requirement"] = own  # the tightest limit is the tolerance of periods
    if config.holdout is not None:  # held-out stars are predicted with all position errors
        settings |= {key: later[key] for key in ("assess", "budget")}
        # may be the epoch of the assessment
        settings["useafter"] = config.products.useafter_years()
    return settings


def changes(known: Config, now: Config) -> Iterator[tuple[str, Any, Any]]:
    """Dotted key, old value and new value of each difference between two configurations."""
    yield from differences(as_json(known.model_dump()), as_json(now.model_dump()))


def is_adjustable(key: str, config: Config) -> bool:
    """True if a run may be resumed with another value of the key."""
    section, _, name = key.partition(".")
    if key.startswith("assess.grid") and config.fits_on_grid:
        return False
    if section == "sampler":
        return name in LIMITS
    return section.partition("[")[0] in (*LATER, *NOWHERE)


def with_seed(config: Config, seed: int | None) -> Config:
    """Configuration with another seed; unchanged if the seed is None."""
    if seed is None:
        return config
    sampler = config.sampler.model_copy(update={"seed": seed})
    return config.model_copy(update={"sampler": sampler})


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
