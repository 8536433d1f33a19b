"""The package's face: its names are where they are said to be, and importing it costs nothing.

Which room may import which, and which library has which door, is checked by `lint-imports`: the
contracts are in pyproject.toml.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import bayesdist

HEAVY = (
    *("arviz", "astropy", "dask", "distributed", "emcee", "h5py", "llvmlite"),
    *("matplotlib", "numba", "pyarrow", "scipy", "xarray"),
)


@pytest.mark.parametrize(
    "package", ["", ".data", ".infer", ".assess", ".products", ".missions.wise"]
)
def test_public_names_are_where_they_are_said_to_be(package):
    """The stub, which type checkers read, and what is loaded."""
    face = import_module(f"bayesdist{package}")
    stub = ast.parse(Path(face.__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    named = [node for node in stub.body if isinstance(node, ast.ImportFrom)]
    assert named
    for node in named:
        home = import_module(f"{face.__name__}.{node.module}")
        for one in node.names:
            assert one.asname == one.name
            assert getattr(home, one.name) is getattr(face, one.name)
            assert one.name in face.__all__ and one.name in dir(face)


def test_importing_the_package_is_cheap():
    """Only errors and the standard library: numba, matplotlib and arviz cost seconds."""
    code = f"import sys, bayesdist; print([m for m in {HEAVY!r} if m in sys.modules])"
    run = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(bayesdist.__file__).parent.parent,
    )
    assert run.stdout.strip() == "[]"


def test_importing_a_mission_is_cheap():
    """The entry point loads it, and its names are loaded when they are used."""
    code = f"import sys, bayesdist.missions.wise; print([m for m in {HEAVY!r} if m in sys.modules])"
    run = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(bayesdist.__file__).parent.parent,
    )
    assert run.stdout.strip() == "[]"


def test_the_face_has_few_names():
    """At most 45, without those of single formats and missions."""
    assert len(bayesdist.__all__) <= 45
    assert not [n for n in bayesdist.__all__ if n.startswith(("simulate_wise", "read_sip", "Idc"))]
