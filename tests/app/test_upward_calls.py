"""Calls from one layer to a higher one, in runs: only where docs/architecture.md has them."""

from __future__ import annotations

import inspect
import re
import sys
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
from numba.core.event import Event, Listener, install_listener

import bayesdist
from tests.kinds.selfcal.runs.support import list_table, small, write_selfcal
from tests.sketches import quick

from .support import REPOSITORY, as_table, good, simulated, write_job

PACKAGE = Path(bayesdist.__file__).parent
DOCS = REPOSITORY / "docs" / "architecture.md"
Calls = set[tuple[str, str]]  # files of callers and of what they call, relative to the repository


def heights() -> dict[str, dict[str, int]]:
    """Height of each member of a package, by the package: the layers of the import contracts."""
    settings = tomllib.loads((REPOSITORY / "pyproject.toml").read_text("utf-8"))
    out = {}
    for contract in settings["tool"]["importlinter"]["contracts"]:
        if contract["type"] == "layers":
            layers = [re.split(r" [|:] ", layer) for layer in reversed(contract["layers"])]
            members = {name: height for height, layer in enumerate(layers) for name in layer}
            out |= {container.replace(".", "/"): members for container in contract["containers"]}
    return out


def is_upward(caller: str, callee: str, packages: dict[str, dict[str, int]]) -> bool:
    """True if a call leaves its layer upwards, in any package that contains both files."""
    for package, members in packages.items():
        places = [re.match(rf"{package}/(\w+)", file) for file in (caller, callee)]
        first, second = (members.get(place[1]) if place else None for place in places)
        if first is not None and second is not None and second > first:
            return True
    return False


@cache
def file_of(path: str) -> str | None:
    """File of the package, relative to the repository; None if it is elsewhere."""
    return f"bayesdist{path[len(str(PACKAGE)) :]}" if path.startswith(f"{PACKAGE}/") else None


@contextmanager
def calls_traced() -> Iterator[Calls]:
    """Calls between files of the package, directly or through other libraries.

    Imports are none, and neither are iterators, which whoever is given them may exhaust.
    """
    found: Calls = set()

    def called(frame: FrameType, event: str, _: Any) -> None:
        if event != "call":
            return
        code = frame.f_code
        callee = file_of(code.co_filename)
        if not callee or code.co_name == "<module>" or code.co_flags & inspect.CO_GENERATOR:
            return
        caller = frame.f_back
        while caller and "importlib" not in caller.f_code.co_filename:
            place = file_of(caller.f_code.co_filename)
            if place and caller.f_code.co_name != "<module>":
                found.add((place, callee))
                return
            caller = caller.f_back

    before = sys.getprofile()
    sys.setprofile(called)
    try:
        with install_listener("numba:compiler_lock", Untraced(called)):
            yield found
    finally:
        sys.setprofile(before)


class Untraced(Listener):
    """Compilation, which takes a minute while each of its calls is looked at, is not traced."""

    def __init__(self, trace: Callable[[FrameType, str, Any], None]):
        self.trace = trace
        self.depth = 0  # compiled functions call others, which are compiled meanwhile

    def on_start(self, event: Event) -> None:
        self.depth += 1
        sys.setprofile(None)

    def on_end(self, event: Event) -> None:
        self.depth -= 1
        if not self.depth:
            sys.setprofile(self.trace)


def declared() -> list[tuple[str, str]]:
    """Beginnings of the paths of callers and of what they call, as the documentation lists them."""
    rows = re.findall(r"^\| (`bayesdist/.*?) \| (`bayesdist/.*?) \|", DOCS.read_text("utf-8"), re.M)
    return [
        (caller, callee)
        for callers, callees in rows
        for caller in re.findall("`(.*?)`", callers)
        for callee in re.findall("`(.*?)`", callees)
    ]


def undeclared(calls: Calls) -> list[tuple[str, str]]:
    packages, known = heights(), declared()
    return sorted(
        (caller, callee)
        for caller, callee in calls
        if is_upward(caller, callee, packages)
        and not any(caller.startswith(a) and callee.startswith(b) for a, b in known)
    )


def job_of(kind: str, folder: Path) -> Path:
    asked = {"name": "loose", "statistic": "p95", "limit": 1.0, "unit": "pix", "probability": 0.95}
    if kind == "selfcal":
        return write_selfcal(folder, list_table(small()))
    return write_job(
        folder,
        as_table(simulated(300)[0]),
        detector={"name": "A", "size": (1000, 800), "scale_mas": 50.0},
        requirement=[asked],
        holdout={"fraction": 0.25},
        products={"sip": {"inverse_order": 4}, "tpv": {}},
    )


@pytest.mark.parametrize("kind", ["data", "selfcal"])
def test_runs_call_upwards_only_what_the_documentation_lists(tmp_path, kind):
    config = job_of(kind, tmp_path / "job")
    with quick(), calls_traced() as calls:
        good("run", config, "-o", tmp_path / "run", "-q")
    assert len(calls) > 500
    assert undeclared(calls) == []


def test_what_is_not_listed_is_found():
    calls = {("bayesdist/assess/maps.py", "bayesdist/report/contents.py")}
    calls |= {("bayesdist/infer/stars/stars.py", "bayesdist/infer/compare/periods.py")}
    down = {("bayesdist/report/contents.py", "bayesdist/assess/maps.py")}
    assert undeclared(calls | down) == sorted(calls)
