"""What the package never does with what others have written, and what it never offers to others."""

from __future__ import annotations

import ast
import json
import logging
import sys
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from astropy.io import fits
from astropy.table import Table
from distributed import LocalCluster

import bayesdist
from bayesdist.app.cli import main

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


# -- on the network -------------------------------------------------------------------------------

AWAY = "http://127.0.0.1:9/a"
LOCAL = "file:///etc/passwd"
EVENTS = ("socket.connect", "socket.getaddrinfo", "socket.gethostbyname", "urllib.Request")
_heard: list[str] | None = None  # events while somebody listens; a hook stays for good


def _hear(event: str, arguments: tuple[object, ...]) -> None:
    if _heard is not None:
        outside = event == "open" and str(arguments[0]) in ("/etc/passwd", "/dev/zero")
        if outside or event in EVENTS:
            place = arguments[1] if event == "socket.connect" else arguments[:2]
            _heard.append(f"{event} {place}")


sys.addaudithook(_hear)


@contextmanager
def heard() -> Iterator[list[str]]:
    """List of what is opened that lies elsewhere."""
    global _heard
    _heard = []
    try:
        yield _heard
    finally:
        _heard = None


def _hostile_votable(path: Path) -> None:
    table = Table({name: np.arange(9.0) for name in ("x", "y", "u", "v")})
    table.write(path, format="votable")
    text = path.read_text()
    away = LOCAL if path.stem == "local" else AWAY
    if path.stem == "doctype":
        text = text.replace("?>", f'?><!DOCTYPE a SYSTEM "{AWAY}">', 1)
    else:
        at = text.index("<DATA>")
        text = text[:at] + f'<DATA><BINARY><STREAM href="{away}"/></BINARY></DATA>'
        text += "</TABLE></RESOURCE></VOTABLE>"
    path.write_text(text)


def _hostile_text(path: Path) -> None:
    Table({"x": [1.0, 2.0], "y": [1.0, 2.0], "u": [AWAY, LOCAL], "v": [1.0, 2.0]}).write(
        path, format={".ecsv": "ascii.ecsv", ".csv": "ascii.csv"}[path.suffix]
    )


def _hostile_yaml(path: Path) -> None:
    _hostile_text(path)
    lines = path.read_text().splitlines()
    lines[2:2] = ["# meta:", f"#   a: !include {LOCAL}", f"#   b: !!python/name:urllib.{AWAY}"]
    path.write_text("\n".join(lines) + "\n")


def _hostile_parquet(path: Path) -> None:
    rows = pa.table({"x": [1.0], "y": [1.0], "u": [1.0], "v": [1.0], "exposure": [AWAY]})
    yaml = f"datatype:\n- {{name: x, datatype: !include {LOCAL}}}"
    pq.write_table(rows.replace_schema_metadata({"table_meta_yaml": yaml}), path)


def _hostile_fits(path: Path) -> None:
    header = fits.Header()
    for keyword in ("IDCTAB", "NPOLFILE", "D2IMFILE", "XT_LOC"):
        header[keyword] = AWAY
    columns = [fits.Column(name, "D", array=np.arange(9.0)) for name in ("x", "y", "u", "v")]
    hdus = [fits.PrimaryHDU(header=header), fits.BinTableHDU.from_columns(columns)]
    fits.HDUList(hdus).writeto(path)


def _hostile_cards(path: Path) -> None:
    header = fits.Header()
    for keyword, value in [
        ("CTYPE1", "RA---TAN-SIP"), ("CTYPE2", "DEC--TAN-SIP"), ("CRVAL1", 10.0),
        ("CRPIX1", 5.0), ("CRPIX2", 5.0), ("CD1_1", 1e-4), ("CD2_2", 1e-4), ("A_ORDER", 2),
        ("B_ORDER", 2), ("NPOLFILE", AWAY), ("D2IMFILE", LOCAL), ("DATE-OBS", "2031-01-01"),
    ]:  # fmt: skip
        header[keyword] = value
    header.totextfile(path)


def _hostile_hdf5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["a"] = h5py.ExternalLink("/etc/passwd", "x")
        file.create_dataset("b", (9,), "u1", external=[("/etc/passwd", 0, 9)])
        layout = h5py.VirtualLayout((9,), "u1")
        layout[:] = h5py.VirtualSource("/etc/passwd", "x", (9,))
        file.create_virtual_dataset("c", layout)
        file.attrs["fingerprint"] = AWAY


