"""Small data sets of known truth, configurations as text, and the command line."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from bayesdist.app.cli import main
from bayesdist.app.config import load_config
from bayesdist.app.pipeline import rehearse
from bayesdist.app.run import Run
from bayesdist.app.screen import start_logging
from bayesdist.app.stages import ASSESS, initialized, make_stages
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.data import Matches
from bayesdist.model import Chip, DistortionModel
from bayesdist.simulate import Truth, simulate_matches

REPOSITORY = Path(__file__).resolve().parents[2]
SIZE = (1000, 800)
CENTRE = (500.5, 400.5)
SIGMA = 0.02


@dataclass(frozen=True)
class Result:
    """What a command did."""

    code: int
    out: str
    err: str


def cli(*arguments: object) -> Result:
    """Run a command in this process."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main([str(a) for a in arguments])
    return Result(code, out.getvalue(), err.getvalue())


def good(*arguments: object) -> Result:
    """Run a command that must succeed."""
    result = cli(*arguments)
    assert result.code == 0, result.err
    return result


def process(*arguments: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run a command in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "bayesdist", *map(str, arguments)],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(REPOSITORY), *sys.path])},
        capture_output=True,
        text=True,
        check=False,
    )


def snapshot(folder: Path) -> dict[str, str]:
    """Every file below a folder, hidden ones too, with the hash of its content."""
    return {
        str(p.relative_to(folder)): (
            "folder" if p.is_dir() else hashlib.sha256(p.read_bytes()).hexdigest()
        )
        for p in sorted(folder.rglob("*"))
    }


def one_sentence(err: str, *words: str) -> None:
    """stderr holds one sentence of ours that names these words, and nothing else."""
    lines = err.splitlines()
    assert len(lines) == 1, err
    line = lines[0]
    assert line.startswith("bayesdist: ") and line.endswith("."), line
    assert "Traceback" not in line
    cause, _, action = line.partition("; ")
    assert cause and action, f"no action: {line}"
    for word in words:
        assert word in line, f"{word!r} not in: {line}"


def refused(folder: Path, *arguments: object, words: Sequence[str] = ()) -> str:
    """Run a command that must be refused with one sentence and leave the folder as it was."""
    before = snapshot(folder)
    result = cli(*arguments)
    assert result.code == 1, (result.code, result.out, result.err)
    one_sentence(result.err, *words)
    assert result.out == ""
    assert snapshot(folder) == before
    return result.err


# -- data -----------------------------------------------------------------------------------------


def model_of(**options: Any) -> DistortionModel:
    """Order 2 on one chip of SIZE."""
    return DistortionModel(2, (Chip(1, "A", SIZE, CENTRE),), **options)


def truth_of(model: DistortionModel, scale: float = 1.0, offset: bool = True) -> np.ndarray:
    """A distortion of a few pixels; `scale` is the unit of u, v per pixel."""
    theta = np.zeros(model.n_params)
    basis = model.basis()
    shift = CENTRE if offset else (0.0, 0.0)
    for axis, terms in enumerate(
        ({(1, 0): 1.0, (2, 0): 1e-5, (1, 1): -4e-6}, {(0, 1): 1.0, (2, 0): -2e-5, (0, 2): 3e-6})
    ):
        monomial = np.array([terms.get(t, 0.0) for t in basis.terms])
        monomial[0] = shift[axis]
        theta[model.coefficient_slice(None, axis)] = basis.from_monomials(scale * monomial)
    return theta


def simulated(n: int = 400, seed: int = 1, **options: Any) -> tuple[Matches, Truth]:
    """Stars on one chip, 5 % of them false, errors 0.022 px where 0.02 is quoted."""
    model = model_of()
    options = {"fraction": 0.05, "outlier_scale": 0.5, "jitter": 0.01, "sigma": SIGMA} | options
    rng = np.random.default_rng(seed)
    return simulate_matches(model, truth_of(model), n, rng=rng, **options)


def as_table(matches: Matches, unit: str | None = "same") -> Table:
    """Matches as a file holds them."""
    table = Table({k: getattr(matches, k).copy() for k in ("x", "y", "u", "v")})
    if matches.sigma_u is not None:
        table["sigma_u"], table["sigma_v"] = matches.sigma_u.copy(), matches.sigma_v.copy()
    for name in ("epoch", "mag"):
        if getattr(matches, name) is not None:
            table[name] = getattr(matches, name).copy()
    if len(matches.exposure_names) > 1:
        table["exposure"] = np.array(matches.exposure_names)[matches.exposure]
    if unit is not None:
        for name in table.colnames:
            if name in ("u", "v", "sigma_u", "sigma_v"):
                table[name].unit = matches.unit if unit == "same" else unit
    return table


