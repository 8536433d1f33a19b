"""Figures of the benchmarks that other pages state: taken from the page into measured.toml."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence

__all__ = ["cell_of", "with_measured"]

_ENTRY = r"(?ms)^\[{}\]\n.*?(?=^\[|\Z)"


def cell_of(page: str, place: Sequence[str]) -> str:
    """Text of a cell of the page by its heading, the beginning of its row, and its column.

    KeyError where the page has none.
    """
    heading, beginning, column = place
    section = page.partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    heads: list[str] = []
    for line in section.splitlines():
        cells = [cell.strip() for cell in line.strip("| ").split(" | ")]
        if not line.startswith("|"):
            heads = []
        elif not heads:
            heads = cells
        elif column in heads and line.startswith(f"| {beginning} |"):
            return cells[heads.index(column)]
    raise KeyError(f"no row {beginning!r} with a column {column!r} under {heading!r}")


def with_measured(text: str, page: str, revision: str) -> str:
    """The text of measured.toml with the figures of a page of benchmarks, and their revision."""
    for key, entry in tomllib.loads(text).items():
        if "cell" not in entry:
            continue
        found = re.search(_ENTRY.format(re.escape(key)), text)
        assert found, key
        new = found.group()
        for name, value in (("value", cell_of(page, entry["cell"])), ("revision", revision)):
            new = re.sub(rf'(?m)^{name} = ".*"$', f'{name} = "{value}"', new)
        text = text[: found.start()] + new + text[found.end() :]
    return text
