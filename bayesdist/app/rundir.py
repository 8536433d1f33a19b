"""A run directory: one folder that holds everything about one calibration."""

from __future__ import annotations

import platform
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from bayesdist import __version__
from bayesdist.app.config import (
    Config,
    config_of_record,
    load_config,
    load_text,
    parse_config,
)
from bayesdist.app.made_from import CODECS, NEEDS, changes, is_adjustable, settings_of
from bayesdist.app.named_files import files_of_products, named_files
from bayesdist.app.store import SCHEMA, Adjustable, Made, Record, RunStore, as_json, write_json
from bayesdist.app.store.keys import shown
from bayesdist.assess import Requirement
from bayesdist.data import input_files
from bayesdist.errors import ConfigError, InputError
from bayesdist.files import atomic_path, is_leftover, made_folder, remove_leftovers, sha256_of

__all__ = ["RunDirectory", "as_json", "versions", "write_json"]

PACKAGES = ("arviz", "astropy", "emcee", "numba", "numpy", "scipy", "xarray")
PAIRS = "pairs"  # matches that were prepared before the first stage

RESUME = "resume with the old value, or start again with --force"


class RunDirectory:
    """Files and state of a run.

    Parameters
    ----------
    path : path
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.store = RunStore(self.path, CODECS)
        self._planned: tuple[dict[str, Any], str] | None = None
        self._adopted: tuple[Config, str, dict[str, str]] | None = None

    def __truediv__(self, name: str) -> Path:
        return self.path / name

    # -- beginning --------------------------------------------------------------------------------

    @classmethod
    def plan(
        cls,
        path: str | Path,
        config: Config,
        text: str,
        base: Path,
        *,
        resume: bool = False,
        force: bool = False,
        seed: int | None = None,
        command: str = "",
    ) -> RunDirectory:
        """A run that may be resumed in a folder, or may begin there; nothing is written yet.

        Parameters
        ----------
        path : path
        config : Config
        text : str
            The configuration as written by the user.
        base : Path
            Folder that relative inputs are relative to.
        resume, force : bool
            Resume the run that is there, or replace it.
        seed : int, optional
            In place of the configured one.
        command : str
            For the record.

        Raises
        ------
        InputError
            When the folder holds another run or foreign files, or a resumed run was made from other
            inputs or settings.
        """
        run = cls(path)
        if run.path.exists() and not run.path.is_dir():
            raise InputError("is a file, not a folder", where=str(path), do="choose another folder")
        run._refuse_inside_input(config, base)
        inputs = _hashes(config, base)
        if run.is_initialized and not force:
            if not resume:
                raise InputError(
                    "the folder holds another run",
                    where=str(path),
                    do="go on with it by --resume, replace it by --force, or choose another folder",
                )
            run._refuse_another(config, inputs, base, seed)
            run._adopted = config, text, inputs
            return run
        if run.is_initialized:
            run.store.record  # noqa: B018 - refuse to replace what nobody can tell from other files
        foreign = run._foreign(text)
        if foreign:
            raise InputError(
                f"the folder holds other files ({foreign[0]})",
                where=str(path),
                do="choose an empty folder",
            )
        facts = {
            "config": _with_seed(config, seed).model_dump(),
            "base": str(base.resolve()),
            "inputs": inputs,
            "seed": config.sampler.seed if seed is None else seed,
            "versions": versions(),
            "command": command,
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
        }
        run._planned = as_json(facts), text
        return run

    @property
    def is_initialized(self) -> bool:
        """Boolean: the folder holds a run."""
        return (self / "run.json").exists()

    @property
    def is_planned(self) -> bool:
        """Boolean: nothing of this run has been written yet."""
        return self._planned is not None

    def locked(self) -> AbstractContextManager[None]:
        """Keep other processes from working on this run; its folder is made.

        Raises
        ------
        InputError
            When another process is at work on it, or the folder cannot be made.
        """
        made_folder(self.path)
        return self.store.locked()

    def begin(self) -> None:
        """Write down what is about to be done.

        Another run that stands there is removed; a resumed one takes over the settings that may
        change.

        Raises
        ------
        InputError
            When the folder cannot be made or written.
        """
        if self._planned is None:
            self._adopt()
            return
        facts, text = self._planned
        made_folder(self.path)
        if self.is_initialized:
            self.clear()
        remove_leftovers(self.path)
        self._write_text(text)
        Record(facts).write(self / "run.json")
        self._planned = None

    def _adopt(self) -> None:
        """Take over what a resumed run was given in another way, and put summary.json right."""
        remove_leftovers(self.path)
        if self._adopted is not None:
            config, text, inputs = self._adopted
            record, known = self.store.record, self.config
            changed = {key for key, *_ in changes(known, _with_seed(config, known.sampler.seed))}
            if changed or inputs != record.facts["inputs"]:
                config = _with_seed(config, known.sampler.seed)
                record.facts |= {"config": as_json(config.model_dump()), "inputs": inputs}
                if any(key.startswith("requirement") for key in changed):
                    record.facts.pop("requirements", None)
                record.write(self / "run.json")
                self._write_text(text)
            self._adopted = None
        self.store.restore_summary()

    def _write_text(self, text: str) -> None:
        """Write config.toml as the user wrote it."""
        with atomic_path(self / "config.toml") as temporary:
            temporary.write_text(text, encoding="utf-8", newline="")

    @classmethod
    def open(cls, path: str | Path) -> RunDirectory:
        """A run that exists, or a folder with a config.toml that becomes one.

        Raises
        ------
        InputError
        """
        run = cls(path)
        if run.is_initialized:
            run._refuse_edited()
            run._refuse_other_inputs(_hashes(run.config, Path(run.record["base"])))
            return run
        if (run / "config.toml").exists():
            config, text = load_config(run / "config.toml")
            return cls.plan(path, config, text, run.path)
        raise run.not_a_run_error()

    def not_a_run_error(self) -> InputError:
        """The error for a place that holds no run; a demo has its run in a folder of its own."""
        within = self / "run"
        cause = "is no run: it has neither run.json nor config.toml"
        if not self.path.exists():
            cause = "there is no such folder"
        elif not self.path.is_dir():
            cause = "is a file, not the folder of a run"
        return InputError(
            cause,
            where=str(self.path),
            do=f"give {within}, which is one"
            if (within / "run.json").exists()
            else "make one with 'bayesdist run CONFIG.toml -o RUN'",
        )

    # -- refusals ---------------------------------------------------------------------------------

    def _refuse_inside_input(self, config: Config, base: Path) -> None:
        """Refuse a run whose own Parquet files would become part of its input."""
        named = named_files(config, base)
        for path in named if isinstance(named, list) else [named]:
            if path.is_dir() and self.path.resolve().is_relative_to(path.resolve()):
                raise InputError(
                    "the run would lie inside the folder of its input",
                    where=str(self.path),
                    do="choose a folder outside of it",
                )

    def _foreign(self, text: str) -> list[str]:
        """What forbids a run to begin in a folder that holds none, sorted.

        A config.toml that says the same is no obstacle: a stage may be run on it.
        """
        if self.is_initialized or not self.path.is_dir():
            return []
        names = {p.name for p in self.path.iterdir() if not is_leftover(p.name)}
        if "config.toml" in names and load_text(self / "config.toml") == text:
            names.remove("config.toml")
        return sorted(names)

    def _refuse_another(
        self, config: Config, inputs: dict[str, str], base: Path, seed: int | None
    ) -> None:
        """Refuse to resume with inputs or settings that the solution was not made from."""
        known, path = self.config, self / "config.toml"
        if seed is not None and seed != known.sampler.seed:
            raise InputError(
                f"the run began with seed {known.sampler.seed}",
                where=str(self.path),
                do="leave --seed out, or start again with --force",
            )
        if path.exists():  # the command line may have given another seed than the file
            known = _with_seed(known, parse_config(load_text(path), str(path)).sampler.seed)
        for key, old, new in changes(known, config):
            if not is_adjustable(key, known):
                raise InputError(
                    f"the configuration has {key} = {shown(new)}, and this run began with "
                    f"{shown(old)}",
                    where=str(path),
                    do=RESUME,
                )
        of_products = {str(f) for f in files_of_products(config, base.resolve())}
        of_products |= {str(f) for f in files_of_products(known, Path(self.record["base"]))}
        self._refuse_other_inputs(inputs, but=of_products)

    def _refuse_edited(self) -> None:
        """Refuse a config.toml that was edited in place: the run goes by what it was given."""
        path, known = self / "config.toml", self.config
        if not path.exists():
            return
        # the command line may have given another seed
        now = _with_seed(load_config(path)[0], known.sampler.seed)
        keys = [key for key, *_ in changes(known, now)]
        if keys:
            resumed = f"take it over by 'bayesdist run {path} -o {self.path} --resume'"
            adjustable = all(is_adjustable(key, known) for key in keys)
            raise InputError(
                f"was edited since the run began ({keys[0]}), which goes by the old one",
                where=str(path),
                do=f"restore it, or {resumed if adjustable else 'start again with --force'}",
            )

    def _refuse_other_inputs(self, now: dict[str, str], but: Collection[str] = ()) -> None:
        """Refuse inputs that are not those of the record, `but` some."""
        known = self.record["inputs"]
        for name in sorted((known.keys() | now.keys()) - set(but)):
            if known.get(name) != now.get(name):
                raise InputError(
                    "this input changed since the run began",
                    where=name,
                    do="restore it, or start again with --force",
                )

    # -- record -----------------------------------------------------------------------------------

    @property
    def record(self) -> dict[str, Any]:
        """Content of run.json, or of what it will be."""
        if self._planned is not None:
            return {"schema": SCHEMA, **self._planned[0], "stages": {}}
        return self.store.record.as_dict()

    def note(self, **facts: Any) -> None:
        """Add facts to run.json."""
        record = self.store.record
        record.facts |= as_json(facts)
        record.write(self / "run.json")

    @property
    def config(self) -> Config:
        """The resolved configuration."""
        try:
            return config_of_record(self.record["config"], str(self / "run.json"))
        except ConfigError as error:  # made by a version that allowed other settings
            raise InputError(
                error.cause, where=error.where, do="start again with --force"
            ) from error

    @property
    def matches(self) -> Path | list[Path]:
        """What the configuration names as matches: a file, a pattern, a folder, or a list."""
        return named_files(self.config, Path(self.record["base"]))

    # -- stages -----------------------------------------------------------------------------------

    def make(self, stage: str, function: Callable[[], None], *, force: bool = False) -> bool:
        """Make a stage where what it was made from or what it wrote is not as it was.

        Parameters
        ----------
        stage : str
        function : callable
            Writes its files into the folder and its sections by `summarise`.
        force : bool
            Make it also where it stands.

        Returns
        -------
        bool
            Whether it was made.
        """
        made_from = self._made_from(stage)
        if made_from is None:
            raise InputError(
                f"'{stage}' needs stages that have not been run",
                where=str(self.path),
                do="run them first",
            )
        return self.store.stage(stage, lambda *_: function(), *made_from, force=force).was_made

    def made(self, stage: str) -> Made[None] | None:
        """A stage that stands; None for one that was not run, or on something else."""
        if self._planned is not None:
            return None
        return self._standing().get(stage)

    def done(self, stage: str) -> bool:
        """Boolean: a stage has ended, and what it was made from is as it was."""
        return self.made(stage) is not None

    def _standing(self, before: str = "") -> dict[str, Made[None]]:
        """Stages that stand, of all or of those before one, in order."""
        found: dict[str, Made[None]] = {}
        for name in CODECS:
            if name == before:
                break
            made_from = self._from(name, found)
            made = None if made_from is None else self.store.standing(name, *made_from)
            if made is not None:
                found[name] = made
        return found

    def _made_from(
        self, stage: str, requirements: Sequence[Requirement] | None = None
    ) -> tuple[object, ...] | None:
        """What a stage is made from now; None where a stage is missing that it needs."""
        return self._from(stage, self._standing(stage), requirements)

    def _from(
        self,
        stage: str,
        before: Mapping[str, Made[None]],
        requirements: Sequence[Requirement] | None = None,
    ) -> tuple[object, ...] | None:
        """What a stage is made from, given the stages before it that stand.

        `requirements` are those that it is judged by, in place of the recorded ones.
        """
        config, facts = self.config, self.store.record.facts
        solution, limits, later = settings_of(config)
        judged = config.requirements() if requirements is None else requirements
        later["requirement"] = [as_json(vars(one)) for one in judged]
        if requirements is None and "requirements" in facts:
            later["requirement"] = facts["requirements"]
        of_products = {str(f) for f in files_of_products(config, Path(facts["base"]))}
        inputs = {k: v for k, v in facts["inputs"].items() if k not in of_products}
        begins_with = () if config.data is not None or stage == "match" else ("match",)
        if not before.keys() >= {*begins_with, *NEEDS[stage]}:
            return None
        if stage in ("match", "fit"):
            return solution, {"inputs": inputs}, *before.values()
        if stage == "sample":
            return solution, *before.values(), Adjustable(limits)
        if stage == "assess":
            return before["fit"], before["sample"], Adjustable(later)
        later["files"] = {k: v for k, v in facts["inputs"].items() if k in of_products}
        return *before.values(), Adjustable(later), {"bayesdist": __version__}

    def require(self, stage: str, needs: Sequence[str], *, thorough: bool = False) -> None:
        """Refuse a stage, or another command, whose predecessors do not stand.

        Parameters
        ----------
        stage : str
            In words.
        needs : sequence of str
        thorough : bool
            Look at the content of their files, not just at their sizes.

        Raises
        ------
        InputError
        """
        for earlier in needs:
            do = f"run 'bayesdist stage {earlier} {self.path}'"
            known = None if self._planned is not None else self.store.record.artefacts.get(earlier)
            if known is None:
                raise InputError(
                    f"'{stage}' needs stage '{earlier}', which has not been run",
                    where=str(self.path),
                    do=f"{do} first",
                )
            harmed = self.store.harmed(earlier, thorough=thorough)
            if harmed:
                raise InputError(
                    f"is not as stage '{earlier}' wrote it",
                    where=str(self / harmed),
                    do=f"{do} again",
                )
            if not self.done(earlier):
                raise InputError(
                    f"'{stage}' needs stage '{earlier}', which was made from something else",
                    where=str(self.path),
                    do=f"{do} again",
                )

    @contextmanager
    def judged_by(self, requirements: Sequence[Requirement]) -> Iterator[None]:
        """Write margins by other requirements: the assessment is by these from now on.

        Until other ones are given, or the configuration's own are changed.
        """
        made_from = self._made_from("assess", requirements) if self.done("assess") else None
        blocks = [as_json(vars(one)) for one in requirements]
        own = [as_json(vars(one)) for one in self.config.requirements()]
        with self.store.amended("assess", *(made_from or ())) as facts:
            yield
            facts.pop("requirements", None)
            if blocks != own:
                facts["requirements"] = blocks

    # -- summary ----------------------------------------------------------------------------------

    @property
    def summary(self) -> dict[str, Any]:
        """Sections of summary.json so far."""
        return {} if self._planned is not None else self.store.summary

    def summarise(self, **sections: Any) -> None:
        """Replace sections of summary.json, for the stage that is being made."""
        self.store.summarise(**sections)

    # -- the end ----------------------------------------------------------------------------------

    def clear(self) -> None:
        """Remove what a run wrote, and nothing else."""
        self.store.clear()
        pairs = (self / PAIRS).glob("part-" + 5 * "[0-9]" + ".parquet")
        for path in (self / "config.toml", self / "bayesdist.log", *pairs):
            path.unlink(missing_ok=True)
        remove_leftovers(self / PAIRS)
        if (self / PAIRS).is_dir() and not any((self / PAIRS).iterdir()):
            (self / PAIRS).rmdir()


def _with_seed(config: Config, seed: int | None) -> Config:
    """A configuration with another seed; as it is where none is given."""
    if seed is None:
        return config
    sampler = config.sampler.model_copy(update={"seed": seed})
    return config.model_copy(update={"sampler": sampler})


def _hashes(config: Config, base: Path) -> dict[str, str]:
    """SHA-256 of every file that the configuration names, by its absolute path."""
    named, others = named_files(config, base.resolve()), files_of_products(config, base.resolve())
    return {str(f): sha256_of(f) for f in [*input_files(named), *others]}


def versions() -> dict[str, str]:
    """Versions of Python, the platform, and the packages that matter."""
    out = {"python": sys.version.split()[0], "platform": platform.platform()}
    out["bayesdist"] = __version__  # also where it runs from a source tree
    out |= {name: metadata.version(name) for name in PACKAGES}
    return out