# -- configuration --------------------------------------------------------------------------------


def toml(value: Any) -> str:
    """A value as TOML."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{k} = {toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(toml(v) for v in value) + "]"
    return json.dumps(value, ensure_ascii=False)


# what verdicts ask for: the catalogue of a simulation is exact
EXACT = {
    "name": "reference catalogue",
    "kind": "random",
    "sigma_u": 0.0,
    "sigma_v": 0.0,
    "source": "exact in the simulation",
}


def config_text(**sections: Any) -> str:
    """A configuration; sections change these defaults, a section that is None is left out."""
    defaults: dict[str, Any] = {
        "data": {"matches": "stars.ecsv"},
        "detector": {"name": "A", "size": SIZE},
        "model": {"order": 2, "reference_pixel": CENTRE},
        "sampler": {"target_ess": 100, "target_rhat": 1.05},
        "assess": {"grid": (9, 7), "draws": 400},
    }
    lines = []
    for name, content in (defaults | sections).items():
        if content is None:
            continue
        for block in content if isinstance(content, list) else [content]:
            lines.append(f"[[{name}]]" if isinstance(content, list) else f"[{name}]")
            lines += [f"{k} = {toml(v)}" for k, v in block.items()]
    return "\n".join(lines) + "\n"


def write_config(path: Path, **sections: Any) -> Path:
    path.write_text(config_text(**sections), encoding="utf-8")
    return path


def replaced(text: str, changes: Mapping[str, str]) -> str:
    """A text with these parts of it replaced; each is there."""
    for old, new in changes.items():
        assert old in text, old
        text = text.replace(old, new)
    return text


def edit(config: Path, changes: Mapping[str, str]) -> Path:
    """Replace parts of a configuration."""
    text = config.read_text(encoding="utf-8")
    config.write_text(replaced(text, changes), encoding="utf-8")
    return config


def write_job(
    folder: Path, table: Table | None = None, *, stars: str = "stars.ecsv", **sections: Any
) -> Path:
    """A table of stars and config.toml in a folder; the configuration's path.

    Thousands of stars are written and read in a moment where `stars` is no text.
    """
    folder.mkdir(parents=True, exist_ok=True)
    table = as_table(simulated()[0]) if table is None else table
    table.write(folder / stars)
    known = {"budget": [EXACT], "data": {"matches": stars}}
    return write_config(folder / "config.toml", **(known | sections))


def begin(folder: Path, config: Path) -> Path:
    """A folder that holds nothing but a configuration, whose files are named in full."""
    folder.mkdir()
    text = config.read_text(encoding="utf-8")
    for path in config.parent.iterdir():
        text = text.replace(f'"{path.name}"', toml(str(path)))
    (folder / "config.toml").write_text(text, encoding="utf-8")
    return folder


def begin_stagewise(folder: Path, config: Path, *stages: str) -> Path:
    """Stages of a run that begins here, each by a command."""
    begin(folder, config)
    for stage in stages:
        good("stage", stage, folder)
    return folder


def partly_run(folder: Path, config: Path, *stages: str) -> Path:
    """Stages of a run that begins here, in one go; without a report it is quick."""
    return carried_out(begin(folder, config), *stages)


def carried_out(run: Path, *stages: str) -> Path:
    """Stages of a run whose folder holds nothing but a configuration."""
    start_logging(quiet=True)  # as a command does: the log of the run has all of it
    names = [one for name in stages for one in (ASSESS if name == "assess" else (name,))]
    with initialized(RunDirectory.open(run)) as opened:
        make_stages(opened, names)
    return run


def summary_of(run: Path) -> dict[str, Any]:
    return json.loads((run / "summary.json").read_text(encoding="utf-8"))


def after_stages(directory: RunDirectory, *stages: str, rehearsed: bool = True) -> Run:
    """Run after some stages, which begins here; the caller must close it."""
    run = Run.of(directory)
    if rehearsed:
        run = rehearse(run)
    directory.begin()
    run = run.adopting_inputs()
    return make_stages(run, stages, force=True)


def in_memory(config: Path) -> Run:
    """Run of a configuration file in memory; the caller must close it."""
    settings, text = load_config(config)
    return Run.of(RunDirectory.unsaved(settings, text, files=True, base=config.parent))
