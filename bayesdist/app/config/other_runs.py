"""Files of other runs that a configuration goes by: tables of a detector, rates of its drift."""

from __future__ import annotations

from pathlib import Path

from bayesdist.errors import InputError

FREE = "free"  # rates that no other run says anything of
TABLES, POSTERIOR = "tables.h5", "posterior.nc"


def tables_file(path: Path) -> Path:
    """File of a detector's tables: a D2IMFILE as it is named, or that of a run."""
    return path if path.is_file() else _file_of_run(path, TABLES, "tables.detector")


def rates_file(folder: Path) -> Path:
    """File of the posterior of a run whose drift is taken over."""
    return _file_of_run(folder, POSTERIOR, "model.tdd.rates")


def calibration_file(path: Path) -> Path:
    """File of an earlier calibration: one of any format as it is named, or a run's posterior."""
    return path if path.is_file() else _file_of_run(path, POSTERIOR, "prior_calibration.source")


def _file_of_run(folder: Path, name: str, key: str) -> Path:
    if not (folder / name).exists():
        raise InputError(
            f"has no {name}" if folder.is_dir() else "is not there",
            where=str(folder),
            do=f"name a finished run in {key}",
        )
    return folder / name
