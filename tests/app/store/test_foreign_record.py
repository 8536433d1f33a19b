"""run.json is as foreign as any other file: a record, or one sentence."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from typing import Any

import pytest
from pydantic import TypeAdapter

from bayesdist.app.store import Record
from bayesdist.app.store.record import SCHEMA, digest_of
from bayesdist.app.store.summary import Summary
from bayesdist.errors import InputError
from bayesdist.files.documents import model_of

WHOLE: dict[str, Any] = {
    "schema": SCHEMA,
    "config": {"data": {"matches": "a.ecsv"}},
    "base": "/data",
    "inputs": {"/data/a.ecsv": "0" * 64},
    "seed": 1,
    "versions": {"bayesdist": "0.1"},
    "command": "bayesdist run",
    "created": "2026-01-01",
    "stages": {"fit": {"wall_s": 1.0, "ended": "2026-01-01"}},
    "artefacts": {
        "fit": {
            "key": "a",
            "parts": {"revision": 1},
            "files": {"fit.nc": {"size": 3, "sha256": "0" * 64}},
            "sections": {
                "data": {
                    "n_rows": 3,
                    "n_used": 3,
                    "n_rejected": 0,
                    "rejected": {},
                    "n_exposures": 1,
                    "sources": ["a.ecsv"],
                    "tangent_point": None,
                }
            },
        }
    },
    "under_way": {"stage": "sample", "files": ["posterior.nc"]},
    "checkpoints": {"sample": "a"},
}
VALUES = (None, [], {}, "text", -1, 1e300, [None], {"a": [1]}, True)


def _text(tree: dict[str, Any]) -> str:
    """With its checksum, as whoever makes such a file can give it."""
    return json.dumps(tree | {"sha256": digest_of(tree)})


def _places(tree: Any, above: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    inner = tree.items() if isinstance(tree, dict) else enumerate(tree)
    for key, value in inner:
        yield (*above, key)
        if isinstance(value, dict | list):
            yield from _places(value, (*above, key))


def _replaced(place: tuple[Any, ...], value: Any) -> Any:
    tree = inner = copy.deepcopy(WHOLE)
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    return tree


def test_a_record_is_read_as_it_was_written(tmp_path):
    path = tmp_path / "run.json"
    path.write_text(_text(WHOLE))
    record = Record.read(path)
    record.write(path)
    assert json.loads(path.read_text()) == json.loads(_text(WHOLE))


def test_a_record_that_was_edited_is_refused(tmp_path):
    path = tmp_path / "run.json"
    Record({"config": {"scale": 1.5}}).write(path)
    assert Record.read(path).facts == {"config": {"scale": 1.5}}
    path.write_text(path.read_text().replace("1.5", "1.6"))
    with pytest.raises(InputError, match=r"run\.json: was changed since .*; restore it"):
        Record.read(path)


@pytest.mark.parametrize("place", list(_places(WHOLE)), ids=lambda p: ".".join(map(str, p)))
def test_any_other_value_anywhere(tmp_path, place):
    """It is read where a value of that kind may stand there, and can be written again."""
    path = tmp_path / "run.json"
    for value in VALUES:
        path.write_text(_text(_replaced(place, value)))
        sentence = ""
        try:
            Record.read(path).write(path)
        except InputError as error:
            sentence = str(error)
        assert not sentence or (sentence.startswith(f"{path}: ") and "\n" not in sentence)


@pytest.mark.parametrize("place", list(_places(WHOLE)), ids=lambda p: ".".join(map(str, p)))
def test_a_number_in_place_of_a_table_or_a_list_is_refused(tmp_path, place):
    found = WHOLE
    for key in place:
        found = found[key]
    if not isinstance(found, dict | list | str) or place[:1] == ("config",) or "parts" in place[3:]:
        return
    path = tmp_path / "run.json"
    path.write_text(_text(_replaced(place, 1.5)))
    with pytest.raises(InputError, match=r"run\.json: is not as bayesdist wrote it \("):
        Record.read(path)


@pytest.mark.parametrize("text", ["[]", "null", "3", '"a"', "{}", "", "{", "[" * 100_000])
def test_what_is_no_record(tmp_path, text):
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(InputError, match=r"run\.json: is not .*; restore it"):
        Record.read(tmp_path / "run.json")


@pytest.mark.parametrize("tree", [[], None, {}, {"schema": 2, "data": []}])
def test_what_is_no_summary(tree):
    with pytest.raises(InputError, match=r"summary\.json: is not as bayesdist wrote it"):
        model_of(TypeAdapter(Summary), tree, "summary.json", do="resume the run")
