"""What the package never does with what others have written, and what it never offers to others."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import bayesdist

PACKAGE = Path(bayesdist.__file__).parent

# what runs whatever stands in a text or file
RUNNERS = {
    "": {"eval", "exec", "compile", "__import__"},
    "pickle": {"load", "loads", "Unpickler"},
    "marshal": {"load", "loads"},
    "shelve": {"open"},
    "joblib": {"load"},
    "dill": {"load", "loads"},
    "cloudpickle": {"load", "loads"},
    "yaml": {"load", "load_all", "unsafe_load", "unsafe_load_all", "full_load", "full_load_all"},
    "os": {"system", "popen"},
    "pd": {"read_pickle"},
    "pandas": {"read_pickle"},
}
NAMES = set[str]().union(*RUNNERS.values())
MODULES = {"marshal", "shelve", "joblib", "dill", "cloudpickle"}


def _dangers(source: str) -> Iterator[str]:
    """Calls, arguments and imports by which a file could run as a program."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (one.name for one in node.names if one.name in MODULES)
        elif isinstance(node, ast.ImportFrom):
            if node.module in MODULES:
                yield str(node.module)
            names = {one.name for one in node.names} & RUNNERS.get(node.module or "", set())
            yield from (f"{node.module}.{name}" for name in names)
        elif isinstance(node, ast.Call):
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            if name in NAMES:
                whole = ast.unparse(node.func)
                if name in RUNNERS.get(whole.rpartition(".")[0], ()):
                    yield whole
            for given in node.keywords:
                if given.arg in ("allow_pickle", "shell") and ast.unparse(given.value) != "False":
                    yield f"{ast.unparse(node.func)}({given.arg})"


def test_a_file_is_never_run():
    """Objects that are pickled travel between processes of one run and are read from no disk."""
    found = [
        f"{path.relative_to(PACKAGE)}: {one}"
        for path in sorted(PACKAGE.rglob("*.py"))
        for one in _dangers(path.read_text(encoding="utf-8"))
    ]
    assert found == []


def test_that_the_search_finds_what_it_looks_for():
    for source in (
        "import pickle\npickle.load(f)",
        "from pickle import loads",
        "np.load(p, allow_pickle=True)",
        "eval(text)",
        "yaml.load(text, Loader=yaml.Loader)",
        "from yaml import full_load",
        "subprocess.run(text, shell=True)",
        "os.system(text)",
    ):
        assert list(_dangers(source)), source
    assert not list(_dangers("re.compile(x)\nnp.load(p, allow_pickle=False)\nmodel.eval()"))
