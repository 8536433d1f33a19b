"""A run directory: one folder that holds everything about one calibration."""

from __future__ import annotations

import json
import math
import platform
import re
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np

from bayesdist import __version__
from bayesdist.app.campaign.files import campaign_files
from bayesdist.app.config import Config, config_of_record, load_config, load_text
from bayesdist.app.selfcal.files import selfcal_files
from bayesdist.app.star_files import FOLDER, PAIRS, part_files
from bayesdist.data import input_files
from bayesdist.errors import ConfigError, InputError
from bayesdist.files import atomic_path, is_leftover, made_folder, remove_leftovers, sha256_of

__all__ = ["RunDirectory", "as_json", "write_json"]

SCHEMA = 1
PACKAGES = ("arviz", "astropy", "emcee", "numba", "numpy", "scipy", "xarray")

# what a run writes beside its products and figures, which it lists itself; --force removes these
# and nothing else
OWN_FILES = re.compile(
    r"config\.toml|run\.json|bayesdist\.log|fit\.nc|magnitude_errors\.ecsv|chain-\d+-\w+\.h5|"
    r"posterior\.nc|(coefficients|budget|margins|periods|holdout|matching|series|drift|gauge|stars)\.ecsv|maps\.fits|"
    r"(tables|hierarchy|exposure_terms|catalogue_errors|detections|solution)\.h5|stars\.parquet|"
    r"summary\.json|report\.(html|md)"
)


# when to stop: a resumed run may be given other limits
LIMITS = ("max_steps", "target_ess", "target_rhat")


