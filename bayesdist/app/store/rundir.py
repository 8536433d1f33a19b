"""Run directory: one folder that holds everything about one calibration."""

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
    refuse_another_solution,
    refuse_edited,
    refuse_foreign_files,
    refuse_inside_input,
    refuse_other_inputs,
    with_seed,
)
from bayesdist.app.store.summary import head_of
from bayesdist.assess import Requirement
from bayesdist.errors import ConfigError, InputError
from bayesdist.files.atomic import atomic_path, made_folder, remove_leftovers

T = TypeVar("T")

PAIRS = "pairs"  # folder of matches, for campaigns and for formats that are read in part
UNSAVED = Path("a run in memory")  # in place of the folder of a run in memory


def part_files(folder: Path) -> list[Path]:
    """Existing part files of a folder, in order."""
    return sorted(folder.glob("part-" + 5 * "[0-9]" + ".parquet"))


class RunDirectory(ArtefactStore):
    """Folder of a run: its configuration and inputs, and the artefacts of its stages."""

    def __init__(self, path: str | Path) -> None:
        super().__init__(Path(path), STAGES, head_of)
        self._text = ""  # configuration of a planned run
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
        """Prepare to resume the run in a folder, or to begin one there, without writing anything.

        Parameters
        ----------
        path : path
            Folder of the run.
        config : Config
        text : str
            The configuration as written by the user.
        base : Path
            Folder that inputs are relative to.
        resume : bool
            Resume an existing run.
        force : bool
            Replace an existing run.
        seed : int, optional
            Seed that replaces the configured one.
        command : str
            Command line, for the record.

        Returns
        -------
        RunDirectory

        Raises
        ------
        InputError
            If the folder holds other files or a run that is neither resumed nor replaced, or the
            run cannot be resumed with this configuration or these inputs.
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
            run.record  # noqa: B018 - refuse to replace a run with an unreadable record
        else:
            refuse_foreign_files(run.path, text, (base / name for name in inputs))
        run._plan(with_seed(config, seed), text, base, inputs, command)
        return run

    @classmethod
    def unsaved(
        cls, config: Config, text: str, *, files: bool, base: Path | None = None
    ) -> RunDirectory:
        """Run in memory that has no folder yet.

        Parameters
        ----------
        config : Config
        text : str
            The configuration as TOML.
        files : bool
            True if the stars are read from files, whose hashes are recorded.
        base : Path, optional
            Folder that files are relative to; the current folder by default.
        """
        run, base = cls(UNSAVED), Path.cwd() if base is None else base
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
        """True if the folder holds a run."""
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
        """Configuration of a planned run in TOML, as the user wrote it."""
        return self._text

    def begin(self) -> None:
        """Write the configuration and the record.

        An existing run is removed if it is to be replaced; a resumed run takes over the settings
        that may change.
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
        """Take over the changed settings of a resumed run, and restore summary.json."""
        remove_leftovers(self.path)
        if self._adopted is not None:
            config, text, facts = self._adopted
            record, old_config = self.record, self.config
            changed = {
                key for key, *_ in changes(old_config, with_seed(config, old_config.sampler.seed))
            }
            if changed or record.facts != record.facts | facts:
                config = with_seed(config, old_config.sampler.seed)
                record.facts |= {"config": as_json(config.model_dump()), **facts}
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
        """Open an existing run, or plan one in a folder that contains a config.toml."""
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
        """Error for a folder that is not a run; it names the run inside the folder of a demo."""
        within = self / "run"
        cause = "is not a run: it has neither run.json nor config.toml"
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
        """Ingredients of the run: configuration, inputs, seed, versions."""
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

        If all inputs exist at the recorded path relative to the run, that folder is used, because
        the run may have been moved together with them.  Otherwise it is the recorded folder.
        """
        return base_of(self.facts, self.path)

    def note(self, **facts: Any) -> None:
        """Add entries to run.json."""
        record = self.record
        record.facts |= as_json(facts)
        record.write(self / "run.json")

    @property
    def config(self) -> Config:
        """Resolved configuration."""
        try:
            return config_of_record(self.facts["config"], str(self / "run.json"))
        except ConfigError as error:  # written by a version with other settings
            raise InputError(
                error.cause, where=error.where, do="start again with --force"
            ) from error

    # -- stages -----------------------------------------------------------------------------------

    def make(self, stage: str, function: Callable[[], T], *, force: bool = False) -> Made[T]:
        """Artefact of a stage, which is made unless it is up to date.

        Parameters
        ----------
        stage : str
        function : callable
            Writes files to the folder, and sections by `summarise`.
        force : bool
            Call the function even if the artefact is up to date.

        Returns
        -------
        Made

        Raises
        ------
        InputError
            If a stage that is needed has not been run.
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
        """True if a stage has ended and its artefact is up to date."""
        return stage in self._standing()

    def _standing(self, before: str = "") -> dict[str, Made[object]]:
        """Stages that are up to date, in order; only those before the given one, if any."""
        config, facts = self.config, self.facts
        current: dict[str, Made[object]] = {}
        for name in STAGES:
            if name == before:
                break
            made_from = made_from_of(name, current, config, facts)
            artefact = None if made_from is None else self.standing(name, *made_from)
            if artefact is not None:
                current[name] = artefact
        return current

    def _made_from(
        self, stage: str, requirements: Sequence[Requirement] | None = None
    ) -> tuple[object, ...] | None:
        """Present ingredients of a stage; None if a stage that it needs is missing."""
        facts = self.facts
        if requirements is not None:
            facts = facts | {
                "requirements": [as_json(vars(requirement)) for requirement in requirements]
            }
        return made_from_of(stage, self._standing(stage), self.config, facts)

    def require(self, stage: str, needs: Sequence[str]) -> None:
        """Refuse a stage or another command if a stage in `needs` is not up to date."""
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
                    f"'{stage}' needs stage '{earlier}', which was made from other inputs or "
                    "settings",
                    where=str(self.path),
                    do=f"{do} again",
                )

    def damage(self, stage: str) -> tuple[str, str] | None:
        """First file that differs from what a stage wrote, and a description of the damage.

        None if all files are intact.
        """
        artefact = self.record.artefacts.get(stage)
        name = "" if artefact is None else self.harmed(artefact, thorough=True)
        if not name:
            return None
        if not (self / name).is_file():
            return name, f"is gone, and not as stage '{stage}' wrote it"
        return name, f"is not as stage '{stage}' wrote it"

    def refuse_damaged(self, stage: str) -> None:
        """Refuse to use files that differ from what their stage wrote."""
        damage = self.damage(stage)
        if damage is not None:
            raise InputError(
                damage[1],
                where=str(self / damage[0]),
                do=f"restore it, or run 'bayesdist stage {stage} {self.path}' again",
            )

    @contextmanager
    def judged_by(self, requirements: Sequence[Requirement]) -> Iterator[None]:
        """Write margins for other requirements inside this context.

        They remain the requirements of the evaluation until others are given or the configured ones
        change.
        """
        made_from = self._made_from("evaluate", requirements) if self.done("evaluate") else None
        blocks = [as_json(vars(requirement)) for requirement in requirements]
        configured = [as_json(vars(requirement)) for requirement in self.config.requirements()]
        with self.amended("evaluate", *(made_from or ())) as facts:
            yield
            facts.pop("requirements", None)
            if blocks != configured:
                facts["requirements"] = blocks

    # -- the end ----------------------------------------------------------------------------------

    def clear(self, *others: str) -> None:
        """Remove the files that the run wrote, and no others."""
        pairs = part_files(self / PAIRS)
        names = [path.relative_to(self.path).as_posix() for path in pairs]
        super().clear(*others, "config.toml", "bayesdist.log", *names)
