"""A run directory: one folder that holds everything about one calibration."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

from bayesdist.app.config import (
    Config,
    config_of_record,
    load_config,
)
from bayesdist.app.store import ArtefactStore, Made, Record, as_json, versions
from bayesdist.app.store.made_from import (
    STAGES,
    base_of,
    changes,
    hashes_of,
    made_from_of,
    places_of,
    with_seed,
)
from bayesdist.app.store.refusals import (
    refuse_another_solution,
    refuse_edited,
    refuse_foreign_files,
    refuse_inside_input,
    refuse_other_inputs,
)
from bayesdist.app.store.summary import head_of
from bayesdist.assess import Requirement
from bayesdist.errors import ConfigError, InputError
from bayesdist.files.atomic import atomic_path, made_folder, remove_leftovers

T = TypeVar("T")

PAIRS = "pairs"  # folder of matches, of a campaign and of formats that are selected from
UNSAVED = Path("a run in memory")  # stands for the folder of a run that has none


def part_files(folder: Path) -> list[Path]:
    """Parts that are there, in order."""
    return sorted(folder.glob("part-" + 5 * "[0-9]" + ".parquet"))


class RunDirectory(ArtefactStore):
    """The folder of a run: its configuration and inputs, and the artefacts of its stages."""

    def __init__(self, path: str | Path) -> None:
        super().__init__(Path(path), STAGES, head_of)
        self._text = ""  # of a planned run's configuration
        self._adopted: tuple[Config, str, dict[str, Any]] | None = None

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

        `text`: the configuration as written by the user. `base`: folder that inputs are relative
        to. `resume`, `force`: resume the run that is there, or replace it.
        """
        run = cls(path)
        if run.path.exists() and not run.path.is_dir():
            raise InputError("is a file, not a folder", where=str(path), do="choose another folder")
        refuse_inside_input(run.path, config, base)
        inputs = hashes_of(config, base)
        if run.is_initialized and not force:
            if not resume:
                raise InputError(
                    "the folder holds another run",
                    where=str(path),
                    do="resume it with --resume, replace it with --force, or choose another folder",
                )
            refuse_another_solution(run.path, run.config, run.facts, config, base, inputs, seed)
            run._adopted = config, text, {"inputs": inputs, **places_of(base, run.path)}
            return run
        if run.is_initialized:
            run.record  # noqa: B018 - refuse to replace what nobody can tell from other files
        else:
            refuse_foreign_files(run.path, text, (base / name for name in inputs))
        run._plan(with_seed(config, seed), text, base, inputs, command)
        return run

    @classmethod
    def unsaved(cls, config: Config, text: str, *, files: bool) -> RunDirectory:
        """Run in memory that has no folder yet; files are relative to the current folder.

        Parameters
        ----------
        config : Config
        text : str
            The configuration as TOML.
        files : bool
            True if the stars are read from files, of which the record gets the hashes.
        """
        run, base = cls(UNSAVED), Path.cwd()
        run._plan(config, text, base, hashes_of(config, base) if files else {}, "")
        return run

    def _plan(
        self, config: Config, text: str, base: Path, inputs: Mapping[str, str], command: str
    ) -> None:
        """Set the record with which the run will begin."""
        facts = {
            "config": config.model_dump(),
            **places_of(base, self.path),
            "inputs": inputs,
            "seed": config.sampler.seed,
            "versions": versions(),
            "command": command,
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
        }
        self._planned, self._text = Record(as_json(facts)), text

    @property
    def is_initialized(self) -> bool:
        """Boolean: the folder holds a run."""
        return (self / "run.json").exists()

    @property
    def is_planned(self) -> bool:
        """True if nothing of this run has been written yet."""
        return self._planned is not None

    @property
    def in_memory(self) -> bool:
        """True if the run has no folder."""
        return self.path == UNSAVED

    @property
    def text(self) -> str:
        """The configuration of a planned run as its user wrote it, in TOML."""
        return self._text

    def begin(self) -> None:
        """Write down what is about to be done.

        Another run that stands there is removed; a resumed one takes over the settings that may
        change.
        """
        if self._planned is None:
            self._adopt()
            return
        planned, self._planned = self._planned, None
        made_folder(self.path)
        if self.is_initialized:
            self.clear()
        remove_leftovers(self.path)
        self._write_text(self._text)
        planned.write(self / "run.json")

    def _adopt(self) -> None:
        """Take over what a resumed run was given in another way, and put summary.json right."""
        remove_leftovers(self.path)
        if self._adopted is not None:
            config, text, found = self._adopted
            record, known = self.record, self.config
            changed = {key for key, *_ in changes(known, with_seed(config, known.sampler.seed))}
            if changed or record.facts != record.facts | found:
                config = with_seed(config, known.sampler.seed)
                record.facts |= {"config": as_json(config.model_dump()), **found}
                if any(key.startswith("requirement") for key in changed):
                    record.facts.pop("requirements", None)
                self._write_text(text)
                record.write(self / "run.json")
            self._adopted = None
        self.restore_summary()

    def _write_text(self, text: str) -> None:
        """Write config.toml as the user wrote it."""
        with atomic_path(self / "config.toml") as temporary:
            temporary.write_text(text, encoding="utf-8", newline="")

    @classmethod
    def open(cls, path: str | Path) -> RunDirectory:
        """A run that exists, or a folder with a config.toml that becomes one."""
        run = cls(path)
        if run.is_initialized:
            refuse_edited(run.path, run.config)
            facts = run.facts
            now = hashes_of(run.config, run.base, Path(facts["base"]))
            refuse_other_inputs(facts["inputs"], now, run.base)
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

    # -- record -----------------------------------------------------------------------------------

    @property
    def facts(self) -> dict[str, Any]:
        """Facts that the run is made from: configuration, inputs, seed, versions."""
        facts = self.record.facts
        for name in ("config", "base", "inputs", "seed", "versions", "created"):
            if name not in facts:
                raise InputError(
                    f"lacks {name!r}",
                    where=str(self / "run.json"),
                    do="restore it, or choose another folder",
                )
        return facts

    @property
    def base(self) -> Path:
        """Folder that inputs are relative to.

        It is found from the run as it was when that began, if inputs are there: a run may have been
        moved together with them.  Else it is where it was.
        """
        return base_of(self.facts, self.path)

    def note(self, **facts: Any) -> None:
        """Add facts to run.json."""
        record = self.record
        record.facts |= as_json(facts)
        record.write(self / "run.json")

    @property
    def config(self) -> Config:
        """The resolved configuration."""
        try:
            return config_of_record(self.facts["config"], str(self / "run.json"))
        except ConfigError as error:  # made by a version that allowed other settings
            raise InputError(
                error.cause, where=error.where, do="start again with --force"
            ) from error

    # -- stages -----------------------------------------------------------------------------------

    def make(self, stage: str, function: Callable[[], T], *, force: bool = False) -> Made[T]:
        """The artefact of a stage: made where it, or what it was made from, is not as it was.

        `function` writes files into the folder and sections by `summarise`; with `force` it is
        called also where the artefact stands.
        """
        made_from = self._made_from(stage)
        if made_from is None:
            raise InputError(
                f"'{stage}' needs stages that have not been run",
                where=str(self.path),
                do="run them first",
            )
        return self.stage(stage, function, *made_from, force=force)

    def done(self, stage: str) -> bool:
        """Boolean: a stage has ended, and what it was made from is as it was."""
        return stage in self._standing()

    def _standing(self, before: str = "") -> dict[str, Made[object]]:
        """Stages that stand, of all or of those before one, in order."""
        config, facts = self.config, self.facts
        found: dict[str, Made[object]] = {}
        for name in STAGES:
            if name == before:
                break
            made_from = made_from_of(name, found, config, facts)
            made = None if made_from is None else self.standing(name, *made_from)
            if made is not None:
                found[name] = made
        return found

    def _made_from(
        self, stage: str, requirements: Sequence[Requirement] | None = None
    ) -> tuple[object, ...] | None:
        """Ingredients of a stage now; None where a stage is missing that it needs."""
        facts = self.facts
        if requirements is not None:
            facts = facts | {"requirements": [as_json(vars(one)) for one in requirements]}
        return made_from_of(stage, self._standing(stage), self.config, facts)

    def require(self, stage: str, needs: Sequence[str]) -> None:
        """Refuse a stage, or another command, whose predecessors do not stand."""
        for earlier in needs:
            do = f"run 'bayesdist stage {earlier} {self.path}'"
            if earlier not in self.record.artefacts:
                raise InputError(
                    f"'{stage}' needs stage '{earlier}', which has not been run",
                    where=str(self.path),
                    do=f"{do} first",
                )
            self.refuse_damaged(earlier)
            if not self.done(earlier):
                raise InputError(
                    f"'{stage}' needs stage '{earlier}', which was made from something else",
                    where=str(self.path),
                    do=f"{do} again",
                )

    def damage(self, stage: str) -> tuple[str, str] | None:
        """A file that is not as a stage wrote it, and what is wrong with it; None without one."""
        artefact = self.record.artefacts.get(stage)
        name = "" if artefact is None else self.harmed(artefact, thorough=True)
        if not name:
            return None
        if not (self / name).is_file():
            return name, f"is gone, and not as stage '{stage}' wrote it"
        return name, f"is not as stage '{stage}' wrote it"

    def refuse_damaged(self, stage: str) -> None:
        """Refuse to go by files that are not as their stage wrote them."""
        damage = self.damage(stage)
        if damage is not None:
            raise InputError(
                damage[1],
                where=str(self / damage[0]),
                do=f"restore it, or run 'bayesdist stage {stage} {self.path}' again",
            )

    @contextmanager
    def judged_by(self, requirements: Sequence[Requirement]) -> Iterator[None]:
        """Write margins by other requirements: the evaluation is by these from now on.

        Until other ones are given, or the configuration's own are changed.
        """
        made_from = self._made_from("evaluate", requirements) if self.done("evaluate") else None
        blocks = [as_json(vars(one)) for one in requirements]
        own = [as_json(vars(one)) for one in self.config.requirements()]
        with self.amended("evaluate", *(made_from or ())) as facts:
            yield
            facts.pop("requirements", None)
            if blocks != own:
                facts["requirements"] = blocks

    # -- the end ----------------------------------------------------------------------------------

    def clear(self, *others: str) -> None:
        """Remove what a run wrote, and nothing else."""
        pairs = part_files(self / PAIRS)
        names = [path.relative_to(self.path).as_posix() for path in pairs]
        super().clear(*others, "config.toml", "bayesdist.log", *names)
