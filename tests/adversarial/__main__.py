"""Carry kinds of truth with several seeds through runs, and make the table of them."""

from __future__ import annotations

import argparse
import json
import logging
import sys
from pathlib import Path
from typing import Any

from bayesdist.files.atomic import atomic_path

from . import KINDS
from .goals import table_of
from .measure import measured


def kept(path: Path) -> dict[str, dict[str, Any]]:
    """Results that a file holds, by kind and seed."""
    return json.loads(path.read_text()) if path.exists() else {}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.adversarial", description=__doc__)
    parser.add_argument("results", type=Path, help="JSON file; what it holds is not made again")
    parser.add_argument("--kinds", help="separated by commas; all by default")
    parser.add_argument("--seeds", type=int, default=20, help="of each kind (default 20)")
    parser.add_argument("--first", type=int, default=0, help="the first seed (default 0)")
    parser.add_argument("--table", type=Path, help="Markdown file for the table")
    a = parser.parse_args()
    names = a.kinds.split(",") if a.kinds else list(KINDS)
    if unknown := [name for name in names if name not in KINDS]:
        parser.error(f"unknown kind {unknown[0]!r}; choose from {', '.join(KINDS)}")
    logging.getLogger("bayesdist").setLevel(logging.ERROR)
    found = kept(a.results)
    seeds = range(a.first, a.first + a.seeds)
    # a seed of every kind before the next one: a run that is cut short has all kinds
    for seed in seeds:
        for name in names:
            key = f"{name}/{seed}"
            if key in found:
                continue
            found[key] = measured(name, seed)
            with atomic_path(a.results) as temporary:
                temporary.write_text(json.dumps(found, indent=0))
            print(f"{key}: {found[key]['seconds']:.1f} s", file=sys.stderr, flush=True)
    table = table_of([one for one in found.values() if one["kind"] in names])
    if a.table:
        a.table.write_text(table)
    print(table, end="")


main()
