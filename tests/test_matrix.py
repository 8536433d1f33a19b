"""The environments of `make test-matrix`, of the workflow and of pyproject.toml are the same."""

from __future__ import annotations

import re
import sys
import tomllib

import pytest

from tests.matrix import NAMES, ROOT, find_python, main


def _project() -> dict:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def test_the_running_python_is_found_or_another_of_its_version():
    version = "{}.{}".format(*sys.version_info[:2])
    found = find_python(version)
    if found is None:
        pytest.skip("neither on the path nor of pyenv")
    assert found.exists()


def test_an_interpreter_that_does_not_exist():
    assert find_python("3.999") is None


def test_a_name_that_is_none(capsys):
    assert main(["3.13-ancient"]) == 2
    assert "3.13-ancient" in capsys.readouterr().out


def test_the_oldest_python_is_the_one_that_the_project_requires():
    oldest = _project()["project"]["requires-python"].removeprefix(">=")
    assert f"{oldest}-oldest" in NAMES
    assert min(NAMES, key=lambda name: int(name.split("-")[0].split(".")[1])).startswith(oldest)


def test_the_workflow_runs_the_same_environments():
    workflow = (ROOT / ".github/workflows/tests.yml").read_text(encoding="utf-8")
    (newest,) = re.findall(r"python: (\[.*\])", workflow)
    assert {f"{v}-newest" for v in re.findall(r"[\d.]+", newest)} | {"3.11-oldest"} == set(NAMES)


def test_the_versions_of_the_types_are_exact():
    lines = (ROOT / ".ci/types.txt").read_text(encoding="utf-8").splitlines()
    required = [line for line in lines if not line.startswith("#")]
    assert required and all(re.fullmatch(r"[\w.-]+==[\w.]+", line) for line in required)
    assert {"mypy", "numpy"} <= {line.split("==")[0] for line in required}
