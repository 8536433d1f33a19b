"""`python -m tests.benchmarks [--quick] [--only NAME ...] [--output DIR] [--docs DIR]`

With `--release NAME` the ratios of the run are kept as those of a release, and with `--against
FILE` compared with those of the latest one: the exit code is 1 where one is a fifth worse.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from bayesdist.files.atomic import atomic_path
from tests.benchmarks import (
    budget,
    commands,
    dithers,
    likelihood,
    linear,
    processes,
    samplers,
    scaling,
    scamp,
    wise,
)
from tests.benchmarks.figure import draw_scaling
from tests.benchmarks.history import HISTORY, read_history, regressions, with_run, write_history
from tests.benchmarks.machine import describe
from tests.benchmarks.markdown import to_markdown
from tests.benchmarks.measured import with_measured
from tests.benchmarks.timing import say

__all__ = ["main"]

FIGURE = "figures/scaling.png"  # beside the page
PARTS = {
    "commands": commands,
    "samplers": samplers,
    "kernel": likelihood,
    "linear": linear,
    "scaling": scaling,
    "wise": wise,
    "budget": budget,
    "scamp": scamp,
    "dithers": dithers,
    "processes": processes,
}


def _finite(value: Any) -> Any:
    """The same without numbers that JSON does not know."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _write(bench: dict[str, Any], folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    clean = _finite(bench)
    texts = {
        "bench.json": json.dumps(clean, indent=1, allow_nan=False) + "\n",
        "bench.md": to_markdown(clean),
    }
    for name, text in texts.items():
        with atomic_path(folder / name) as path:
            path.write_text(text, encoding="utf-8")


def _document(bench: dict[str, Any], folder: Path, release: str | None) -> None:
    """Write the page of the documentation, the figures of it that other pages state, and ratios."""
    kept = folder / HISTORY
    history = read_history(kept) if kept.exists() else []
    if release is not None:
        history = with_run(history, bench, release)
        write_history(history, folder)
    page, measured = to_markdown(_finite(bench), history), folder / "measured.toml"
    revision = bench["machine"]["revision"] or "unknown"
    texts = {
        measured: with_measured(measured.read_text(encoding="utf-8"), page, revision),
        folder / "benchmarks.md": page,
    }
    for target, text in texts.items():
        with atomic_path(target) as path:
            path.write_text(text, encoding="utf-8")


def _compared(bench: dict[str, Any], history: list[dict[str, Any]]) -> int:
    """Say which ratios are worse than at the latest release: the exit code."""
    worse, latest, here = regressions(history, bench), history[-1], bench["machine"]["cpu"]
    for sentence in worse:
        say(sentence)
    if worse and latest["processor"] != here:
        say(f"{latest['release']} was measured on {latest['processor']}, this on {here}")
    return 1 if worse else 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the parts that are asked for; the files are renewed after each.

    Parameters
    ----------
    arguments : sequence of str, optional
        Of the command line by default.

    Returns
    -------
    int
        Zero; 1 where a ratio is a fifth worse than at the release that it is compared with.
    """
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="tiny problems: does it work?")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS), metavar="NAME")
    parser.add_argument("--output", type=Path, default=Path("build/bench"), metavar="DIR")
    parser.add_argument(
        "--docs",
        type=Path,
        metavar="DIR",
        help="write benchmarks.md, figures/scaling.png and the figures of measured.toml there",
    )
    parser.add_argument(
        "--fields",
        type=int,
        metavar="N",
        help="of the part scamp: that many, without false matches",
    )
    parser.add_argument("--release", metavar="NAME", help="keep the ratios there as this one's")
    parser.add_argument(
        "--against", type=Path, metavar="FILE", help="history whose latest ratios are to be kept up"
    )
    options = parser.parse_args(arguments)
    if options.fields is not None and (options.quick or options.only != ["scamp"]):
        parser.error("--fields goes with --only scamp, and without --quick")
    if options.docs is not None and (options.quick or len(options.only) < len(PARTS)):
        parser.error("--docs takes the whole benchmark: leave --quick and --only out")
    if options.release is not None and options.docs is None:
        parser.error("--release goes with --docs")
    if options.against is not None and (options.quick or len(options.only) < len(PARTS)):
        parser.error("--against takes the whole benchmark: leave --quick and --only out")
    bench: dict[str, Any] = {
        "schema": 1,
        "quick": options.quick,
        "machine": describe(),
        "parts": {},
    }
    for name in PARTS:
        if name not in options.only:
            continue
        module = PARTS[name]
        start = time.perf_counter()
        sizes = module.QUICK if options.quick else module.FULL
        if options.fields is not None:
            sizes = replace(sizes, seeds=tuple(range(1, options.fields + 1)), false=(0.0,))
        part = module.run(sizes)
        part["wall_s"] = time.perf_counter() - start
        if name == "scaling":
            draw_scaling(part, options.output / FIGURE)
            part["figure"] = FIGURE
        bench["parts"][name] = part
        _write(bench, options.output)
    if options.docs is not None:
        _document(bench, options.docs, options.release)
        shutil.copy(options.output / FIGURE, options.docs / FIGURE)
    say(f"written: {options.output / 'bench.json'}, {options.output / 'bench.md'}")
    return 0 if options.against is None else _compared(bench, read_history(options.against))


if __name__ == "__main__":
    raise SystemExit(main())
