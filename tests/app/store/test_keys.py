"""What is in a key, and how differences are said."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from bayesdist.app.config import parse_config
from bayesdist.app.store import differences
from bayesdist.app.store.record import as_json, difference, digest_of
from tests.app.support import config_text


@dataclass(frozen=True)
class Settings:
    order: int
    size: tuple[float, float]


def test_equal_values_have_equal_keys():
    one = {"b": np.float64(0.5), "a": Settings(2, (1.0, 2.0)), "path": Path("x") / "y"}
    other = {"a": {"size": [1.0, 2.0], "order": 2}, "path": "x/y", "b": 0.5}
    assert digest_of(one) == digest_of(other)
    assert digest_of(one) != digest_of(other | {"b": 0.5000000001})
    config = parse_config(config_text(), "c.toml")
    assert digest_of(config) == digest_of(config.model_dump())


def test_a_value_of_unknown_content_is_in_no_key():
    for value in (object(), open, {1, 2}, {"a": [lambda: None]}, Settings(2, {1.0})):
        with pytest.raises(TypeError, match="cannot be in a record or a key"):
            as_json(value)


def test_differences_are_said_by_key_and_value():
    known = {"assess": {"grid": [33, 17]}, "budget": [{"sigma": 1.0}, {"sigma": 2.0}], "a": None}
    now = {"assess": {"grid": [65, 33]}, "budget": [{"sigma": 1.0}, {"sigma": 3.0}], "a": None}
    assert list(differences(known, now)) == [
        ("assess.grid", [33, 17], [65, 33]),
        ("budget[2].sigma", 2.0, 3.0),
    ]
    assert difference(known, now) == "assess.grid [33, 17] is now [65, 33]"
    assert difference(known, known) == ""
    assert difference({}, {"periods": {"days": 5.0}}) == 'periods none is now {"days": 5.0}'
    assert difference({"from": {"fit": "1"}}, {"from": {"fit": "2"}}) == "fit has other results"
    assert difference({"budget": [{"sigma": 1.0}]}, {"budget": []}).startswith("budget [{")