def as_json(value: Any) -> Any:
    """A value as plain JSON: arrays as lists, and null for what is not a finite number."""
    if isinstance(value, Mapping):
        return {str(k): as_json(v) for k, v in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [as_json(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Path):
        return str(value)
    return value


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file, replaced atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(
            json.dumps(as_json(value), indent=1, ensure_ascii=False, allow_nan=False) + "\n",
            encoding="utf-8",
        )


class RunDirectory:
    """Files and state of a run.

    Parameters
    ----------
    path : path
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._planned: tuple[dict[str, Any], str] | None = None
        self._follow: tuple[Config, str] | None = None

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
        """A run that may go on in a folder, or may begin there; nothing is written yet.

        Parameters
        ----------
        path : path
        config : Config
        text : str
            The configuration as written by the user.
        base : Path
            Folder that relative inputs are relative to.
        resume, force : bool
            Go on with the run that is there, or replace it.
        seed : int, optional
            In place of the configured one.
        command : str
            For the record.

        Raises
        ------
        InputError
            When the folder holds another run or foreign files, or the input of a resumed run
            changed.
        """
        run = cls(path)
        if run.path.exists() and not run.path.is_dir():
            raise InputError("is a file, not a folder", where=str(path), do="choose another folder")
        run._refuse_inside_input(config, base)
        inputs = run._hashes(config, base)
        if (run / "run.json").exists() and not force:
            if not resume:
                raise InputError(
                    "the folder holds another run",
                    where=str(path),
                    do="go on with it by --resume, replace it by --force, or choose another folder",
                )
            run._check_unchanged(config, text, inputs, seed)
            run._follow = config, text
            return run
        foreign = run._foreign(text)
        if foreign:
            raise InputError(
                f"the folder holds other files ({foreign[0]})",
                where=str(path),
                do="choose an empty folder",
            )
        if seed is not None:
            sampler = config.sampler.model_copy(update={"seed": seed})
            config = config.model_copy(update={"sampler": sampler})
        record = {
            "schema": SCHEMA,
            "config": config.model_dump(),
            "base": str(base.resolve()),
            "inputs": inputs,
            "seed": config.sampler.seed,
            "versions": versions(),
            "command": command,
            "created": _now(),
            "stages": {},
        }
        run._planned = as_json(record), text
        return run

    @property
    def begun(self) -> bool:
        """Whether the folder holds this run already."""
        return self._planned is None

    def follow(self) -> None:
        """Take over the limits of the sampler that a resumed run was given.

        A posterior that had not converged is then sampled further.
        """
        if self._follow is None:
            return
        (config, text), record = self._follow, self.record
        known = self.config
        limits = {key: getattr(config.sampler, key) for key in LIMITS}
        if limits == {key: getattr(known.sampler, key) for key in LIMITS}:
            return
        now = known.model_copy(update={"sampler": known.sampler.model_copy(update=limits)})
        record["config"] = as_json(now.model_dump())
        for stage in ("sample", "assess", "export", "report"):
            record["stages"].pop(stage, None)
        with atomic_path(self / "config.toml") as temporary:
            temporary.write_text(text, encoding="utf-8", newline="")
        self.write_record(record)

    def begin(self) -> None:
        """Write down what is about to be done; another run that stands there is removed.

        Raises
        ------
        InputError
            When the folder cannot be made or written.
        """
        assert self._planned is not None
        record, text = self._planned
        if (self / "run.json").exists():
            self.clear()
        remove_leftovers(self.path)
        made_folder(self.path)
        with atomic_path(self / "config.toml") as temporary:
            temporary.write_text(text, encoding="utf-8", newline="")
        self.write_record(record)
        self._planned = None

    @classmethod
    def open(cls, path: str | Path) -> RunDirectory:
        """A run that exists, or a folder with a config.toml that becomes one.

        Raises
        ------
        InputError
        """
        run = cls(path)
        if (run / "run.json").exists():
            run._check_configuration()
            run._check_inputs()
            return run
        if (run / "config.toml").exists():
            config, text = load_config(run / "config.toml")
            return cls.plan(path, config, text, run.path)
        raise run.no_run()

    def no_run(self) -> InputError:
        """What to say of a place that holds no run; a demo has its run in a folder of its own."""
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

    def _refuse_inside_input(self, config: Config, base: Path) -> None:
        """Refuse a run whose own Parquet files would become part of its input."""
        named = _named(config, base)
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
        if (self / "run.json").exists() or not self.path.is_dir():
            return []
        names = {p.name for p in self.path.iterdir() if not is_leftover(p.name)}
        if "config.toml" in names and load_text(self / "config.toml") == text:
            names.remove("config.toml")
        return sorted(names)

    def _own(self) -> list[Path]:
        """Files that the run in this folder wrote."""
        own = [p for p in self.path.iterdir() if OWN_FILES.fullmatch(p.name) and not p.is_dir()]
        try:
            summary = self.summary
        except InputError:  # what it listed stays; the rest can be cleared all the same
            summary = {}
        products = [self / Path(p["path"]).name for p in summary.get("products", [])]
        figures = [self / "figures" / Path(name).name for name in summary.get("figures", [])]
        return own + products + figures + part_files(self / FOLDER) + part_files(self / PAIRS)

    def clear(self) -> None:
        """Remove what a run wrote, and nothing else."""
        for path in self._own():
            path.unlink(missing_ok=True)
        for folder in ("figures", FOLDER, PAIRS):
            remove_leftovers(self / folder)
            try:
                (self / folder).rmdir()
            except OSError:  # there is none, or it holds other files
                pass

    @staticmethod
    def _hashes(config: Config, base: Path) -> dict[str, str]:
        """SHA-256 of every file that the configuration names, by its absolute path."""
        return {str(f): sha256_of(f) for f in input_files(_named(config, base.resolve()))}

    def _check_unchanged(
        self, config: Config, text: str, inputs: dict[str, str], seed: int | None
    ) -> None:
        record = self.record
        changed = load_text(self / "config.toml") != text
        if changed and _without_limits(config) != _without_limits(self.config):
            raise InputError(
                "the configuration is not the one this run began with",
                where=str(self / "config.toml"),
                do="resume with the old one, or start again with --force",
            )
        if seed is not None and seed != record["seed"]:
            raise InputError(
                f"the run began with seed {record['seed']}",
                where=str(self.path),
                do="leave --seed out, or start again with --force",
            )
        self._compare(record["inputs"], inputs)

    def _check_configuration(self) -> None:
        """Refuse a config.toml that was edited in place: the run goes by what it began with."""
        path = self / "config.toml"
        if not path.exists():
            return
        now, known = load_config(path)[0], self.config
        if now.model_copy(update={"sampler": known.sampler}) != known or (
            # the command line may have given another seed
            now.sampler.model_copy(update={"seed": known.sampler.seed}) != known.sampler
        ):
            raise InputError(
                "was edited since the run began, which goes by the old one",
                where=str(path),
                do="restore it, or start again with --force",
            )

    def _check_inputs(self) -> None:
        record = self.record
        self._compare(record["inputs"], self._hashes(self.config, Path(record["base"])))

    def _compare(self, known: dict[str, str], now: dict[str, str]) -> None:
        for name in sorted(known.keys() | now.keys()):
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
            return self._planned[0]
        try:
            return json.loads((self / "run.json").read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise InputError(
                "cannot be read", where=str(self / "run.json"), do="start again with --force"
            ) from error

    def write_record(self, record: Mapping[str, Any]) -> None:
        """Replace run.json."""
        write_json(self / "run.json", record)

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
        return _named(self.config, Path(self.record["base"]))

    def done(self, stage: str) -> bool:
        """Whether a stage has ended well."""
        return stage in self.record["stages"]

    def outdate(self, stage: str) -> None:
        """Note that a stage has to be run again, as what it shows has changed."""
        record = self.record
        if record["stages"].pop(stage, None) is not None:
            self.write_record(record)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a stage, and note it as done when the block ends well."""
        remove_leftovers(self.path)
        record = self.record
        record["stages"].pop(name, None)
        self.write_record(record)
        started = monotonic()
        yield
        record = self.record
        record["stages"][name] = {"wall_s": monotonic() - started, "ended": _now()}
        self.write_record(record)

    # -- summary ----------------------------------------------------------------------------------

    @property
    def summary(self) -> dict[str, Any]:
        """Content of summary.json so far."""
        path = self / "summary.json"
        if not path.exists():
            return {"schema": SCHEMA}
        try:
            return json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise InputError("cannot be read", where=str(path), do="run the stage again") from error

    def summarise(self, **sections: Any) -> None:
        """Replace sections of summary.json."""
        write_json(self / "summary.json", {**self.summary, **sections})


def _named(config: Config, base: Path) -> Path | list[Path]:
    if config.campaign is not None:
        return campaign_files(config, base)
    if config.selfcal is not None:
        return selfcal_files(config, base)
    assert config.data is not None
    names = config.data.matches
    return base / names if isinstance(names, str) else [base / name for name in names]


def _without_limits(config: Config) -> dict[str, Any]:
    """A configuration without what may change when a run is resumed: its limits, and its seed,
    which the command line may have given."""
    out = config.model_dump()
    for key in (*LIMITS, "seed"):
        out["sampler"].pop(key)
    return out


def versions() -> dict[str, str]:
    """Versions of Python, the platform, and the packages that matter."""
    out = {"python": sys.version.split()[0], "platform": platform.platform()}
    out["bayesdist"] = __version__  # also where it runs from a source tree
    out |= {name: metadata.version(name) for name in PACKAGES}
    return out


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
