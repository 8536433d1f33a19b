"""The floors of the package: imports go downwards only, and each heavy library has one door.

The imports are read from the source with `ast`, those inside functions and under TYPE_CHECKING
included: a type that lies above is as much a dependence as a call.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from functools import cache
from importlib import import_module
from pathlib import Path

import pytest

import bayesdist

ROOT = Path(bayesdist.__file__).parent

# Packages on one floor do not see each other; each may import what lies on the floors before.
FLOORS = (
    ("errors", "lazy", "limits", "numbers", "records", "streams"),
    ("checks", "names"),
    ("files",),
    ("mission",),
    ("data", "model"),
    ("infer", "simulate"),
    ("calibration",),
    ("diagnose",),
    ("assess",),
    ("products",),
    ("report",),
    ("app",),
    ("missions",),  # the core imports none of them
    ("",),  # bayesdist/__init__.py and __main__.py: the public face
)
LEVEL = {name: level for level, names in enumerate(FLOORS) for name in names}

# library: the only module or folder of the core (relative to bayesdist/) that may import it
DOORS = {
    "emcee": "infer/sampler/ensembles.py",
    "numba": "infer/kernel/",
    "llvmlite": "infer/kernel/",
    "dask": "infer/stars/cluster.py",
    "distributed": "infer/stars/cluster.py",
    "pyarrow": "data/",
    "xarray": "infer/files.py",
    "arviz": "infer/sampler/convergence.py",
    "matplotlib": "report/",
    "corner": "report/",
}


def modules() -> dict[str, Path]:
    """Dotted name of every module of the package, and its file."""
    out = {}
    for path in sorted(ROOT.rglob("*.py")):
        parts = ("bayesdist", *path.relative_to(ROOT).with_suffix("").parts)
        out[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return out


MODULES = modules()


@cache
def parsed(name: str) -> ast.Module:
    """Syntax tree of a module."""
    return ast.parse(MODULES[name].read_text(encoding="utf-8"))


@cache
def imports_of(name: str, *, at_import_time: bool = False) -> set[str]:
    """Full dotted names that a module imports; `from a import b` gives a.b where that is a module.

    With `at_import_time`, only what runs when the module is loaded: neither inside functions nor
    under TYPE_CHECKING.
    """
    path = MODULES[name]
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    out: set[str] = set()

    def visit(node: ast.AST) -> None:
        if at_import_time and isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            return
        if at_import_time and isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            for child in node.orelse:
                visit(child)
            return
        if isinstance(node, ast.Import):
            out.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                above = package.split(".")
                above = above[: len(above) - node.level + 1]
                base = ".".join([*above, base] if base else above)
            for alias in node.names:
                full = f"{base}.{alias.name}"
                out.add(full if full in MODULES else base)
        for child in ast.iter_child_nodes(node):
            visit(child)

    visit(parsed(name))
    return out


def floor(name: str) -> str:
    """'infer' of bayesdist.infer.sampler.ensembles; '' of bayesdist itself and of __main__."""
    parts = name.split(".")
    return "" if len(parts) == 1 or parts[1] == "__main__" else parts[1]


def ours(names: set[str]) -> set[str]:
    return {n for n in names if n == "bayesdist" or n.startswith("bayesdist.")}


def test_every_module_stands_on_a_known_floor():
    assert len(MODULES) > 20
    assert {floor(name) for name in MODULES} <= set(LEVEL)


@pytest.mark.parametrize("name", sorted(MODULES))
def test_imports_go_downwards(name):
    here = floor(name)
    for other in sorted(ours(imports_of(name))):
        there = floor(other)
        if other == "bayesdist":
            # the package itself gives its version away and nothing else
            assert _only_the_version(name), f"{name} imports the public face"
            continue
        assert there == here or LEVEL[there] < LEVEL[here], (
            f"{name} ({here}) imports {other} ({there})"
        )


def _only_the_version(name: str) -> bool:
    """Whether all that a module takes from the package's root is `__version__`."""
    for node in ast.walk(parsed(name)):
        if isinstance(node, ast.Import) and any(a.name == "bayesdist" for a in node.names):
            return False
        if isinstance(node, ast.ImportFrom) and node.module == "bayesdist" and not node.level:
            names = {a.name for a in node.names if f"bayesdist.{a.name}" not in MODULES}
            if not names <= {"__version__"}:
                return False
    return True


def test_no_import_cycles():
    """What runs on loading has no cycle, not even inside one package."""
    graph = {}
    for name in MODULES:
        targets = {n for n in ours(imports_of(name, at_import_time=True)) if n in MODULES}
        graph[name] = targets - {name, "bayesdist"}  # the root loads lazily
    done: set[str] = set()

    def descend(name: str, trail: tuple[str, ...]) -> None:
        assert name not in trail, " -> ".join((*trail[trail.index(name) :], name))
        if name not in done:
            for other in sorted(graph[name]):
                descend(other, (*trail, name))
            done.add(name)

    for name in graph:
        descend(name, ())


@pytest.mark.parametrize(("library", "door"), DOORS.items())
def test_each_heavy_library_has_one_door(library, door):
    users = {
        str(MODULES[name].relative_to(ROOT))
        for name in MODULES
        if floor(name) != "missions" and any(n.split(".")[0] == library for n in imports_of(name))
    }
    assert users, f"nothing imports {library}: drop it from the dependencies"
    assert all(user == door or (user.startswith(door) and door.endswith("/")) for user in users), (
        users
    )


@pytest.mark.parametrize("home", bayesdist._HOMES)
def test_public_names_are_where_they_are_said_to_be(home):
    for name in bayesdist._HOMES[home]:
        assert getattr(import_module(home), name) is getattr(bayesdist, name)
        assert name in bayesdist.__all__


def test_importing_the_package_is_cheap():
    """Only errors and the standard library: numba, matplotlib and arviz cost seconds."""
    heavy = (*DOORS, "astropy", "scipy", "h5py")
    code = f"import sys, bayesdist; print([m for m in {heavy!r} if m in sys.modules])"
    run = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT.parent,
    )
    assert run.stdout.strip() == "[]"