def _hostile_asdf(path: Path) -> None:
    tree = "a: {{$ref: '{0}'}}\nb: !<tag:stsci.edu:asdf/core/ndarray-1.1.0> {{source: '{0}'}}\n"
    away = LOCAL if path.stem == "local" else AWAY
    head = "#ASDF 1.0.0\n%YAML 1.1\n--- !<tag:stsci.edu:asdf/core/asdf-1.1.0>\n"
    path.write_text(head + tree.format(away) + "...\n")


def _hostile_json(path: Path) -> None:
    path.write_text(json.dumps({"$schema": AWAY, "$ref": LOCAL, "bayesdist": {"source": AWAY}}))


HOSTILE: dict[str, Callable[[Path], None]] = {
    **dict.fromkeys(("a.vot", "local.vot", "doctype.xml"), _hostile_votable),
    **dict.fromkeys(("a.csv", "a.ecsv"), _hostile_text),
    "yaml.ecsv": _hostile_yaml,
    "a.parquet": _hostile_parquet,
    "a.fits": _hostile_fits,
    "a.hdr": _hostile_cards,
    "a.json": _hostile_json,
    "a.toml": _hostile_json,
    **dict.fromkeys(("a.h5", "a.nc"), _hostile_hdf5),
    **dict.fromkeys(("a.asdf", "local.asdf"), _hostile_asdf),
}


def test_that_what_is_opened_elsewhere_is_heard():
    with heard() as events:
        with suppress(OSError):  # there is no such server
            urllib.request.urlopen(AWAY)
        Path("/etc/passwd").read_bytes()
    assert {"urllib.Request", "socket.connect", "open"} <= {event.split()[0] for event in events}


@pytest.mark.parametrize("name", HOSTILE)
def test_no_command_opens_what_lies_elsewhere(name, tmp_path, capsys):
    """Neither a socket nor a file that the content of another one names."""
    path, config = tmp_path / name, tmp_path / "config.toml"
    HOSTILE[name](path)
    config.write_text(
        f'[data]\nmatches = "{name}"\nunit = "pix"\nsigma = 0.01\n'
        '[detector]\nname = "A"\nsize = [100, 100]\n[model]\norder = 1\n'
    )
    out = str(tmp_path / "out")
    with heard() as events:
        codes = [
            main(arguments)
            for arguments in (
                ["inspect", str(path)],
                ["check", str(path if name == "a.toml" else config)],
                ["init", f"{out}.toml", "--matches", str(path)],
                ["convert", str(path), "--to", "sip", "-o", f"{out}.hdr", "--size", "100", "100"],
                ["apply", str(path), str(path), "-o", f"{out}.csv"],
                ["compare", str(path), str(path)],
                ["report", str(path)],
            )
        ]
    assert events == []
    assert 70 not in codes
    capsys.readouterr()


@pytest.mark.parametrize("address", [AWAY, AWAY.replace("http", "ftp"), "s3://a/b", LOCAL])
def test_addresses_are_no_paths(address, tmp_path, capsys):
    """Only compute.scheduler names a place on the network."""
    config = tmp_path / "config.toml"
    config.write_text(
        f'[data]\nmatches = "{address}.parquet"\n[detector]\nname = "A"\nsize = [100, 100]\n'
        "[model]\norder = 1\n"
    )
    with heard() as events:
        assert main(["check", str(config)]) == 1
        assert main(["inspect", f"{address}.fits"]) == 1
    assert events == []
    assert "does not exist" in capsys.readouterr().err


def test_only_the_scheduler_that_is_named_is_connected_to(tmp_path):
    """And its workers, which hand over results themselves."""
    rng = np.random.default_rng(1)
    x, y = rng.uniform(1, 100, (2, 50))
    u, v = np.stack([x, y]) + rng.normal(0, 0.01, (2, 50))
    Table({"x": x, "y": y, "u": u, "v": v}).write(tmp_path / "a.csv")
    with LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, protocol="tcp", host="127.0.0.1",
        dashboard_address=None, silence_logs=logging.CRITICAL,
    ) as cluster:  # fmt: skip
        (tmp_path / "config.toml").write_text(
            '[data]\nmatches = "a.csv"\nunit = "pix"\nsigma = 0.01\n'
            '[detector]\nname = "A"\nsize = [100, 100]\n[model]\norder = 1\n'
            f'[compute]\nengine = "dask"\nscheduler = "{cluster.scheduler_address}"\n'
        )
        workers = [worker.address for worker in cluster.workers.values()]
        ports = {
            int(address.rpartition(":")[2]) for address in [cluster.scheduler_address, *workers]
        }
        with heard() as events:
            assert main(["stage", "fit", str(tmp_path), "-q"]) == 0
    assert "socket.connect" in {event.split()[0] for event in events}
    allowed = {f"('127.0.0.1', {port})" for port in ports}
    assert {event.partition(" ")[2] for event in events} <= allowed
