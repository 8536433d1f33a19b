"""The page of messages quotes messages that the code has."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import bayesdist

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
# what pages and tables call a thing that has no one sentence
PARAPHRASED = {
    "an unknown key",
    "parameters are named as degenerate",
    "WARNING: quoted errors were multiplied",
    "more than half of the matches count as false",
    "exposures lie otherwise than their frames allow",
    "undecided",
}


def texts_of_the_package() -> str:
    """All texts in the code one after the other; where a number is put in stands a blank."""
    parts = []
    for path in sorted(Path(bayesdist.__file__).parent.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                parts.append(node.value)
            elif isinstance(node, ast.JoinedStr):
                parts.append("".join(_text(value) for value in node.values))
    return "\n".join(" ".join(part.split()) for part in parts)


def _text(node: ast.expr) -> str:
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else " "


def messages() -> list[str]:
    """First cells of the tables of messages."""
    cells = re.findall(r"^\| ([^|]+) \|", PAGE, re.MULTILINE)
    return [cell for cell in cells if cell not in ("message",)]


def test_each_message_is_one_of_the_package():
    known = texts_of_the_package()
    assert len(messages()) > 30
    for message in messages():
        if message not in PARAPHRASED:
            for fragment in re.split(r"\.\.\.|'\w+'|nan", message):
                assert fragment.strip(" ,:;") in known, message


def test_paraphrases_are_used():
    assert set(messages()) >= PARAPHRASED
