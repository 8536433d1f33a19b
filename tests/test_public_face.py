"""The package's face: its names are where they are said to be, and importing it costs nothing.

Which room may import which, and which library has which door, is checked by `lint-imports`: the
contracts are in pyproject.toml.
"""

from __future__ import annotations

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


@pytest.mark.parametrize("home", bayesdist._HOMES)
def test_public_names_are_where_they_are_said_to_be(home):
    for name in bayesdist._HOMES[home]:
        assert getattr(import_module(home), name) is getattr(bayesdist, name)
        assert name in bayesdist.__all__


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
