"""Measured figures stand in docs/measured.toml; README and documentation say the same."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from .benchmarks.measured import cell_of, with_measured

ROOT = Path(__file__).resolve().parents[1]
MEASURED = tomllib.loads((ROOT / "docs" / "measured.toml").read_text(encoding="utf-8"))
NUMBER = r"\d[\d.,]*\d|\d"
# what a figure that was measured looks like in a sentence
FIGURE = re.compile(rf"(?:{NUMBER})(?: (?:s|min|minutes|GB|MB|px|mas|times)\b| %)")


def sentence_of(phrase: str, entry: dict[str, str]) -> tuple[str, str]:
    """A phrase with its value, and the pattern of the same phrase with any value."""
    for other in re.findall(r"\{(\w+)\}", phrase):
        if other != "percent":
            phrase = phrase.replace(f"{{{other}}}", MEASURED[other]["value"])
    key = "{percent}" if "{percent}" in phrase else "{}"
    value = entry["percent"] if key == "{percent}" else entry["value"]
    before, _, after = phrase.partition(key)
    return before + value + after, f"{re.escape(before)}({NUMBER}){re.escape(after)}"


def wrong_figures(text: str, phrase: str, entry: dict[str, str]) -> list[str]:
    """Figures in a text that stand where the measured one should; "missing" without the phrase."""
    said, pattern = sentence_of(phrase, entry)
    found = re.findall(pattern, text)
    expected = re.search(pattern, said)
    assert expected, phrase
    return [one for one in found or ["missing"] if one != expected.group(1)]


def flowing(name: str) -> str:
    """A page with its lines joined."""
    return " ".join((ROOT / name).read_text(encoding="utf-8").replace("\n#  ", " ").split())


CLAIMS = [(key, *place) for key, entry in MEASURED.items() for place in entry["where"]]


@pytest.mark.parametrize(("key", "page", "phrase"), CLAIMS, ids=lambda x: x)
def test_pages_state_the_measured_figure(key, page, phrase):
    assert wrong_figures(flowing(page), phrase, MEASURED[key]) == []


@pytest.mark.parametrize("key", [key for key, entry in MEASURED.items() if "cell" in entry])
def test_benchmarks_have_the_measured_figure(key):
    page = (ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8")
    assert cell_of(page, MEASURED[key]["cell"]) == MEASURED[key]["value"]
    assert f"| revision | {MEASURED[key]['revision']} |" in page


@pytest.mark.parametrize("key", MEASURED)
def test_each_figure_says_what_and_how(key):
    entry = MEASURED[key]
    assert all(entry[name] for name in ("what", "value", "unit", "how", "revision", "where"))
    if "percent" in entry:
        assert float(entry["percent"]) == pytest.approx(100 * float(entry["value"]), abs=1e-9)


@pytest.mark.parametrize("name", ["README.md", "docs/other_tools.md", "docs/paper.md"])
def test_pages_that_compare_state_no_figure_that_is_not_measured(name):
    """Outside code and pictures; 68.3 % is the nominal probability of the intervals."""
    text = (ROOT / name).read_text(encoding="utf-8")
    text = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    text = " ".join(re.sub(r"^(?:    |!\[).*$", "", text, flags=re.MULTILINE).split())
    for key, page, phrase in CLAIMS:
        if page == name:
            text = text.replace(sentence_of(phrase, MEASURED[key])[0], "")
    assert set(FIGURE.findall(text)) <= {"68.3 %"}


def test_another_figure_would_be_refused():
    entry = {"value": "60"}
    phrase = "took {} s on two cores"
    assert wrong_figures("it took 60 s on two cores", phrase, entry) == []
    assert wrong_figures("it took 41 s on two cores", phrase, entry) == ["41"]
    assert wrong_figures("it took long", phrase, entry) == ["missing"]


def test_a_new_page_of_benchmarks_is_taken_over():
    """Value and revision of the entry with a cell; all else stays, comments too."""
    text = """# a comment
[slow]
value = "9 s"
revision = "a"

[fast]
what = "x"
value = "1.0"
revision = "a"
cell = ["Speed", "ours | 5", "s"]
"""
    page = "# P\n\n## Speed\n\n| who | N | s |\n|---|---|---|\n| ours | 5 | 0.70 |\n\n## End\n"
    expected = text.replace('"1.0"', '"0.70"').replace(
        'revision = "a"\ncell', 'revision = "b"\ncell'
    )
    assert with_measured(text, page, "b") == expected
    with pytest.raises(KeyError, match="no row"):
        with_measured(text, page.replace("ours", "theirs"), "b")
