"""Files are opened in one room: no other module of the package does."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import bayesdist

PACKAGE = Path(bayesdist.__file__).parent
ROOM = PACKAGE / "files"

# functions that open or decode, by what stands before the point; '*' is anything
OPENERS = {
    "json": {"load", "loads"},
    "tomllib": {"load", "loads"},
    "Table": {"read"},
    "QTable": {"read"},
    "ascii": {"read"},
    "fits": {"open", "getdata", "getheader"},
    "h5py": {"File"},
    "xr": {"open_dataset", "open_datatree", "open_dataarray", "load_dataset"},
    "xarray": {"open_dataset", "open_datatree", "open_dataarray", "load_dataset"},
    "asdf": {"open"},
    "gzip": {"open", "decompress", "GzipFile"},
    "zlib": {"decompress"},
    "np": {"load", "loadtxt", "genfromtxt", "fromfile", "memmap"},
    "pickle": {"load", "loads"},
    "io": {"open"},
    "*": {"read_text", "read_bytes", "open", "ParquetFile", "read_table", "dataset"},
}

# calls of these names that read no file of others, each with its reason
ALLOWED = {
    ("app/run.py", "webbrowser.open"): "a report of our own, in a browser",
    ("app/screen.py", "os.open"): "nothing, in place of a stream that is closed",
    ("report/drawing.py", "Image.open"): "a picture in memory, of our own",
}
NAMES = set[str]().union(*OPENERS.values())
RUNS = "RunDirectory.open"  # which reads run.json by the room


def _calls(source: str) -> Iterator[tuple[str, int]]:
    """Calls that open or decode a file, as 'name.function' with their lines."""
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Call):
            continue
        if isinstance(node.func, ast.Name):
            if node.func.id in ("open", "ParquetFile"):
                yield node.func.id, node.lineno
        elif isinstance(node.func, ast.Attribute) and node.func.attr in NAMES:
            before, name = ast.unparse(node.func.value), node.func.attr
            if name in OPENERS.get(before.rpartition(".")[2], set()) | OPENERS["*"]:
                yield f"{before}.{name}", node.lineno


def test_files_are_opened_in_one_room_only():
    found, allowed = [], set()
    for path in sorted(PACKAGE.rglob("*.py")):
        if path.is_relative_to(ROOM):
            continue
        name = path.relative_to(PACKAGE).as_posix()
        for call, line in _calls(path.read_text(encoding="utf-8")):
            if (name, call) in ALLOWED:
                allowed.add((name, call))
            elif call != RUNS:
                found.append(f"{name}:{line}: {call}")
    assert found == []
    assert allowed == set(ALLOWED)  # no reason without its call


@pytest.mark.parametrize(
    "line",
    [
        "json.loads(text)",
        "open(path)",
        "Path(path).open('rb')",
        "path.read_bytes()",
        "pyarrow.parquet.ParquetFile(path)",
        "fits.open(path)",
        "astropy.table.Table.read(path)",
        "with xr.open_datatree(path) as tree: pass",
        "np.load(path)",
    ],
)
def test_an_opened_file_is_seen(line):
    assert list(_calls(line))


def test_what_opens_no_file_is_not_seen():
    assert not list(_calls("json.dumps(x)\nread_table(path)\nopened(path)\nnp.loadable(x)"))
