"""Limits that decide: each has its reason, is used, and stands in the documentation."""

from __future__ import annotations

from pathlib import Path

from bayesdist.utils import checks
from bayesdist.utils.checks import Limit

ROOT = Path(checks.__file__).parents[1]
DOCS = ROOT.parent / "docs" / "method.md"
ALL = {name: one for name, one in vars(checks).items() if isinstance(one, Limit)}


def test_a_limit_is_met_on_its_good_side_and_by_no_missing_number():
    most, least = Limit(2.0, "at most", "r"), Limit(2.0, "at least", "r")
    assert most.met_by(2.0) and most.met_by(1.0) and not most.met_by(2.1)
    assert least.met_by(2.0) and not least.met_by(1.0) and least.met_by(2.1)
    assert not most.met_by(float("nan")) and not least.met_by(float("nan"))
    assert most.words == "at most 2"


def test_every_limit_has_a_reason_and_is_used():
    code = [path.read_text(encoding="utf-8") for path in ROOT.rglob("*.py")]
    for name, one in ALL.items():
        assert one.sense in ("at most", "at least") and one.reason, name
        assert sum(name in text for text in code) > 1, name


def test_every_limit_stands_in_the_documentation():
    text = DOCS.read_text(encoding="utf-8")
    for name, one in ALL.items():
        assert f"| {name} | {one.words} | {one.reason} |" in text, name
