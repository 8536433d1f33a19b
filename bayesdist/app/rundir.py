"""A run directory: one folder that holds everything about one calibration."""

from __future__ import annotations

import json
import math
import platform
import shutil
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np

from bayesdist.app.config import Config, parse_config
from bayesdist.data import atomic_path, input_files, sha256_of
from bayesdist.errors import InputError

__all__ = ["RunDirectory", "as_json", "write_json"]

SCHEMA = 1
PACKAGES = ("bayesdist", "arviz", "astropy", "emcee", "numba", "numpy", "scipy", "xarray")

# what a run writes, and --force removes; nothing else in a folder is ever touched
OWN_FILES = (
    "config.toml",
    "run.json",
    "bayesdist.log",
    "fit.nc",
    "magnitude_errors.ecsv",
    "chain-*.h5",
    "posterior.nc",
    "coefficients.ecsv",
    "maps.fits",
    "budget.ecsv",
    "margins.ecsv",
    "summary.json",
    "*_idc.fits",
    "sip*.hdr",
    "figures",
    "report.html",
)


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

    def __truediv__(self, name: str) -> Path:
        return self.path / name

    # -- beginning --------------------------------------------------------------------------------

    @classmethod
    def begin(
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
        """Open a folder for a run and write down what is about to be done.

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
        inputs = {str(f): sha256_of(f) for f in run._inputs(config, base)}
        there = run._entries()
        if (run / "run.json").exists() and not force:
            if not resume:
                raise InputError(
                    "the folder holds another run",
                    where=str(path),
                    do="go on with it by --resume, replace it by --force, or choose another folder",
                )
            run._check_unchanged(config, text, inputs, seed)
            return run
        foreign = there - {"config.toml"} if not force else run._foreign()
        if foreign:
            raise InputError(
                f"the folder holds other files ({sorted(foreign)[0]})",
                where=str(path),
                do="choose an empty folder",
            )
        if force:
            run.clear()
        try:
            run.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"the folder cannot be made ({error.strerror})", where=str(path)
            ) from error
        if seed is not None:
            sampler = config.sampler.model_copy(update={"seed": seed})
            config = config.model_copy(update={"sampler": sampler})
        with atomic_path(run / "config.toml") as temporary:
            temporary.write_text(text, encoding="utf-8")
        run.write_record(
            {
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
        )
        return run

    @classmethod
    def open(cls, path: str | Path) -> RunDirectory:
        """A run that exists, or a folder with a config.toml that becomes one.

        Raises
        ------
        InputError
        """
        run = cls(path)
        if (run / "run.json").exists():
            run._check_inputs()
            return run
        if (run / "config.toml").exists():
            text = (run / "config.toml").read_text(encoding="utf-8")
            config = parse_config(text, str(run / "config.toml"))
            return cls.begin(path, config, text, run.path)
        raise InputError(
            "is no run: it has neither run.json nor config.toml",
            where=str(path),
            do="make one with 'bayesdist run CONFIG.toml -o RUN'",
        )

    def _entries(self) -> set[str]:
        return {p.name for p in self.path.iterdir()} if self.path.is_dir() else set()

    def _own(self) -> set[str]:
        if not self.path.is_dir():
            return set()
        return {p.name for pattern in OWN_FILES for p in self.path.glob(pattern)}

    def _foreign(self) -> set[str]:
        """What --force would have to leave: only a folder that holds a run is cleared."""
        if (self / "run.json").exists():
            return set()
        return self._entries() - {"config.toml"}

    def clear(self) -> None:
        """Remove what a run writes, and nothing else."""
        for name in self._own():
            target = self / name
            if target.is_dir():
                shutil.rmtree(target)
            else:
                target.unlink()

    @staticmethod
    def _inputs(config: Config, base: Path) -> list[Path]:
        names = config.data.matches
        names = [names] if isinstance(names, str) else names
        return input_files([base / name for name in names])

    def _check_unchanged(
        self, config: Config, text: str, inputs: dict[str, str], seed: int | None
    ) -> None:
        record = self.record
        if (self / "config.toml").read_text(encoding="utf-8") != text:
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

    def _check_inputs(self) -> None:
        known = self.record["inputs"]
        self._compare(known, {name: sha256_of(name) for name in known})

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
        """Content of run.json."""
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
        return Config.model_validate(self.record["config"])

    @property
    def inputs(self) -> list[Path]:
        """The files of matches."""
        return [Path(name) for name in self.record["inputs"]]

    def done(self, stage: str) -> bool:
        """Whether a stage has ended well."""
        return stage in self.record["stages"]

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a stage, and note it as done when the block ends well."""
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


def versions() -> dict[str, str]:
    """Versions of Python, the platform, and the packages that matter."""
    out = {"python": sys.version.split()[0], "platform": platform.platform()}
    for name in PACKAGES:
        try:
            out[name] = metadata.version(name)
        except metadata.PackageNotFoundError:  # run from a source tree
            out[name] = "not installed"
    return out


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
