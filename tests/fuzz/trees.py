"""Damage to settings and records: TOML and JSON."""

from __future__ import annotations

import json
import tomllib
from typing import Any

from hypothesis import strategies as st

from bayesdist.app.store.record import digest_of
from tests.fuzz import values
from tests.fuzz.mutation import KNOWABLE, OPEN, changes

Path = list[Any]


def paths(tree: Any, at: Path | None = None) -> list[Path]:
    """Ways to everything in a tree."""
    at = at or []
    out = [at] if at else []
    if isinstance(tree, dict):
        for key, one in tree.items():
            out += paths(one, [*at, key])
    elif isinstance(tree, list):
        for k, one in enumerate(tree[:3]):
            out += paths(one, [*at, k])
    return out


def _changed(tree: Any, at: Path, change) -> Any:
    """The tree with something done where a way ends; as it was where there is no such place."""
    try:
        parent = tree
        for key in at[:-1]:
            parent = parent[key]
        change(parent, at[-1])
    except (KeyError, IndexError, TypeError):
        pass
    return tree


def _put(value: Any):
    def change(parent: Any, key: Any) -> None:
        parent[key] = value

    return change


def _drop(parent: Any, key: Any) -> None:
    del parent[key]


def _in(load, **more):
    def arguments(content: bytes):
        found = paths(load(content))
        return st.fixed_dictionaries({"at": st.sampled_from(found), **more}) if found else None

    return arguments


def _toml(content: bytes) -> Any:
    return tomllib.loads(content.decode())


def toml_value(value: Any) -> str:
    """A value as TOML, which has no null: a table that is empty stands for it."""
    if value is None:
        return "{}"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(k)} = {toml_value(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml_value, value)) + "]"
    if isinstance(value, float):
        return repr(value)
    return json.dumps(value, ensure_ascii=True)


def toml_text(tree: dict[str, Any]) -> bytes:
    lines = [f"{json.dumps(key)} = {toml_value(one)}" for key, one in tree.items()]
    return ("\n".join(lines) + "\n").encode()


KEYS = ["", "x", "sigma", "é", "a.b", "size", "unknown_key"]


@changes("wrong types", OPEN, "toml", arguments=_in(_toml, value=values.trees))
def setting_is(content, at, value):
    return toml_text(_changed(_toml(content), at, _put(value)))


@changes("lost fields", OPEN, "toml", arguments=_in(_toml))
def setting_lost(content, at):
    return toml_text(_changed(_toml(content), at, _drop))


@changes("unknown keys", KNOWABLE, "toml", arguments=_in(_toml, key=st.sampled_from(KEYS)))
def setting_more(content, at, key):
    def change(parent: Any, last: Any) -> None:
        if isinstance(parent, dict) and key not in parent:
            parent[key] = parent[last]

    return toml_text(_changed(_toml(content), at, change))


@changes("bomb", KNOWABLE, "toml", arguments=_in(_toml, mark=st.sampled_from(["[]", "{}"])))
def setting_deep(content, at, mark):
    inner = "[" * values.DEEP + "]" * values.DEEP
    if mark == "{}":
        inner = "{a=" * values.DEEP + "1" + "}" * values.DEEP
    return toml_text(_changed(_toml(content), at, _put("@@"))).replace(b'"@@"', inner.encode())


@changes("bomb", OPEN, "toml", arguments=_in(_toml))
def setting_enormous(content, at):
    """An integer of five thousand digits."""
    text = toml_text(_changed(_toml(content), at, _put("@@")))
    return text.replace(b'"@@"', b"9" * values.LONG)


# -- JSON -----------------------------------------------------------------------------------------


def _json_text(tree: Any) -> bytes:
    """As JSON; with the checksum of a run.json, so that what is behind it is tried as well."""
    if isinstance(tree, dict) and {"sha256", "artefacts"} <= tree.keys():
        tree["sha256"] = digest_of({key: one for key, one in tree.items() if key != "sha256"})
    return json.dumps(tree, indent=1).encode()


@changes("wrong types", OPEN, "json", arguments=_in(json.loads, value=values.trees))
def entry_is(content, at, value):
    return _json_text(_changed(json.loads(content), at, _put(value)))


@changes(
    "wrong types",
    KNOWABLE,
    "json",
    arguments=lambda c: st.fixed_dictionaries(
        {"value": st.sampled_from([None, [], {}, 0, "", "abc", True, [[]], {"a": None}])}
    ),
)
def whole_is(content, value):
    return _json_text(value)


@changes("lost fields", OPEN, "json", arguments=_in(json.loads))
def entry_lost(content, at):
    return _json_text(_changed(json.loads(content), at, _drop))


@changes("bomb", OPEN, "json", arguments=_in(json.loads))
def entry_deep(content, at):
    deep = "[" * 100_000 + "]" * 100_000
    return _json_text(_changed(json.loads(content), at, _put("@@"))).replace(b'"@@"', deep.encode())


@changes("bomb", OPEN, "json", arguments=_in(json.loads))
def entry_enormous(content, at):
    text = _json_text(_changed(json.loads(content), at, _put("@@")))
    return text.replace(b'"@@"', b"9" * values.LONG)
