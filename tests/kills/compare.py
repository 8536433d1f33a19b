"""Comparison of two run folders, apart from dates and durations."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from astropy.io import fits

TIMES = {"wall_s", "began", "created", "ended"}
# the log, the record and the report tell what happened when; chains are divided where they were
# interrupted, and the posterior has all of them
TELLING = re.compile(r"bayesdist\.log|run\.json|report\..*|figures/.*|chain-.*\.h5")


def assert_same(expected: Path, torn: Path) -> None:
    """All results are equal to the last bit, and nothing half-written is left behind."""
    names, got = (
        {str(p.relative_to(run)) for p in run.rglob("*") if p.is_file()} for run in (expected, torn)
    )
    assert {n for n in names ^ got if not n.startswith("chain-")} == set()
    for name in sorted(names):
        if not TELLING.fullmatch(name):
            assert _content(expected / name) == _content(torn / name), name


def assert_whole(run: Path, *, handled: bool) -> None:
    """Each file of a run that has been struck can be read to its end.

    `handled`: True if the process could tidy up, so that no temporary file may be left.
    """
    for path in run.rglob("*"):
        hidden = path.name.startswith(".")
        assert not (handled and hidden and path.is_file()), path
        if path.is_file() and not hidden:
            _content(path)


def _content(path: Path) -> Any:
    """Content of a file without dates and durations."""
    if path.suffix in (".h5", ".nc"):
        with h5py.File(path) as file:
            return dict(_items(file))
    if path.suffix == ".json":
        return _timeless(json.loads(path.read_text(encoding="utf-8")))
    if path.suffix == ".fits":
        with fits.open(path, checksum=True) as hdus:
            return [_hdu(hdu) for hdu in hdus]
    return path.read_bytes()


def _timeless(value: Any) -> Any:
    """JSON without dates and durations."""
    if isinstance(value, dict):
        return {k: _timeless(v) for k, v in value.items() if k not in TIMES}
    return [_timeless(v) for v in value] if isinstance(value, list) else value


def _items(file: h5py.File) -> Iterator[tuple[str, Any]]:
    """Arrays and attributes of an HDF5 file by their names."""
    nodes: dict[str, Any] = {"/": file}
    file.visititems(nodes.__setitem__)
    for name, node in nodes.items():
        for key, value in node.attrs.items():
            if key in TIMES or h5py.check_ref_dtype(_innermost(node.attrs.get_id(key).dtype)):
                continue
            if key == "provenance":
                continue
            yield f"{name}@{key}", _bits(value)
        if isinstance(node, h5py.Dataset) and name.rpartition("/")[2] not in TIMES:
            yield name, _bits(node[()])


def _innermost(kind: np.dtype) -> np.dtype:
    """Type of the elements of a type that may be a list or have fields."""
    kind = h5py.check_vlen_dtype(kind) or kind
    return next(iter(kind.fields.values()))[0] if getattr(kind, "fields", None) else kind


def _bits(value: Any) -> Any:
    """Value that is equal only if all bits are."""
    array = np.asarray(value)
    return array.tolist() if array.dtype.hasobject else (array.dtype.str, array.tobytes())


def _hdu(hdu: Any) -> tuple[list[str], Any]:
    """Cards without checksums, whose comments have dates, and the data of an HDU."""
    cards = [str(c) for c in hdu.header.cards if c.keyword not in ("CHECKSUM", "DATASUM", "DATE")]
    return cards, None if hdu.data is None else _bits(np.asarray(hdu.data))
