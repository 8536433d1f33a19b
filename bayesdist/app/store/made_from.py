"""Ingredients of the stages of a run: inputs by name, settings, and the stages before them."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from bayesdist.app.config import Config
from bayesdist.app.store import Adjustable, Made, Stage, as_json, differences
from bayesdist.data import input_files
from bayesdist.files.atomic import sha256_of
from bayesdist.version import __version__


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


# stages in order; `revision` is raised when the numbers of a stage, or its files, change
STAGES = {
    "match": Stage(revision=2),
    "fit": Stage(revision=4),
    "sample": Stage(revision=3, checkpoints=("chain-*.h5",)),
    "diagnose": Stage(revision=7),
    "evaluate": Stage(revision=4),
    "export": Stage(),
    "report": Stage(),
}

# stages that a stage cannot do without
NEEDS = {
    "match": (),
    "fit": (),
    "sample": ("fit",),
    "diagnose": ("fit", "sample"),
    "evaluate": ("fit", "sample", "diagnose"),
    "export": ("fit", "sample"),
    "report": ("fit", "sample", "diagnose", "evaluate"),
}

# when to stop: the sampler goes on from its chains where these are others
LIMITS = ("max_steps", "target_ess", "target_rhat")

# sections that nothing goes by before there is a posterior
LATER = ("assess", "budget", "requirement", "discrepancy", "periods", "products")

# sections that change no number
NOWHERE = ("compute",)


def settings_of(config: Config) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    """Settings of a run by what they decide: the solution, the length of chains, and all later."""
    whole = as_json(config.model_dump())
    later = {key: whole.pop(key) for key in LATER if key in whole}
    limits = {"sampler": {key: whole["sampler"].pop(key) for key in LIMITS}}
    for key in NOWHERE:
        whole.pop(key, None)
    if _is_on_the_grid(config):
        whole["assess"] = {"grid": later["assess"]["grid"]}
    return whole, limits, later


def made_from_of(
    stage: str, before: Mapping[str, Made[object]], config: Config, facts: Mapping[str, Any]
) -> tuple[object, ...] | None:
    """Ingredients of a stage; None where a stage is missing that it needs.

    `before` are the stages before it that stand; `facts` of the record have the inputs with their
    hashes, and requirements in place of the configured ones.
    """
    begins_with = () if config.data is not None or stage == "match" else ("match",)
    if not before.keys() >= {*begins_with, *NEEDS[stage]}:
        return None
    solution, limits, later = settings_of(config)
    own = [as_json(vars(one)) for one in config.requirements()]
    later["requirement"] = facts.get("requirements", own)
    base = Path(facts["base"])
    of_products = {input_name(one, base) for one in config.files_of_products(base)}
    inputs = {k: v for k, v in facts["inputs"].items() if k not in of_products}
    if stage in ("match", "fit"):
        return solution, {"inputs": inputs}, *before.values()
    if stage == "sample":
        return solution, *before.values(), Adjustable(limits)
    if stage == "diagnose":
        return before["fit"], before["sample"], Adjustable(_of_diagnoses(later, own, config))
    if stage == "evaluate":
        return before["fit"], before["sample"], before["diagnose"], Adjustable(later)
    later["files"] = {k: v for k, v in facts["inputs"].items() if k in of_products}
    return *before.values(), Adjustable(later), {"bayesdist": __version__}


def _of_diagnoses(later: Mapping[str, Any], own: list[Any], config: Config) -> dict[str, Any]:
    """Settings that decide what residuals say."""
    found = {key: later[key] for key in ("discrepancy", "periods") if key in later}
    if later.get("periods"):
        found["requirement"] = own  # the tightest limit is the tolerance of periods
    if config.holdout is not None:  # what is held out is predicted with all errors of a position
        found |= {key: later[key] for key in ("assess", "budget")}
        found["useafter"] = config.products.useafter_years()  # which may be the epoch of assess
    return found


def _is_on_the_grid(config: Config) -> bool:
    """Boolean: the fit writes errors of tables on the grid of the assessment."""
    tables = config.tables
    return config.campaign is not None and (tables.method != "none" or tables.detector is not None)


def changes(known: Config, now: Config) -> Iterator[tuple[str, Any, Any]]:
    """Dotted key, old and new value of whatever differs between two configurations."""
    yield from differences(as_json(known.model_dump()), as_json(now.model_dump()))


def is_adjustable(key: str, config: Config) -> bool:
    """Boolean: a run may be resumed with another value of a key."""
    section, _, name = key.partition(".")
    if key.startswith("assess.grid") and _is_on_the_grid(config):
        return False
    if section == "sampler":
        return name in LIMITS
    return section.partition("[")[0] in (*LATER, *NOWHERE)


def with_seed(config: Config, seed: int | None) -> Config:
    """A configuration with another seed; as it is where none is given."""
    if seed is None:
        return config
    sampler = config.sampler.model_copy(update={"seed": seed})
    return config.model_copy(update={"sampler": sampler})
