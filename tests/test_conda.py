"""The conda recipe asks for what pyproject.toml asks for."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
import yaml

import bayesdist

ROOT = Path(__file__).resolve().parents[1]
# the parts of these packages that need no further libraries have names of their own in conda
IN_CONDA = {"astropy": "astropy-base", "matplotlib": "matplotlib-base", "pyarrow": "pyarrow-core"}


@pytest.fixture(scope="module")
def project() -> dict:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


@pytest.fixture(scope="module")
def recipe() -> dict:
    text = (ROOT / "conda" / "recipe.yaml").read_text(encoding="utf-8")
    context = yaml.safe_load(text)["context"]
    for name, value in context.items():
        text = text.replace(f"${{{{ {name} }}}}", str(value))
    return yaml.safe_load(text)


def test_requirements(project, recipe):
    wanted = set()
    for requirement in project["dependencies"]:
        name, bound = re.fullmatch(r"([\w-]+)(>=[\w.]+)", requirement).groups()
        wanted.add(f"{IN_CONDA.get(name, name)} {bound}")
    assert set(recipe["requirements"]["run"]) == wanted | {f"python {project['requires-python']}"}


def test_version_licence_and_command(project, recipe):
    assert recipe["package"]["version"] == project["version"] == bayesdist.__version__
    assert recipe["about"]["license"] == project["license"]
    assert (ROOT / recipe["about"]["license_file"]).is_file()
    commands = [f"{name} = {place}" for name, place in project["scripts"].items()]
    assert recipe["build"]["python"]["entry_points"] == commands
